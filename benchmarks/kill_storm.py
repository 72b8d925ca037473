"""Kills renders at random instants and flips single bits in the files of runs; every run must end well all the same.

A run ends well if its frames and caches equal those of an undisturbed run, or if it stops with an error that names the
damaged file and says what to do. Everything else is reported, and the exit code is 1.

    python benchmarks/kill_storm.py --kills 100 --flips 2000

Each flip takes less than a second, each kill half of the time of its film. Several of these can run at once, with other
seeds and films.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from steadylight.animation.request import prepare
from steadylight.animation.run import Session
from steadylight.errors import SteadylightError
from steadylight.scenes import load_scene
from steadylight.scenes.description import SceneDescription

FILMS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "gallery": ("gallery", {"cache_parts": 3}),
    "furnace": ("furnace", {"cache_parts": 2}),
    "single-pass": ("furnace", {"mode": "single-pass"}),
}
"""Scene of each film, and options that differ from `OPTIONS`."""

OPTIONS: Final[dict[str, Any]] = {
    "frames": 4,
    "size": (32, 24),
    "spp": 1,
    "quality": "draft",
    "frames_as": "png",
}

CLASSES: Final = {
    "run.json": ("run.json",),
    "scene.zip": ("scene.zip",),
    "stats.json": ("stats.json",),
    "display.json": ("display.json",),
    "picture": ("pictures/*.png",),
    "frame": ("frames/*.exr",),
    "cache": ("cache/gather*", "cache/merged*", "cache/filled*", "cache/smoothed*"),
    "misses": ("cache/audit*",),
    "video": ("animation.mp4",),
    "report": ("report.html",),
    "journal": ("log/tasks.jsonl",),
    "result": ("log/results/*.json",),
    "session": ("log/sessions/*.json",),
    "lock": ("log/lock",),
}
"""Kinds of files of a run directory."""

EQUAL, NAMED, REFUSED = "equal", "equal, damage named", "refused, file named"
GOOD: Final = (EQUAL, NAMED, REFUSED)


def main() -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=10, help="shared by three films")
    parser.add_argument("--flips", type=int, default=200, help="shared by the classes of files")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--films", choices=list(FILMS), nargs="+", default=list(FILMS), help="that are killed"
    )
    parser.add_argument("--film", choices=list(FILMS), default="furnace", help="whose files are damaged")
    options = parser.parse_args()
    draw = random.Random(options.seed)  # noqa: S311 - not for secrets
    table: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory(prefix="steadylight-storm-") as folder:
        for number, film in enumerate(options.films):
            share = len(range(number, options.kills, len(options.films)))
            table.update((f"killed {film}", outcome) for outcome in kill(Path(folder), film, share, draw))
        table.update(flip(Path(folder), options.film, options.flips, draw))
    show(table)
    return int(any(outcome not in GOOD for _, outcome in table))


def kill(folder: Path, film: str, kills: int, draw: random.Random) -> Iterator[str]:
    """Render a film, killed at random instants; the outcome of each render that was killed or finished."""
    if not kills:
        return
    whole, run = folder / f"{film}-whole", folder / f"{film}-killed"
    started = time.monotonic()
    subprocess.run(command(film, whole), check=True, capture_output=True)
    seconds = time.monotonic() - started
    done: dict[str, str] = {}
    for _ in range(kills):
        if (run / "stats.json").exists():  # ended before the signal: begin again
            shutil.rmtree(run)
            done = {}
        with subprocess.Popen(
            command(film, run), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
        ) as process:
            time.sleep(draw.uniform(0, seconds))
            os.killpg(process.pid, signal.SIGKILL)
        kept = finished(run)
        yield EQUAL if done.items() <= kept.items() else "DONE WORK LOST"
        done = kept
    last = subprocess.run(command(film, run), check=False, capture_output=True, text=True)
    if last.returncode:
        print(f"{film}: exit code {last.returncode}: {last.stderr}", flush=True)
        yield "NOT RESUMED"
    else:
        yield EQUAL if digests(run) == digests(whole) else "OTHER BYTES"


def command(film: str, run: Path) -> list[str]:
    """The command line that renders a film."""
    given = {
        **OPTIONS,
        **FILMS[film][1],
        "size": "x".join(map(str, OPTIONS["size"])),
        "output": run,
        "workers": 2,
    }
    words = [word for name, value in given.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    return [sys.executable, "-m", "steadylight", "render", FILMS[film][0], *words]


def flip(folder: Path, film: str, flips: int, draw: random.Random) -> Iterator[tuple[str, str]]:
    """Flip bits of a finished and of a half-finished run and go on; class of file and outcome of each flip."""
    if not flips:
        return
    whole, half = folder / f"{film}-reference", folder / f"{film}-half"
    _, expected = go_on(film, whole)
    shutil.copytree(whole, half)
    for path in (half / "frames/frame_00004.exr", half / "log/results/shade-00004.json", half / "stats.json"):
        path.unlink()
    expected_digests = digests(whole)
    names = list(CLASSES)
    for number in range(flips):
        kind = names[number % len(names)]
        source = (whole, half)[number // len(names) % 2]
        files = [path for pattern in CLASSES[kind] for path in sorted(source.glob(pattern))]
        if not files:
            continue
        run = folder / "damaged"
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(source, run)
        damaged = run / draw.choice(files).relative_to(source)
        place = flip_bit(damaged, draw)
        outcome = outcome_of(film, damaged, run, (expected_digests, expected))
        if outcome not in GOOD:
            print(f"{damaged.relative_to(run)}, {place}, of the {source.name} run: {outcome}", flush=True)
        yield kind, outcome


def outcome_of(film: str, damaged: Path, run: Path, expected: tuple[dict[str, str], dict[str, Any]]) -> str:
    """Go on with a damaged run; `expected` are digests and counts of the undisturbed one."""
    try:
        faults, counts = go_on(film, run)
    except SteadylightError as error:
        return REFUSED if damaged.name in str(error) and ";" in str(error) else "REFUSED WITHOUT A NAME"
    except Exception as error:  # noqa: BLE001 - the purpose of this program
        return f"UNEXPECTED {type(error).__name__}"
    if digests(run) != expected[0]:
        return "OTHER BYTES"
    if counts != expected[1] and not faults:
        return "OTHER STATISTICS"
    return NAMED if faults else EQUAL


def flip_bit(path: Path, draw: random.Random) -> str:
    """Flip one random bit of a file; returns which."""
    content = bytearray(path.read_bytes())
    place, bit = draw.randrange(len(content)), draw.randrange(8)
    content[place] ^= 1 << bit
    path.write_bytes(content)
    return f"byte {place} bit {bit}"


def go_on(film: str, run: Path) -> tuple[list[str], dict[str, Any]]:
    """Render in this process what is left of a run; the damage that it names, and counts that must not change."""
    options = {**OPTIONS, **FILMS[film][1], "output": run, "cluster": "in-process"}
    with Session(prepare(scene_of(film), **options)) as session:
        for _ in session:
            pass
        statistics = session.finish().statistics
        return session.faults, counts_of(statistics)


@functools.cache
def scene_of(film: str) -> SceneDescription:
    """The scene of a film, whose geometry is then built once."""
    return load_scene(FILMS[film][0])


def counts_of(statistics: Mapping[str, Any]) -> dict[str, Any]:
    """Counts of statistics, without times."""
    counts = {
        stage: {name: value for name, value in statistics[stage].items() if "second" not in name}
        for stage in ("first_pass", "merge", "coverage", "second_pass")
        if stage in statistics
    }
    return counts | {"done": statistics["tasks"]["done"], "exposure": statistics["exposure"]}


def digests(run: Path) -> dict[str, str]:
    """SHA-256 of the frames and caches of a run."""
    files = [path for folder in ("frames", "cache") for path in (run / folder).glob("[!.]*")]
    return {path.relative_to(run).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def finished(run: Path) -> dict[str, str]:
    """Digests of the outputs of tasks that are done: those whose result is there and names them."""
    files = digests(run)
    named: dict[str, str] = {}
    for path in (run / "log/results").glob("[!.]*.json"):
        named |= json.loads(path.read_bytes())["outputs"]
    return {name: digest for name, digest in named.items() if files.get(name) == digest}


def show(table: Mapping[tuple[str, str], int]) -> None:
    """Print outcomes by class of file."""
    outcomes = sorted({outcome for _, outcome in table}, key=lambda outcome: (outcome not in GOOD, outcome))
    print(f"| {'damage':<18} | {' | '.join(outcomes)} |")
    print(f"| {'-' * 18} | {' | '.join('-' * len(outcome) for outcome in outcomes)} |")
    for kind in dict.fromkeys(kind for kind, _ in table):
        cells = (f"{table.get((kind, outcome), 0):>{len(outcome)}}" for outcome in outcomes)
        print(f"| {kind:<18} | {' | '.join(cells)} |")


if __name__ == "__main__":
    sys.exit(main())
