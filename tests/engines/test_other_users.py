"""Other users of the machine can neither run code through our workers, nor see the dashboard, nor lay traps."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import urllib.error
import urllib.request
from http.cookiejar import CookieJar
from pathlib import Path

import pytest
from arithmetic import in_folder, task, total

from steadylight.engines.dask_cluster import DaskCluster
from steadylight.engines.private_folder import PREFIX, PrivateFolder
from steadylight.errors import StorageError

AS_NOBODY = """
import asyncio, os, pickle, sys
from distributed import Client, Scheduler, Worker
from distributed.comm import connect
from distributed.security import Security

Security.temporary()
nobody = 65534
os.setgroups([]); os.setgid(nobody); os.setuid(nobody)
os.environ["HOME"] = "/"
address, mark, operation = sys.argv[1:]


async def attack(address, security):
    comm = await connect(address, timeout=3, **security.get_connection_args("client"))
    function, arguments = pickle.dumps(os.mkdir), pickle.dumps((mark,))
    await comm.write({"op": operation, "function": function, "args": arguments, "reply": True})
    try:
        return await asyncio.wait_for(comm.read(), 3)
    finally:
        comm.abort()


async def main():
    place = address.partition("://")[2]
    for protocol, security in ("tcp", Security()), ("tls", Security.temporary()):
        try:
            print(await attack(f"{protocol}://{place}", security))
        except Exception as error:
            print("refused:", type(error).__name__, error)

asyncio.run(main())
"""


@pytest.fixture
def shared():
    """A folder that everyone may use, as the system's temporary folder."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o1777)
    yield folder
    shutil.rmtree(folder)


def need_root():
    if os.geteuid() != 0:
        pytest.skip("acting as another user needs root")


def as_nobody(command, **options):
    return subprocess.run(command, user=65534, group=65534, extra_groups=[], check=True, **options)


class TestAttacks:
    @pytest.mark.parametrize(("target", "operation"), [("scheduler", "run_function"), ("worker", "run")])
    def test_another_user_cannot_run_code_through_the_local_pool(
        self, target, operation, shared, tmp_path, importing_environment
    ):
        need_root()
        with DaskCluster(workers=1) as engine:
            list(engine.run([task("a-1", value=3)], in_folder(total, tmp_path)))
            workers = engine._client.scheduler_info()["workers"]
            address = engine.address if target == "scheduler" else next(iter(workers))
            done = subprocess.run(
                [sys.executable, "-c", AS_NOBODY, address, str(shared / "taken"), operation],
                env=importing_environment,
                capture_output=True,
                text=True,
                check=True,
                timeout=60,
            )
        assert not (shared / "taken").exists(), done.stdout
        assert done.stdout.count("refused:") == 2, done.stdout

    def test_a_scratch_folder_made_by_another_user_is_not_used(self, shared, tmp_path, monkeypatch):
        need_root()
        thesis = tmp_path / "thesis.tex"
        thesis.write_text("precious")
        trap = shared / "dask-scratch-space"
        as_nobody(["mkdir", "-m", "777", str(trap)])
        for name in ("global.lock", "purge.lock"):
            as_nobody(["ln", "-s", str(thesis), str(trap / name)])
        monkeypatch.setattr(tempfile, "tempdir", str(shared))
        with DaskCluster(workers=1) as engine:
            list(engine.run([task("a-1", value=3)], in_folder(total, tmp_path)))
        assert thesis.read_text() == "precious"
        assert sorted(path.name for path in trap.iterdir()) == ["global.lock", "purge.lock"]

    def test_folders_of_other_users_are_not_removed(self, shared):
        need_root()
        as_nobody(["mkdir", str(shared / f"{PREFIX}{socket.gethostname()}-theirs")])
        as_nobody(["touch", str(shared / f"{PREFIX}{socket.gethostname()}-theirs" / "lock")])
        PrivateFolder(shared).remove()
        assert (shared / f"{PREFIX}{socket.gethostname()}-theirs" / "lock").exists()


KILLED = """
import os, signal, sys
from pathlib import Path
from steadylight.engines.private_folder import PrivateFolder
PrivateFolder(Path(sys.argv[1]))
os.kill(os.getpid(), signal.SIGKILL)
"""


class TestPrivateFolder:
    def test_a_place_that_cannot_be_written_is_named_with_the_remedy(self, tmp_path):
        (tmp_path / "file").touch()
        with pytest.raises(StorageError, match=r"no private folder can be made in .*file: .*; set TMPDIR to"):
            PrivateFolder(tmp_path / "file")

    def test_only_its_user_may_enter_it_and_it_is_removed(self, tmp_path):
        folder = PrivateFolder(tmp_path)
        assert folder.path.stat().st_mode & 0o077 == 0
        assert folder.path.name.startswith(PREFIX)
        folder.remove()
        folder.remove()
        assert list(tmp_path.iterdir()) == []

    def test_what_a_killed_command_left_is_removed_by_the_next_and_what_is_in_use_stays(
        self, tmp_path, importing_environment
    ):
        used = PrivateFolder(tmp_path)
        subprocess.run(
            [sys.executable, "-c", KILLED, str(tmp_path)], env=importing_environment, check=False, timeout=60
        )
        assert len(list(tmp_path.iterdir())) == 2
        again = PrivateFolder(tmp_path)
        assert set(tmp_path.iterdir()) == {used.path, again.path}
        used.remove()
        again.remove()

    def test_a_link_with_such_a_name_is_left_alone(self, tmp_path):
        (tmp_path / "precious").mkdir()
        (tmp_path / "precious" / "lock").touch()
        (tmp_path / f"{PREFIX}{socket.gethostname()}-link").symlink_to(tmp_path / "precious")
        PrivateFolder(tmp_path).remove()
        assert (tmp_path / "precious" / "lock").exists()

    def test_the_local_pool_leaves_nothing_in_the_temporary_folder(self, tmp_path, monkeypatch):
        temporary = tmp_path / "temporary"
        temporary.mkdir()
        monkeypatch.setattr(tempfile, "tempdir", str(temporary))
        with DaskCluster(workers=1) as engine:
            list(engine.run([task("a-1", value=3)], in_folder(total, tmp_path)))
            (folder,) = temporary.iterdir()
            assert folder.stat().st_mode & 0o077 == 0
        assert list(temporary.iterdir()) == []


class TestDashboard:
    @pytest.mark.filterwarnings("default")  # of the page's own library
    def test_only_the_printed_link_opens_it_and_then_its_pages(self):
        with DaskCluster(workers=1) as engine:
            link = engine.dashboard_link
            base = link.partition("/status")[0]
            for path in (
                "/",
                "/status",
                "/status?token=guess",
                "/health",
                "/json/identity.json",
                "/status/ws",
            ):
                with pytest.raises(urllib.error.HTTPError, match="403"):
                    urllib.request.urlopen(base + path, timeout=20)
            browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))
            with browser.open(link, timeout=20) as page:
                assert page.status == 200
                assert "token" not in page.url
            with browser.open(f"{base}/health", timeout=20) as page:
                assert page.read() == b"ok"
