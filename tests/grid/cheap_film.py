# ruff: noqa: T201 - it is a program
"""A film whose light costs next to nothing: real plan, directory, journal and files, made-up tasks.

As a program it is the command under test: `python cheap_film.py DIRECTORY ...`.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import signal
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np

from steadylight.animation.request import prepare
from steadylight.animation.run import Session
from steadylight.animation.tasks import validators_of
from steadylight.atomic_file import atomic_write
from steadylight.cache.file import CacheFile, encode_cache, encode_points
from steadylight.cache.records import Records
from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import SteadylightError
from steadylight.images import validate_exr, write_exr
from steadylight.renderers.base import Backend
from steadylight.renderers.mitsuba.plugin import RENDERER, MitsubaRenderer
from steadylight.scenes.description import SceneDescription
from steadylight.storage import RunDirectory

SCENE = SceneDescription(
    name="cheap",
    content={},
    camera=CameraPath((Keyframe(0.0, (0, 0, 0), (1, 0, 0)), Keyframe(4.0, (1, 0, 0), (2, 1, 0)))),
    width=16,
    height=8,
    frames=100,
)


class Unchecked(MitsubaRenderer):
    """Takes any scene, without Mitsuba."""

    def check(self, *_, **__):
        return Backend("llvm_ad_rgb", {})


def perform(task, *, directory, seconds=0.0, pixels=(16, 8), poison=None):
    """Burn time, write what the task's kind writes, and note who did it; nothing if it is done already."""
    run = RunDirectory(directory)
    if (
        poison is not None
        and Path(poison).exists()
        and Path(poison).read_text() == os.environ.get("HOST_NAME")
    ):
        raise RuntimeError("this host is poisoned")
    settings = prepare(SCENE, size=pixels).settings
    if (run.root / run.result_name(task.key)).exists() and run.is_done(
        task, validators_of(RENDERER, settings, SCENE.hash)
    )[0]:
        return run.read_result(task.key)
    end = time.monotonic() + seconds * (task.stage == "shade")
    while time.monotonic() < end:
        hashlib.sha256(b"light" * 100000)
    path = run.root / task.outputs[0]
    seed = int.from_bytes(hashlib.sha256(task.key.encode()).digest()[:8])
    if path.suffix == ".exr":
        image = np.random.default_rng(seed).random((pixels[1], pixels[0], 3), np.float32)
        with atomic_write(path, lambda temporary: validate_exr(temporary, *pixels), once=True) as temporary:
            write_exr(temporary, image)
    else:
        points = path.suffix == ".points"
        empty = (*np.zeros((2, 0, 3), np.float32), *np.zeros((3, 0), np.float32))
        about = CacheFile(Records.empty(), SCENE.hash, {"task": task.key})
        with atomic_write(path, once=True) as temporary:
            temporary.write_bytes(encode_points(*empty, SCENE.hash) if points else encode_cache(about))
    result = {
        "seconds": seconds,
        "missed": 0,
        "new_records": 0,
        "records": 0,
        "rays": 0,
        "hits": 0,
        "misses": 0,
    }
    result |= {"records_in": 0, "records_out": 0, "looked_up": 0}
    run.write_result(task.key, result, task.outputs)
    note(run.root.with_name(run.root.name + ".performed"), task.key)
    return result


def note(path, line):
    """Add a line that others cannot cut."""
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    os.write(descriptor, f"{line}\n".encode())
    os.close(descriptor)


def performed(directory):
    """Tasks in the order in which their outputs were committed."""
    path = directory.with_name(directory.name + ".performed")
    return path.read_text().split() if path.exists() else []


def main(arguments):
    parser = argparse.ArgumentParser()
    parser.add_argument("directory", type=Path)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--seconds", type=float, default=0.1)
    parser.add_argument("--size", default="16x8")
    parser.add_argument("--cluster", default="local")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--site")
    parser.add_argument("--poison")
    given = parser.parse_args(arguments)

    def stop(_number, _frame):
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)
    pixels = tuple(map(int, given.size.split("x")))
    try:
        request = prepare(
            SCENE,
            frames=given.frames,
            size=pixels,
            output=given.directory,
            cluster=given.cluster,
            workers=given.workers,
            site=given.site,
        )
        work = partial(
            perform,
            directory=str(given.directory.resolve()),
            seconds=given.seconds,
            pixels=pixels,
            poison=given.poison,
        )
        request = dataclasses.replace(request, renderer=Unchecked())
        with Session(request, perform=work) as session:
            for fault in session.faults:
                print(fault, flush=True)
            session.start_engine()
            print(session.dashboard, flush=True)
            for attempt in session:
                words = {"key": attempt.task.key, "outcome": attempt.outcome, "cause": attempt.cause}
                print(json.dumps(words | {"worker": attempt.worker}), flush=True)
            print(json.dumps(session.finish().statistics["tasks"]), flush=True)
    except SteadylightError as error:
        print(f"Error: {error}", flush=True)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    # Workers import this file by its name, not as the main program.
    import cheap_film

    sys.exit(cheap_film.main(sys.argv[1:]))
