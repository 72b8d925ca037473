"""Reads scene files in a separate process.

On a damaged file, C++ libraries may crash, run out of memory or never return, and they write to stderr as they like.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from steadylight import errors
from steadylight.errors import SceneError, SteadylightError
from steadylight.scenes.description import SceneDescription

TIME_LIMIT: Final = 3600.0
"""Seconds: far more than the largest scene takes."""


@dataclass(frozen=True)
class Reading:
    """What to read: the request to the other process.

    Attributes:
        path: path of the scene file, for messages.
        library: name of the library that reads it, for messages.
        module: full name of the module whose function `described` makes the description.
        request: argument of that function; plain data.
    """

    path: Path
    library: str
    module: str
    request: Any


def read_apart(reading: Reading, time_limit: float = TIME_LIMIT) -> SceneDescription:
    """Read a scene file in another process.

    Raises:
        SceneError: it cannot be read, whatever happened in the other process.
        SteadylightError: raised by the module.
    """
    with TemporaryDirectory(prefix="steadylight-") as folder:
        place = Path(folder)
        (place / "request").write_bytes(pickle.dumps(reading))
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PXR_AR_")}
        environment["PYTHONPATH"] = os.pathsep.join(entry for entry in sys.path if entry)
        with (place / "said").open("wb") as said:
            try:
                done = subprocess.run(  # noqa: S603 - our own module, in our own interpreter
                    [sys.executable, "-m", __name__, folder],
                    stdin=subprocess.DEVNULL,
                    stdout=said,
                    stderr=said,
                    env=environment,
                    timeout=time_limit,
                    check=False,
                )
            except subprocess.TimeoutExpired:
                raise SceneError(
                    f"{reading.path}: {reading.library} did not finish reading it within {time_limit:g} s; it may be "
                    "damaged"
                ) from None
        answer = place / "answer"
        if not answer.is_file():
            end = _end(done.returncode, place / "said")
            raise SceneError(f"{reading.path}: {reading.library} cannot read it ({end})")
        kind, content = pickle.loads(answer.read_bytes())  # noqa: S301 - written by our own process, above
    if kind == "description":
        assert isinstance(content, SceneDescription)
        return content
    raise getattr(errors, kind)(content)


def _end(code: int, said: Path) -> str:
    """Description of how a process ended without an answer."""
    if code < 0:
        try:
            return f"its library crashed: {signal.Signals(-code).name}"
        except ValueError:
            return f"its library crashed: signal {-code}"
    lines = [line for line in said.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1].strip()[:300] if lines else f"its library exited with code {code}"


def answer_to(reading: Reading) -> tuple[str, Any]:
    """The answer of the other process: its kind and content."""
    try:
        return "description", import_module(reading.module).described(reading.request)
    except SteadylightError as error:
        return type(error).__name__, str(error)
    except MemoryError:
        return "SceneError", f"{reading.path}: needs more memory than this machine has"


def main(folder: Path) -> None:
    """Answer the request in a folder."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    reading: Reading = pickle.loads((folder / "request").read_bytes())  # noqa: S301 - written by our own process
    answer = answer_to(reading)
    (folder / "answer.part").write_bytes(pickle.dumps(answer, protocol=5))
    (folder / "answer.part").rename(folder / "answer")
    os._exit(0)  # skips USD's tear-down, which takes seconds for a large stage


if __name__ == "__main__":
    main(Path(sys.argv[1]))
