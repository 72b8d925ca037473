"""TLS between scheduler, workers and this command: peers without a matching certificate are rejected.

Anyone who can connect to a Dask scheduler can run any code as its user. On a shared machine or network, the scheduler
must therefore authenticate its peers.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from distributed.security import Security

    from steadylight.sites import TlsSettings

_CERTIFICATE: Final = "certificate.pem"
_KEY: Final = "key.pem"


def security_of(tls: TlsSettings) -> Security:
    """Security with the user's own certificates."""
    return _security(tls.ca, tls.certificate, tls.key)


def temporary_security(folder: Path) -> Security:
    """A self-signed certificate for this command, in files that only its user can read.

    It is its own authority, so no other certificate is accepted.

    Args:
        folder: visible on the nodes; created if needed.
    """
    from distributed.security import Security

    made = Security.temporary()
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    folder.chmod(0o700)
    _write_private(folder / _CERTIFICATE, made.tls_client_cert)
    _write_private(folder / _KEY, made.tls_client_key)
    return security_in(folder)


def security_in(folder: Path) -> Security:
    """Security with the files that `temporary_security` wrote."""
    return _security(folder / _CERTIFICATE, folder / _CERTIFICATE, folder / _KEY)


def forget_others(folder: Path) -> None:
    """Remove the certificates of killed commands next to `folder`, where only one command works at a time."""
    for other in folder.parent.glob(f"{folder.name.partition('-')[0]}-*"):
        if other != folder and other.is_dir() and not other.is_symlink():
            with suppress(OSError):
                forget(other)


def forget(folder: Path) -> None:
    """Remove what `temporary_security` wrote."""
    for name in (_CERTIFICATE, _KEY):
        (folder / name).unlink(missing_ok=True)
    if folder.is_dir():
        folder.rmdir()


def _security(ca: Path, certificate: Path, key: Path) -> Security:
    from distributed.security import Security

    own = {f"tls_{role}_cert": str(certificate) for role in ("client", "scheduler", "worker")}
    keys = {f"tls_{role}_key": str(key) for role in ("client", "scheduler", "worker")}
    return Security(tls_ca_file=str(ca), require_encryption=True, **own, **keys)


def _write_private(path: Path, text: str) -> None:
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(text)
