"""The run directory: file names, lock, journal and results of tasks, and the same files at a URL.

Valid files on disk are the only state of a render. Hence three rules. A file under its final name is complete and was
read back (`atomic_write`). Only one command at a time works on a directory (a lock that ends with its process). A task
is done when all its outputs exist and are valid (`RunDirectory.pending`).
"""

from __future__ import annotations

from steadylight.atomic_file import Validator, atomic_write, write_json
from steadylight.storage.directory import RunDirectory
from steadylight.storage.results import Work, file_hash

__all__ = ["RunDirectory", "Validator", "Work", "atomic_write", "file_hash", "write_json"]
