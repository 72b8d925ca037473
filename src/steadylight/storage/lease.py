"""A lease that excludes other commands from a run at a URL."""

from __future__ import annotations

import json
import os
import secrets
import socket
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from steadylight.errors import SettingsError, StorageError

if TYPE_CHECKING:
    from steadylight.storage.store import Store

LEASE: Final = "log/lock"
"""Name of its file, relative to the run directory."""

_LEASE_LASTS: Final = 120.0
_SECONDS_BETWEEN_SIGNS: Final = 30.0
_SECONDS_TO_SETTLE: Final = 1.0


class Lease:
    """Excludes other commands from a run at a URL: a file in the store that its holder renews periodically.

    If the store can create a file in one atomic step (`Store.create`), only one of several commands that start together
    gets the lease. Replacing an expired lease takes two steps. After that, or on a store without the atomic step, the
    command waits a moment and checks who holds the lease. Every command also checks the holder before renewing, and
    stops if another one has it. Remaining gap: if a command stalls between two steps for longer than that moment, or
    the store creates without checking, two commands may be active until the first one is due to renew. Clocks must
    agree to well within the duration of a lease.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._holder = f"host {socket.gethostname()}, process {os.getpid()}, {secrets.token_hex(4)}"
        self._given_back = threading.Event()
        self._lost = False
        self._thread: threading.Thread | None = None

    def take(self) -> None:
        """Take the lease, and keep renewing it.

        Raises:
            SettingsError: another command holds it.
            StorageError: the store cannot be reached.
        """
        held = self._store.read(LEASE)
        if held is not None and not _signature(held)[0]:
            time.sleep(_SECONDS_TO_SETTLE)  # another command may be writing it right now
            held = self._store.read(LEASE)
        if held is not None:
            holder, signed = _signature(held)
            if time.time() - signed < _LEASE_LASTS:
                raise self._taken_by(holder)
            self._store.remove([LEASE])
        one_step = self._store.create(LEASE, self._sign())
        if held is not None or not one_step:
            time.sleep(_SECONDS_TO_SETTLE)
        holder = _signature(self._store.read(LEASE))[0]
        if holder != self._holder:
            raise self._taken_by(holder)
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Check that the lease was not lost.

        Raises:
            StorageError: another command has taken it, because this one did not renew it in time.
        """
        if self._lost:
            raise StorageError(
                f"{self._store}: another steadylight command has taken over this run, because this one did "
                f"not renew its lock for {_LEASE_LASTS:.0f} s; wait for it to finish, then run the same command again"
            )

    def give_back(self) -> bool:
        """Stop renewing the lease and remove it; returns whether this command still held it.

        Raises:
            StorageError: the store cannot be reached; the lease will expire.
        """
        self._given_back.set()
        if self._thread is not None:
            self._thread.join()
        if self._lost or _signature(self._store.read(LEASE))[0] != self._holder:
            return False
        self._store.remove([LEASE])
        return True

    def _sign(self) -> bytes:
        return json.dumps({"holder": self._holder, "time": time.time()}).encode()

    def _keep(self) -> None:
        while not self._given_back.wait(_SECONDS_BETWEEN_SIGNS):
            with suppress(StorageError):
                held = self._store.read(LEASE)
                if held is None:
                    self._store.create(LEASE, self._sign())
                elif _signature(held)[0] == self._holder:
                    self._store.write(LEASE, self._sign())
                else:
                    self._lost = True
                    return

    def _taken_by(self, holder: str) -> SettingsError:
        return SettingsError(
            f"{self._store}: another steadylight command is using this run ({holder or 'unknown holder'}); "
            f"wait for it, stop it (and wait {_LEASE_LASTS:.0f} s), or choose another output"
        )


def _signature(lease: bytes | None) -> tuple[str, float]:
    """Holder and time of a lease; an empty holder and minus infinity if it cannot be read."""
    with suppress(ValueError, KeyError, TypeError, RecursionError):
        content = json.loads(lease or b"")
        return str(content["holder"]), float(content["time"])
    return "", float("-inf")
