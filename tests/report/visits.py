"""Pages that are open in headless Chromium."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

AXE = importlib.util.find_spec("axe_core_python")


class Visit:
    """A page that is open, with all that it asked for and complained about.

    Attributes:
        page: of Playwright.
        complaints: console errors and warnings, and uncaught errors.
        asked: addresses that were fetched, without those within the page.
    """

    def __init__(self, page: Any) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.asked: list[str] = []
        page.on("console", lambda said: self._note(said.type, said.text))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self._ask(request.url))

    def _note(self, kind: str, text: str) -> None:
        if kind in {"error", "warning"}:
            self.complaints.append(text)

    def _ask(self, url: str) -> None:
        if not url.startswith(("data:", "blob:")):
            self.asked.append(url)

    def findings(self) -> list[Any]:
        """What axe-core finds wrong for people who do not see, hear or point."""
        assert AXE is not None
        rules = Path(str(AXE.origin)).with_name("axe.min.js").read_text(encoding="utf-8")
        self.page.evaluate(rules + "; 0")
        found = self.page.evaluate("axe.run()")
        return [(rule["id"], [node["html"] for node in rule["nodes"]]) for rule in found["violations"]]

    def overflow(self) -> int:
        """Pixels by which the page is wider than the screen."""
        return int(self.page.evaluate("document.documentElement.scrollWidth - innerWidth"))
