"""A run that was killed, stopped or damaged goes on to the same bytes, and does nothing twice."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess

import psutil
import pytest

from small_film import PARTS, TASKS, command, digests, journal, render, wait_until, write_film
from steadylight.cache.file import VERSION

STAGES = {
    "gather": ("cache/", "group", ()),
    "merge": ("log/results/gather-000.json", "group", ("--cluster", "in-process")),
    "audit": ("log/results/merge.json", "parent", ()),
    "fill": ("log/results/audit-1-0001.json", "group", ("--cluster", "in-process")),
    "shade": ("log/results/shade-00001.json", "group", ("--workers", "2")),
}
"""For each stage: what appears when its work is under way, what to kill, and where the work runs.

A folder stands for any file in it. The work of `shade` that is cut off is that of the second frame.
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films")
    write_film(folder)
    return folder


@pytest.fixture(scope="module")
def whole(folder):
    """A film that was rendered without interruption."""
    render(folder, "whole", "--cluster", "in-process")
    return folder / "whole"


@pytest.fixture
def copy(whole, tmp_path_factory):
    """A copy of the whole film, to be damaged."""
    return shutil.copytree(whole, tmp_path_factory.mktemp("copies") / "run")


def start(folder, output, *more):
    """Start the command as a terminal would: in a process group of its own."""
    return subprocess.Popen(
        command(output, *more),
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def family(process):
    """A process and all that it started."""
    parent = psutil.Process(process.pid)
    return [parent, *parent.children(recursive=True)]


def assert_gone(processes):
    _, alive = psutil.wait_procs(processes, timeout=60)
    assert not [process for process in alive if process.status() != psutil.STATUS_ZOMBIE]


def finished(run):
    """Times of change of all that is done for good: outputs whose task has a result."""
    keys = {path.stem for path in run.glob("log/results/[!.]*.json")}
    names = [f"log/results/{key}.json" for key in keys]
    names += [f"frames/frame_{key[6:]}.exr" for key in keys if key.startswith("shade-")]
    return {name: (run / name).stat().st_mtime_ns for name in names}


def sessions(run):
    """Files of the commands that worked on a run."""
    return list(run.glob("log/sessions/[!.]*.json"))


def appeared(path):
    return any(path.iterdir()) if path.is_dir() else path.exists()


def test_a_run_killed_in_every_stage_ends_with_the_same_bytes_and_no_task_is_done_twice(folder, whole):
    run = folder / "killed"
    done = {}
    for sign, victim, where in STAGES.values():
        number = len(sessions(run)) + 1
        process = start(folder, run, *where)
        # A worker whose parent alone was killed may have brought the next sign about before it ended.
        wait_until(
            lambda sign=sign, number=number: appeared(run / sign) and len(sessions(run)) == number, process
        )
        everyone = family(process)
        if victim == "group":
            os.killpg(process.pid, signal.SIGKILL)
        else:
            os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        assert_gone(everyone)
        assert done.items() <= finished(run).items()
        done = finished(run)
    said = render(folder, run, "--cluster", "in-process")
    assert f"Resuming {run}" in said
    assert done.items() <= finished(run).items()
    entries = [entry["task"] for entry in journal(run) if entry["outcome"] == "done"]
    assert len(entries) == len(set(entries))
    assert not list(run.rglob(".partial-*"))
    assert digests(run) == digests(whole)
    assert (
        len(json.loads((run / "stats.json").read_text())["sessions"]) == len(sessions(run)) == len(STAGES) + 1
    )


@pytest.mark.slow
def test_a_run_in_parts_killed_on_its_way_ends_with_the_same_bytes(folder):
    where = ("--cluster", "in-process", *PARTS)
    render(folder, "parts", *where)
    run = folder / "parts-killed"
    for sign in ("merge-001", "fill-1-002", "smooth-000", "shade-00002"):
        process = start(folder, run, *where)
        wait_until(lambda sign=sign: (run / f"log/results/{sign}.json").exists(), process)
        everyone = family(process)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        assert_gone(everyone)
    record = (run / "run.json").read_bytes()
    render(folder, run, "--workers", "2", *PARTS)
    assert (run / "run.json").read_bytes() == record
    assert digests(run) == digests(folder / "parts")


def test_a_worker_may_be_killed_while_the_command_goes_on(folder, whole):
    run = folder / "worker-killed"
    process = start(folder, run, "--workers", "2")
    wait_until(lambda: len(journal(run)) >= 1, process)
    everyone = family(process)
    os.kill(int(journal(run)[0]["worker"].rpartition(":")[2]), signal.SIGKILL)
    said, complaint = process.communicate(timeout=300)
    assert process.returncode == 0, said + complaint
    assert_gone(everyone)
    assert digests(run) == digests(whole)


def test_ctrl_c_stops_cleanly_and_says_how_to_go_on(folder):
    run = folder / "stopped"
    # Frames that last: the film must not end between the first task and the signal, however busy the machine is.
    process = start(folder, run, "--spp", "50000")
    wait_until(lambda: journal(run), process)
    everyone = family(process)
    os.killpg(process.pid, signal.SIGINT)
    _, complaint = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "Traceback" not in complaint
    assert f"of {TASKS} tasks are done and saved" in complaint
    assert f"room.xml --camera walk.toml --spp 2 --quality draft --output {run} --spp 50000" in complaint
    assert_gone(everyone)
    assert not list(run.rglob(".partial-*"))
    assert json.loads((run / "log/sessions/0001.json").read_text())["outcome"] == "stopped"


def test_a_finished_run_is_left_as_it_is(folder, copy):
    before, entries = finished(copy), journal(copy)
    said = render(folder, copy)
    assert f"{TASKS} of {TASKS} tasks done, only video and report left" in said
    assert finished(copy) == before
    assert journal(copy) == entries


def cut_short(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def of_another_version(path):
    content = path.read_bytes()
    now = b'\\"version\\": %d}' % VERSION
    assert now in content
    path.write_bytes(content.replace(now, b'\\"version\\": %d}' % (VERSION + 1)))


def of_another_scene(path):
    from steadylight.cache.file import CacheFile, encode_cache, read_cache

    path.write_bytes(encode_cache(CacheFile(read_cache(path).records, "0" * 64, {})))


def test_damaged_files_are_named_and_made_again_with_the_same_bytes(folder, whole, copy):
    damaged = {
        "cache/gather_000.safetensors": (of_another_scene, "made for another scene", "gather-000"),
        "cache/merged.safetensors": (of_another_version, f"version {VERSION + 1}", "merge"),
        "cache/audit_1_0001.points": (cut_short, "truncated", "audit-1-0001"),
        "cache/filled_1.safetensors": (cut_short, "truncated", "fill-1"),
        "cache/prepared.prepared": (cut_short, "truncated", "prepare"),
        "frames/frame_00002.exr": (cut_short, "", "shade-00002"),
        "frames/frame_00004.exr": (lambda path: path.write_bytes(b""), "", "shade-00004"),
        "log/results/shade-00003.json": (cut_short, "", "shade-00003"),
    }
    for name, (damage, _, _) in damaged.items():
        damage(copy / name)
    before = journal(copy)
    said = render(folder, copy, "--cluster", "in-process")
    assert f"{TASKS - len(damaged)} of {TASKS} tasks done, {len(damaged)} left" in said
    for name, (_, fault, key) in damaged.items():
        line = next(line for line in said.splitlines() if line.startswith(name.rpartition("/")[2]))
        assert "is not valid" in line
        assert fault in line
        assert f"task {key} will run again" in line
    again = [entry["task"] for entry in journal(copy)[len(before) :]]
    assert sorted(again) == sorted(key for _, _, key in damaged.values())
    assert digests(copy) == digests(whole)
