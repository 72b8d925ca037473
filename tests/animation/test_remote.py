"""A run directory at a URL: machines that share no file system, one truth."""

from __future__ import annotations

import dataclasses
import errno
import json
import shutil
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import fsspec
import pytest
from fake_tasks import SCENE, FakeRenderer, names, prepared
from fake_tasks import session as local_session

from small_film import command, digests, render, wait_until, write_film
from steadylight.animation import remote
from steadylight.animation.plan import SCENE_FILE
from steadylight.animation.provenance import read_run
from steadylight.animation.remote import RemoteRun
from steadylight.animation.run import Session
from steadylight.atomic_file import TEMPORARY
from steadylight.errors import SceneError, SettingsError, StorageError
from steadylight.scenes.archive import read_archive
from steadylight.storage import RunDirectory, file_hash, lease
from steadylight.storage import store as store_module
from steadylight.storage.store import Store, copy_of

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


def fake_perform(task, *, directory, threads):
    """The fake renderer, but like the real one it keeps what is done, and its caches tell the run's seed."""
    from fake_tasks import perform

    run = RunDirectory(directory)
    if all((run.root / name).exists() for name in task.outputs):
        return run.read_result(task.key)
    result = perform(task, directory=directory)
    if task.outputs[0].endswith(".cache"):
        about = {"scene": SCENE.hash, "seed": read_run(run).settings.seed}
        (run.root / task.outputs[0]).write_text(json.dumps(about))
    return result


def perform_as_remote(task, *, url, perform=fake_perform):
    """What a worker does with a task of the fake renderer, seen through `perform_remote`."""
    import steadylight.animation.tasks as tasks_module

    original = tasks_module.perform
    tasks_module.perform = perform
    try:
        return remote.perform_remote(task, url=url, threads=1)
    finally:
        tasks_module.perform = original


def session(url, frames=3, scene=SCENE, renderer=None, **options):
    request = prepared(scene, renderer=renderer, output=url, cluster="in-process", frames=frames, **options)
    return Session(request, perform=partial(perform_as_remote, url=url))


def finish(opened):
    with opened:
        for _ in opened:
            pass
        return opened.finish()


def at(url):
    return Path(url.removeprefix("file://"))


def test_workers_that_do_not_see_the_files_of_the_scene_get_them_with_it(url, tmp_path):
    mesh = tmp_path / "mesh.obj"
    mesh.write_text("v 0 0 0")
    files = {str(mesh): file_hash(mesh)}
    scene = dataclasses.replace(SCENE, content={"a": {"type": "obj", "filename": str(mesh)}}, files=files)
    found = []

    def look(task, *, directory, threads):
        found.append(read_archive(Path(directory) / SCENE_FILE))
        raise RuntimeError("seen")

    with session(url, scene=scene) as opened:
        mesh.unlink()
        with pytest.raises(RuntimeError, match="seen"):
            perform_as_remote(opened.waiting[0], url=url, perform=look)
    assert found[0].hash == scene.hash
    assert Path(found[0].content["a"]["filename"]).read_text() == "v 0 0 0"


def test_a_run_at_a_url_holds_what_a_run_in_a_folder_holds(url, tmp_path):
    finish(session(url))
    with local_session(tmp_path / "local", frames=3) as plain:
        for _ in plain:
            pass
        plain.finish()
    assert names(at(url)) == names(tmp_path / "local") - {"log/lock"}
    for folder in ("frames/*.exr", "cache/*.misses"):
        for path in (tmp_path / "local").glob(folder):
            assert (at(url) / path.relative_to(tmp_path / "local")).read_bytes() == path.read_bytes()


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
    with pytest.raises(SettingsError, match="another steadylight command is using this run"):
        RemoteRun(url, copy_of(url)).open()
    monkeypatch.setattr(lease, "_LEASE_LASTS", 0.0)
    second = RemoteRun(url, copy_of(url))
    second.open()
    second.close()
    first.close()


def test_a_copy_that_others_could_write_to_is_refused(url):
    copy_of(url).parent.chmod(0o777)
    with pytest.raises(SettingsError, match="nobody else can write to"):
        copy_of(url)


def test_a_url_that_nobody_knows_and_a_store_that_does_not_answer_are_named(url):
    with pytest.raises(SettingsError, match="--output nowhere://x: cannot be reached"):
        Store("nowhere://x", copy_of(url))
    with pytest.raises(StorageError, match="cannot be read or written"):
        Store(url, copy_of(url)).fetch(["run.json"])


def test_a_worker_that_outlives_a_run_takes_nothing_of_it_into_the_next(url):
    finish(session(url, seed=1))
    shutil.rmtree(at(url))
    finish(session(url, seed=2))
    assert {json.loads(path.read_text())["seed"] for path in at(url).glob("cache/*.cache")} == {2}


def test_a_worker_that_wakes_late_leaves_the_run_of_another_alone(url):
    def work(task, *, directory, threads):
        record = at(url) / "run.json"
        record.write_text(record.read_text().replace('"seed": 1', '"seed": 2'))
        return fake_perform(task, directory=directory, threads=threads)

    with session(url, seed=1) as opened:
        task = opened.waiting[0]
        with pytest.raises(
            StorageError, match="now belongs to another run; the result of this task was discarded"
        ):
            perform_as_remote(task, url=url, perform=work)
    assert not names(at(url)) & set(task.outputs)


def test_a_worker_that_finds_no_run_says_on_which_machine(url):
    with session(url) as opened:
        task = opened.waiting[0]
    shutil.rmtree(at(url))
    with pytest.raises(StorageError, match="finds no run there"):
        perform_as_remote(task, url=url)


def test_copies_of_processes_that_are_gone_go_but_not_those_of_other_machines(url):
    with session(url) as opened:
        task = opened.waiting[0]
        name = copy_of(url).name
        here = copy_of(url).with_name(f"{name}-worker-{socket.gethostname()}-99999999")
        elsewhere = copy_of(url).with_name(f"{name}-worker-elsewhere-99999999")
        here.mkdir()
        elsewhere.mkdir()
        remote._clear_left_copies.cache_clear()
        perform_as_remote(task, url=url)
    assert not here.exists()
    assert elsewhere.exists()


def test_a_copy_of_another_run_whose_record_is_as_long_does_not_hide_the_run_that_is_there(url, tmp_path):
    finish(session(url, seed=1))
    mine = (copy_of(url) / "run.json").read_bytes()
    copy_of(url).rename(tmp_path / "aside")
    shutil.rmtree(at(url))
    finish(session(url, seed=2))  # by another machine
    theirs = (at(url) / "run.json").read_bytes()
    shutil.rmtree(copy_of(url))
    (tmp_path / "aside").rename(copy_of(url))
    assert len(mine) == len(theirs)
    with pytest.raises(SettingsError, match="--seed: was 2, is now 1"), session(url, seed=1):
        pass
    assert (at(url) / "run.json").read_bytes() == theirs


def test_caches_made_meanwhile_stay_in_the_store_and_are_checked_by_the_next_command(url):
    finish(session(url))
    caches = {name for name in names(at(url)) if name.startswith("cache/")}
    assert caches
    assert not names(copy_of(url)) & caches
    with session(url) as again:
        assert not again.waiting
    assert caches <= names(at(url))
    shutil.rmtree(copy_of(url))
    merged = at(url) / "cache/merged.cache"
    merged.write_bytes(merged.read_bytes()[:-1])
    with session(url) as again:
        assert [task.key for task in again.waiting] == ["merge"]
    assert names(at(url)) >= caches - {"cache/merged.cache"}
    assert not merged.exists()


@contextmanager
def a_store_that_refuses(monkeypatch, start):
    """A store where files whose names start so cannot be written."""
    store = Store.store

    def refuse(self, names):
        for name in names:
            if name.startswith(start):
                raise StorageError("no room there")
            store(self, [name])

    with monkeypatch.context() as patch:
        patch.setattr(Store, "store", refuse)
        yield


def test_a_film_that_cannot_be_stored_is_an_error_and_the_same_command_may_follow_at_once(url, monkeypatch):
    with (
        a_store_that_refuses(monkeypatch, "animation.mp4"),
        pytest.raises(StorageError, match="no room there"),
    ):
        finish(session(url))
    assert not (at(url) / "animation.mp4").exists()
    finish(session(url))
    assert (at(url) / "animation.mp4").exists()


def test_logs_that_cannot_be_stored_do_not_keep_the_next_command_waiting(url, monkeypatch):
    with a_store_that_refuses(monkeypatch, "log/tasks.jsonl"):
        finish(session(url))
    assert not (at(url) / "log/lock").exists()
    assert (at(url) / "report.html").exists()


def test_a_full_disk_here_is_not_blamed_on_the_store(url, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    store = Store(url, copy_of(url))
    monkeypatch.setattr(store._files, "get_file", full)
    with pytest.raises(StorageError, match="no space left on device"):
        store.fetch(["run.json"])
    assert not names(copy_of(url))


def test_what_an_interrupted_write_left_there_is_not_fetched_and_goes(url, monkeypatch):
    with session(url):
        pass
    store = Store(url, copy_of(url))
    with monkeypatch.context() as killed:
        for name in ("mv", "rm_file"):
            killed.setattr(store._files, name, lambda *_: 1 / 0)
        with pytest.raises(StorageError):
            store.store(["run.json"])
    (left,) = (name for name in names(at(url)) if "partial" in name)
    assert TEMPORARY.fullmatch(left)
    assert left not in store.names()
    with session(url):
        assert left not in names(at(url))
        assert left not in names(copy_of(url))


def test_a_refused_first_start_leaves_nothing_there(url, tmp_path):
    with pytest.raises(SceneError), session(url, renderer=FakeRenderer(fault=SceneError("no emitter"))):
        pass
    assert not (tmp_path / "store").exists()


def test_a_command_that_is_refused_writes_nothing_there(url):
    finish(session(url))
    before = {name: (at(url) / name).stat().st_mtime_ns for name in names(at(url))}
    with pytest.raises(SettingsError, match="--seed"), session(url, seed=5):
        pass
    assert {name: (at(url) / name).stat().st_mtime_ns for name in names(at(url))} == before


@contextmanager
def s3_server(environment):
    """A stand-in for S3 in a process of its own; sets what finds it, and makes the bucket `films`."""
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
            for name, value in (keys | {"AWS_ENDPOINT_URL": endpoint}).items():
                environment.setenv(name, value)
            kind = fsspec.get_filesystem_class("s3")
            kind.clear_instance_cache()
            store = fsspec.filesystem("s3")
            store.mkdir("films")
            yield store
            kind.clear_instance_cache()
        finally:
            server.stdin.close()
            server.kill()


@pytest.fixture(params=["file", "memory", "s3"])
def any_url(request, tmp_path, monkeypatch):
    if request.param == "s3":
        with s3_server(monkeypatch):
            yield "s3://films/walk"
    else:
        yield f"{request.param}://{tmp_path}/walk"


def blind_at_first(run):
    """A command that looked at the lease before there was one."""
    read, looks = run.store.read, []

    def look(name):
        looks.append(name)
        return None if len(looks) == 1 else read(name)

    run.store.read = look
    return run


def test_of_two_commands_that_start_together_one_gets_the_lease(any_url, tmp_path):
    first = RemoteRun(any_url, tmp_path / "first")
    first.open()
    held = first.store.read("log/lock")
    second = blind_at_first(RemoteRun(any_url, tmp_path / "second"))
    with pytest.raises(SettingsError, match="another steadylight command is using this run"):
        second.open()
    second.close()
    assert first.store.read("log/lock") == held
    first.close()
    assert first.store.read("log/lock") is None


def test_where_a_store_cannot_create_in_one_step_the_last_to_write_has_the_lease(url, monkeypatch):
    monkeypatch.setattr(store_module, "_PLAIN", set())
    first = RemoteRun(url, copy_of(url))
    theirs = json.dumps({"holder": "them", "time": time.time()}).encode()
    monkeypatch.setattr(time, "sleep", lambda _: first.store.write("log/lock", theirs))
    with pytest.raises(SettingsError, match=r"using this run \(them\)"):
        first.open()
    first.close()
    assert (at(url) / "log/lock").read_bytes() == theirs


def test_a_lease_that_cannot_be_read_is_looked_at_again_and_then_taken_over(url, monkeypatch):
    monkeypatch.setattr(lease, "_SECONDS_TO_SETTLE", 0.01)
    file = at(url) / "log/lock"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"")
    run = RemoteRun(url, copy_of(url))
    run.open()
    assert b"process" in file.read_bytes()
    run.close()
    assert not file.exists()


def test_a_command_whose_lease_was_taken_over_stops_and_leaves_the_other_its_own(url, monkeypatch):
    monkeypatch.setattr(lease, "_SECONDS_BETWEEN_SIGNS", 0.01)
    theirs = json.dumps({"holder": "them", "time": time.time()}).encode()
    with session(url) as opened:
        renewal = opened._remote._lease._thread
        for _ in range(600):  # a renewal that had read the lease before this writes its own over it
            Store(url, copy_of(url)).write("log/lock", theirs)
            renewal.join(0.1)
            if not renewal.is_alive():
                break
        with pytest.raises(StorageError, match="another steadylight command has taken over this run"):
            list(opened)
    assert (at(url) / "log/lock").read_bytes() == theirs
    assert not list(at(url).glob("log/sessions/*"))


@pytest.mark.slow
def test_an_s3_store_over_http_holds_the_run_that_two_workers_render(tmp_path, monkeypatch):
    with s3_server(monkeypatch) as store:
        write_film(tmp_path)
        render(tmp_path, "local", "--cluster", "in-process")
        words = command("s3://films/walk", "--workers", "2")
        first = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE)
        wait_until(lambda: found(store, "films/walk/log/results/gather*"), first)
        first.kill()
        first.communicate()
        store.rm("films/walk/log/lock")  # or wait until the lease has run out
        time.sleep(1)
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        store.invalidate_cache()
        store.get("films/walk", str(tmp_path / "got"), recursive=True)
    assert digests(tmp_path / "got") == digests(tmp_path / "local")
    assert json.loads((tmp_path / "got/stats.json").read_text())["tasks"]["failed"] == 0


def found(store, pattern):
    store.invalidate_cache()
    return store.glob(pattern)
