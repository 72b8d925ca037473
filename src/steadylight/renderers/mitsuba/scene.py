"""Build Mitsuba's scene and sensor from a plain description, once per process.

All functions require that the caller has set Mitsuba's variant.
"""

from __future__ import annotations

import gc
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from steadylight.errors import SceneError
from steadylight.scenes import without_light
from steadylight.scenes.image_texture import texels
from steadylight.scenes.mitsuba_faults import explain_fault
from steadylight.scenes.mitsuba_plugins import refusal, refusals, supported

if TYPE_CHECKING:
    import mitsuba as mi
    from numpy.typing import NDArray

    from steadylight.camera import Pose
    from steadylight.renderers.mitsuba.merged_meshes import Parts
    from steadylight.scenes.description import SceneDescription

_EMITTED = re.compile(r"^(radiance|irradiance|intensity|data|scale)(\.(value|values|data|scale))?$")
"""Parameters of Mitsuba's emitters that scale their emission."""

_TRIANGLES = {"type", "vertices", "faces", "normals", "uv", "colors", "bsdf", "emitter"}

_AS_OBJECTS = {"shapegroup", "obj", "ply", "serialized", "cube"}
"""Entries that are built before the scene: groups, or the instances that refer to one would build its meshes again; and
meshes, to be merged."""

_LOOK_UP = {"wrap_mode", "filter_type", "to_uv"}
"""Properties of an image texture that control how it is looked up."""


@contextmanager
def reading_images() -> Iterator[None]:
    """Give Dr.Jit a second thread while Mitsuba may read OpenEXR images.

    Mitsuba decodes them on Dr.Jit's threads and waits without helping. With a single thread, as in a worker that shares
    its machine, it would wait forever.
    """
    import drjit as dr

    threads = dr.thread_count()
    dr.set_thread_count(max(threads, 2))
    try:
        yield
    finally:
        dr.set_thread_count(threads)


class _Built(NamedTuple):
    """A scene, what it was built from, and the parts of merged meshes by name."""

    variant: str
    description: SceneDescription
    scene: mi.Scene
    parts: Mapping[str, Parts]

    def made_from(self, description: SceneDescription, variant: str) -> bool:
        return self.description is description and self.variant == variant


_LAST: list[_Built] = []
"""The scene that was built last, or none."""


def build_scene(description: SceneDescription, integrator: Any = None) -> mi.Scene:
    """Build Mitsuba's scene, on the current variant, unless it is the one that was built last.

    Checks, surveys, previews and frames of one process share a scene. It is kept until another is built, or `release`.

    The scene is loaded serially, so that plugins get the same numbers in every process and cached kernels are found
    again. Meshes of one material are merged (see `merged_meshes`).

    Plugins keep their numbers until Python has collected their scene, and until then each kernel contains the code of
    all of them. Unused scenes are therefore collected first.

    Args:
        description: the scene as plain data.
        integrator: the scene's integrator, as an object or a dict; Mitsuba's default if None.

    Raises:
        SceneError: Mitsuba refused something in the description.
    """
    import mitsuba as mi

    from steadylight.renderers.mitsuba.merged_meshes import merge_meshes

    if integrator is None and _LAST and _LAST[0].made_from(description, mi.variant()):
        return _LAST[0].scene
    _free()
    try:
        with reading_images():
            content, parts = merge_meshes(_Builder(description.content).scene())
            # Otherwise Mitsuba would add a sensor of its own, with a warning; a fixed view is the same for all frames.
            content["steadylight_sensor"] = build_sensor(description, description.camera.pose(0.0), 8, 8)
            if integrator is not None:
                content["steadylight_integrator"] = integrator
            scene = mi.load_dict({"type": "scene", **content}, parallel=False, optimize=False)
    except (RuntimeError, ValueError) as error:
        raise SceneError(f"scene {description.name}: {explain_fault(error)}") from error
    if integrator is None:
        _LAST.append(_Built(mi.variant(), description, scene, parts))
    return scene


def parts_of_meshes(description: SceneDescription) -> Mapping[str, Parts]:
    """What the meshes of `build_scene` were merged from, by name; those that were not merged are left out."""
    build_scene(description)
    return _LAST[0].parts


def release() -> None:
    """Let go of the scene that was built last."""
    if _LAST:  # otherwise, Mitsuba may not even be loaded
        _free()


def _free() -> None:
    """Collect unused scenes, and that which was built last. Recordings keep theirs alive, so they go first."""
    from steadylight.renderers.mitsuba.frozen import forget_recordings

    _LAST.clear()
    forget_recordings()
    gc.collect()


def check_scene(description: SceneDescription) -> None:
    """Build the scene, so that errors in it are found before anything starts.

    Raises:
        SceneError: something in the scene is not supported, or there is no emitter.
    """
    for reason in refusals(description.content):
        raise SceneError(f"scene {description.name}: {reason}")
    scene = build_scene(description)
    if not scene.emitters():
        raise SceneError(without_light(description))
    if not scene.shapes():
        raise SceneError(f"scene {description.name}: has no shapes")
    _check_emitters(description.name, scene)


def _check_emitters(name: str, scene: mi.Scene) -> None:
    """Reject emission that is negative, not finite, or zero everywhere."""
    import mitsuba as mi

    dark = True
    for emitter in scene.emitters():
        shape = emitter.get_shape() if mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface) else None
        parameters = mi.traverse(emitter)
        factors = []
        for key in filter(_EMITTED.search, parameters.properties):
            values = _numbers(parameters[key])
            wrong = values[~(np.isfinite(values) & (values >= 0))]
            if len(wrong):
                owner = emitter.id() if shape is None else shape.id()
                raise SceneError(
                    f"scene {name}: emitter of `{owner}`: {key} has the value {wrong[0]:g}; light must be finite and "
                    "not negative"
                )
            factors.append(bool((values > 0).any()))
        dark = dark and bool(factors) and not all(factors)
    if dark:
        raise SceneError(f"scene {name}: all emitters have the value 0, so that every frame would be black")


def _numbers(parameter: Any) -> NDArray[np.float64]:
    """All numbers of a parameter; a vector component by component, which takes no kernel."""
    import drjit as dr

    parts = list(parameter) if dr.is_vector_v(parameter) else [parameter]
    return np.concatenate([np.ravel(np.array(part, np.float64)) for part in parts])


def build_sensor(
    description: SceneDescription,
    pose: Pose,
    width: int,
    height: int,
    rfilter: Mapping[str, Any] | None = None,
) -> mi.Sensor:
    """The scene's sensor at a pose, with an RGB float32 film.

    Args:
        description: determines the type of sensor and its reconstruction filter.
        pose: camera pose; the field of view has no effect on an orthographic sensor.
        width: of the film, pixels.
        height: of the film, pixels.
        rfilter: another reconstruction filter, as a plain dict.

    Raises:
        SceneError: this type of sensor is not supported.
    """
    import mitsuba as mi

    properties = dict(description.sensor)
    kind = properties.get("type", "perspective")
    if kind not in supported("sensor"):
        reason = refusal(kind) or f"sensor `{kind}` is not supported; use {' or '.join(supported('sensor'))}"
        raise SceneError(f"scene {description.name}: {reason}")
    scale = _rounded(np.asarray(properties.pop("scale", (1.0, 1.0, 1.0)), dtype=np.float64))
    to_world = pose.to_world @ np.diag([*scale, 1.0])
    film = {
        "type": "hdrfilm",
        "width": int(width),
        "height": int(height),
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": _Builder({}).plain(rfilter or description.film),
    }
    if kind != "orthographic":
        properties |= {"fov": pose.fov, "fov_axis": "x"}
    try:
        content = _Builder({}).plain(properties)
        sensor = mi.load_dict({**content, "to_world": mi.ScalarTransform4d(to_world), "film": film})
    except (RuntimeError, ValueError) as error:
        raise SceneError(f"scene {description.name}: sensor: {explain_fault(error)}") from error
    set_pose(sensor, pose)
    return sensor


def set_pose(sensor: mi.Sensor, pose: Pose) -> None:
    """Move a sensor (of `build_sensor`) without compiling a new kernel for the next render.

    All that depends on the pose becomes an opaque variable; literals would be compiled into the kernel. The scale of
    the camera frame (an orthographic sensor's extent, a mirrored image) is kept.
    """
    import drjit as dr
    import mitsuba as mi

    parameters = mi.traverse(sensor)
    rows = parameters["to_world"].matrix
    matrix = np.array([[np.ravel(entry)[0] for entry in row] for row in rows], np.float64)  # takes no kernel
    to_world = mi.Matrix4f((pose.to_world @ np.diag([*_scale_of(matrix), 1.0])).tolist())
    dr.make_opaque(to_world)
    parameters["to_world"] = mi.Transform4f(to_world)
    if "x_fov" in parameters:
        fov = mi.Float(pose.fov)
        dr.make_opaque(fov)
        parameters["x_fov"] = fov
    parameters.update()


def _scale_of(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of the camera axes, (3,); the first is negative if the image is mirrored."""
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    scale[0] *= np.sign(np.linalg.det(matrix[:3, :3]))
    return _rounded(scale)


def _rounded(scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round to five digits: without single-precision residue, no pose depends on the poses set before it."""
    return np.array([float(f"{length:.4e}") for length in scale])


class _Builder:
    """Converts plain content into the form that `mi.load_dict` takes.

    References are resolved to objects here, because a mesh in memory needs its material as an object.
    """

    def __init__(self, content: Mapping[str, Any]) -> None:
        self.content = content
        self.built: dict[str, Any] = {}

    def scene(self) -> dict[str, Any]:
        """The entries of the scene's dictionary; materials enter through the shapes that refer to them."""
        import mitsuba as mi

        entries = {
            key: self.reference(key) if _kind(entry) in _AS_OBJECTS else self.plain(entry, key)
            for key, entry in self.content.items()
            if _kind(entry) != "image"  # enters through the materials that refer to it
        }
        for key, item in self.built.items():
            if isinstance(item, mi.Shape | mi.Emitter):
                entries[key] = item
            else:
                entries.pop(key, None)
        return entries

    def plain(self, value: Any, key: str = "") -> Any:
        """A value of the description in Mitsuba's types; the key tells what an array stands for."""
        if isinstance(value, Mapping):
            return self.table(value, key)
        if isinstance(value, np.ndarray):
            return _array(value, key)
        return value.item() if isinstance(value, np.generic) else value

    def table(self, value: Mapping[str, Any], key: str) -> Any:
        """A nested dict, in which references and meshes become objects."""
        import mitsuba as mi

        kind = value.get("type")
        if kind == "ref":
            return self.reference(value["id"])
        if kind == "triangles":
            return self.mesh(value, key)
        if kind == "image":
            return _bitmap(value)
        converted = {name: self.plain(item, name) for name, item in value.items()}
        if kind == "envmap" and "data" in converted:
            converted["bitmap"] = mi.Bitmap(converted.pop("data"))
        return converted

    def reference(self, name: str) -> Any:
        """The object that an entry describes; the same object each time."""
        if name not in self.content:
            raise ValueError(f"reference to `{name}`, which is not in the scene")
        if name not in self.built:
            self.built[name] = _load(self.plain(self.content[name], name), name)
        return self.built[name]

    def mesh(self, entry: Mapping[str, Any], name: str) -> mi.Mesh:
        """A mesh held in memory; faceted unless it has normals."""
        import mitsuba as mi

        unknown = set(entry) - _TRIANGLES
        if unknown:
            raise ValueError(f"`{name}`: triangles have no {sorted(unknown)}; valid: {sorted(_TRIANGLES)}")
        vertices, faces = np.asarray(entry["vertices"]), np.asarray(entry["faces"])
        _check_mesh(name, vertices, faces, entry)
        properties = mi.Properties()
        for part in ("bsdf", "emitter"):
            if part in entry:
                properties[part] = _load(self.plain(entry[part]), name)
        normals, uv = entry.get("normals"), entry.get("uv")
        mesh = mi.Mesh(name, len(vertices), len(faces), properties, normals is not None, uv is not None)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
        parameters["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
        if uv is not None:
            parameters["vertex_texcoords"] = np.ascontiguousarray(uv, dtype=np.float32).ravel()
        if normals is not None:
            parameters["vertex_normals"] = np.ascontiguousarray(normals, dtype=np.float32).ravel()
        parameters.update()
        if entry.get("colors") is not None:
            mesh.add_attribute(
                "vertex_color", 3, np.ascontiguousarray(entry["colors"], dtype=np.float32).ravel()
            )
        return mesh


def _load(entry: Any, name: str) -> Any:
    """Load the object that a dict describes; errors are attributed to the scene entry `name`."""
    import mitsuba as mi

    if not isinstance(entry, dict):
        return entry
    try:
        return mi.load_dict(entry, parallel=False, optimize=False)
    except RuntimeError as error:
        raise ValueError(f"`{name}`: {explain_fault(error)}") from error


def _kind(entry: Any) -> Any:
    """Type of a scene entry."""
    return entry.get("type") if isinstance(entry, Mapping) else None


def _bitmap(entry: Mapping[str, Any]) -> dict[str, Any]:
    """An image texture as a Mitsuba `bitmap`; 8- and 16-bit texels are kept as they are."""
    import mitsuba as mi

    image = texels(entry)
    kept = {
        name: _array(value, name) if isinstance(value, np.ndarray) else value
        for name, value in entry.items()
        if name in _LOOK_UP
    }
    encoded = bool(entry.get("srgb", False)) and image.dtype == np.uint8
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": not encoded, "format": "auto", **kept}


def _array(value: NDArray[Any], key: str) -> Any:
    """An image if the key is `data` or `bitmap`, a transform if the array is 4x4, else a list of numbers."""
    import mitsuba as mi

    if key in ("data", "bitmap"):
        image = np.ascontiguousarray(value, dtype=np.float32)
        image = image[..., None] if image.ndim == 2 else image
        return mi.Bitmap(image) if key == "bitmap" else mi.TensorXf(image)
    if value.shape == (4, 4):
        return mi.ScalarTransform4d(np.asarray(value, dtype=np.float64))
    return value.tolist()


def _check_mesh(name: str, vertices: NDArray[Any], faces: NDArray[Any], entry: Mapping[str, Any]) -> None:
    """Reject arrays that would make Mitsuba read out of bounds."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise ValueError(f"`{name}`: vertices must be finite, of shape (V, 3), not {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise ValueError(f"`{name}`: faces must be of shape (F, 3), F > 0, not {faces.shape}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"`{name}`: a face refers to vertex {faces.max()}, but there are only {len(vertices)} vertices"
        )
    for part, width in (("normals", 3), ("uv", 2), ("colors", 3)):
        shape = np.shape(entry[part]) if entry.get(part) is not None else (len(vertices), width)
        if shape != (len(vertices), width):
            raise ValueError(f"`{name}`: {part} must be of shape ({len(vertices)}, {width}), not {shape}")


def field_of_view(sensor: Any) -> float:
    """Horizontal field of view of a sensor, degrees; 45 for sensors without one, such as `orthographic`."""
    import mitsuba as mi

    params = mi.traverse(sensor)
    return float(np.ravel(np.array(params["x_fov"]))[0]) if "x_fov" in params else 45.0
