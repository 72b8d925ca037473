"""Read Mitsuba's XML scene files, of versions 0.5 to 3, into plain scene descriptions.

`mitsuba_document` reads the file and what it includes, `mitsuba_older` converts it to Mitsuba 3, and `mitsuba_build`
lets Mitsuba's own parser read and build it, so that errors that Mitsuba would report on a worker are reported at the
start, with their place in the file. The result is converted to plain values here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import CameraError, SceneError
from steadylight.llvm import find_llvm
from steadylight.scenes.description import Note, SceneDescription
from steadylight.scenes.mitsuba_build import Parsed, build, note_unread
from steadylight.scenes.mitsuba_document import Document
from steadylight.scenes.mitsuba_meshes import Rewritten, as_triangles, convert_meshes
from steadylight.scenes.mitsuba_older import modernise
from steadylight.scenes.mitsuba_plugins import refusal
from steadylight.scenes.world import DEFAULT_FOV, chosen, listed, view_from_outside
from steadylight.settings import SceneOptions

if TYPE_CHECKING:
    from numpy.typing import NDArray

_OWN_SENSOR_PROPERTIES = {"to_world", "fov", "fov_axis", "focal_length"}
_SKIPPED = ("Integrator", "Sensor", "Film", "Sampler", "ReconstructionFilter")


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read a scene from a Mitsuba XML file.

    A sensor gives the default camera (a still view), film size and reconstruction filter. A file
    without a sensor gets a view of the whole scene from outside, with z up. Integrators and samplers are
    ignored: the scene does not determine how to render. `mitsuba_plugins` and `mitsuba_older` say what else is not
    supported. The description's notes list everything that is not used as it stands.

    Sets Mitsuba's variant to `scalar_rgb` if none is set.

    Args:
        path: path of the file.
        options: `sensor`: its id, or its number, counted from 1; the first if None, with a warning if there are others.
            `parameters`: values that override `<default>`s. `allow_outside`: see `SceneOptions`.

    Raises:
        SceneError: a line for each fault, with file, line and column, and the remedy where possible.
    """
    path = Path(path).absolute()
    _check_readable(path)
    find_llvm()  # the scene may be rendered in this process afterwards
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    document = Document(path, dict(options.parameters), options.allow_outside)
    _drop_rendering(document, None if options.sensor is None else str(options.sensor))
    modernise(document)
    document.root.children = [
        child for child in document.root.children if child.tag not in {"integrator", "sampler"}
    ]
    with TemporaryDirectory(prefix="steadylight-") as folder:
        converted = convert_meshes(document, Path(folder))
        parsed = build(document)
        note_unread(document, parsed)
        reader = _Reader(parsed, converted)
        chosen = reader.sensor()
        if chosen is None:
            view: dict[str, Any] = {
                "camera": CameraPath((view_from_outside(*_corners(parsed.scene.bbox())),))
            }
        else:
            view = chosen.view(parsed.scene.sensors()[0])
        content = reader.content()
    notes = tuple(document.notes)
    return SceneDescription(
        name=path.stem, content=content, files=reader.files, about=str(path), notes=notes, **view
    )


def _check_readable(path: Path) -> None:
    """Reject missing and unreadable files, and those that never end, such as pipes."""
    if not path.exists():
        raise SceneError(f"{path}: no such scene file")
    if not path.is_file() and not path.is_dir():
        raise SceneError(f"{path}: cannot be read: it is not a file")
    try:
        with path.open("rb") as file:
            file.read(1)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from None


def _drop_rendering(document: Document, wanted: str | None) -> None:
    """Remove the unused sensors, and the samplers of the used one."""
    sensors = [child for child in document.root.children if child.tag == "sensor"]
    if sensors or wanted is not None:
        used = sensors[_number_of(document, wanted, [each.attributes.get("id", "") for each in sensors])]
        used.children = [child for child in used.children if child.tag != "sampler"]
        rest = {each for each in sensors if each is not used}
        document.root.children = [child for child in document.root.children if child not in rest]


def _number_of(document: Document, wanted: str | None, ids: list[str]) -> int:
    """Number of a sensor, from 0."""
    if wanted is None:
        if len(ids) > 1:
            text = f"of {listed(ids)} the first is used; choose with --sensor"
            document.notes.append(Note("warning", "sensors", text))
        return 0
    return chosen(document.path, wanted, [(name,) for name in ids], "sensor")


@dataclass(frozen=True)
class _Sensor:
    """A sensor as in the file.

    Attributes:
        place: file, line and column.
        to_world: (4, 4) camera-to-world.
        properties: the other properties, without those that the camera path replaces.
        film: the reconstruction filter.
    """

    place: str
    to_world: NDArray[np.float64]
    properties: dict[str, Any]
    film: dict[str, Any]

    def view(self, built: Any) -> dict[str, Any]:
        """Camera, sensor, film and size for the description; `built` is Mitsuba's own sensor."""
        import mitsuba as mi

        # Mitsuba computed the horizontal angle from fov or focal length, fov axis and film.
        parameters = mi.traverse(built)
        fov = float(np.ravel(parameters["x_fov"])[0]) if "x_fov" in parameters else DEFAULT_FOV
        scale = _camera_scale(self.to_world, self.place)
        scaled = not np.allclose(scale, 1.0, rtol=0, atol=1e-5)
        try:
            camera = CameraPath((_keyframe(self.to_world, fov),))
        except CameraError as error:
            raise SceneError(f"{self.place}: {error}") from None
        film = built.film()
        if any(film.crop_offset()) or any(film.crop_size() != film.size()):
            raise SceneError(f"{self.place}: {refusal('hdrfilm: crop')}")
        width, height = (int(size) for size in film.size())
        return {
            "camera": camera,
            "sensor": self.properties | ({"scale": scale.tolist()} if scaled else {}),
            "width": width,
            "height": height,
            "film": self.film,
        }


class _Reader:
    """Converts the nodes of a parsed file to plain values.

    Attributes:
        converted: meshes that are held in memory, by the name of the file that Mitsuba reads them from.
        files: SHA-256 of every file that the scene refers to, by absolute path.
    """

    def __init__(self, parsed: Parsed, converted: Mapping[str, Rewritten]) -> None:
        self.state = parsed.state
        self.parsed = parsed
        self.converted = converted
        self.files: dict[str, str] = {}
        self.entries: dict[str, Any] = {}
        self.top = self._top_level_names()
        for number, node in enumerate(self.state.nodes):
            if "filename" in node.props and "filename" not in parsed.unread.get(number, ()):
                self._hash(node.props["filename"], number)

    def _hash(self, name: str, number: int) -> None:
        """Hash a file that the scene refers to."""
        if name in self.converted:
            return
        try:
            with Path(name).open("rb") as stream:
                self.files[name] = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            place = self.parsed.elements[number].place
            raise SceneError(f"{place}: {name} cannot be read: {error.strerror}") from None

    def _children(self, node: Any) -> Iterator[tuple[str, int]]:
        """Property names and node indices of the children of a node."""
        for key in node.props:
            if node.props.type(key).name == "ResolvedReference":
                yield key, node.props[key].index()

    def _top_level_names(self) -> dict[int, str]:
        """Names in the description of the scene's own children, by node index.

        Without an id, the name is the node's type and a number. Dots, which Mitsuba reads as paths, are replaced.
        """
        names: dict[int, str] = {}
        taken = {node.props.id().replace(".", "_") for node in self.state.nodes}
        for _, index in self._children(self.state.root):
            node = self.state.nodes[index]
            wish = node.props.id().replace(".", "_")
            if not wish or wish in names.values():
                stem, number = f"{node.type.name.lower()}", 1
                while f"{stem}_{number}" in taken:
                    number += 1
                wish = f"{stem}_{number}"
                taken.add(wish)
            names[index] = wish
        return names

    def content(self) -> dict[str, Any]:
        """The scene's children, each after those that it refers to."""
        for index in self.top:
            if self.state.nodes[index].type.name not in _SKIPPED:
                self._emit(index)
        return self.entries

    def _emit(self, index: int) -> None:
        """Add a child of the scene to the entries, if missing."""
        if self.top[index] not in self.entries:
            self.entries[self.top[index]] = self._plain(index)

    def _plain(self, number: int) -> dict[str, Any]:
        """A node as a plain dict; children of the scene become references."""
        node = self.state.nodes[number]
        unread = self.parsed.unread.get(number, set())
        plain: dict[str, Any] = {"type": node.props.plugin_name()}
        for key in node.props:
            if node.props.type(key).name != "ResolvedReference" and key not in unread:
                plain[key] = self._value(number, key)
        gain = self.parsed.elements[number].gain
        if gain:
            plain = _multiplied(plain, gain)
        held = self.converted.get(plain.get("filename", ""))
        if held is not None:
            plain = as_triangles(plain, held)
        for key, index in self._children(node):
            child = self.state.nodes[index]
            if child.type.name in _SKIPPED or key in unread:
                continue
            nameless = key.startswith("_arg_") or held is not None
            name = _unique(child.type.name.lower(), plain) if nameless else key
            if index in self.top:
                self._emit(index)
                plain[name] = {"type": "ref", "id": self.top[index]}
            else:
                plain[name] = self._plain(index)
        return plain

    def _value(self, number: int, key: str) -> Any:
        """A property as a plain value."""
        node = self.state.nodes[number]
        value = node.props[key]
        kind = node.props.type(key).name
        match kind:
            case "Bool" | "Integer" | "Float" | "String":
                return value
            case "Vector":
                return [float(item) for item in value]
            case "Color":
                return {"type": "rgb", "value": [float(item) for item in value]}
            case "Transform":
                return np.array(value.matrix, dtype=np.float64).reshape(4, 4)
            case "Spectrum":
                wavelengths, values = list(value.wavelengths), list(value.values)
                pairs = (
                    [list(pair) for pair in zip(wavelengths, values, strict=True)] if wavelengths else None
                )
                return {"type": "spectrum", "value": pairs or values[0]}
        place = (self.parsed.elements[number].child(key) or self.parsed.elements[number]).place
        raise SceneError(f"{place}: property `{key}` of kind {kind} is not supported")

    def sensor(self) -> _Sensor | None:
        """The sensor; None if there is none."""
        numbers = [
            index
            for _, index in self._children(self.state.root)
            if self.state.nodes[index].type.name == "Sensor"
        ]
        if not numbers:
            return None
        plain = self._plain(numbers[0])
        return _Sensor(
            place=str(self.parsed.elements[numbers[0]].place),
            to_world=plain.get("to_world", np.eye(4)),
            properties={key: item for key, item in plain.items() if key not in _OWN_SENSOR_PROPERTIES},
            film=self._filter(self.state.nodes[numbers[0]]),
        )

    def _filter(self, sensor: Any) -> dict[str, Any]:
        """The reconstruction filter of a sensor's film; Mitsuba's default if it has none."""
        for _, index in self._children(sensor):
            film = self.state.nodes[index]
            if film.type.name == "Film":
                for _, inner in self._children(film):
                    if self.state.nodes[inner].type.name == "ReconstructionFilter":
                        return self._plain(inner)
        return {"type": "gaussian"}


def _multiplied(bitmap: dict[str, Any], gain: list[float]) -> dict[str, Any]:
    """A `bitmap` as an image texture with a factor; see `image_texture`. Mitsuba takes OpenEXR files as linear."""
    raw, name = bitmap.pop("raw", False), bitmap["filename"]
    encoded = not raw and Path(name).suffix.lower() != ".exr"
    return {**bitmap, "type": "image", "channels": "rgb", "srgb": encoded, "gain": gain}


def _unique(stem: str, taken: dict[str, Any]) -> str:
    """A name for a nameless child: `bsdf`, `bsdf_2`, ..."""
    name, number = stem, 1
    while name in taken:
        number += 1
        name = f"{stem}_{number}"
    return name


def _keyframe(matrix: NDArray[np.float64], fov: float) -> Keyframe:
    """A still view from a camera-to-world matrix."""
    origin, view, up = (matrix[:3, column] for column in (3, 2, 1))
    target = origin + view / np.linalg.norm(view)
    return Keyframe(0.0, tuple(origin.tolist()), tuple(target.tolist()), tuple(up.tolist()), fov)


def _camera_scale(matrix: NDArray[np.float64], place: str) -> NDArray[np.float64]:
    """Lengths of the camera axes, (3,); the first is negative for a mirrored image."""
    axes = matrix[:3, :3]
    scale = np.linalg.norm(axes, axis=0)
    if not np.isfinite(matrix).all() or not scale.all():
        raise SceneError(f"{place}: the sensor's to_world has no inverse, or is not finite")
    across = (axes / scale).T @ (axes / scale) - np.eye(3)
    if np.abs(across).max() > 1e-3:
        raise SceneError(f"{place}: the sensor's to_world is sheared; its axes must be perpendicular")
    scale[0] *= np.sign(np.linalg.det(axes))
    return np.asarray(scale)


def _corners(box: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner of Mitsuba's bounding box."""
    return np.array(box.min, dtype=np.float64).ravel(), np.array(box.max, dtype=np.float64).ravel()
