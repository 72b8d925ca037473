"""Read Mitsuba's XML scene files into plain scene descriptions.

Mitsuba's own parser reads the file (versions 0.5 to 3; older property names are updated, includes and
parameters resolved); the result is converted to plain values here. The scene is also built once, so that errors that
Mitsuba would report on a worker are reported at the start, with their place in the file.
"""

from __future__ import annotations

import difflib
import hashlib
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import CameraError, SceneError, SettingsError
from steadylight.llvm import find_llvm
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.mitsuba_plugins import refusal
from steadylight.scenes.outside import FOV, outside
from steadylight.settings import SceneOptions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_log = logging.getLogger(__name__)

_OWN_SENSOR_PROPERTIES = {"to_world", "fov", "fov_axis", "focal_length"}
_SKIPPED = ("Integrator", "Sensor", "Film", "Sampler", "ReconstructionFilter")


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read a scene from a Mitsuba XML file.

    A sensor gives the default camera (a still view), film size and reconstruction filter. A file
    without a sensor gets a view of the whole scene from outside, with z up. The integrator is
    ignored: the scene does not determine how to render. `mitsuba_plugins` says what else is not supported.

    Sets Mitsuba's variant to `scalar_rgb` if none is set.

    Args:
        path: of the file.
        options: `sensor`: its id, or its number, counted from 1; the first if None, with a warning if there are others.

    Raises:
        SceneError: the message gives file, line and column, the fault, and the remedy where possible.
    """
    path = Path(path).absolute()
    _check_readable(path)
    find_llvm()  # the scene may be rendered in this process afterwards
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    config = mi.parser.ParserConfig(mi.variant() or "scalar_rgb")
    config.merge_meshes = config.merge_equivalent = config.parallel = False
    try:
        state = _parse(config, path)
        reader = _Reader(state, path)
        content = reader.content()
        chosen = reader.sensor(None if options.sensor is None else str(options.sensor))
        # Parsed again: properties that were read count as used, so misspelt ones would not be reported.
        scene: Any = mi.parser.instantiate(config, reader.prepare(_parse(config, path)))
    except (RuntimeError, ValueError) as error:
        raise SceneError(explain_fault(error, path)) from error
    if chosen is None:
        view: dict[str, Any] = {"camera": outside(*_corners(scene.bbox()))}
    else:
        view = chosen.view(scene.sensors()[chosen.number])
    return SceneDescription(name=path.stem, content=content, files=reader.files, about=str(path), **view)


def _check_readable(path: Path) -> None:
    """Reject a missing or unreadable file."""
    if not path.exists():
        raise SceneError(f"{path}: no such scene file")
    try:
        with path.open("rb") as file:
            file.read(1)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from None


def _parse(config: Any, path: Path) -> Any:
    """Mitsuba's parse tree; meanwhile, the scene's folder is on the search path for included and spectrum files."""
    import mitsuba as mi

    file_resolver: Any = mi.file_resolver  # untyped in Mitsuba's stubs
    resolver = file_resolver()
    resolver.prepend(str(path.parent))
    try:
        state = mi.parser.parse_file(config, str(path))
        mi.parser.transform_all(config, state)
    finally:
        folders = [str(folder) for folder in resolver][1:]
        resolver.clear()
        for folder in folders:
            resolver.append(folder)
    if state.root.type != mi.ObjectType.Scene:
        raise SceneError(f"{path}: the outermost element must be <scene>")
    return state


@dataclass(frozen=True)
class _Sensor:
    """A sensor as in the file.

    Attributes:
        place: file, line and column.
        number: among the sensors of the file, from 0.
        to_world: (4, 4) camera-to-world.
        properties: the other properties, without those that the camera path replaces.
        film: the reconstruction filter.
    """

    place: str
    number: int
    to_world: NDArray[np.float64]
    properties: dict[str, Any]
    film: dict[str, Any]

    def view(self, built: Any) -> dict[str, Any]:
        """Camera, sensor, film and size for the description; `built` is Mitsuba's own sensor."""
        import mitsuba as mi

        # Mitsuba computed the horizontal angle from fov or focal length, fov axis and film.
        parameters = mi.traverse(built)
        fov = float(np.ravel(parameters["x_fov"])[0]) if "x_fov" in parameters else FOV
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
        files: SHA-256 of every file that the scene refers to, by absolute path.
    """

    def __init__(self, state: Any, path: Path) -> None:
        self.state = state
        self.path = path
        self.files: dict[str, str] = {}
        self.entries: dict[str, Any] = {}
        self.top = self._top_level_names()
        self.filenames: dict[int, str] = {}
        for index, node in enumerate(state.nodes):
            self._check(index, node)

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

    def _check(self, index: int, node: Any) -> None:
        """Reject what is not supported; make file names absolute, and hash the files."""
        place = _place(self.state, node)
        reason = refusal(node.props.plugin_name())
        if node.type.name == "Medium":
            reason = reason or refusal("homogeneous")
        if node.type.name == "Integrator" and _is_set(node.props, "hide_emitters"):
            reason = refusal("any: hide_emitters")
        # A file may have sensors for other programs; `sensor` looks at the one that is used.
        if reason is not None and node.type.name != "Sensor":
            raise SceneError(f"{place}: {reason}")
        if "filename" not in node.props:
            return
        name = node.props["filename"]
        folder = Path(str(self.state.files[node.file_index])).absolute().parent
        file = next((at for at in (self.path.parent / name, folder / name) if at.is_file()), None)
        if file is None:
            raise SceneError(f"{place}: `{node.props.plugin_name()}` needs {name}; no such file in {folder}")
        try:
            with file.open("rb") as stream:
                self.files[str(file)] = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            raise SceneError(f"{place}: {file} cannot be read: {error.strerror}") from None
        self.filenames[index] = node.props["filename"] = str(file)

    def content(self) -> dict[str, Any]:
        """The scene's children, each after those it refers to."""
        for index in self.top:
            if self.state.nodes[index].type.name not in _SKIPPED:
                self._emit(index)
        return self.entries

    def _emit(self, index: int) -> None:
        """Add a child of the scene to the entries, if missing."""
        if self.top[index] not in self.entries:
            self.entries[self.top[index]] = self._plain(self.state.nodes[index])

    def _plain(self, node: Any) -> dict[str, Any]:
        """A node as a plain dict; children of the scene become references."""
        plain: dict[str, Any] = {"type": node.props.plugin_name()}
        for key in node.props:
            if node.props.type(key).name != "ResolvedReference":
                plain[key] = self._value(node, key)
        for key, index in self._children(node):
            child = self.state.nodes[index]
            if child.type.name in _SKIPPED:
                continue
            name = _unique(child.type.name.lower(), plain) if key.startswith("_arg_") else key
            if index in self.top:
                self._emit(index)
                plain[name] = {"type": "ref", "id": self.top[index]}
            else:
                plain[name] = self._plain(child)
        return plain

    def _value(self, node: Any, key: str) -> Any:
        """A property as a plain value."""
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
        raise SceneError(f"{_place(self.state, node)}: property `{key}` of kind {kind} is not supported")

    def prepare(self, fresh: Any) -> Any:
        """A freshly parsed file with absolute file names and without integrators (whose plugins may be missing)."""
        for index, name in self.filenames.items():
            fresh.nodes[index].props["filename"] = name
        for key, index in self._children(self.state.root):
            if self.state.nodes[index].type.name == "Integrator":
                del fresh.root.props[key]
        return fresh

    def sensor(self, wanted: str | None) -> _Sensor | None:
        """The sensor of this id or number; None if there is none at all."""
        nodes = [self.state.nodes[index] for _, index in self._children(self.state.root)]
        nodes = [node for node in nodes if node.type.name == "Sensor"]
        if not nodes and wanted is None:
            return None
        number = self._number_of(wanted, [node.props.id() for node in nodes])
        node = nodes[number]
        reason = refusal(node.props.plugin_name())
        if reason is not None:
            raise SceneError(f"{_place(self.state, node)}: {reason}")
        plain = self._plain(node)
        return _Sensor(
            place=_place(self.state, node),
            number=number,
            to_world=plain.get("to_world", np.eye(4)),
            properties={key: item for key, item in plain.items() if key not in _OWN_SENSOR_PROPERTIES},
            film=self._filter(node),
        )

    def _number_of(self, wanted: str | None, ids: list[str]) -> int:
        """Number of a sensor, from 0."""
        names = ", ".join(f"{number} ({name})" if name else str(number) for number, name in enumerate(ids, 1))
        if wanted is None:
            if len(ids) > 1:
                _log.warning("%s: of its sensors %s the first is used; choose by --sensor", self.path, names)
            return 0
        if wanted in ids:
            return ids.index(wanted)
        if wanted.isdecimal() and 1 <= int(wanted) <= len(ids):
            return int(wanted) - 1
        has = f"it has {names}" if ids else "it has none"
        raise SettingsError(f"--sensor: {wanted!r} is no sensor of {self.path}; {has}")

    def _filter(self, sensor: Any) -> dict[str, Any]:
        """The reconstruction filter of a sensor's film; Mitsuba's default if it has none."""
        for _, index in self._children(sensor):
            film = self.state.nodes[index]
            if film.type.name == "Film":
                for _, inner in self._children(film):
                    if self.state.nodes[inner].type.name == "ReconstructionFilter":
                        return self._plain(self.state.nodes[inner])
        return {"type": "gaussian"}


def _is_set(properties: Any, name: str) -> bool:
    """Whether a flag is there and true."""
    return name in properties and bool(properties[name])


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


def _place(state: Any, node: Any) -> str:
    """File, line and column of a node."""
    import mitsuba as mi

    return _LOCATION.sub(r"\1: line \2, column \3", mi.parser.file_location(state, node))


_TAG = re.compile(r"\[[\w.:]+\] ")  # place in Mitsuba's source, or class name
_LOCATION = re.compile(r"^(.+?) \((?:near )?line (\d+), col (\d+)\)")
_UNUSED = re.compile(r'Found \d+ unreferenced propert\w+ in \w+ plugin of type "(\w+)":\s*')
_NO_PLUGIN = re.compile(r'failed to instantiate (\w+) plugin of type "([^"]*)": Plugin "[^"]*" not found!')
_DOCUMENTED = "; see Mitsuba's documentation for the available ones"
_REWRITES = (
    (
        re.compile(r'^Parsing of XML file "(.+?)" failed: (.*) \((line \d+, col \d+)\)$'),
        r"\1 (\3): not valid XML: \2",
    ),
    (
        re.compile(r"Start-end tags mismatch"),
        "this closing tag does not match the last opened one; close inner elements first",
    ),
    (re.compile(r"No document element found"), "the file is empty; it must contain a <scene>"),
    (re.compile(r"missing version attribute in"), 'add version="3.0.0" to'),
    (re.compile(r' in property "_arg_\d+"'), ""),
    (re.compile(r'^Error while loading XML file "(.+?)": '), r"\1: "),
    (re.compile(r"^(?:Error while loading|While loading|At) (?=.+ \((?:near )?line )"), ""),
    (re.compile(r'^(?:At|While loading) dictionary node "(?:root\.)?(.+?)": '), r"`\1`: "),
    (re.compile(r"^`root`: "), ""),
    (re.compile(r'failed to instantiate \w+ plugin of type "(\w+)": '), r"`\1`: "),
)


def explain_fault(error: Exception, path: Path | None = None) -> str:
    """Mitsuba's error message in one or two lines: place first, without the names of its source files.

    Args:
        error: raised by Mitsuba's parser or by a plugin.
        path: file to name if Mitsuba's message does not name one.
    """
    # For an error in an included file, the chain of includes comes first: the last line has the error.
    text = str(error)
    included = text.rsplit("while processing <include>:\n", 1)[-1]
    text = _TAG.sub("", included).strip()
    missing = _NO_PLUGIN.search(text)
    if missing:
        text = text.replace(missing[0], _no_plugin(missing[1], missing[2]))
    if _UNUSED.search(text):
        text = _UNUSED.sub(r"`\1` does not have the property ", text)
        text = text.replace("\n  - ", ", ").replace("- ", "", 1) + _DOCUMENTED
    for pattern, replacement in _REWRITES:
        text = pattern.sub(replacement, text)
    text = _LOCATION.sub(r"\1: line \2, column \3", text)
    return text if path is None or ".xml" in text else f"{path}: {text}"


def _no_plugin(kind: str, name: str) -> str:
    """Error message for an unknown plugin, with a suggestion."""
    import mitsuba as mi

    plugins = [file.stem for file in (Path(mi.__file__).parent / "plugins").glob("*.*")]
    near = difflib.get_close_matches(name, plugins, n=1)
    what = "plugin" if kind == "unknown" else f"{kind} plugin"
    return f"Mitsuba has no {what} `{name}`" + (f"; did you mean `{near[0]}`?" if near else _DOCUMENTED)
