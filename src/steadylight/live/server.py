"""Serves the live page: only on this machine, and only to those who know its address, which contains a token."""

from __future__ import annotations

import hmac
import secrets
import threading
import time
from collections import OrderedDict
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Final, Self
from urllib.parse import parse_qs, urlsplit

from steadylight.errors import InputError, SettingsError, SteadylightError
from steadylight.images import exposure_of_files, read_exr, tone_map
from steadylight.live.state import RunState, as_text
from steadylight.report.embedding import jpeg, page_from, resized

if TYPE_CHECKING:
    from pathlib import Path

WIDEST: Final = 640
"""Maximum width of a picture, pixels."""

KEPT: Final = 600
"""Maximum number of pictures kept for later requests."""


class LiveServer:
    """The live page of a run, as long as the `with` block lasts.

    Attributes:
        address: address of the page.
    """

    def __init__(self, root: Path, port: int = 0) -> None:
        """Take a port of this machine.

        Args:
            root: the run directory; the run need not have begun.
            port: port number; 0 for any free one.

        Raises:
            SettingsError: the port is taken, or its use is not permitted.
        """
        self._run = _Run(root)
        self._token = secrets.token_urlsafe(18)
        try:
            self._http = _Server(("127.0.0.1", port), self._handler())
        except (OSError, OverflowError) as error:
            raise SettingsError(
                f"--port: {port} cannot be used ({error}); give another, or leave it out"
            ) from None
        self._thread = threading.Thread(target=self._http.serve_forever, name="live page", daemon=True)

    @property
    def address(self) -> str:
        """Address of the page, including the token."""
        return f"http://127.0.0.1:{self._http.server_address[1]}/{self._token}/"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        run, token = self._run, self._token

        class Handler(_Handler):
            """Answers requests for this run."""

            def answer(self, path: str, query: dict[str, list[str]]) -> tuple[str, bytes] | None:
                given, _, name = path.removeprefix("/").partition("/")
                if not hmac.compare_digest(given.encode(), token.encode()):
                    return None
                return run.answer(name, query)

        return Handler


class _Server(ThreadingHTTPServer):
    """Prints nothing about browsers that disconnect during a response: the terminal belongs to the render."""

    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a request that could not be answered; the browser asks again."""


class _Handler(BaseHTTPRequestHandler):
    def answer(self, path: str, query: dict[str, list[str]]) -> tuple[str, bytes] | None:
        """Content type and content; None if there is no such resource."""
        raise NotImplementedError

    def do_GET(self) -> None:
        """Answer a request."""
        asked = urlsplit(self.path)
        start = time.thread_time()
        found = self.answer(asked.path, parse_qs(asked.query))
        kind, content = found or (
            "text/plain; charset=utf-8",
            b"There is no such page. Is the address complete?\n",
        )
        self.send_response(HTTPStatus.OK if found else HTTPStatus.NOT_FOUND)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Seconds", f"{time.thread_time() - start:.4f}")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Print nothing: the terminal belongs to the render."""


class _Run:
    """Answers requests about one run, from any number of threads."""

    def __init__(self, root: Path) -> None:
        self._state = RunState(root)
        self._lock = threading.Lock()
        self._pictures: OrderedDict[tuple[str, float], bytes] = OrderedDict()
        self._exposure: float | None = None
        self._page = page_from("live.html", name=root.resolve().name).encode()

    def answer(self, name: str, query: dict[str, list[str]]) -> tuple[str, bytes] | None:
        if name == "":
            return "text/html; charset=utf-8", self._page
        if name == "state":
            with self._lock:
                self._state.look()
                since = _number(query, "since") or 0
                return "application/json", as_text(self._state.plain(since)).encode()
        if name == "frame":
            number = _number(query, "number")
            picture = None if number is None else self._picture(number)
            return None if picture is None else ("image/jpeg", picture)
        return None

    def _picture(self, number: int) -> bytes | None:
        """A frame as a small picture; None if it is missing or damaged."""
        with self._lock:
            path = self._state.frames.get(number)
            if path is None:
                return None
            try:
                key = (path.name, path.stat().st_mtime)
                if key not in self._pictures:
                    self._pictures[key] = self._drawn(path)
                    while len(self._pictures) > KEPT:
                        self._pictures.popitem(last=False)
            except (OSError, InputError):
                return None
            return self._pictures[key]

    def _drawn(self, path: Path) -> bytes:
        image = read_exr(path)
        if self._exposure is None:
            # From the first few frames, and then fixed: pictures must not change when new frames arrive.
            self._exposure = _exposure(list(self._state.frames.values())[:3])
        scale = min(1.0, WIDEST / image.shape[1])
        size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
        return jpeg(resized(tone_map(image, self._exposure), *size), 85)


def _number(query: dict[str, list[str]], name: str) -> int | None:
    """A whole number from a query."""
    text = query.get(name, [""])[0]
    return int(text) if text.isdecimal() and len(text) < 10 else None


def _exposure(paths: list[Path]) -> float:
    try:
        return exposure_of_files(paths)
    except SteadylightError:
        return 1.0
