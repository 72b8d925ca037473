"""The page in a browser: axe-core has no finding, in light and dark, on a wide and on a narrow screen."""

from __future__ import annotations

import html
import importlib.util
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from steadylight.checksum import with_checksum
from steadylight.images import write_exr
from steadylight.report import write_report

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
RULES = importlib.util.find_spec("axe_core_python")
QUIET = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *(
        "--disable-background-networking",
        "--disable-component-update",
        "--virtual-time-budget=20000",
        "--dump-dom",
    ),
)
CHECK = """
axe.run().then(found => {
  const said = parent.document.createElement("pre");
  said.id = "said";
  said.textContent = JSON.stringify({
    width: innerWidth, needed: document.documentElement.scrollWidth,
    dark: matchMedia("(prefers-color-scheme: dark)").matches,
    findings: found.violations.map(rule => [rule.id, rule.nodes.map(node => node.html)]),
  });
  parent.document.body.append(said);
});
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The report of a run with a gap, selected frames, statistics and a video."""
    run = tmp_path_factory.mktemp("run")
    (run / "frames").mkdir()
    for number in (1, 2, 3, 7, 8, 12):
        write_exr(run / "frames" / f"frame_{number:05d}.exr", np.full((24, 32, 3), 0.1 + 0.01 * number))
    settings = {"mode": "two-pass", "width": 32, "height": 24, "spp": 16, "fps": 25.0, "quality": 1.0}
    record = {"scene": {"name": "scene", "title": "kitchen/scene", "hash": "f" * 64}, "settings": settings}
    (run / "run.json").write_text(json.dumps(with_checksum(record)))
    session = {"started": "2026-11-24T04:07:53+00:00", "host": "node-1", "seconds": 7500.0}
    statistics = {
        "makespan_s": 7500.0,
        "frames": 6,
        "selected_frames": [1, 8],
        "sessions": [session],
        "second_pass": {"missed": 0, "new_records": 123_456_789},
        "tasks": {"failed": 0, "lost": 1},
    }
    (run / "stats.json").write_text(json.dumps(statistics))
    (run / "animation.mp4").write_bytes(b"a film")
    return write_report(run).read_text(encoding="utf-8")


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
@pytest.mark.skipif(RULES is None, reason="needs axe-core-python")
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_and_nothing_is_wider_than_the_screen(
    page: str, width: int, scheme: str, tmp_path: Path
) -> None:
    assert RULES is not None
    rules = Path(str(RULES.origin)).with_name("axe.min.js").read_text(encoding="utf-8")
    inner = page.replace("</body>", f"<script>{rules}</script><script>{CHECK}</script></body>")
    # A window is never narrower than 500 pixels, a frame in it may be.
    frame = (
        f'<iframe style="border: 0; width: {width}px; height: 5000px" srcdoc="{html.escape(inner)}"></iframe>'
    )
    (tmp_path / "page.html").write_text(f'<body style="margin: 0">{frame}', encoding="utf-8")
    colours = f"--blink-settings=preferredColorScheme={int(scheme == 'light')}"
    words = [
        str(CHROMIUM),
        *QUIET,
        f"--user-data-dir={tmp_path / 'user'}",
        "--window-size=1280,5000",
        colours,
    ]
    shown = subprocess.run(
        [*words, f"file://{tmp_path / 'page.html'}"], capture_output=True, text=True, check=True, timeout=120
    ).stdout
    match = re.search('<pre id="said">(.*?)</pre>', shown, re.DOTALL)
    assert match is not None
    said = json.loads(html.unescape(match[1]))
    assert said == {"width": width, "needed": width, "dark": scheme == "dark", "findings": []}
