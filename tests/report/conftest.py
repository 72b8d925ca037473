"""Fixtures of tests that look at pages in a browser: headless Chromium by Playwright."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from visits import Visit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--no-first-run", "--disable-quic"),
)


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """One browser for all tests of this process."""
    if CHROMIUM is None or importlib.util.find_spec("playwright") is None:
        pytest.skip("needs Chromium and Playwright")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield chromium
        chromium.close()


@pytest.fixture
def visit(browser: Any) -> Iterator[Callable[..., Visit]]:
    """Opens a file or an address; `width` and `scheme` of the screen may be given; `ready`: it says so itself."""
    opened = []

    def open_page(
        address: Path | str, width: int = 1400, scheme: str = "light", *, ready: bool = True
    ) -> Visit:
        page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        opened.append(page)
        visited = Visit(page)
        page.goto(address if isinstance(address, str) else address.as_uri())
        if ready:
            page.wait_for_selector("html[data-ready=yes]", state="attached")
        return visited

    yield open_page
    for page in opened:
        page.close()
