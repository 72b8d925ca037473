"""Kernels that Python traces once: a recording is replayed with other arrays (`drjit.freeze`).

Where pictures are small or cores are many, tracing a frame in Python takes longer than running it.
"""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.memory import RECORDINGS

_ONE_AT_A_TIME = threading.RLock()
_FUNCTIONS: weakref.WeakSet[Any] = weakref.WeakSet()  # what `drjit.freeze` returned
_LOADED: dict[int, Loaded] = {}  # by id of the scene, which each keeps alive


class Loaded:
    """A scene as an input of recordings: all Dr.Jit variables that were loaded for it, each once.

    Given the scene itself, or a pointer to an object in one, Dr.Jit traverses all that Mitsuba has loaded, twice per
    call: 25 ms for 1000 point lights. Given this class, it traverses a list, through the two methods that Mitsuba's own
    objects have for that purpose.

    If a kernel reads something that is not in the list, recording it raises an error. This happens with several scenes,
    as kernels contain the code of all. Each scene is then passed as a whole.

    Attributes:
        scene: mi.Scene.
        whole: whether Dr.Jit traverses the scene itself.
        widths: of the variables.
    """

    def __init__(self, scene: mi.Scene, unasked: Iterable[mi.Object]) -> None:
        self.scene, self.whole = scene, False
        left_out = set(_variables([*scene.sensors(), *unasked]))
        self._variables = [each for each in _variables([scene, *scene.shapes()]) if each not in left_out]
        self._held = dr.detail.IndexVector()  # keeps their indices from being reused
        for each in self._variables:
            self._held.append(each)
        self.widths = _widths(self._variables)

    def _traverse_1_cb_ro(self, see: Callable[[int, str, str], Any]) -> None:
        for variable in self._variables:
            see(variable, "", "")

    _traverse_1_cb_rw = _traverse_1_cb_ro


def loaded(scene: mi.Scene, unasked: Iterable[mi.Object] = ()) -> list[Loaded | mi.Scene]:
    """A scene that does not change, as an input of a recording; its sensors, which move, are separate inputs.

    On a GPU, this is the scene itself: Dr.Jit must meet the owners of the ray tracing and texture resources there.

    Args:
        scene: mi.Scene.
        unasked: objects of it that no kernel reads.
    """
    if mi.variant().startswith("cuda"):
        return [scene]
    if id(scene) not in _LOADED:
        _LOADED[id(scene)] = Loaded(scene, unasked)
    found = _LOADED[id(scene)]
    return [found.scene if found.whole else found]


def _variables(objects: Iterable[mi.Object]) -> list[int]:
    """Indices of all Dr.Jit variables in these objects, each once."""
    with dr.scoped_set_flag(dr.JitFlag.EnableObjectTraversal, True):
        return list(dict.fromkeys(dr.detail.collect_indices(list(objects))))


def widths(state: Iterable[Any]) -> set[int]:
    """Widths of all arrays in a state; see `frozen`.

    Dr.Jit records a kernel again where arrays are equally wide that were not before: a batch of 24 records, where some
    mesh has 24 vertices. Arrays whose width varies should avoid these.
    """
    state = list(state)
    found: set[int] = set()
    arrays = []
    while state:
        each = state.pop()
        if isinstance(each, list):
            state += each
        elif isinstance(each, Loaded):
            found |= each.widths
        elif not isinstance(each, mi.Object):
            arrays.append(each)
    return found | _widths(dr.detail.collect_indices(arrays))


def _widths(variables: Sequence[int]) -> set[int]:
    """Widths of Dr.Jit variables, given by their indices."""
    # Whatever their types, as if they were integers.
    arrays: Any = dr.detail.update_indices([mi.UInt32(0)] * len(variables), variables)
    return {dr.width(each) for each in arrays}


def frozen(
    trace: Callable[..., Any],
    state: Callable[[Any], list[Any]],
    undo: Callable[..., None] | None = None,
) -> Callable[..., Any]:
    """The same function, recorded at its first call with arguments of these types and a state of this form.

    Args:
        trace: takes an object, which Dr.Jit does not traverse, and arrays, dataclasses and plain tuples of these; it
            returns the latter, since a named tuple would be returned as it was the first time. Numbers must be opaque:
            others are compiled into the kernel.
        state: called with that object; returns everything that the kernel reads through it, or that is compiled into
            it, including Mitsuba's sensor and its scene, either as such or `loaded`. Objects whose states have the same
            form share a recording, which keeps none of them alive.
        undo: called with the arguments of `trace` but the first if a recording has failed, perhaps after it ran: undoes
            what it has written to them. Not needed if it only returns arrays.
    """
    held = SimpleNamespace(what=None)  # a recording would look at an object that the function sees by itself
    recorded: Any = dr.freeze(
        lambda *given: trace(held.what, *given),
        state_fn=lambda *_: state(held.what),
        limit=RECORDINGS,
        warn_after=1 << 30,
    )
    _FUNCTIONS.add(recorded)

    def call(what: Any, *given: Any) -> Any:
        if mi.variant().startswith("cuda") and not all(map(_recordable_on_gpu, _scenes(state(what)))):
            return trace(what, *given)
        with _ONE_AT_A_TIME, _no_garbage_collection():
            held.what = what
            try:
                return recorded(*given)
            except RuntimeError:
                # A recording becomes invalid when Mitsuba loads or frees objects, of this scene or another.
                for each in _LOADED.values():
                    each.whole = True
                recorded.clear()
                if undo is not None:
                    dr.eval()  # what is still pending
                    undo(*given)
                return recorded(*given)
            finally:
                held.what = None

    return call


def forget_recordings() -> None:
    """Release all recordings and the scenes that they keep alive."""
    with _ONE_AT_A_TIME:
        _LOADED.clear()
        for recorded in list(_FUNCTIONS):
            recorded.clear()


def _scenes(state: Iterable[Any]) -> Iterator[mi.Scene]:
    for each in state:
        if isinstance(each, list):
            yield from _scenes(each)
        elif isinstance(each, mi.Scene):
            yield each


def _recordable_on_gpu(scene: mi.Scene) -> bool:
    """Whether Dr.Jit can record kernels that read this scene, on a GPU.

    An environment map is a GPU texture. Inactive lanes read a null pointer instead, which Dr.Jit 1.5 passes to the
    kernel as a separate argument. While recording, it looks for the array behind that pointer and, as there is none,
    aborts the process.
    """
    environment = scene.environment()
    return environment is None or environment.class_name() != "EnvironmentMapEmitter"


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Keep the garbage collector from freeing unrelated arrays while recording: Dr.Jit would abort the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
