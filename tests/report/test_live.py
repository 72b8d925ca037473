"""The live page: what a run directory says while it grows, to who knows the token, and in a browser."""

from __future__ import annotations

import json
import os
import socket
import struct
import urllib.error
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest
from handmade_runs import flickering, write_run

from steadylight.checksum import with_checksum
from steadylight.errors import SettingsError
from steadylight.images import write_exr
from steadylight.live import LiveServer
from steadylight.live.state import RunState

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from visits import Visit

BEGAN = 1_700_000_000.0


def ended(run: Path, key: str, second: float, *, worker: str = "node-1", error: str = "") -> None:
    """Add the end of an attempt of 4 seconds to the journal, and the result of a task that is done."""
    (run / "log" / "results").mkdir(parents=True, exist_ok=True)
    entry: dict[str, Any] = {
        "time": BEGAN + second,
        "task": key,
        "stage": key.partition("-")[0],
        "attempt": 1,
        "outcome": "failed" if error else "done",
        "seconds": 4.0,
        "seconds_cpu": 6.0,
        "worker": worker,
        "result": {"error": error} if error else {"missed": 0},
    }
    if error:
        entry["cause"] = "host"
    else:
        (run / "log" / "results" / f"{key}.json").write_text("{}")
    with (run / "log" / "tasks.jsonl").open("a") as journal:
        journal.write(json.dumps(with_checksum(entry)) + "\n")


def new_frame(run: Path, number: int) -> None:
    write_exr(run / "frames" / f"frame_{number:05d}.exr", flickering(0.1)(number))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run of 24 frames on two workers, of which 5 are there."""
    root = write_run(tmp_path / "walk", [1, 2, 3, 4, 5], flickering(0.1), wanted=24)
    ended(root, "prepare", 0)
    ended(root, "gather-00001", 4)
    ended(root, "merge", 8, worker="node-2")
    return root


def state_of(run: Path) -> dict[str, Any]:
    state = RunState(run)
    state.look()
    return state.plain()


def files_of(run: Path) -> dict[str, tuple[float, int]]:
    return {str(path): (path.stat().st_mtime, path.stat().st_size) for path in run.rglob("*")}


def test_progress_is_counted_by_pass_from_what_is_done(run: Path) -> None:
    state = state_of(run)
    passes = {each["name"]: (each["done"], each["total"]) for each in state["passes"]}
    assert passes["first pass"] == (3, 3)
    assert passes["second pass"] == (0, 24)
    assert state["frames"] == [1, 2, 3, 4, 5]
    assert state["wanted"] == 24
    assert state["status"] == "running"
    assert state["workers"] == 2


def test_time_left_follows_from_tasks_of_the_stage_and_the_workers(run: Path) -> None:
    # Nothing is known yet of audits and frames: the usual stands in.
    assert state_of(run)["left"].startswith("about ")
    for key in ("audit-1-0001", "fill-1", "smooth", "shade-00001"):
        ended(run, key, 12)
    # These compiled kernels. What is left is foretold by preparing: for so small a film, the least for each task.
    assert state_of(run)["left"] == "about 1.5 s left"
    for key in ("audit-1-0002", "fill-2", "shade-00002"):
        ended(run, key, 16)
    # Left: 1 + 3 audits and 22 frames on two workers, 4 seconds each.
    assert state_of(run)["left"] == "about 52.0 s left"


def test_only_what_is_new_is_told_and_half_a_line_waits(run: Path) -> None:
    state = RunState(run)
    state.look()
    assert [each["task"] for each in state.plain()["attempts"]] == ["prepare", "gather-00001", "merge"]
    journal = run / "log" / "tasks.jsonl"
    with journal.open("a") as file:
        file.write('{"task": "audi')
    state.look()
    assert state.plain(3)["attempts"] == []
    journal.write_text(journal.read_text().rpartition("\n")[0] + "\nrubbish\n")
    ended(run, "fill-1", 20, error="no memory\nmore")
    state.look()
    (told,) = state.plain(3)["attempts"]
    assert (told["task"], told["outcome"], told["cause"], told["why"]) == (
        "fill-1",
        "failed",
        "host",
        "no memory",
    )


def test_a_run_that_was_prepared_and_no_more_waits(tmp_path: Path) -> None:
    run = write_run(tmp_path / "walk", [1], flickering(0.1), wanted=24)
    assert state_of(run)["status"] == "waiting"


def test_a_browser_that_leaves_and_odd_questions_leave_the_terminal_alone(
    run: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with LiveServer(run) as server:
        port = int(server.address.split(":")[2].partition("/")[0])
        path = server.address.partition(f"{port}")[2]
        for question in ("state?since=" + "9" * 5000, "frame?number=" + "9" * 5000):
            with socket.create_connection(("127.0.0.1", port)) as browser:
                browser.sendall(f"GET {path}{question} HTTP/1.0\r\n\r\n".encode())
                browser.recv(100)
                linger = struct.pack("ii", 1, 0)  # gone at once, with the answer unread
                browser.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
    assert capfd.readouterr() == ("", "")


def test_a_session_whose_process_is_gone_was_interrupted(run: Path) -> None:
    import platform

    (run / "log" / "sessions").mkdir()
    session = {"seconds": 9.0, "workers": 2, "outcome": "running", "host": platform.node(), "process": 2**30}
    (run / "log" / "sessions" / "0001.json").write_text(json.dumps(with_checksum(session)))
    assert state_of(run)["status"] == "killed"


def test_empty_and_broken_run_directories_say_what_is_missing(tmp_path: Path, run: Path) -> None:
    (tmp_path / "empty").mkdir()
    state = state_of(tmp_path / "empty")
    assert (state["status"], state["frames"], state["tasks"]) == ("waiting", [], [0, 0])
    assert "no run.json" in state["notices"][0]
    (run / "run.json").write_text("{")
    state = state_of(run)
    assert state["status"] == "unknown"
    assert "run.json: cannot be read" in state["notices"][0]
    assert state["frames"] == [1, 2, 3, 4, 5]
    assert len(state["attempts"]) == 3


def test_without_the_token_there_is_nothing(run: Path) -> None:
    with LiveServer(run) as server:
        assert server.address.startswith("http://127.0.0.1:")
        port = server.address.split("/")[2]
        for path in ("", "state", "x/state", f"{'a' * 24}/", "..%2f/run.json"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(f"http://{port}/{path}")
        with urllib.request.urlopen(f"{server.address}state") as answer:
            assert json.load(answer)["wanted"] == 24
        for name in ("frame?number=99", "frame", "frame?number=../1", "other"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(server.address + name)


def test_a_port_that_is_taken_is_named(run: Path) -> None:
    with LiveServer(run) as server:
        port = int(server.address.split("/")[2].partition(":")[2])
        with pytest.raises(SettingsError, match=f"--port: {port} cannot be used"):
            LiveServer(run, port)


def test_a_look_at_a_long_run_reads_only_what_has_changed(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = json.loads((run / "run.json").read_text())
    record["settings"]["frames"] = list(range(1, 1442))
    del record["sha256"]
    (run / "run.json").write_text(json.dumps(with_checksum(record)))
    for number in range(6, 1442):
        (run / "frames" / f"frame_{number:05d}.exr").write_bytes(b"")
    for number in range(1, 1000):
        ended(run, f"shade-{number:05d}", 10 + 2 * number)
    folders = [run / "frames", run / "log" / "results"]

    def look() -> tuple[list[str], int]:
        """Folders listed, and lines of the journal read, by one look."""
        listed: list[str] = []
        monkeypatch.setattr(
            os, "scandir", lambda folder, scan=os.scandir: (listed.append(folder.name), scan(folder))[1]
        )
        before = state.plain()["count"]
        state.look()
        monkeypatch.undo()
        return listed, state.plain()["count"] - before

    def grow_old() -> None:
        for folder in folders:
            os.utime(folder, (BEGAN, BEGAN))

    state = RunState(run)
    assert sorted(look()[0]) == ["frames", "results"]
    grow_old()
    look()
    assert look() == ([], 0)
    ended(run, "shade-01000", 2010)
    assert look() == (["results"], 1)
    assert len(state.plain()["frames"]) == 1441
    assert state.plain(since=999)["attempts"][0]["task"].startswith("shade-")


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (400, "dark")])
def test_the_page_follows_the_run_and_changes_nothing(
    run: Path, visit: Callable[..., Visit], width: int, scheme: str
) -> None:
    before = files_of(run)
    with LiveServer(run) as server:
        visited = visit(server.address, width, scheme)
        page = visited.page
        page.wait_for_selector("#film img")
        assert page.inner_text("#status") == "rendering"
        assert "5 of 24 frames" in page.inner_text("#told")
        assert page.inner_text("#well") == "None."
        assert files_of(run) == before
        new_frame(run, 6)
        ended(run, "shade-00006", 30, error="the disk is full")
        page.wait_for_selector("#failures li")
        assert "shade-00006: attempt 1 failed (host) on node-1: the disk is full" in page.inner_text(
            "#failures"
        )
        page.wait_for_selector("figure[data-number='6']")
        assert "4 attempts at tasks on 2 workers" in page.get_attribute("#timeline canvas", "aria-label")
        page.click("figure[data-number='6'] button")
        page.wait_for_function("document.querySelector('#picture').alt === 'Frame 6'")
        page.click("#back")
        page.wait_for_function("document.querySelector('#picture').alt === 'Frame 5'")
        assert visited.findings() == []
        assert visited.overflow() <= 0
        assert visited.complaints == []
        assert all(address.startswith(server.address) for address in visited.asked)


def test_a_damaged_frame_leaves_a_gap_in_the_page(run: Path, visit: Callable[..., Visit]) -> None:
    (run / "frames" / "frame_00004.exr").write_bytes(b"rubbish")
    with LiveServer(run) as server:
        page = visit(server.address).page
        page.wait_for_function("document.querySelectorAll('#film img').length === 4")


def test_the_page_says_when_its_command_has_ended(run: Path, visit: Callable[..., Visit]) -> None:
    with LiveServer(run) as server:
        page = visit(server.address).page
    page.wait_for_function("document.querySelector('#status').textContent.includes('has ended')")
