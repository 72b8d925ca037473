"""The errors a user may meet, named by what happened.

```
SteadylightError
├── InputError          what the user gave is wrong: exit code 2
│   ├── SceneError        a scene file or bundled name
│   ├── CameraError       a camera file or path
│   ├── SettingsError     a setting, or settings that disagree with a run directory
│   └── CacheFileError    a cache file that is cut short, of another version or another scene
└── RunError            something failed for good while running: exit code 1, but for StorageError
    ├── BackendError      no usable Mitsuba/Dr.Jit backend on this machine
    ├── StorageError      the output cannot be written (disk full, no permission): exit code 2
    └── TaskFailed        a task kept failing; carries its key and the worker's words
```
"""

from __future__ import annotations


class SteadylightError(Exception):
    """Base of all errors that steadylight raises on purpose."""

    exit_code = 1


class InputError(SteadylightError):
    """What the user gave is wrong; the message names file, place, fault and remedy."""

    exit_code = 2


class SceneError(InputError):
    """A scene file or a bundled scene name is wrong."""


class CameraError(InputError):
    """A camera file or a camera path is wrong."""


class SettingsError(InputError):
    """A setting is wrong, or disagrees with what the run directory was started with."""


class CacheFileError(InputError):
    """A cache file is cut short, damaged, of another version, or of another scene."""


class RunError(SteadylightError):
    """Something failed for good while running."""


class BackendError(RunError):
    """No usable Mitsuba/Dr.Jit backend on this machine; the message says what to install."""


class StorageError(RunError):
    """The output cannot be written: disk full, no permission, or gone.

    The place was the user's choice, and the remedy is theirs: the exit code is that of bad input.
    """

    exit_code = 2


class TaskFailed(RunError):  # noqa: N818 - named by what happened
    """A task failed as often as is allowed.

    Attributes:
        key: name of the task, for example `second_pass-0012`.
        details: what the worker said (traceback text), for the log.
    """

    def __init__(self, key: str, message: str, details: str = "") -> None:
        super().__init__(f"task {key} failed: {message}")
        self.key = key
        self.details = details
