"""Radiance's programs from pyradiance: finds and runs them."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from steadylight.errors import BackendError, RunError

_LONGEST = 2000
"""Maximum number of characters of a program's error message to show."""


@lru_cache(maxsize=1)
def home() -> Path:
    """The folder of pyradiance, with `bin` and `lib`.

    Raises:
        BackendError: it is not installed; the message says how to install it.
    """
    # Found without importing the package, which would load all of it.
    spec = find_spec("pyradiance")
    folder = (
        Path(next(iter(spec.submodule_search_locations)))
        if spec and spec.submodule_search_locations
        else None
    )
    if folder is None or not (folder / "bin").is_dir():
        raise BackendError(
            "Radiance's programs were not found; install them with "
            f"`{shlex.join([sys.executable, '-m', 'pip', 'install', 'pyradiance'])}`"
        )
    return folder


def command(program: str, *arguments: object) -> list[str]:
    """The command line of one of Radiance's programs."""
    return [str(home() / "bin" / program), *map(str, arguments)]


def environment(folder: Path, *, alone: bool = False) -> dict[str, str]:
    """Environment in which the programs find each other, Radiance's files and those of the scene in `folder`.

    Args:
        folder: folder of the scene.
        alone: whether they can find only each other, and no other programs.
    """
    found = str(home() / "bin")
    return os.environ | {
        "RAYPATH": os.pathsep.join([str(folder.absolute()), str(home() / "lib")]),
        "PATH": found if alone else os.pathsep.join([found, os.environ.get("PATH", "")]),
    }


def output_of(
    folder: Path, program: str, *arguments: object, given: bytes = b"", seconds: float | None = None
) -> bytes:
    """Run a program in a folder, on one core, and wait for it.

    Args:
        folder: its working directory, which is also searched for files.
        program: name of the program.
        arguments: arguments of the command line.
        given: standard input.
        seconds: time after which it is ended; None for no limit.

    Returns:
        Standard output of the program.

    Raises:
        BackendError: pyradiance is not installed, or the program cannot be started.
        RunError: the program failed, with its own message, or took too long.
    """
    call = command(program, *arguments)
    try:
        done = subprocess.run(  # noqa: S603 - a program of an installed package
            call,
            cwd=folder,
            env=environment(folder),
            input=given,
            capture_output=True,
            check=False,
            timeout=seconds,
        )
    except subprocess.TimeoutExpired:
        raise RunError(f"{program} took more than {seconds:g} s") from None
    except OSError as error:
        raise BackendError(f"{call[0]}: cannot be started ({error}); reinstall pyradiance") from error
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip()
        raise RunError(f"{program} failed: {said[-_LONGEST:] or f'exit code {done.returncode}'}")
    return done.stdout


@lru_cache(maxsize=1)
def version() -> str:
    """The version of the programs, such as `RADIANCE 6.0a`."""
    return output_of(Path.cwd(), "rpict", "-version").decode().strip()
