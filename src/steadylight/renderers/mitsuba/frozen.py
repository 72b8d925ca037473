"""Kernels that Python traces once: what was recorded runs again with other arrays (`drjit.freeze`).

To trace a frame takes Python longer than to run it, where pictures are small or cores are many.
"""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.memory import RECORDINGS

_ONE_AT_A_TIME = threading.RLock()
_FUNCTIONS: weakref.WeakSet[Any] = weakref.WeakSet()  # what `drjit.freeze` returned
_LOADED: dict[int, Loaded] = {}  # by the identity of the scene, which each keeps alive


class Loaded:
    """A scene as a recording is to see it: the variables of all that was loaded for it, each once.

    Given the scene itself, or a pointer to something in one, Dr.Jit looks at each call, twice, through all that Mitsuba
    has loaded: 25 ms for 1000 point lights. By this it looks through a list, by the two methods that Mitsuba's own
    objects have for it.

    What a kernel reads and the list lacks is an error of Dr.Jit's when that is recorded. So it is with several scenes:
    kernels have the code of all. Then each is seen whole.

    Attributes:
        scene: mi.Scene.
        whole: whether Dr.Jit looks at the scene itself.
    """

    def __init__(self, scene: mi.Scene, unasked: Iterable[mi.Object]) -> None:
        self.scene, self.whole = scene, False
        left_out = set(_variables([*scene.sensors(), *unasked]))
        self._variables = [each for each in _variables([scene, *scene.shapes()]) if each not in left_out]
        self._held = dr.detail.IndexVector()  # their numbers must not go to others
        for each in self._variables:
            self._held.append(each)

    def _traverse_1_cb_ro(self, see: Callable[[int, str, str], Any]) -> None:
        for variable in self._variables:
            see(variable, "", "")

    _traverse_1_cb_rw = _traverse_1_cb_ro


def loaded(scene: mi.Scene, unasked: Iterable[mi.Object] = ()) -> list[Loaded | mi.Scene]:
    """A scene that does not change as one of the inputs of a recording; its sensors, which move, are others.

    On a GPU the scene itself: Dr.Jit wants to meet there what owns the resources of rays and textures.

    Args:
        scene: which.
        unasked: objects of it that no kernel reads.
    """
    if mi.variant().startswith("cuda"):
        return [scene]
    if id(scene) not in _LOADED:
        _LOADED[id(scene)] = Loaded(scene, unasked)
    found = _LOADED[id(scene)]
    return [found.scene if found.whole else found]


def _variables(objects: Iterable[mi.Object]) -> list[int]:
    """Numbers of all variables of Dr.Jit's in these, each once."""
    with dr.scoped_set_flag(dr.JitFlag.EnableObjectTraversal, True):
        return list(dict.fromkeys(dr.detail.collect_indices(list(objects))))


def frozen(trace: Callable[..., Any], state: Callable[..., list[Any]]) -> Callable[..., Any]:
    """The same function, recorded at its first call with arguments of these kinds.

    Args:
        trace: of arrays, dataclasses and plain tuples of these, and what it returns of the same kinds; a named tuple
            would be returned as it was the first time. Opaque numbers only: others are compiled into the kernel.
        state: called with the same arguments; returns all else that the kernel reads: Mitsuba's sensor, and its scene,
            by itself or `loaded`, included.
    """
    recorded: Any = dr.freeze(trace, state_fn=state, limit=RECORDINGS, warn_after=1 << 30)
    _FUNCTIONS.add(recorded)

    def call(*given: Any) -> Any:
        if mi.variant().startswith("cuda") and not all(map(_recordable_on_gpu, _scenes(state(*given)))):
            return trace(*given)
        with _ONE_AT_A_TIME, _no_garbage_collection():
            try:
                return recorded(*given)
            except RuntimeError:
                # A recording does not outlive a change of what Mitsuba has loaded, for this scene or another.
                for each in _LOADED.values():
                    each.whole = True
                recorded.clear()
                return recorded(*given)

    return call


def forget_recordings() -> None:
    """Let go of all recordings and of the scenes that they hold."""
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
    """Whether Dr.Jit can record kernels that look at this scene, on a GPU.

    An environment map is a texture of the GPU's. Lanes that do not look read a null pointer instead, which Dr.Jit 1.5
    passes to the kernel as an argument of its own; to record that, it looks for the array behind it and, as there is
    none, ends the process.
    """
    environment = scene.environment()
    return environment is None or environment.class_name() != "EnvironmentMapEmitter"


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """What is recorded must not see arrays go that have nothing to do with it: Dr.Jit would end the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
