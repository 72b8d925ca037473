"""Elements of an XML file with their places: read without recursion, and with limits on depth, number and size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from steadylight.errors import SceneError

MAX_DEPTH = 100
"""Maximum nesting depth of elements; real scenes have some ten levels."""
MAX_ELEMENTS = 2_000_000
"""Maximum number of elements of a scene and all that it includes: about a gigabyte of memory."""
MAX_BYTES = 2**29
"""Maximum size of one file."""

_EXPLAINED = {
    "mismatched tag": "this closing tag does not match the last opened one; close inner elements first",
    "no element found": "the file is empty, or ends before its elements are closed",
    "not well-formed (invalid token)": "an invalid character; a file that is not UTF-8 needs "
    '<?xml version="1.0" encoding="..."?> as its first line',
}


@dataclass(frozen=True, order=True)
class Place:
    """Place in a file: line and column are counted from 1; the column is that of an element's name."""

    file: str
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.file}: line {self.line}, column {self.column}"


@dataclass(eq=False)
class Element:
    """An element; text between elements is ignored.

    Attributes:
        tag: tag name.
        attributes: attributes by name, as in the file until they are resolved.
        place: place in the file.
        children: child elements.
        spelled: the attribute `name` as in the file, if it was renamed.
        version: format version of the file, such as (0, 6, 0).
        gain: factor on the linear RGB values of a picture, for which Mitsuba has no property; empty for 1.
    """

    tag: str
    attributes: dict[str, str]
    place: Place
    children: list[Element] = field(default_factory=list)
    spelled: str = ""
    version: tuple[int, ...] = ()
    gain: list[float] = field(default_factory=list)

    @property
    def name(self) -> str:
        """The attribute `name`: name of the parent's property that this element is; empty without one."""
        return self.attributes.get("name", "")

    @property
    def kind(self) -> str:
        """The attribute `type`: name of a plugin."""
        return self.attributes.get("type", "")

    def walk(self) -> Iterator[Element]:
        """This element and all its descendants, each before its children, in the order of the file."""
        waiting = [self]
        while waiting:
            element = waiting.pop()
            yield element
            waiting.extend(reversed(element.children))

    def child(self, name: str) -> Element | None:
        """The first child that is the property `name`."""
        return next((child for child in self.children if child.name == name), None)

    def text(self, name: str, default: str = "") -> str:
        """The value of a property."""
        child = self.child(name)
        return default if child is None else child.attributes.get("value", default)

    def drop(self, *names: str) -> None:
        """Remove properties."""
        self.children = [child for child in self.children if child.name not in names]

    def put(self, tag: str, name: str, value: str) -> None:
        """Set a property; its place is that of an existing property of this name, or else of this element."""
        old = self.child(name)
        new = Element(tag, {"name": name, "value": value}, (old or self).place, version=self.version)
        self.children = [child for child in self.children if child is not old] + [new]

    def within(self, tag: str, kind: str, name: str = "") -> Element:
        """A new element for a plugin, with the place of this element; not yet a child of anything."""
        attributes = {"type": kind} | ({"name": name} if name else {})
        return Element(tag, attributes, self.place, version=self.version)


def read_elements(path: Path, room: int = MAX_ELEMENTS) -> Element:
    """The outermost element of a file.

    Args:
        path: path of the file.
        room: maximum number of elements.

    Raises:
        SceneError: the file is not XML, or exceeds a limit; the message gives file, line and column.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SceneError(f"{path}: is larger than {MAX_BYTES >> 20} MiB; keep meshes in separate files")
        with path.open("rb") as file:
            return _Builder(str(path), room).read(file)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from None


class _Builder:
    """Builds elements from expat's events."""

    def __init__(self, file: str, room: int) -> None:
        self.file = file
        self.room = room
        self.open: list[Element] = []
        self.root: Element | None = None
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.EntityDeclHandler = self._entity

    def read(self, file: Any) -> Element:
        try:
            self.parser.ParseFile(file)
        except expat.ExpatError as error:
            words = expat.errors.messages[error.code]
            place = Place(self.file, error.lineno, error.offset + 1)
            raise SceneError(f"{place}: not valid XML: {_EXPLAINED.get(words, words)}") from None
        except (LookupError, ValueError) as error:  # from expat's encoding handler
            raise SceneError(f"{self._here()}: not valid XML: {error}") from None
        assert self.root is not None
        return self.root

    def _here(self) -> Place:
        return Place(self.file, self.parser.CurrentLineNumber, self.parser.CurrentColumnNumber + 2)

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, self._here())
        self.room -= 1
        if len(self.open) >= MAX_DEPTH:
            raise SceneError(f"{element.place}: elements are nested more than {MAX_DEPTH} levels deep")
        if self.room < 0:
            raise SceneError(f"{element.place}: the scene has more than {MAX_ELEMENTS} elements")
        if self.open:
            self.open[-1].children.append(element)
        else:
            self.root = element
        self.open.append(element)

    def _end(self, _tag: str) -> None:
        self.open.pop()

    def _entity(self, *_declaration: object) -> None:
        raise SceneError(f"{self._here()}: a scene file may not declare entities")
