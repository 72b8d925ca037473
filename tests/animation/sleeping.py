"""Tasks that take a known time and no processor."""

import time
import zlib


def seconds_of(task) -> float:
    """From 0.2 to 0.6 s, by the task's name."""
    return 0.2 + 0.4 * (zlib.crc32(task.key.encode()) % 100) / 100


def sleep(task) -> dict:
    time.sleep(seconds_of(task))
    return {}
