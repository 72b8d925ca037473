"""The command line: arguments and exit codes. Console output is in `display` and `progress`.

Exit codes: 0 success; 1 permanent failure (`cache diff`: the caches differ); 2 bad input or usage, or the
output cannot be written; 130 stopped by Ctrl-C.
"""

from __future__ import annotations

import errno
import io
import sys
import traceback
from typing import NoReturn

from steadylight.cli.application import app, debugging
from steadylight.display import err
from steadylight.errors import SteadylightError, TaskFailed
from steadylight.redaction import redacted

# Importing a module adds its commands; `--help` lists them in this order.
# isort: off
from steadylight.cli import rendering  # noqa: F401
from steadylight.cli import walking  # noqa: F401
from steadylight.cli import previewing  # noqa: F401
from steadylight.cli import results  # noqa: F401
from steadylight.cli import watching  # noqa: F401
from steadylight.cli import demo  # noqa: F401
from steadylight.cli import scenes  # noqa: F401
from steadylight.cli import caches  # noqa: F401
from steadylight.cli import farms  # noqa: F401
from steadylight.cli import inspecting  # noqa: F401
# isort: on

__all__ = ["app", "main"]


def main() -> None:
    """Run a command; every error becomes a message and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # file names need not be valid text
    try:
        app()
    except SteadylightError as error:
        _fail(error, str(error), error.exit_code)
    except (MemoryError, RuntimeError, OSError, ImportError) as error:
        if isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT}:
            # Errors of output files are StorageError already: this is the disk of redirected text or temporary files.
            where = (
                f"{error.filename}: " if error.filename else "what this command prints, or a temporary file: "
            )
            _fail(error, f"{where}no space left on device; make room, then run the same command again", 2)
        if not _is_about_memory(error):
            _fail(error, _unexpected(error), 1)
        _fail(
            error,
            f"not enough memory for the command itself ({error or type(error).__name__}); raise its limit, or use a "
            "machine with more memory, then run the same command again",
            1,
        )
    except Exception as error:  # noqa: BLE001 - users always get a sentence, not a traceback
        _fail(error, _unexpected(error), 1)


def _unexpected(error: Exception) -> str:
    return f"unexpected error, please report it: {type(error).__name__}: {error}"


def _is_about_memory(error: BaseException) -> bool:
    """Whether an error or its cause means that the system refused more memory or threads."""
    number = error.errno if isinstance(error, OSError) else None
    words = ("can't start new thread", "failed to map segment")
    if isinstance(error, MemoryError) or number == errno.ENOMEM or any(each in str(error) for each in words):
        return True
    cause = error.__cause__ or error.__context__
    return cause is not None and _is_about_memory(cause)


def _fail(error: Exception, message: str, code: int) -> NoReturn:
    err.print(f"Error: {redacted(message)}", soft_wrap=True)
    if isinstance(error, TaskFailed) and error.details and not debugging():
        err.print(
            "Run the same command to resume. For details, add --debug or read log/tasks.jsonl.",
            soft_wrap=True,
        )
    if debugging():
        if isinstance(error, TaskFailed) and error.details:
            err.print(error.details, soft_wrap=True)
        sys.stderr.write(redacted("".join(traceback.format_exception(error))))
    sys.exit(code)
