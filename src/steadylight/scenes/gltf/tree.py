"""The nodes of a glTF scene: which are visible, and where they are at which time.

Matrices are (4, 4) or (T, 4, 4), from the node to the file's world (y up, metres).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.gltf.curves import Curve
from steadylight.scenes.gltf.document import File
from steadylight.scenes.gltf.schema import Channel, Node

Array = NDArray[np.float64]

_POINTER: Final = re.compile(r"/(nodes|cameras)/(\d+)/(?:(perspective|orthographic)/)?(\w+)")
_WIDTHS: Final = {"translation": 3, "rotation": 4, "scale": 3, "yfov": 1}


class Tree:
    """The nodes of the scene that is shown.

    Attributes:
        order: indices of the nodes, parents first.
        parents: parent of each node, or None.
        curves: animation curves, by `("nodes", index, "translation")` or `("cameras", index, "yfov")`.
        unread: names of other animated properties.
    """

    def __init__(self, file: File) -> None:
        """Traverse the scene's nodes.

        Raises:
            SceneError: a node is its own ancestor, or has two parents.
        """
        self._file = file
        self.order: list[int] = []
        self.parents: dict[int, int | None] = {}
        self.curves: dict[tuple[str, int, str], Curve] = {}
        self.unread: set[str] = set()
        self._rest: dict[int, Array] = {}
        pending: list[tuple[int, int | None, str]] = [(*root, "scenes") for root in self._roots()]
        while pending:
            index, parent, place = pending.pop()
            node = file.item("nodes", file.document.nodes, index, place)
            if index in self.parents:
                raise file.fault(
                    f"nodes[{index}]", "is reached twice: a node must have one parent and not contain itself"
                )
            self.order.append(index)
            self.parents[index] = parent
            pending += [(child, index, f"nodes[{index}].children") for child in reversed(node.children)]
        for number, animation in enumerate(file.document.animations):
            for at, channel in enumerate(animation.channels):
                self._add(channel, number, f"animations[{number}].channels[{at}]")

    def _roots(self) -> list[tuple[int, None]]:
        """Root nodes of the scene that is shown, last first."""
        document = self._file.document
        if document.scenes:
            scene = self._file.item("scenes", document.scenes, document.scene or 0, "scene")
            return [(index, None) for index in reversed(scene.nodes)]
        below = {child for node in document.nodes for child in node.children}
        return [(index, None) for index in reversed(range(len(document.nodes))) if index not in below]

    def node(self, index: int) -> Node:
        """A node of the document."""
        return self._file.document.nodes[index]

    def name(self, index: int) -> str:
        """Name of a node to show."""
        return self.node(index).name or f"node {index}"

    def chain(self, index: int) -> list[int]:
        """The path to a node: its ancestors, outermost first, and the node itself."""
        found: list[int] = []
        at: int | None = index
        while at is not None:
            found.append(at)
            at = self.parents[at]
        return found[::-1]

    def _add(self, channel: Channel, number: int, place: str) -> None:
        """Add the curve of a channel."""
        target = channel.target
        sampler = self._file.item(
            f"animations[{number}].samplers",
            self._file.document.animations[number].samplers,
            channel.sampler,
            place,
        )
        pointer = target.extensions.pointer
        if pointer is not None:
            found = _POINTER.fullmatch(pointer.pointer)
            key = None if found is None else (found[1], int(found[2]), found[4])
            shown = pointer.pointer
        else:
            key = None if target.node is None else ("nodes", target.node, target.path)
            shown = "morph targets" if target.path == "weights" else target.path
        if key is None or key[2] not in _WIDTHS:
            self.unread.add(shown)
            return
        if key not in self.curves:
            self.curves[key] = Curve(self._file, sampler, _WIDTHS[key[2]], place)

    def moving(self, index: int) -> list[Curve]:
        """The curves that move a node, directly or by its ancestors."""
        at = set(self.chain(index))
        return [curve for (kind, node, _), curve in self.curves.items() if kind == "nodes" and node in at]

    @cached_property
    def moved(self) -> frozenset[int]:
        """Nodes that have curves of their own, and all below them."""
        found = {index for kind, index, _ in self.curves if kind == "nodes"}
        for index in self.order:
            if self.parents[index] in found:
                found.add(index)
        return frozenset(found)

    def world(self, index: int) -> Array:
        """World matrix of a node without animation, (4, 4)."""
        missing: list[int] = []
        above: int | None = index
        while above is not None and above not in self._rest:
            missing.append(above)
            above = self.parents[above]
        for at in reversed(missing):
            parent = self.parents[at]
            outer = np.eye(4) if parent is None else self._rest[parent]
            self._rest[at] = outer @ _local(self.node(at))
            if not np.isfinite(self._rest[at]).all():
                raise self._file.fault(f"nodes[{at}]", "its world position is not finite")
        return self._rest[index]

    def world_at(self, index: int, times: Array) -> Array:
        """World matrices of a node at times, (T, 4, 4)."""
        found = np.broadcast_to(np.eye(4), (len(times), 4, 4))
        for at in self.chain(index):
            found = found @ self._local_at(at, times)
        return np.asarray(found)

    def _local_at(self, index: int, times: Array) -> Array:
        """Matrices of a node relative to its parent at times, (T, 4, 4)."""
        node = self.node(index)
        curves = {
            part: self.curves.get(("nodes", index, part)) for part in ("translation", "rotation", "scale")
        }
        if not any(curves.values()):
            return np.broadcast_to(_local(node), (len(times), 4, 4))
        parts = {}
        for part, curve in curves.items():
            still = np.asarray(getattr(node, part), np.float64)
            parts[part] = (
                np.broadcast_to(still, (len(times), len(still))) if curve is None else curve.at(times)
            )
        return composed(parts["translation"], parts["rotation"], parts["scale"])

    def among(self, indices: Iterable[int]) -> list[int]:
        """The given nodes that are in the scene, in the order of the file."""
        return sorted(index for index in indices if index in self.parents)

    def visible(self, indices: Iterable[int]) -> list[int]:
        """The given nodes that are in the scene and visible, in the order of the file."""
        return [index for index in self.among(indices) if index not in self._hidden]

    @cached_property
    def _hidden(self) -> frozenset[int]:
        """Hidden nodes, and all nodes below them."""
        found: set[int] = set()
        for index in self.order:
            if self.parents[index] in found or not self.node(index).extensions.visibility.visible:
                found.add(index)
        return frozenset(found)


def _local(node: Node) -> Array:
    """Matrix of a node relative to its parent without animation, (4, 4)."""
    if node.matrix is not None:
        return np.array(node.matrix, np.float64).reshape(4, 4).T
    place, turn, size = (
        np.array([part], np.float64) for part in (node.translation, node.rotation, node.scale)
    )
    return np.asarray(composed(place, turn, size)[0])


def composed(translation: Array, rotation: Array, scale: Array) -> Array:
    """Matrices of translation (T, 3), rotation (T, 4) (quaternions x, y, z, w) and scale (T, 3): (T, 4, 4)."""
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    unit = np.where(length > 0, rotation / np.where(length > 0, length, 1.0), [0.0, 0.0, 0.0, 1.0])
    x, y, z, w = unit.T
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    found = np.broadcast_to(np.eye(4), (len(translation), 4, 4)).copy()
    found[:, :3, :3] = np.moveaxis(turn, 2, 0) * scale[:, None, :]
    found[:, :3, 3] = translation
    return found
