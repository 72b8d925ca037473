"""Removes shapes of a Mitsuba scene file whose mesh is missing, and what is useless without them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from steadylight.scenes.xml_elements import Element, Place


def emitter_names(root: Element) -> set[str]:
    """Ids and aliases of the emitters of a scene."""
    aliases: dict[str, list[str]] = {}
    waiting: list[str] = []
    for element in root.walk():
        name = element.attributes.get("id", "")
        if element.tag == "emitter":
            waiting.append(name)
        elif element.tag == "alias":
            aliases.setdefault(name, []).append(element.attributes.get("as", ""))
    names: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name and name not in names:
            names.add(name)
            waiting += aliases.get(name, [])
    return names


def remove_shapes(root: Element, shapes: Iterable[Element]) -> tuple[list[Element], set[Place]]:
    """Remove shapes from a scene, and the groups and instances that are left without a shape.

    Elements inside them that have an id are kept, except shapes, because other elements may refer to them.

    Args:
        root: root of the scene.
        shapes: shapes to remove.

    Returns:
        Groups without shapes and their instances, which were removed too; and the places of all removed elements.
    """
    gone = dict.fromkeys(shapes)
    followed: list[Element] = []
    while True:
        names = {shape.attributes["id"] for shape in gone if shape.attributes.get("id")}
        more = [
            element
            for element in root.walk()
            if element.tag == "shape" and element not in gone and _is_empty(element, gone, names)
        ]
        if not more:
            break
        followed += more
        gone |= dict.fromkeys(more)
    kept = [element for shape in gone for element in _named(shape)]
    places = {element.place for shape in gone for element in shape.walk()}
    places -= {element.place for each in kept for element in each.walk()}
    for element in root.walk():
        element.children = [
            child
            for child in element.children
            if child not in gone and not (child.tag == "ref" and child.attributes.get("id") in names)
        ]
    root.children = kept + root.children
    return followed, places


def _is_empty(shape: Element, gone: Iterable[Element], names: set[str]) -> bool:
    """Whether a shape is an instance of a removed group, or a group without remaining shapes."""
    lost = [
        child in gone or (child.tag == "ref" and child.attributes.get("id") in names)
        for child in shape.children
    ]
    if shape.kind == "instance":
        return any(lost)
    shapes = [
        is_lost for is_lost, child in zip(lost, shape.children, strict=True) if child.tag in {"shape", "ref"}
    ]
    return shape.kind == "shapegroup" and bool(shapes) and all(shapes)


def _named(element: Element) -> Iterator[Element]:
    """The outermost elements inside another that have an id of their own."""
    for child in element.children:
        if child.attributes.get("id") and child.tag not in {"ref", "shape"}:
            yield child
        else:
            yield from _named(child)
