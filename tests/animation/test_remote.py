"""A run directory at a URL: machines that share no file system, one truth."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import fsspec
import pytest
from fake_tasks import SCENE
from fake_tasks import session as local_session

from small_film import command, digests, render, wait_until, write_film
from steadylight.animation import remote
from steadylight.animation.remote import RemoteRun, Store, copy_of
from steadylight.animation.request import prepare
from steadylight.animation.run import Session
from steadylight.errors import SettingsError, StorageError

SERVER = """
import sys
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
server.start()
print(server.get_host_and_port()[1], flush=True)
sys.stdin.read()
"""


@pytest.fixture
def url(tmp_path):
    return f"file://{tmp_path}/store/run"


@pytest.fixture(autouse=True)
def own_copies(tmp_path, monkeypatch):
    """Copies of this test only."""
    (tmp_path / "copies").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "copies"))
    monkeypatch.setattr("tempfile.tempdir", None)


def perform_as_remote(task, *, url):
    """What a worker does with a task of the fake renderer, seen through `perform_remote`."""
    from fake_tasks import perform

    import steadylight.animation.tasks as tasks_module

    original = tasks_module.perform
    tasks_module.perform = lambda task, *, directory, threads: perform(task, directory=directory)
    try:
        return remote.perform_remote(task, url=url, threads=1)
    finally:
        tasks_module.perform = original


def session(url, frames=3):
    request = prepare(SCENE, output=url, cluster="in-process", frames=frames)
    return Session(request, perform=partial(perform_as_remote, url=url), check=lambda _: "llvm_ad_rgb")


def finish(opened):
    with opened:
        for _ in opened:
            pass
        return opened.finish()


def at(url):
    return Path(url.removeprefix("file://"))


def test_a_run_at_a_url_holds_what_a_run_in_a_folder_holds(url, tmp_path):
    finish(session(url))
    with local_session(tmp_path / "local", frames=3) as plain:
        for _ in plain:
            pass
        plain.finish()
    there = {path.relative_to(at(url)).as_posix() for path in at(url).rglob("*") if path.is_file()}
    here = {path.relative_to(tmp_path / "local").as_posix() for path in (tmp_path / "local").rglob("*")}
    assert there == {name for name in here if (tmp_path / "local" / name).is_file()} - {"log/lock"}
    assert digests(at(url)) == digests(tmp_path / "local")


def test_another_machine_goes_on_with_what_is_there(url):
    with session(url) as first:
        done = [attempt.task.key for attempt, _ in zip(first, range(3), strict=False)]
    for path in sorted(copy_of(url).parent.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    with session(url) as second:
        assert second.resumed
        assert not {task.key for task in second.waiting} & set(done)
    finish(session(url))
    assert len(list((at(url) / "frames").iterdir())) == 3


def test_a_damaged_file_there_is_found_and_made_again(url):
    finish(session(url))
    frame = at(url) / "frames/frame_00002.exr"
    whole = frame.read_bytes()
    frame.write_bytes(whole[:-20])
    with session(url) as again:
        assert [task.key for task in again.waiting] == ["shade-00002"]
        assert "frame_00002.exr" in again.faults[0]
        for _ in again:
            pass
        again.finish()
    assert frame.read_bytes() == whole


def test_a_second_command_is_refused_until_the_first_has_given_no_sign_for_long(url, monkeypatch):
    first = RemoteRun(url, copy_of(url))
    first.open()
    with pytest.raises(SettingsError, match="another steadylight command is at work here"):
        RemoteRun(url, copy_of(url)).open()
    monkeypatch.setattr(remote, "_LEASE_LASTS", 0.0)
    second = RemoteRun(url, copy_of(url))
    second.open()
    second.close()
    first._done.set()
    first._thread.join()


def test_a_copy_that_others_could_write_to_is_refused(url):
    copy_of(url).parent.chmod(0o777)
    with pytest.raises(SettingsError, match="nobody else may write to"):
        copy_of(url)


def test_a_url_that_nobody_knows_and_a_store_that_does_not_answer_are_named(url):
    with pytest.raises(SettingsError, match="--output nowhere://x: cannot be reached from here"):
        Store("nowhere://x", copy_of(url))
    with pytest.raises(StorageError, match="cannot be read or written"):
        Store(url, copy_of(url)).fetch(["run.json"])


@pytest.mark.slow
def test_an_s3_store_over_http_holds_the_run_that_two_workers_render(tmp_path):
    pytest.importorskip("s3fs")
    pytest.importorskip("moto.server")
    with subprocess.Popen(
        [sys.executable, "-c", SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as server:
        try:
            endpoint = f"http://127.0.0.1:{int(server.stdout.readline())}"
            keys = {"AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "y", "AWS_DEFAULT_REGION": "us-east-1"}
            environment = (
                os.environ | keys | {"AWS_ENDPOINT_URL": endpoint, "FSSPEC_S3_ENDPOINT_URL": endpoint}
            )
            write_film(tmp_path)
            render(tmp_path, "local", "--cluster", "in-process")
            store = fsspec.filesystem("s3", endpoint_url=endpoint, key="x", secret="y")
            store.mkdir("films")
            words = command("s3://films/walk", "--workers", "2")
            first = subprocess.Popen(words, cwd=tmp_path, env=environment, stdout=subprocess.PIPE)
            wait_until(lambda: store.glob("films/walk/log/results/gather*"), first)
            first.kill()
            first.communicate()
            store.rm("films/walk/log/lock")  # or wait until the lease has run out
            time.sleep(1)
            done = subprocess.run(
                words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, done.stdout + done.stderr
            store.invalidate_cache()
            store.get("films/walk", str(tmp_path / "got"), recursive=True)
        finally:
            server.stdin.close()
            server.kill()
    assert digests(tmp_path / "got") == digests(tmp_path / "local")
    assert json.loads((tmp_path / "got/stats.json").read_text())["tasks"]["failed"] == 0
