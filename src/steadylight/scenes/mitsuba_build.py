"""Let Mitsuba parse and build a scene, and collect all the faults that it finds."""

from __future__ import annotations

import difflib
import re
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from steadylight.scenes.mitsuba_document import MAX_FAULTS, Document, as_text
from steadylight.scenes.mitsuba_faults import locate_fault
from steadylight.scenes.xml_elements import Element

_QUOTED = re.compile(r'"(\w+)"')


@dataclass
class Parsed:
    """A parsed scene.

    Attributes:
        state: Mitsuba's parse tree.
        scene: the scene, built from another such tree; None if it was not built.
        unread: names of the properties that no plugin read, by node number.
        elements: the element of each node.
    """

    state: Any
    scene: Any
    unread: dict[int, set[str]]
    elements: list[Element]


def build(document: Document) -> Parsed:
    """Parse and build a document.

    Raises:
        SceneError: lists all faults of the document and all that Mitsuba finds, each with its place.
    """
    if not document.faults:
        try:
            return _build(document.root)
        except (RuntimeError, ValueError) as error:
            _blame(document, document.root, error)
    _Search(document).run()
    document.refuse()
    raise AssertionError("Mitsuba built the parts of a scene, but not the whole")


def _configuration() -> Any:
    import mitsuba as mi

    config = mi.parser.ParserConfig(mi.variant() or "scalar_rgb")
    config.merge_meshes = config.merge_equivalent = config.parallel = False
    config.unused_properties = mi.LogLevel.Debug
    return config


def _parse(config: Any, text: str) -> Any:
    import mitsuba as mi

    state = mi.parser.parse_string(config, text)
    mi.parser.transform_all(config, state)
    return state


def _build(root: Element) -> Parsed:
    import mitsuba as mi

    config = _configuration()
    text, order = as_text(root)
    state = _parse(config, text)
    used = _parse(config, text)  # a second tree, because building marks the properties that it reads
    scene: Any = mi.parser.instantiate(config, used)
    unread = {number: set(node.props.unqueried()) for number, node in enumerate(used.nodes)}
    starts = [0]
    for line in text.encode().split(b"\n"):
        starts.append(starts[-1] + len(line) + 1)
    elements = [order[bisect_right(starts, node.offset) - 1] for node in state.nodes]
    return Parsed(state, scene, {number: names for number, names in unread.items() if names}, elements)


def _blame(document: Document, root: Element, error: Exception) -> Element:
    """Attribute an error to an element, add it to the faults, and return the element."""
    line, text = locate_fault(error)
    element = root if line is None else as_text(root)[1][line - 1]
    place = element.place
    for name in _QUOTED.findall(text):
        child = element.child(name)
        if child is not None:
            place, text = child.place, text.replace(f'"{name}"', f'"{child.spelled or name}"')
    document.fault(place, text)
    return element


def note_unread(document: Document, parsed: Parsed) -> None:
    """Note the properties that no plugin read."""
    for number, names in parsed.unread.items():
        element = parsed.elements[number]
        known = sorted(set(parsed.state.nodes[number].props.keys()) - names)
        for name in sorted(names):
            child = element.child(name) or element
            likely = [other for other in (*known, *_COMMON) if other != name]
            near = difflib.get_close_matches(name, likely, n=1, cutoff=0.8)
            hint = f"; did you mean `{near[0]}`?" if near else ""
            spelled = child.spelled or name
            document.note("left out", child, f"`{element.kind}` has no property `{spelled}`{hint}")


_COMMON = tuple(
    re.findall(
        r"\w+",
        "to_world to_uv filename face_normals flip_normals reflectance diffuse_reflectance "
        "specular_reflectance specular_transmittance int_ior ext_ior alpha alpha_u alpha_v distribution "
        "material eta k nonlinear weight opacity base_color roughness metallic specular radiance intensity "
        "irradiance scale cutoff_angle beam_width position direction turbidity albedo sun_direction sun_scale "
        "sky_scale sun_aperture center radius p0 p1 width height fov fov_axis focal_length near_clip far_clip "
        "aperture_radius focus_distance filter_type wrap_mode raw color0 color1 ",
    )
)
"""Most common names of properties, for suggestions."""


class _Search:
    """Finds the faults of each of the scene's children, even if others are faulty."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.root = document.root
        self.owner = {inner: child for child in self.root.children for inner in child.walk()}
        self.blamed = {place for place, _ in document.faults}
        self.faulty = {child for inner, child in self.owner.items() if inner.place in self.blamed}
        self.users: dict[Element, set[Element]] = {}
        for child in self.root.children:
            for target in self._targets(child):
                self.users.setdefault(target, set()).add(child)

    def run(self) -> None:
        """Parse everything without a known fault, then build each child with what it refers to."""
        self._remove(element for element in self.owner if element.place in self.blamed)
        config = _configuration()
        import mitsuba as mi

        while len(self.document.faults) < MAX_FAULTS:
            try:
                mi.parser.parse_string(config, as_text(self.root)[0])
                break
            except (RuntimeError, ValueError) as error:
                element = _blame(self.document, self.root, error)
                if element is self.root:
                    return
                self.faulty.add(self.owner[element])
                self._remove([element])
        self._spread()
        for child in self.root.children:
            if child not in self.faulty and len(self.document.faults) < MAX_FAULTS:
                self._try(child)

    def _remove(self, elements: Iterable[Element]) -> None:
        """Remove elements and the references to them from the tree."""
        gone = {inner for element in elements for inner in element.walk()}
        ids = {element.attributes.get("id") for element in gone if element.tag != "ref"} - {None}
        for element in list(self.root.walk()):
            element.children = [
                child
                for child in element.children
                if child not in gone
                and not (child.tag in {"ref", "alias"} and child.attributes.get("id") in ids)
            ]

    def _targets(self, child: Element) -> set[Element]:
        """Children of the scene to which a child refers directly."""
        objects = self.document.objects
        named = (objects.get(each.attributes.get("id", "")) for each in child.walk() if each.tag == "ref")
        return {self.owner[target] for target in named if target in self.owner} - {child}

    def _spread(self) -> None:
        """Mark children that refer to a faulty one, directly or not, as faulty: they cannot be built."""
        waiting = list(self.faulty)
        while waiting:
            for user in self.users.get(waiting.pop(), set()) - self.faulty:
                self.faulty.add(user)
                waiting.append(user)

    def _try(self, child: Element) -> None:
        """Build a child with everything that it refers to; materials of shapes are built on their own."""
        needed: dict[Element, None] = {child: None}
        waiting = [child]
        while waiting:
            for target in self._targets(waiting.pop()):
                if target not in needed and not (child.tag == "shape" and target.tag == "bsdf"):
                    needed[target] = None
                    waiting.append(target)
        kept = {inner.attributes.get("id") for each in needed for inner in each.walk() if inner.tag != "ref"}
        aliases = [
            each for each in self.root.children if each.tag == "alias" and each.attributes.get("id") in kept
        ]
        part = Element("scene", {}, self.root.place)
        part.children = [
            _without_references(each, kept | {alias.attributes.get("as") for alias in aliases})
            for each in (*needed, *aliases)
        ]
        try:
            _build(part)
        except (RuntimeError, ValueError) as error:
            _blame(self.document, part, error)


def _without_references(element: Element, kept: set[str | None]) -> Element:
    """A copy without references to ids that are not in `kept`."""
    copy = Element(element.tag, element.attributes, element.place, version=element.version)
    copy.children = [
        _without_references(child, kept)
        for child in element.children
        if child.tag != "ref" or child.attributes.get("id") in kept
    ]
    return copy
