"""Makes a test scene in Blender; run by Blender's Python, not by pytest.

Usage: python blender_room.py FOLDER. Writes room.blend, room.usdc and room.glb; what Cycles renders of frame 1
(cycles.exr, and lamps.exr with what glTF holds of the light); and facts.json: the camera's pose at each frame, and
where the patches are in the picture.
"""

import json
import math
import sys
from pathlib import Path

import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

FOLDER = Path(sys.argv[-1])
WIDTH, HEIGHT, FRAMES, FPS = 160, 100, 25, 24
ALBEDO = (
    (0.8, 0.8, 0.8),
    (0.6, 0.1, 0.1),
    (0.1, 0.5, 0.1),
    (0.1, 0.15, 0.7),
    (0.4, 0.4, 0.4),
    (0.7, 0.6, 0.2),
)


def picture(name, width, height, colour, file_format):
    image = bpy.data.images.new(name, width, height, float_buffer=file_format == "OPEN_EXR")
    image.colorspace_settings.name = "sRGB" if file_format == "PNG" else "Linear Rec.709"
    image.pixels = [
        value for y in range(height) for x in range(width) for value in (*colour(x / width, y / height), 1.0)
    ]
    image.filepath_raw = str(FOLDER / "textures" / name)
    image.file_format = file_format
    image.save()
    return image


def material(name, **inputs):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    surface = made.node_tree.nodes["Principled BSDF"]
    for key, value in inputs.items():
        surface.inputs[key.replace("_", " ")].default_value = value
    return made, surface


def matte(name, colour):
    return material(name, Base_Color=(*colour, 1), Roughness=1.0, Specular_IOR_Level=0.0)[0]


def put(add, name, surface, **where):
    add(**where)
    made = bpy.context.object
    made.name = name
    if surface is not None:
        made.data.materials.append(surface)
    return made


def lamp(kind, name, location, **properties):
    light = bpy.data.lights.new(name, kind)
    for key, value in properties.items():
        setattr(light, key, value)
    made = bpy.data.objects.new(name, light)
    made.location = location
    bpy.context.collection.objects.link(made)
    return made


def build():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    (FOLDER / "textures").mkdir(parents=True, exist_ok=True)
    mesh = bpy.ops.mesh
    floor, surface = material("Boden, geölt", Roughness=1.0, Specular_IOR_Level=0.0)
    tiles = floor.node_tree.nodes.new("ShaderNodeTexImage")
    tiles.image = picture(
        "Fliesen hell.png",
        64,
        64,
        lambda x, y: (0.7, 0.6, 0.5) if (x < 0.5) == (y < 0.5) else (0.3, 0.3, 0.35),
        "PNG",
    )
    floor.node_tree.links.new(tiles.outputs["Color"], surface.inputs["Base Color"])
    put(mesh.primitive_plane_add, "Floor", floor, size=10)
    pane, _ = material("Glass", Transmission_Weight=1.0, Roughness=0.0, IOR=1.5)
    put(mesh.primitive_cube_add, "Pane", pane, size=1, location=(0, -1.6, 1.9)).scale = (0.8, 0.02, 0.8)
    for number, colour in enumerate(ALBEDO):
        x = (number - 2.5) * 1.0
        put(
            mesh.primitive_cube_add,
            f'Patch "{number}" Süd',
            matte(f"patch {number}", colour),
            size=0.7,
            location=(x, 1.2, 0.35),
        )
    ball = put(
        mesh.primitive_uv_sphere_add,
        "Ball",
        matte("ball", (0.5, 0.5, 0.5)),
        radius=0.25,
        location=(-2, -1, 0.25),
    )
    for number in range(3):
        twin = bpy.data.objects.new(f"Ball twin {number}", ball.data)
        twin.location = (-2.4 + 2.2 * number, -0.2, 0.25)
        bpy.context.collection.objects.link(twin)
    add_stools()
    lamp(
        "AREA",
        "Area lamp",
        (0, 0, 3),
        energy=80,
        shape="RECTANGLE",
        size=1.2,
        size_y=0.6,
        color=(1, 0.9, 0.8),
    )
    lamp("POINT", "Bulb", (-2, 0.3, 1.8), energy=60, shadow_soft_size=0.1)
    lamp("SUN", "Sun", (0, 0, 5), energy=1.5, angle=math.radians(2)).rotation_euler = (0.6, 0.3, 0)
    world = bpy.data.worlds.new("World")
    bpy.context.scene.world = world
    world.use_nodes = True
    sky = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    sky.image = picture(
        "sky.exr",
        64,
        32,
        lambda x, y: (0.1 + 0.4 * x, 0.15 + 0.15 * y, 0.5 - 0.4 * x) if y > 0.5 else (0.05, 0.05, 0.05),
        "OPEN_EXR",
    )
    world.node_tree.links.new(sky.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 1.0


def add_stools():
    """A collection that is placed twice."""
    stool = bpy.data.collections.new("Stool")
    wood = matte("stool", (0.3, 0.2, 0.1))
    for number, height in enumerate((0.1, 0.3)):
        add = bpy.ops.mesh.primitive_cube_add
        put(add, f"Stool {number}", wood, size=0.2, location=(0, 0, height))
        block = bpy.context.object
        for holder in list(block.users_collection):
            holder.objects.unlink(block)
        stool.objects.link(block)
    for number in range(2):
        copy = bpy.data.objects.new(f"Stool copy {number}", None)
        copy.instance_type, copy.instance_collection = "COLLECTION", stool
        copy.location = (3.2, -0.5 - number, 0)
        bpy.context.collection.objects.link(copy)


def animate():
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    scene.render.fps = FPS
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = (
        WIDTH,
        HEIGHT,
        100,
    )
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    dolly = bpy.data.objects.new("Dolly", None)
    for made in (camera, dolly):
        bpy.context.collection.objects.link(made)
    camera.parent = dolly
    scene.camera = camera
    camera.location, camera.rotation_euler = (0, -6, 1.9), (math.radians(78), 0, 0)
    camera.data.lens = 32
    for frame, (turn, lens) in ((1, (0.0, 30)), (13, (0.5, 35)), (25, (-0.3, 50))):
        dolly.rotation_euler = (0, 0, turn)
        dolly.keyframe_insert("rotation_euler", frame=frame)
        camera.data.lens = lens
        camera.data.keyframe_insert("lens", frame=frame)
        camera.location = (turn, -6 + turn, 1.9)
        camera.keyframe_insert("location", frame=frame)


def facts():
    scene = bpy.context.scene
    poses, angles = [], []
    for frame in range(1, FRAMES + 1):
        scene.frame_set(frame)
        bpy.context.view_layer.update()
        poses.append([list(row) for row in scene.camera.matrix_world])
        angles.append(math.degrees(scene.camera.data.angle_x))
    scene.frame_set(1)
    bpy.context.view_layer.update()
    patches = []
    for number in range(len(ALBEDO)):
        x = (number - 2.5) * 1.0
        corners = [Vector((x + dx, 0.85, z)) for dx in (-0.25, 0.25) for z in (0.1, 0.6)]
        seen = [world_to_camera_view(scene, scene.camera, corner) for corner in corners]
        left, right = max(seen[i].x for i in (0, 1)), min(seen[i].x for i in (2, 3))
        bottom, top = max(seen[i].y for i in (0, 2)), min(seen[i].y for i in (1, 3))
        patches.append([left, 1 - top, right, 1 - bottom])
    pane = [
        world_to_camera_view(scene, scene.camera, Vector((dx, -1.62, z)))
        for dx, z in ((-0.3, 1.6), (0.3, 2.2))
    ]
    return {
        "poses": poses,
        "fov": angles,
        "fps": FPS,
        "size": [WIDTH, HEIGHT],
        "patches": patches,
        "pane": [pane[0].x, 1 - pane[1].y, pane[1].x, 1 - pane[0].y],
    }


def render(name):
    scene = bpy.context.scene
    scene.frame_set(1)
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.samples, cycles.use_denoising, cycles.use_adaptive_sampling = 128, False, False
    cycles.max_bounces = cycles.transmission_bounces = cycles.glossy_bounces = 12
    cycles.diffuse_bounces = 2
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.blur_glossy = 0
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(FOLDER / name)
    bpy.ops.render.render(write_still=True)


build()
animate()
(FOLDER / "facts.json").write_text(json.dumps(facts()))
bpy.ops.wm.save_as_mainfile(filepath=str(FOLDER / "room.blend"))
bpy.ops.file.make_paths_relative()
bpy.ops.wm.save_mainfile()
bpy.ops.wm.usd_export(
    filepath=str(FOLDER / "room.usdc"),
    export_animation=True,
    generate_materialx_network=True,
    use_instancing=True,
)
bpy.ops.export_scene.gltf(
    filepath=str(FOLDER / "room.glb"),
    export_lights=True,
    export_cameras=True,
    export_yup=True,
    export_animations=True,
)
render("cycles.exr")
bpy.data.objects["Area lamp"].hide_render = True
bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
render("lamps.exr")
