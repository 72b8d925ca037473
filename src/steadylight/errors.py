"""The errors that a user may see, named by what happened.

```
SteadylightError
├── InputError          what the user gave is wrong: exit code 2
│   ├── SceneError        a scene file or bundled name
│   ├── CameraError       a camera file or path
│   ├── SettingsError     a setting, or settings that do not match the run directory
│   └── CacheFileError    a cache file that is truncated, of another version or another scene
└── RunError            permanent failure while running: exit code 1, except StorageError
    ├── BackendError      no usable renderer backend on this machine
    ├── StorageError      the output cannot be written (disk full, no permission): exit code 2
    └── TaskFailed        a task kept failing; carries its key and the worker's traceback
```
"""

from __future__ import annotations


class SteadylightError(Exception):
    """Base class of all errors that steadylight raises deliberately."""

    exit_code = 1


class InputError(SteadylightError):
    """What the user gave is wrong; the message names the file, the place, the fault and the remedy."""

    exit_code = 2


class SceneError(InputError):
    """A scene file or a bundled scene name is wrong."""


class CameraError(InputError):
    """A camera file or a camera path is wrong."""


class SettingsError(InputError):
    """A setting is wrong, or does not match the settings that the run directory was started with."""


class CacheFileError(InputError):
    """A cache file is truncated, damaged, of another version, or of another scene."""


class RunError(SteadylightError):
    """Permanent failure while running."""


class BackendError(RunError):
    """No usable renderer backend on this machine; the message says what to install."""


class StorageError(RunError):
    """The output cannot be written: disk full, no permission, or folder gone.

    The user chose the location and can fix it, so the exit code is that of bad input.
    """

    exit_code = 2


class TaskFailed(RunError):  # noqa: N818 - named by what happened
    """A task failed the maximum number of times.

    Attributes:
        key: name of the task, for example `shade-00012`.
        details: the worker's traceback, for the log.
    """

    def __init__(self, key: str, message: str, details: str = "") -> None:
        super().__init__(f"task {key} failed: {message}")
        self.key = key
        self.details = details
