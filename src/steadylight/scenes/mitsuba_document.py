"""A Mitsuba scene file as one tree: parameters substituted, includes expanded, file names made absolute.

Faults are collected, so that a scene's author sees all of them at once. A shape whose mesh file is missing is left out
with a note, because published scenes often name meshes that may not be redistributed. For an emitting shape, it is a
fault.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

from steadylight.errors import SceneError, SettingsError
from steadylight.scenes.description import Note
from steadylight.scenes.downloads import lacking
from steadylight.scenes.file_names import named
from steadylight.scenes.mitsuba_missing import emitter_names, remove_shapes
from steadylight.scenes.mitsuba_plugins import is_known
from steadylight.scenes.xml_elements import MAX_DEPTH, MAX_ELEMENTS, Element, Place, read_elements

OBJECTS = frozenset(
    (
        *(
            "scene",
            "bsdf",
            "emitter",
            "film",
            "integrator",
            "medium",
            "phase",
            "rfilter",
            "sampler",
            "sensor",
        ),
        *("shape", "subsurface", "texture", "volume"),
    )
)
"""Tags of elements that stand for a plugin; `spectrum` does too if it has a type."""
MAX_FAULTS = 50
"""Maximum number of faults that are shown."""
_MAX_INCLUDES = 15
_MAX_REFERENCES = 100
_VERSION = re.compile(r"\s*(\d+)\.(\d+)(?:\.(\d+))?\s*")
_CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
_MESHES = {"obj", "ply", "serialized"}
_TIES = {"id", "name", "type", "version"}


@dataclass
class Document:
    """A scene file and what it refers to.

    Attributes:
        path: absolute path of the scene file.
        parameters: values of `$name`, which override the file's defaults.
        outside: whether files may lie outside the scene's folder.
        root: the outermost element.
        faults: what is wrong, and where.
        notes: what became of elements that are not used as they stand.
        objects: the elements that have an id, by id.
    """

    path: Path
    parameters: Mapping[str, str] = field(default_factory=dict)
    outside: bool = False
    root: Element = field(init=False)
    faults: dict[tuple[Place, str], None] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    objects: dict[str, Element] = field(init=False)

    def __post_init__(self) -> None:
        self._values = dict(self.parameters)
        self._unused = set(self.parameters)
        self._folders: list[Path] = []
        self._room = MAX_ELEMENTS
        self._without_file: dict[Element, tuple[Element, str, Path]] = {}
        self.root = self._read(self.path)
        self._resolve(self.root, self.path, 0, 0)
        if self.root.tag != "scene" and not self.faults:
            raise SceneError(f"{self.path}: the outermost element must be <scene>")
        if self._unused:
            known = ", ".join(sorted(set(self._values) - self._unused)) or "none"
            names = ", ".join(sorted(self._unused))
            raise SettingsError(f"-D {names}: no such parameter in {self.path}; it has {known}")
        self._leave_out()
        self._check_references()

    def fault(self, place: Place, text: str) -> None:
        """Add a fault."""
        self.faults[place, text] = None

    def note(self, kind: str, element: Element, text: str) -> None:
        """Note what became of an element; the note gives its file relative to the scene's folder."""
        where = str(element.place).removeprefix(f"{self.path.parent}{os.sep}")
        self.notes.append(Note(kind, where, text))  # type: ignore[arg-type]

    def refuse(self) -> None:
        """Raise all faults in one message, in the order of the file."""
        if self.faults:
            lines = [f"{place}: {text}" for place, text in sorted(self.faults)]
            more = [f"... and {len(lines) - MAX_FAULTS} more"] if len(lines) > MAX_FAULTS else []
            raise SceneError("\n".join(lines[:MAX_FAULTS] + more))

    def _read(self, path: Path) -> Element:
        """The tree of one file; every element gets the version of the file."""
        root = read_elements(path, self._room)
        version = _VERSION.fullmatch(root.attributes.get("version", ""))
        if "version" not in root.attributes:
            self.fault(root.place, f'missing version attribute; add version="3.0.0" to <{root.tag}>')
        elif version is None:
            self.fault(
                root.place, f"no version: {root.attributes['version']!r}; expected a version such as 3.0.0"
            )
        number = tuple(int(part or 0) for part in version.groups()) if version else (3, 0, 0)
        for element in root.walk():
            self._room -= 1
            element.version = number
        return root

    def _resolve(self, element: Element, path: Path, includes: int, depth: int) -> None:
        """Substitute parameters and expand includes in an element of a file."""
        if depth > MAX_DEPTH:
            raise SceneError(f"{element.place}: elements are nested more than {MAX_DEPTH} levels deep")
        self._substitute(element)
        kept: list[Element] = []
        for child in element.children:
            if child.tag == "default":
                self._substitute(child)
                name = child.attributes.get("name", "")
                if not name or "value" not in child.attributes:
                    self.fault(child.place, "<default> needs a name and a value")
                self._values.setdefault(name, child.attributes.get("value", ""))
                self._unused.discard(name)
            elif child.tag == "include":
                self._substitute(child)
                kept += self._included(child, path, includes, depth)
            elif child.tag == "path":
                self._substitute(child)
                self._add_folder(child, path)
            else:
                self._resolve(child, path, includes, depth + 1)
                if child.version < (2,) or is_known(element.kind):
                    _rename(child)
                self._name_file(child, element, path)
                kept.append(child)
        element.children = kept

    def _substitute(self, element: Element) -> None:
        """Substitute values for `$name` in the attributes; after a backslash, `$` is a plain dollar sign."""
        for key, text in element.attributes.items():
            if "$" not in text:
                continue
            parts = re.split(r"(\\?\$)", text)
            out = parts[0]
            for mark, rest in zip(parts[1::2], parts[2::2], strict=True):
                names = [name for name in self._values if name and rest.startswith(name)]
                name = max(names, key=len, default="")
                if mark == "\\$":
                    out += "$" + rest
                elif name:
                    self._unused.discard(name)
                    out += self._values[name] + rest[len(name) :]
                else:
                    wanted = re.match(r"\w*", rest)
                    label = wanted[0] if wanted else ""
                    self.fault(
                        element.place, f"undefined parameter: ${label}; give it a value with -D {label}=..."
                    )
                    out += rest
            element.attributes[key] = out

    def _included(self, element: Element, path: Path, includes: int, depth: int) -> list[Element]:
        """The elements that replace an `<include>`."""
        name = element.attributes.get("filename", "")
        file = self._find(name, path, element)
        if file is None:
            return []
        if includes >= _MAX_INCLUDES:
            self.fault(element.place, f"files include each other more than {_MAX_INCLUDES} levels deep")
            return []
        try:
            root = self._read(file)
        except SceneError as error:
            if self._room <= 0:
                raise
            self.fault(element.place, f"included file: {error}")
            return []
        self._resolve(root, file, includes + 1, depth)
        if root.tag == "scene":
            return root.children
        if "name" in element.attributes:
            root.attributes["name"] = element.attributes["name"]
        root.attributes.pop("version", None)
        return [root]

    def _add_folder(self, element: Element, path: Path) -> None:
        """Handle a `<path>`: add a folder to the search path."""
        folder = path.parent / element.attributes.get("value", "")
        if folder.is_dir():
            self._folders.insert(0, folder)
        else:
            self.fault(element.place, f'<path>: folder "{element.attributes.get("value", "")}" not found')

    def _name_file(self, element: Element, outer: Element, path: Path) -> None:
        """Make the file name in a property of `outer` absolute."""
        if outer.tag in {"film", "integrator", "sampler"}:
            return
        if element.tag == "string" and element.name == "filename":
            key = "value"
        elif element.tag == "spectrum" and "filename" in element.attributes:
            key = "filename"
        else:
            return
        name = element.attributes.get(key, "")
        if outer.tag == "shape" and outer.kind in _MESHES and name and self._first(name, path) is None:
            self._without_file[outer] = element, name, path
            return
        file = self._find(name, path, element, outer)
        element.attributes[key] = str(file) if file else ""

    def _leave_out(self) -> None:
        """Remove the shapes whose mesh is missing; add a fault for those that emit."""
        if not self._without_file:
            return
        lights = emitter_names(self.root)
        dark: list[Element] = []
        for shape, (element, name, path) in self._without_file.items():
            if any(
                child.tag == "emitter" or (child.tag == "ref" and child.attributes.get("id") in lights)
                for child in shape.children
            ):
                self._find(name, path, element, shape)
            else:
                dark.append(shape)
                self.note("left out", shape, f"`{shape.kind}`: its file {name} is missing")
        if not dark:
            return
        followed, places = remove_shapes(self.root, dark)
        for shape in followed:
            self.note("left out", shape, f"`{shape.kind}`: all of its shapes are left out")
        self.faults = {fault: None for fault in self.faults if fault[0] not in places}

    def _first(self, name: str, path: Path) -> Path | None:
        """The first file of this name on the search path."""
        try:
            folders = (*self._folders, self.path.parent, path.parent)
            return next(
                (at for at in (named(folder, name) for folder in folders) if name and at.is_file()), None
            )
        except (OSError, ValueError):  # too long, or contains a null character
            return None

    def _find(self, name: str, path: Path, element: Element, outer: Element | None = None) -> Path | None:
        """The file of this name; adds a fault if there is none, or if it is outside the folder."""
        file = self._first(name, path)
        if file is None:
            what = "included file" if outer is None else f"`{outer.kind}` needs {name};"
            said = f'{what} "{name}" not found' if outer is None else f"{what} no such file in {path.parent}"
            self.fault(element.place, said)
            return None
        if not self.outside and not file.resolve().is_relative_to(self.path.parent.resolve()):
            text = f"{name} is outside the scene's folder; add --allow-outside if you trust this scene"
            self.fault(element.place, text)
        elif (wrong := lacking(file)) is not None:
            self.fault(element.place, f"{name} {wrong}")
        return file

    def _check_references(self) -> None:
        """Add faults for ids that are missing, given twice, or refer to each other in a cycle."""
        objects: dict[str, Element] = {}
        aliases: dict[str, str] = {}
        for element in self.root.walk():
            identity = element.attributes.get("id", "")
            if element.tag == "alias":
                aliases[element.attributes.get("as", "")] = identity
            elif identity and element.tag != "ref":
                if identity in objects:
                    self.fault(
                        element.place,
                        f'duplicate id "{identity}"; it is given on line {objects[identity].place.line}',
                    )
                objects.setdefault(identity, element)
        for new, old in aliases.items():
            if old in objects:
                objects.setdefault(new, objects[old])
        self.objects = objects
        for element in self.root.walk():
            target = element.attributes.get("id", "")
            if element.tag == "ref" and target not in objects:
                self.fault(element.place, f'unresolved reference to "{target}"')
        self._check_chains(objects)

    def _check_chains(self, objects: Mapping[str, Element]) -> None:
        """Add faults for references in a cycle, and for chains that are too long for Mitsuba's recursion."""
        depth: dict[Element, int] = {}
        targets = {
            element: {
                objects[ref.attributes["id"]]
                for ref in element.walk()
                if ref.tag == "ref" and ref.attributes.get("id") in objects
            }
            for element in dict.fromkeys(objects.values())
        }
        for start, first in targets.items():
            trail: list[tuple[Element, list[Element]]] = [(start, list(first))]
            on_trail = {start}
            while trail:
                element, rest = trail[-1]
                following = rest.pop() if rest else None
                if following is None:
                    trail.pop()
                    on_trail.discard(element)
                    depth[element] = 1 + max((depth.get(target, 0) for target in targets[element]), default=0)
                elif following in on_trail:
                    self.fault(
                        element.place, f'"{element.attributes.get("id")}" refers to itself, directly or not'
                    )
                elif following not in depth:
                    trail.append((following, list(targets[following])))
                    on_trail.add(following)
            if depth[start] > _MAX_REFERENCES:
                raise SceneError(f"{start.place}: references are chained more than {_MAX_REFERENCES} deep")


def _rename(element: Element) -> None:
    """Spell names of properties as Mitsuba 3 does: `toWorld` becomes `to_world`."""
    name = element.name
    new = _CAMEL.sub("_", name).lower() if len(name) > 1 else name
    if new != name and not name.startswith("_"):
        element.spelled = name
        element.attributes["name"] = new


def as_text(root: Element) -> tuple[str, list[Element]]:
    """The tree as XML for Mitsuba's parser, with one element per line, and the elements in the order of the lines."""
    lines: list[str] = []
    order: list[Element] = []
    waiting: list[Element | str] = [root]
    while waiting:
        element = waiting.pop()
        if isinstance(element, str):
            lines[-1] += element
            continue
        attributes = "".join(
            f" {key}={_quoted(value)}"
            for key, value in element.attributes.items()
            if not (element is root and key in _TIES)
        )
        if element is root:
            attributes += ' version="3.0.0"'
        order.append(element)
        if element.children:
            lines.append(f"<{element.tag}{attributes}>")
            waiting.append(f"</{element.tag}>")
            waiting.extend(reversed(element.children))
        else:
            lines.append(f"<{element.tag}{attributes}/>")
    return "\n".join(lines), order


def _quoted(value: str) -> str:
    """A value as an attribute; dollar signs are escaped, because all parameters are substituted already."""
    return quoteattr(value.replace("$", "\\$"))
