"""Radiance's programs, as pyradiance brings them: where they are, and running one of them."""

from __future__ import annotations

import os
import subprocess
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from steadylight.errors import BackendError, RunError

_LONGEST = 2000
"""Characters of a program's complaint that are shown."""


@lru_cache(maxsize=1)
def home() -> Path:
    """The folder of pyradiance, with `bin` and `lib`.

    Raises:
        BackendError: it is not installed; says how to.
    """
    # The package itself is not imported: it loads everything that it has.
    spec = find_spec("pyradiance")
    folder = (
        Path(next(iter(spec.submodule_search_locations)))
        if spec and spec.submodule_search_locations
        else None
    )
    if folder is None or not (folder / "bin").is_dir():
        raise BackendError(
            "Radiance's programs were not found: install them with `pip install 'steadylight[radiance]'` "
            "(in a clone of the project: `pip install -e '.[radiance]'`)"
        )
    return folder


def command(program: str, *arguments: object) -> list[str]:
    """A call of one of Radiance's programs."""
    return [str(home() / "bin" / program), *map(str, arguments)]


def environment(folder: Path) -> dict[str, str]:
    """Where the programs find each other, Radiance's files and those of the scene in `folder`."""
    return os.environ | {
        "RAYPATH": os.pathsep.join([str(folder.absolute()), str(home() / "lib")]),
        "PATH": os.pathsep.join([str(home() / "bin"), os.environ.get("PATH", "")]),
    }


def output_of(folder: Path, program: str, *arguments: object, given: bytes = b"") -> bytes:
    """Run a program in a folder, on one core, until it ends.

    Args:
        folder: its working directory, where it also looks for files.
        program: its name.
        arguments: of the command line.
        given: what it reads from its standard input.

    Returns:
        What it wrote to its standard output.

    Raises:
        BackendError: pyradiance is not installed, or the program cannot be started.
        RunError: the program failed; carries its words.
    """
    call = command(program, *arguments)
    try:
        done = subprocess.run(  # noqa: S603 - the programs of an installed package
            call, cwd=folder, env=environment(folder), input=given, capture_output=True, check=False
        )
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
