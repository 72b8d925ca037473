"""The Dask scheduler of this command: peers need a certificate, and the dashboard opens only with the printed link.

Anyone who can connect to a scheduler can run any code as its user, and the dashboard shows everything about a run.
Other users of a machine can connect to its loopback interface, too.
"""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any

import dask
from distributed import Scheduler, SpecCluster
from tornado import web
from tornado.httputil import HTTPServerRequest

from steadylight.errors import SettingsError

if TYPE_CHECKING:
    from pathlib import Path

    from distributed.security import Security

_OPTIONS = {
    # Losses are counted here, so the scheduler must report the first one at once.
    "distributed.scheduler.allowed-failures": 0,
    # A worker whose task holds the GIL for minutes is slow, not dead; its process is monitored separately.
    "distributed.scheduler.worker-ttl": None,
}


class GuardedScheduler(Scheduler):  # type: ignore[misc]
    """A scheduler whose HTTP server answers only to those who know its token."""

    def __init__(self, *, token: str, **options: Any) -> None:
        """Start with options of Dask's scheduler; `token` opens the dashboard."""
        self._token = token
        super().__init__(**options)

    def start_http_server(self, *arguments: Any, **options: Any) -> None:
        """Start the server; it is guarded before it can answer its first request."""
        super().start_http_server(*arguments, **options)
        application, port, token = self.http_application, self.http_server.port, self._token
        find_handler = application.find_handler

        def find_handler_if_allowed(request: HTTPServerRequest, **more: Any) -> Any:
            if _is_same(_cookie_of(request, port), token):
                return find_handler(request, **more)
            return application.get_handler_delegate(request, _Entrance, {"token": token, "port": port})

        application.find_handler = find_handler_if_allowed


class _Entrance(web.RequestHandler):
    """Takes the token of the printed link, and remembers it in a cookie, as notebook servers do."""

    def initialize(self, token: str, port: int) -> None:
        self._token, self._port = token, port

    def prepare(self) -> None:
        if not _is_same(self.get_query_argument("token", ""), self._token):
            self.set_status(403)
            self.finish("Open the whole link that steadylight printed: it ends in a token.\n")
            return
        # Cookies are shared by all ports of a host, hence the port in the name.
        self.set_cookie(_cookie(self._port), self._token, httponly=True, samesite="Strict")
        self.redirect(self.request.path)


def _is_same(given: str, token: str) -> bool:
    return secrets.compare_digest(given.encode(), token.encode())


def _cookie(port: int) -> str:
    return f"steadylight-{port}"


def _cookie_of(request: HTTPServerRequest, port: int) -> str:
    morsel = request.cookies.get(_cookie(port))
    return "" if morsel is None else str(morsel.value)


class OwnScheduler:
    """A scheduler in this process without workers, with a dashboard on loopback if possible.

    Attributes:
        cluster: Dask's object for it, to which a client connects.
    """

    def __init__(self, host: str, port: int, security: Security | None, scratch: Path) -> None:
        """Start the scheduler.

        Args:
            host: address to listen at.
            port: port to listen at; any free port if 0.
            security: certificates; None for plain connections.
            scratch: a folder that only this user can enter.

        Raises:
            SettingsError: it cannot listen there.
        """
        self._token = secrets.token_urlsafe(24)
        self.cluster = self._start(host, port, security, scratch)

    @property
    def dashboard_link(self) -> str:
        """Address of the dashboard with the token that opens it."""
        port = self.cluster.scheduler.http_server.port
        return f"http://127.0.0.1:{port}/status?token={self._token}"

    def _start(self, host: str, port: int, security: Security | None, scratch: Path) -> Any:
        from distributed.security import Security

        security = security or Security()
        options = {
            "token": self._token,
            "host": host,
            "port": port,
            "protocol": "tls://" if security.require_encryption else "tcp://",
            "security": security,
            "local_directory": str(scratch),
        }
        for dashboard in (True, False):
            page = {"dashboard": dashboard, "dashboard_address": "127.0.0.1:0"}
            try:
                with dask.config.set(_OPTIONS):
                    return SpecCluster(
                        scheduler={"cls": GuardedScheduler, "options": options | page},
                        security=security,
                        silence_logs=False,
                    )
            except Exception as error:
                if not dashboard:
                    if isinstance(error, OSError):
                        raise SettingsError(
                            f"--site: no scheduler can be started at {host}, port {port or 'any'}: {error}; give a "
                            "`host`, `interface` and `port` of this machine"
                        ) from error
                    raise
        raise AssertionError
