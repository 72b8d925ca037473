"""The run directory: whole files or none, one command at a time, and what is done."""

import errno
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from steadylight import atomic_file
from steadylight.errors import SettingsError, StorageError
from steadylight.storage import RunDirectory, atomic_write, write_json

RECORD = {"settings": {"width": 64, "frames": (1, 2, 3), "mode": "two-pass"}, "scene_hash": "ab12"}


@dataclass(frozen=True)
class Piece:
    key: str
    outputs: tuple[str, ...]


def starting_with_good(path: Path) -> None:
    if not path.read_bytes().startswith(b"good"):
        raise ValueError("cut short")


def names_in(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


@pytest.fixture
def run(tmp_path):
    with RunDirectory(tmp_path / "run") as directory:
        directory.open_or_create(RECORD)
        yield directory


class TestOpening:
    def test_a_new_directory_gets_the_record_and_the_folders(self, tmp_path):
        with RunDirectory(tmp_path / "deep" / "run") as run:
            assert run.open_or_create(RECORD) is False
            record = run.read_record()
        assert record["settings"]["frames"] == [1, 2, 3]
        assert run.frame(7) == tmp_path / "deep" / "run" / "frames" / "frame_00007.exr"
        assert run.frame(7).parent.is_dir()

    def test_the_same_record_resumes(self, tmp_path):
        for resumed in (False, True):
            with RunDirectory(tmp_path) as run:
                assert run.open_or_create(RECORD) is resumed

    def test_other_settings_are_an_error_that_names_each_entry_with_both_values(self, run):
        other = {"settings": {"width": 128, "frames": list(range(500)), "spp": 4}, "scene_hash": "ab12"}
        before = names_in(run.root)
        run.close()
        with pytest.raises(SettingsError) as caught:
            RunDirectory(run.root).open_or_create(other)
        text = str(caught.value)
        assert "settings.width: was 64, is now 128" in text
        assert 'settings.mode: was "two-pass", is now not set' in text
        assert "settings.spp: was not set, is now 4" in text
        assert "(500 entries)" in text
        assert "scene_hash" not in text
        assert "choose another output" in text
        assert max(len(line) for line in text.splitlines()) < 400
        assert names_in(run.root) == before

    def test_a_folder_of_somebody_else_is_refused_and_left_alone(self, tmp_path):
        (tmp_path / "thesis.tex").write_text("precious")
        with pytest.raises(SettingsError, match=r"not a run directory: it contains thesis\.tex"):
            RunDirectory(tmp_path).open_or_create(RECORD)
        assert names_in(tmp_path) == ["thesis.tex"]

    def test_a_large_folder_of_somebody_else_is_not_walked_through(self, tmp_path, monkeypatch):
        (tmp_path / "work" / "deep").mkdir(parents=True)
        (tmp_path / "frames").mkdir()
        read, iterdir = [], Path.iterdir
        monkeypatch.setattr(Path, "iterdir", lambda path: read.append(path) or iterdir(path))
        with pytest.raises(SettingsError, match="it contains work but no run"):
            RunDirectory(tmp_path).open_or_create(RECORD)
        assert read == [tmp_path]

    def test_a_file_in_place_of_the_folder_is_refused(self, tmp_path):
        (tmp_path / "run").write_text("")
        with pytest.raises(SettingsError, match="is a file"):
            RunDirectory(tmp_path / "run").open_or_create(RECORD)

    @pytest.mark.parametrize("leftover", ["", "frames", "log/lock", ".partial-12-0123456789ab-run.json"])
    def test_a_start_that_was_cut_off_can_be_repeated(self, tmp_path, leftover):
        if leftover:
            (tmp_path / leftover).parent.mkdir(exist_ok=True)
            if leftover == "frames":
                (tmp_path / leftover).mkdir()
            else:
                (tmp_path / leftover).write_text("")
        with RunDirectory(tmp_path) as run:
            assert run.open_or_create(RECORD) is False
        assert not [name for name in names_in(tmp_path) if "partial" in name]

    @pytest.mark.parametrize("content", ["{", "[1]", '{"a": 1', '{"a":' * 100_000])
    def test_a_damaged_run_json_is_named(self, run, content):
        run.run_file.write_text(content)
        with pytest.raises(SettingsError, match=r"run\.json"):
            RunDirectory(run.root).open_or_create(RECORD)

    def test_reading_a_folder_that_is_no_run_says_so(self, tmp_path):
        with pytest.raises(SettingsError, match=r"it has no run\.json"):
            RunDirectory(tmp_path).read_record()

    def test_a_start_on_a_disk_that_cannot_be_written_leaves_nothing(self, tmp_path, monkeypatch):
        monkeypatch.setattr(os, "fsync", failing_with(errno.ENOSPC))
        with pytest.raises(StorageError, match="make room and run the same command again"):
            RunDirectory(tmp_path / "deep" / "run").open_or_create(RECORD)
        assert names_in(tmp_path) == []

    def test_leftovers_of_killed_attempts_are_swept_at_the_next_start(self, run):
        run.close()
        leftover = run.root / "frames" / ".partial-99999-0123456789ab-frame_00001.exr"
        leftover.write_bytes(b"half")
        foreign = run.root / "frames" / ".partial-notes.txt"
        foreign.write_text("not ours")
        with RunDirectory(run.root) as again:
            again.open_or_create(RECORD)
        assert not leftover.exists()
        assert foreign.exists()


HOLD_THE_LOCK = """
import sys, time
from steadylight.storage import RunDirectory
run = RunDirectory(sys.argv[1])
run.open_or_create({"a": 1})
print("held", flush=True)
time.sleep(60)
"""


def child(code: str, *arguments: object) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)], stdout=subprocess.PIPE, env=environment
    )


class TestLock:
    def test_a_second_command_is_refused_until_the_first_is_gone_even_by_kill(self, tmp_path):
        with child(HOLD_THE_LOCK, tmp_path) as first:
            try:
                assert first.stdout.readline() == b"held\n"
                with pytest.raises(
                    SettingsError, match=rf"using this run directory \(host .*, process {first.pid}\)"
                ):
                    RunDirectory(tmp_path).open_or_create({"a": 1})
            finally:
                first.kill()
        with RunDirectory(tmp_path) as run:
            assert run.open_or_create({"a": 1}) is True

    def test_opening_twice_in_one_process_is_refused_too(self, run):
        with pytest.raises(SettingsError, match="another steadylight command"):
            RunDirectory(run.root).open_or_create(RECORD)

    def test_a_command_whose_lock_was_deleted_stops_before_it_meets_another(self, run):
        run.append_journal({"key": "a"})
        run.lock_file.unlink()
        with pytest.raises(StorageError, match=r"log/lock: was removed or replaced"):
            run.append_journal({"key": "b"})
        with RunDirectory(run.root) as second:
            second.open_or_create(RECORD)
            with pytest.raises(StorageError, match=r"log/lock: was removed or replaced"):
                run.append_journal({"key": "c"})
            second.append_journal({"key": "d"})
        assert [entry["key"] for entry in run.read_journal()] == ["a", "d"]

    def test_of_two_starts_at_once_the_loser_leaves_lock_and_folders_to_the_winner(
        self, tmp_path, monkeypatch
    ):
        winner, loser = RunDirectory(tmp_path / "run"), RunDirectory(tmp_path / "run")
        take = loser._lock.take

        def take_late(**how):  # the loser has made the folders by now
            winner.open_or_create(RECORD)
            take(**how)

        monkeypatch.setattr(loser._lock, "take", take_late)
        with winner:
            with pytest.raises(SettingsError, match="another steadylight command"):
                loser.open_or_create(RECORD)
            winner.append_journal({"key": "a"})
            assert {"frames", "cache", "log/results"} <= set(names_in(winner.root))

    def test_a_lock_on_a_file_that_was_removed_meanwhile_is_taken_again(self, run, monkeypatch):
        run.close()
        lock, removals = fcntl.flock, [run.lock_file]

        def flock(file, how):
            while removals:
                removals.pop().unlink()  # as a failed start does that gives up just now
            lock(file, how)

        monkeypatch.setattr("fcntl.flock", flock)
        with RunDirectory(run.root) as again:
            again.open_or_create(RECORD)
            again.append_journal({"key": "a"})
            with pytest.raises(SettingsError, match="another steadylight command"):
                RunDirectory(run.root).open_or_create(RECORD)

    def test_a_lock_that_is_a_link_is_refused_and_its_target_stays(self, run, tmp_path):
        run.close()
        (tmp_path / "thesis.tex").write_text("precious")
        run.lock_file.unlink()
        run.lock_file.symlink_to(tmp_path / "thesis.tex")
        with pytest.raises(
            StorageError, match=r"log/lock: cannot be written: it is a symbolic link: remove it"
        ):
            RunDirectory(run.root).open_or_create(RECORD)
        assert (tmp_path / "thesis.tex").read_text() == "precious"

    def test_a_file_system_without_locks_still_works(self, tmp_path, monkeypatch, caplog):
        monkeypatch.setattr("fcntl.flock", failing_with(errno.ENOLCK))
        with RunDirectory(tmp_path) as run:
            assert run.open_or_create(RECORD) is False
        assert "does not support locks" in caplog.text


def failing_with(number: int):
    def fail(*_arguments, **_keywords):
        raise OSError(number, os.strerror(number))

    return fail


WRITE_AND_STALL = """
import sys, time
from pathlib import Path
from steadylight.storage import atomic_write
with atomic_write(Path(sys.argv[1])) as temporary:
    temporary.write_bytes(b"half of it")
    print("writing", flush=True)
    time.sleep(60)
"""


class TestAtomicWrite:
    def test_the_file_appears_when_it_is_whole(self, tmp_path):
        path = tmp_path / "frame.exr"
        with atomic_write(path, starting_with_good) as temporary:
            assert temporary.parent == tmp_path
            assert temporary.suffix == ".exr"
            temporary.write_bytes(b"good data")
            assert not path.exists()
        assert path.read_bytes() == b"good data"
        assert names_in(tmp_path) == ["frame.exr"]

    @pytest.mark.parametrize("fault", [ValueError("no"), KeyboardInterrupt()])
    def test_an_error_leaves_the_old_file_and_no_temporary(self, tmp_path, fault):
        path = tmp_path / "frame.exr"
        path.write_bytes(b"old")

        def interrupted_write() -> None:
            with atomic_write(path) as temporary:
                temporary.write_bytes(b"new")
                raise fault

        with pytest.raises(type(fault)):
            interrupted_write()
        assert path.read_bytes() == b"old"
        assert names_in(tmp_path) == ["frame.exr"]

    def test_a_folder_in_place_of_the_file_is_named(self, tmp_path):
        (tmp_path / "frame.exr").mkdir()
        with (
            pytest.raises(
                StorageError, match=r"frame\.exr: cannot be written: a folder has this name: move it"
            ),
            atomic_write(tmp_path / "frame.exr") as temporary,
        ):
            temporary.write_bytes(b"data")
        assert names_in(tmp_path) == ["frame.exr"]

    def test_what_does_not_read_back_is_never_given_its_name(self, tmp_path):
        with (
            pytest.raises(
                StorageError, match=r"frame\.exr: the written file could not be read back \(cut short\)"
            ),
            atomic_write(tmp_path / "frame.exr", starting_with_good) as temporary,
        ):
            temporary.write_bytes(b"bad")
        assert names_in(tmp_path) == []

    def test_two_attempts_at_one_file_do_not_meet(self, tmp_path):
        path = tmp_path / "frame.exr"
        with atomic_write(path) as first, atomic_write(path) as second:
            assert first != second
            first.write_bytes(b"same")
            second.write_bytes(b"same")
        assert path.read_bytes() == b"same"

    def test_a_killed_writer_leaves_no_file_under_the_final_name(self, tmp_path):
        with child(WRITE_AND_STALL, tmp_path / "frame.exr") as writer:
            assert writer.stdout.readline() == b"writing\n"
            writer.send_signal(signal.SIGKILL)
        assert not (tmp_path / "frame.exr").exists()
        assert len(RunDirectory(tmp_path).sweep()) == 1
        assert names_in(tmp_path) == []

    @pytest.mark.parametrize(
        ("number", "remedy"),
        [
            (errno.ENOSPC, "no space left"),
            (errno.EDQUOT, "quota"),
            (errno.EACCES, "permission denied"),
            (errno.EROFS, "read-only"),
        ],
    )
    def test_a_disk_that_cannot_be_written_is_explained(self, tmp_path, monkeypatch, number, remedy):
        monkeypatch.setattr(os, "fsync", failing_with(number))
        path = tmp_path / "frame.exr"
        with pytest.raises(StorageError, match=remedy) as caught, atomic_write(path) as temporary:
            temporary.write_bytes(b"data")
        assert str(path) in str(caught.value)
        assert names_in(tmp_path) == []

    def test_a_full_disk_that_a_library_reports_in_its_own_words_is_recognised(self, tmp_path, monkeypatch):
        monkeypatch.setattr(atomic_file, "_probe", failing_with(errno.ENOSPC))
        with pytest.raises(StorageError, match="make room"), atomic_write(tmp_path / "frame.exr"):
            raise RuntimeError("Imf: write failed")

    def test_what_may_not_be_read_elsewhere_is_not_blamed_on_the_output(self, tmp_path):
        refused = PermissionError(errno.EACCES, "Permission denied", "/elsewhere/scene.xml")
        with pytest.raises(PermissionError, match=r"scene\.xml"), atomic_write(tmp_path / "frame.exr"):
            raise refused

    def test_a_folder_that_vanished_is_named(self, tmp_path):
        folder = tmp_path / "frames"
        folder.mkdir()
        with (
            pytest.raises(StorageError, match="is missing or not a folder"),
            atomic_write(folder / "frame.exr"),
        ):
            shutil.rmtree(folder)

    def test_nan_is_no_json(self, tmp_path):
        with pytest.raises(ValueError, match="JSON"):
            write_json(tmp_path / "stats.json", {"a": float("nan")})
        assert names_in(tmp_path) == []

    def test_a_really_full_disk_is_explained_and_left_clean(self, tmp_path):
        disk = tmp_path / "disk"
        disk.mkdir()
        if os.geteuid() != 0 or not shutil.which("mount"):
            pytest.skip("mounting a small disk needs root")
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)], capture_output=True, check=False
        )
        if mounted.returncode:
            pytest.skip(f"mounting a small disk is not permitted: {mounted.stderr.decode().strip()}")
        try:
            with RunDirectory(disk / "run") as run:
                run.open_or_create(RECORD)
                with pytest.raises(StorageError, match="make room"), atomic_write(run.frame(1)) as temporary:
                    temporary.write_bytes(b"\1" * 1_000_000)
                # A library that swallows the error: the file is cut short, the disk is full all the same.
                with (
                    pytest.raises(StorageError, match="make room"),
                    atomic_write(run.frame(1), starting_with_good) as temporary,
                    suppress(OSError),
                ):
                    temporary.write_bytes(b"\1" * 1_000_000)
                assert list(run.frame(1).parent.iterdir()) == []
                run.append_journal({"key": "a"})
            (disk / "filler").touch()
            with pytest.raises(OSError, match="No space"):
                (disk / "filler").write_bytes(b"\1" * 1_000_000)
            with pytest.raises(StorageError, match="make room"):
                RunDirectory(disk / "second").open_or_create(RECORD)
            assert not (disk / "second").exists()
        finally:
            subprocess.run(["umount", str(disk)], check=True)


class TestJournal:
    def test_entries_come_back_in_order_with_a_time(self, run):
        for attempt in (1, 2):
            run.append_journal({"key": "shade-0001", "attempt": attempt})
        entries = run.read_journal()
        assert [entry["attempt"] for entry in entries] == [1, 2]
        assert abs(entries[0]["time"] - time.time()) < 600

    def test_a_line_cut_short_is_left_out_and_spoils_no_later_one(self, run):
        run.append_journal({"key": "a"})
        with run.journal_file.open("ab") as journal:
            journal.write(b'{"key": "b", "outc')
        assert [entry["key"] for entry in run.read_journal()] == ["a"]
        run.append_journal({"key": "c"})
        assert [entry["key"] for entry in run.read_journal()] == ["a", "c"]

    def test_a_journal_that_is_a_link_is_refused_and_its_target_stays(self, run, tmp_path):
        (tmp_path / "thesis.tex").write_text("precious")
        run.journal_file.symlink_to(tmp_path / "thesis.tex")
        with pytest.raises(StorageError, match=r"tasks\.jsonl: cannot be written: it is a symbolic link"):
            run.append_journal({"key": "a"})
        assert (tmp_path / "thesis.tex").read_text() == "precious"

    def test_a_journal_that_cannot_be_read_is_named(self, run):
        run.journal_file.mkdir()
        with pytest.raises(StorageError, match=r"tasks\.jsonl: cannot be read .*move it away"):
            run.read_journal()
        with pytest.raises(StorageError, match=r"tasks\.jsonl: cannot be written: a folder has this name"):
            run.append_journal({"key": "a"})

    def test_without_a_journal_there_are_no_entries(self, tmp_path):
        assert RunDirectory(tmp_path).read_journal() == []


VALIDATORS = {".exr": starting_with_good}


class TestDone:
    def piece(self, run, number: int) -> Piece:
        key = f"shade-{number:04d}"
        return Piece(key, (run.frame_name(number), run.result_name(key)))

    def complete(self, run, number: int) -> None:
        run.frame(number).write_bytes(b"good")
        run.write_result(f"shade-{number:04d}", {"rays": number})

    def test_results_come_back(self, run):
        run.write_result("gather-0001", {"records": 12})
        assert run.read_result("gather-0001") == {"records": 12}
        with pytest.raises(StorageError, match="gather-0002"):
            run.read_result("gather-0002")

    def test_done_means_every_output_is_there_and_valid(self, run):
        piece = self.piece(run, 1)
        assert run.is_done(piece, VALIDATORS) == (False, [])
        run.frame(1).write_bytes(b"good")
        assert run.is_done(piece, VALIDATORS) == (False, [])
        run.write_result(piece.key, {})
        assert run.is_done(piece, VALIDATORS) == (True, [])

    def test_damaged_outputs_are_named_and_only_they_are_pending(self, run):
        for number in (1, 2, 3):
            self.complete(run, number)
        run.frame(2).write_bytes(b"go")
        (run.root / run.result_name("shade-0003")).write_text('{"rays"')
        pieces = [self.piece(run, number) for number in (1, 2, 3, 4)]
        waiting, faults = run.pending(pieces, VALIDATORS)
        assert [piece.key for piece in waiting] == ["shade-0002", "shade-0003", "shade-0004"]
        assert faults[0] == "frame_00002.exr is not valid (cut short); task shade-0002 will run again"
        assert faults[1].startswith("shade-0003.json is not valid (")
        assert len(faults) == 2

    def test_an_empty_file_without_a_validator_is_not_done(self, run):
        (run.root / "cache" / "merged.bin").touch()
        done, faults = run.is_done(Piece("merge", ("cache/merged.bin",)), {})
        assert not done
        assert "it is empty" in faults[0]

    def test_a_long_film_is_looked_through_completely(self, run):
        for number in range(1, 1442):
            run.frame(number).write_bytes(b"good")
        pieces = [Piece(f"shade-{number:04d}", (run.frame_name(number),)) for number in range(1, 1442)]
        looked_at = []

        def validate(path: Path) -> None:
            looked_at.append(path)
            starting_with_good(path)

        assert run.pending(pieces, {".exr": validate}) == ([], [])
        assert len(looked_at) == 1441

    def test_run_json_is_plain_json(self, run):
        assert json.loads(run.run_file.read_text())["scene_hash"] == "ab12"
