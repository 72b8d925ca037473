"""Exports a .blend file for `scenes.blender`; run by Blender's own Python in a separate process, never imported.

Writes `scene.usdc` with the meshes, materials and lights of the first frame, `world.exr` with the environment, and
`facts.json` with what USD does not hold: every camera in every frame, the size of the picture, and what is lost.

Usage: python blender_export.py FILE.blend FOLDER (or `blender --background --python blender_export.py -- ...`).
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

_WORLD_WIDTH = 1024
_LEAST_OF_IMAGES = 512
_WIDEST_WORLD = 4096
_WORLD_SAMPLES = 4
_OF_IMAGES = {"TEX_ENVIRONMENT", "BACKGROUND", "OUTPUT_WORLD", "MAPPING", "TEX_COORD", "FRAME", "REROUTE"}
_SHOWN = {"MESH", "CURVE", "SURFACE", "FONT", "META", "LIGHT"}
_SAME = 1e-6


def export(file: Path, folder: Path) -> None:
    """Export the active scene of a file."""
    bpy.ops.wm.open_mainfile(filepath=str(file), load_ui=False, use_scripts=False)
    scene = bpy.context.scene
    facts: dict[str, Any] = {
        "blender": bpy.app.version_string,
        "camera": scene.camera.name if scene.camera else None,
        "size": _size(scene),
        "fps": scene.render.fps / scene.render.fps_base,
        "files": _files(),
        "notes": [],
    }
    facts["cameras"], moving = _over_time(scene)
    facts["notes"] += [["left out", name, "its motion: it stays as in the first frame"] for name in moving]
    facts["notes"] += _lost(scene)
    _show_what_renders(scene)
    _write_stage(folder)
    facts["world"] = _world(scene, folder)
    (folder / "facts.json").write_text(json.dumps(facts))


def _files() -> list[str]:
    """Absolute paths of the image files and linked scenes that the file refers to, wherever they are used."""
    images = [
        image.filepath
        for image in bpy.data.images
        if image.source in {"FILE", "SEQUENCE", "TILED"} and image.packed_file is None and image.users
    ]
    used = [name for name in [*images, *(library.filepath for library in bpy.data.libraries)] if name]
    return sorted({str(Path(bpy.path.abspath(name)).resolve()) for name in used})


def _size(scene: Any) -> list[int]:
    share = scene.render.resolution_percentage / 100
    return [
        max(1, round(scene.render.resolution_x * share)),
        max(1, round(scene.render.resolution_y * share)),
    ]


def _over_time(scene: Any) -> tuple[dict[str, list[Any]], list[str]]:
    """Every camera in every frame, and the names of other objects that move."""
    cameras: dict[str, list[Any]] = {thing.name: [] for thing in scene.objects if thing.type == "CAMERA"}
    first: dict[str, list[float]] = {}
    moving: set[str] = set()
    frames = range(scene.frame_start, scene.frame_end + 1)
    animated = any(True for _ in _animations())
    for frame in frames if animated else [scene.frame_current]:
        scene.frame_set(frame)
        for thing in scene.objects:
            if thing.type == "CAMERA":
                cameras[thing.name].append(_view(scene, thing))
            elif thing.type in _SHOWN and not thing.hide_render:
                place = [value for row in thing.matrix_world for value in row]
                before = first.setdefault(thing.name, place)
                if max(abs(a - b) for a, b in zip(place, before, strict=True)) > _SAME:
                    moving.add(thing.name)
    scene.frame_set(scene.frame_start if animated else scene.frame_current)
    return cameras, sorted(moving)


def _animations() -> Iterator[Any]:
    """Animation data that may make anything differ between frames."""
    for kind in (
        "objects",
        "cameras",
        "lights",
        "worlds",
        "meshes",
        "shape_keys",
        "node_groups",
        "materials",
    ):
        for item in getattr(bpy.data, kind, ()):
            if item.animation_data is not None or getattr(item, "constraints", None):
                yield item
    yield from bpy.data.actions


def _view(scene: Any, thing: Any) -> dict[str, Any]:
    """A camera at one time: its pose, what it sees at a distance of 1, and its lens."""
    lens = thing.data
    corners = [list(corner) for corner in lens.view_frame(scene=scene)]
    flat = lens.type == "ORTHO"
    depth = 1.0 if flat else -corners[0][2]
    across = [corner[0] / depth for corner in corners]
    up = [corner[1] / depth for corner in corners]
    view = {
        "to_world": [list(row) for row in thing.matrix_world],
        "kind": lens.type,
        "window": [min(across), max(across), min(up), max(up)],
        "clip": [lens.clip_start, lens.clip_end],
    }
    if lens.dof.use_dof and not flat:
        focus = lens.dof.focus_distance
        if lens.dof.focus_object is not None:
            there = thing.matrix_world.inverted() @ lens.dof.focus_object.matrix_world.translation
            focus = -there[2]
        view["lens"] = [lens.lens / 1000 / lens.dof.aperture_fstop / 2, focus]
    return view


def _lost(scene: Any) -> list[list[str]]:
    """Notes on what the export does not hold, as [kind, where, text]."""
    notes = []
    for thing in scene.objects:
        if thing.hide_render:
            continue
        if thing.type == "LIGHT":
            notes += [[kind, thing.name, text] for kind, text in _lost_of_light(thing.data)]
        elif thing.type == "CAMERA" and thing.data.type not in {"PERSP", "ORTHO"}:
            notes.append(["left out", thing.name, "a panoramic camera; use a perspective one"])
        elif thing.type in {"VOLUME", "POINTCLOUD", "CURVES", "GREASEPENCIL"}:
            notes.append(
                ["left out", thing.name, f"an object of type {thing.type.lower()}; convert it to a mesh"]
            )
        if any(system.settings.type == "HAIR" for system in getattr(thing, "particle_systems", ())):
            notes.append(["left out", thing.name, "its hair"])
    if scene.world is not None and scene.world.node_tree is not None:
        outputs = [node for node in scene.world.node_tree.nodes if node.type == "OUTPUT_WORLD"]
        if any(node.inputs["Volume"].is_linked for node in outputs):
            notes.append(["left out", scene.world.name, "its fog; participating media are not rendered"])
    if scene.view_settings.exposure or scene.view_settings.gamma != 1:
        notes.append(["left out", "colour management", "its exposure and gamma; frames are scene-linear"])
    return notes


def _lost_of_light(light: Any) -> Iterator[tuple[str, str]]:
    """The same for one light, as (kind, text)."""
    if light.type == "AREA" and light.shape == "ELLIPSE":
        yield "approximated", "an ellipse: becomes a disk of the mean diameter"
    if light.type == "AREA" and light.spread < math.pi - 1e-3:
        yield "left out", f"its spread of {math.degrees(light.spread):.0f}°: it emits in all directions"
    if light.use_nodes and light.node_tree is not None:
        output = [
            node for node in light.node_tree.nodes if node.type == "OUTPUT_LIGHT" and node.is_active_output
        ]
        source = output[0].inputs["Surface"].links if output else ()
        if source and (
            source[0].from_node.type != "EMISSION"
            or any(entry.is_linked for entry in source[0].from_node.inputs)
            or abs(source[0].from_node.inputs["Strength"].default_value - 1) > 1e-6
        ):
            yield "left out", "its nodes (textures, IES profiles, falloff): only colour and power are used"
    if not light.use_shadow:
        yield "left out", "its setting to cast no shadows"


def _show_what_renders(scene: Any) -> None:
    """Make viewport visibility equal to render visibility, so that exactly what renders is exported."""
    for thing in scene.objects:
        if thing.hide_render != thing.hide_viewport:
            thing.hide_viewport = thing.hide_render
        if thing.hide_get() != thing.hide_render:
            thing.hide_set(thing.hide_render)


def _write_stage(folder: Path) -> None:
    """Export meshes, materials and lights."""
    wanted = {
        "export_animation": False,
        "evaluation_mode": "RENDER",
        "generate_materialx_network": True,
        "export_subdivision": "TESSELLATE",
        "use_instancing": True,
        "convert_world_material": False,
        "export_cameras": False,
        "export_armatures": False,
        "export_textures_mode": "NEW",
        "export_textures": True,
        "overwrite_textures": True,
        "relative_paths": True,
        "visible_objects_only": True,
    }
    known = bpy.ops.wm.usd_export.get_rna_type().properties.keys()
    options = {name: value for name, value in wanted.items() if name in known}
    bpy.ops.wm.usd_export(filepath=str(folder / "scene.usdc"), **options)


def _world(scene: Any, folder: Path) -> list[float] | str | None:
    """The environment: [r, g, b] if it is even, the name of an image of it, or None."""
    world = scene.world
    if world is None:
        return None
    even = _even(world)
    if even is not None:
        return even
    _bake(scene, folder / "world.exr")
    return "world.exr"


def _even(world: Any) -> list[float] | None:
    """The radiance of a world that is the same in all directions; None if it may not be."""
    tree = world.node_tree
    if tree is None or not getattr(world, "use_nodes", True):
        return list(world.color)
    outputs = [node for node in tree.nodes if node.type == "OUTPUT_WORLD" and node.is_active_output]
    if not outputs or not outputs[0].inputs["Surface"].is_linked:
        return [0.0, 0.0, 0.0]
    source = outputs[0].inputs["Surface"].links[0].from_node
    if source.type != "BACKGROUND" or any(entry.is_linked for entry in source.inputs):
        return None
    strength = source.inputs["Strength"].default_value
    return [value * strength for value in list(source.inputs["Color"].default_value)[:3]]


def _bake(scene: Any, path: Path) -> None:
    """Render a panorama of the world alone, with x in the middle."""
    images = [
        node.image
        for node in scene.world.node_tree.nodes
        if node.type == "TEX_ENVIRONMENT" and node.image is not None
    ]
    sizes = [image.size[0] for image in images if image.size[0] > 0]
    only_images = {node.type for node in scene.world.node_tree.nodes} <= _OF_IMAGES
    least = _LEAST_OF_IMAGES if sizes and only_images else _WORLD_WIDTH
    width = min(_WIDEST_WORLD, max([least, *sizes]))
    alone = bpy.data.scenes.new("steadylight world")
    alone.world = scene.world
    lens = bpy.data.cameras.new("steadylight world")
    lens.type = "PANO"
    for holder in (lens, getattr(lens, "cycles", None)):
        if holder is not None and hasattr(holder, "panorama_type"):
            holder.panorama_type = "EQUIRECTANGULAR"
    camera = bpy.data.objects.new("steadylight world", lens)
    camera.rotation_euler = (math.pi / 2, 0, -math.pi / 2)
    alone.collection.objects.link(camera)
    alone.camera = camera
    render = alone.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, width // 2, 100
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_mode = "RGB"
    render.image_settings.color_depth = "32"
    render.filepath = str(path)
    render.film_transparent = False
    cycles = alone.cycles
    cycles.device = "CPU"
    cycles.samples, cycles.use_denoising, cycles.use_adaptive_sampling = _WORLD_SAMPLES, False, False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.pixel_filter_type = "BOX"
    bpy.ops.render.render(write_still=True, scene=alone.name)


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    export(Path(given[0]), Path(given[1]))
