"""Kernels that Python traces once: what was recorded runs again with other arrays (`drjit.freeze`).

To trace a frame takes Python longer than to run it, where pictures are small or cores are many.
"""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.memory import RECORDINGS

_ONE_AT_A_TIME = threading.RLock()
_FUNCTIONS: weakref.WeakSet[Any] = weakref.WeakSet()  # what `drjit.freeze` returned


def frozen(trace: Callable[..., Any], state: Callable[..., list[Any]]) -> Callable[..., Any]:
    """The same function, recorded at its first call with arguments of these kinds.

    Args:
        trace: of arrays, dataclasses and plain tuples of these, and what it returns of the same kinds; a named tuple
            would be returned as it was the first time. Opaque numbers only: others are compiled into the kernel.
        state: called with the same arguments; returns all else that the kernel reads, Mitsuba's scene and sensor
            included. The scene is one of the arguments, or of what this returns, by itself.
    """
    recorded: Any = dr.freeze(trace, state_fn=state, limit=RECORDINGS, warn_after=1 << 30)
    _FUNCTIONS.add(recorded)

    def call(*given: Any) -> Any:
        if mi.variant().startswith("cuda"):
            scenes = (each for each in (*given, *state(*given)) if isinstance(each, mi.Scene))
            if not all(_recordable_on_gpu(scene) for scene in scenes):
                return trace(*given)
        with _ONE_AT_A_TIME, _no_garbage_collection():
            try:
                return recorded(*given)
            except RuntimeError:
                # A recording does not outlive a change of what Mitsuba has loaded, for this scene or another.
                recorded.clear()
                return recorded(*given)

    return call


def forget_recordings() -> None:
    """Let go of all recordings and of the scenes that they hold."""
    with _ONE_AT_A_TIME:
        for recorded in list(_FUNCTIONS):
            recorded.clear()


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
