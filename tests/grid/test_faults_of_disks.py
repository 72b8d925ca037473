"""A disk that fills, files that are damaged, a link that is cut, a command that is killed: on this machine alone."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import cheap_film
import pytest
from cheap_film import performed
from private_machine import PrivateMachine, environment, missing

from small_film import digests, journal

FRAMES = 16


def run(directory, *options, timeout=300):
    """The cheap film's command: exit code and what it said."""
    command = [sys.executable, cheap_film.__file__, directory, "--frames", FRAMES, *options]
    done = subprocess.run(
        list(map(str, command)),
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout,
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("seed", [31, pytest.param(32, marks=pytest.mark.slow)])
def test_a_command_killed_at_random_instants_loses_nothing(tmp_path, undisturbed, seed):
    chance = random.Random(seed)
    directory = tmp_path / "run"
    options = ("--frames", str(FRAMES), "--seconds", "0.2", "--workers", "2")
    for _ in range(2):
        command = [sys.executable, cheap_film.__file__, str(directory), *options]
        process = subprocess.Popen(
            command, env=environment(), stdout=subprocess.DEVNULL, start_new_session=True
        )
        before = len(journal(directory))
        end = time.monotonic() + 40
        while len(journal(directory)) < before + 5 and process.poll() is None and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(chance.uniform(0, 0.4))
        process.send_signal(signal.SIGKILL)
        process.wait()
    code, said = run(directory, *options)
    assert code == 0, said
    assert digests(directory) == undisturbed(FRAMES)
    assert len(performed(directory)) == len(set(performed(directory)))
    assert not list(directory.rglob(".partial-*"))


@pytest.fixture
def small_disk(tmp_path):
    """A machine with a disk of its own, and that disk."""
    reason = missing("mount")
    if reason:
        pytest.skip(f"A disk of its own {reason}")
    disk = tmp_path / "disk"
    disk.mkdir()
    machine = PrivateMachine(tmp_path, "n0", f"mount -t tmpfs -o size=1200k tmpfs {disk}")
    machine.environment, machine.user, machine.work = {}, None, tmp_path
    yield machine, disk
    machine.close()


def test_a_full_disk_ends_the_run_cleanly_and_with_more_room_it_goes_on(small_disk, start, undisturbed):
    machine, disk = small_disk
    size = "128x96"
    options = ("--frames", FRAMES, "--seconds", 0, "--size", size)
    process = start(machine, disk / "run", "local", *options)
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 2, said
    assert "no space left on device: make room and run the same command again" in said
    assert "Traceback" not in said
    # From outside, through the machine's own view of its disks.
    view = f"/proc/{machine.init}/root{disk}/run"
    assert 0 < len(list(os.scandir(f"{view}/frames"))) < FRAMES
    machine.run("mount", "-o", "remount,size=50m", disk)
    process = start(machine, disk / "run", "local", *options)
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 0, said
    copy = shutil.copytree(view, machine.work / "copy")
    assert digests(copy) == undisturbed(FRAMES, size)
    assert not list(copy.rglob(".partial-*"))
    done = [entry["task"] for entry in journal(copy) if entry["outcome"] == "done"]
    assert len(done) == len(set(done))


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) * 3 // 4] ^= 4
    path.write_bytes(content)


def empty(path):
    path.write_bytes(b"")


def run_here(directory, capsys=None):
    """The same in this process: exit code and what it said."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        code = cheap_film.main(
            [str(directory), "--frames", str(FRAMES), "--seconds", "0", "--cluster", "in-process"]
        )
    finally:
        signal.signal(signal.SIGTERM, before)
    return code, "" if capsys is None else capsys.readouterr().out


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    directory = tmp_path_factory.mktemp("whole") / "run"
    code, _ = run_here(directory)
    assert code == 0
    return directory


@pytest.mark.parametrize("damage", [cut, flip, empty])
def test_damaged_frames_caches_and_results_are_named_and_made_again(whole, tmp_path, capsys, damage):
    directory = shutil.copytree(whole, tmp_path / "run")
    damaged = {
        "frames/frame_00003.exr": "shade-00003",
        "cache/gather_000.safetensors": "gather-000",
        "cache/merged.safetensors": "merge",
        "log/results/shade-00007.json": "shade-00007",
    }
    for name in damaged:
        damage(directory / name)
    before = journal(directory)
    code, said = run_here(directory, capsys)
    assert code == 0, said
    for name, key in damaged.items():
        assert f"{name.rpartition('/')[2]} is not valid" in said
        assert f"task {key} will run again" in said
    again = [entry["task"] for entry in journal(directory)[len(before) :]]
    assert sorted(again) == sorted(damaged.values())
    assert digests(directory) == digests(whole)


def test_a_damaged_record_of_the_run_is_named_and_nothing_is_touched(whole, tmp_path, capsys):
    directory = shutil.copytree(whole, tmp_path / "run")
    cut(directory / "run.json")
    before = digests(directory)
    code, said = run_here(directory, capsys)
    assert code == 2
    assert "run.json: cannot be read" in said
    assert digests(directory) == before


NETWORK = """
ip netns add far
ip link add near type veth peer name far netns far
ip addr add 10.78.0.1/24 dev near
ip link set near up
ip -n far addr add 10.78.0.2/24 dev far
ip -n far link set far up
ip -n far link set lo up
"""


@pytest.fixture
def two_networks(tmp_path):
    """A machine with a second host behind a link that can be cut."""
    reason = missing("ip")
    if reason:
        pytest.skip(f"A network of its own {reason}")
    setup = f"mount -t tmpfs tmpfs /run\n{NETWORK}"
    machine = PrivateMachine(tmp_path, "n0", setup)
    machine.environment, machine.user, machine.work = {}, None, tmp_path
    yield machine
    machine.close()


@pytest.mark.slow
def test_a_host_whose_link_is_cut_for_a_minute_costs_attempts_and_no_frame(two_networks, start, undisturbed):
    machine = two_networks
    dask = (sys.executable, "-m", "dask")
    folder = machine.work
    place = ("--scheduler-file", folder / "scheduler.json")
    scheduler = machine.start(
        *dask, "scheduler", *place, "--host", "10.78.0.1", env=environment(), cwd=folder
    )
    machine.wait_until((folder / "scheduler.json").exists)
    here = (*dask, "worker", *place, "--nthreads", "1", "--no-dashboard")
    near = machine.start(*here, "--host", "10.78.0.1", "--name", "near", env=environment(), cwd=folder)
    inside = ("ip", "netns", "exec", "far")
    far = machine.start(*inside, *here, "--host", "10.78.0.2", "--name", "far", env=environment(), cwd=folder)
    directory = folder / "run"

    address = json.loads((folder / "scheduler.json").read_text())["address"]
    site = folder / "site.toml"
    site.write_text("[faults]\nstalled_after = 5.0\n")
    options = ("--frames", FRAMES, "--seconds", 5, "--site", site)
    process = start(machine, directory, address, *options)
    machine.wait_until(lambda: any("far" in entry["worker"] for entry in journal(directory)), 60)
    time.sleep(random.Random(41).uniform(1, 4))
    machine.run("ip", "link", "set", "near", "down")
    time.sleep(60)
    machine.run("ip", "link", "set", "near", "up")
    said, _ = process.communicate(timeout=300)
    machine.run("pkill", "-9", "-f", "scheduler.json")
    for each in (scheduler, near, far):
        each.communicate()
    assert process.returncode == 0, said
    assert digests(directory) == undisturbed(FRAMES)
    assert not list(directory.rglob(".partial-*"))
    outcomes = {entry["outcome"] for entry in journal(directory)}
    assert outcomes == {"done", "lost"}
    done = [entry["task"] for entry in journal(directory) if entry["outcome"] == "done"]
    assert len(done) == len(set(done))
