"""Reads USD files (`.usd`, `.usda`, `.usdc`, `.usdz`) in a process of its own.

USD's library may crash, run out of memory or never end on a damaged file, and it writes its warnings to stderr.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from steadylight import errors
from steadylight.errors import InputError, SceneError
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.usd.request import Request
from steadylight.settings import SceneOptions

TIME_LIMIT: Final = 3600.0
"""Seconds: beyond what the largest scene takes by far."""


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read a scene from a USD file.

    Args:
        path: of the file.
        options: `sensor`: a camera by its path, name or number; `allow_outside`: whether files outside the scene's
            folder may be read.

    Raises:
        SceneError: the message names the file, the prim, and the fault.
        SettingsError: there is no such camera.
    """
    path = Path(path).absolute()
    if not path.is_file():
        raise SceneError(f"{path}: no such scene file")
    try:
        with path.open("rb") as file:
            file.read(1)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from None
    sensor = None if options.sensor is None else str(options.sensor)
    return read_apart(Request(path, sensor, outside=bool(options.allow_outside)))


def read_apart(request: Request, time_limit: float = TIME_LIMIT) -> SceneDescription:
    """The scene of a USD file.

    Raises:
        SceneError: it cannot be read; one message, whatever happened in the other process.
        SettingsError: there is no such camera.
    """
    with TemporaryDirectory(prefix="steadylight-") as folder:
        place = Path(folder)
        (place / "request").write_bytes(pickle.dumps(request))
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
                    f"{request.path}: USD has not read it after {time_limit:g} s; it may be damaged"
                ) from None
        answer = place / "answer"
        if not answer.is_file():
            raise SceneError(f"{request.path}: USD cannot read it ({_end(done.returncode, place / 'said')})")
        kind, content = pickle.loads(answer.read_bytes())  # noqa: S301 - written by our own process, above
    if kind == "description":
        assert isinstance(content, SceneDescription)
        return content
    raise getattr(errors, kind)(content)


def _end(code: int, said: Path) -> str:
    """How a process ended without an answer."""
    if code < 0:
        try:
            return f"its library crashed: {signal.Signals(-code).name}"
        except ValueError:
            return f"its library crashed: signal {-code}"
    lines = [line for line in said.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1].strip()[:300] if lines else f"its library ended with code {code}"


def _answer(request: Request) -> tuple[str, Any]:
    """Kind and content of what the other process answers."""
    from pxr import Tf

    from steadylight.scenes.usd.reading import describe
    from steadylight.scenes.usd.stage import explain

    try:
        return "description", describe(request)
    except InputError as error:
        return type(error).__name__, str(error)
    except Tf.ErrorException as error:
        return "SceneError", f"{request.path}: USD cannot read it: {explain(error)}"
    except TypeError as error:
        # An attribute that is declared with another type than its schema has it comes as it is declared.
        text = f"an attribute is of another type than USD prescribes ({error})"
        return "SceneError", f"{request.path}: {text}"
    except MemoryError:
        return "SceneError", f"{request.path}: needs more memory than this machine has"


def main(folder: Path) -> None:
    """Answer the request in a folder."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    request: Request = pickle.loads((folder / "request").read_bytes())  # noqa: S301 - written by our own process
    answer = _answer(request)
    (folder / "answer.part").write_bytes(pickle.dumps(answer, protocol=5))
    (folder / "answer.part").rename(folder / "answer")
    os._exit(0)  # USD's own tear-down of a large stage takes seconds


if __name__ == "__main__":
    main(Path(sys.argv[1]))
