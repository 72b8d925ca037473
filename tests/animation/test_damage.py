"""Damage to the files of a run is found, named, and does not end the run where it can go on."""

import json
import os
import pickle
import random
import re
import shutil
import zipfile

import pytest
from fake_tasks import rendered, session

from steadylight.errors import InputError, SettingsError
from steadylight.images import read_exr, write_exr
from steadylight.metrics.compare import compare_runs
from steadylight.report import write_report
from steadylight.storage import RunDirectory
from steadylight.video import Look, compile_video

OPTIONS = {"frames": 6, "cache_parts": 2}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A finished run."""
    directory = tmp_path_factory.mktemp("whole") / "run"
    rendered(directory, **OPTIONS)
    return directory


@pytest.fixture
def run(whole, tmp_path):
    """A copy of it, to be damaged."""
    return shutil.copytree(whole, tmp_path / "run")


def flips(path, count, seed=1):
    """The content of a file with one bit flipped, at `count` places."""
    content = path.read_bytes()
    draw = random.Random(seed)
    for _ in range(count):
        place, bit = draw.randrange(len(content)), draw.randrange(8)
        yield content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]


def opened(directory):
    """What a further session says about damage, and its statistics."""
    with session(directory, **OPTIONS) as again:
        assert again.resumed
        return again.faults, again.statistics()


class TestRecord:
    def test_a_changed_digit_of_the_partition_is_refused(self, run):
        path = run / "run.json"
        record = json.loads(path.read_text())
        record["survey"]["windows"][0] = [1, 0]
        path.write_text(json.dumps(record, indent=2))
        with pytest.raises(
            SettingsError, match=r"run\.json: cannot be read \(its content does not match its"
        ):
            opened(run)

    def test_a_flipped_bit_is_refused_or_changes_nothing(self, run):
        path, before = run / "run.json", RunDirectory(run).read_record()
        for damaged in flips(path, 400):
            path.write_bytes(damaged)
            try:
                found = RunDirectory(run).read_record()
            except SettingsError:
                continue
            assert found == before

    def test_a_record_nested_without_end_is_refused(self, run):
        (run / "run.json").write_text('{"format": ' + "[" * 100_000 + "]" * 100_000 + "}")
        with pytest.raises(SettingsError, match=r"run\.json: cannot be read \(it is nested too deeply\)"):
            opened(run)

    def test_a_run_without_a_checksum_is_of_an_older_format(self, run):
        path = run / "run.json"
        record = json.loads(path.read_text())
        del record["sha256"]
        path.write_text(json.dumps(record))
        with pytest.raises(SettingsError, match="it has no checksum"):
            opened(run)
        path.write_text(json.dumps(record | {"format": 2}))
        assert opened(run)[0] == []


class TestJournal:
    def test_a_flipped_bit_costs_a_line_that_is_named_and_set_aside(self, run):
        path, aside = run / "log/tasks.jsonl", run / "log/damaged-tasks.txt"
        content = path.read_bytes()
        lines = content.count(b"\n")
        for damaged in flips(path, 20):
            path.write_bytes(damaged)
            aside.unlink(missing_ok=True)
            faults, statistics = opened(run)
            attempts = statistics["tasks"]["attempts"]
            assert attempts >= lines - 2  # a lost end of a line costs two
            assert (attempts < lines) == bool(faults) == aside.exists()
            assert not faults or "tasks.jsonl: line " in faults[0]
            assert opened(run)[0] == []  # once only

    def test_lines_of_older_versions_are_read(self, run):
        path = run / "log/tasks.jsonl"
        entries = [json.loads(line) for line in path.read_text().splitlines()]
        for entry in entries:
            del entry["sha256"]
        path.write_text("".join(json.dumps(entry) + "\n" for entry in entries))
        faults, statistics = opened(run)
        assert faults == []
        assert statistics["tasks"]["attempts"] == len(entries)

    def test_a_flipped_bit_in_a_session_costs_that_session_and_is_named(self, run):
        (path,) = (run / "log/sessions").glob("*.json")
        for damaged in flips(path, 20):
            path.write_bytes(damaged)
            faults, statistics = opened(run)
            assert len(statistics["sessions"]) + len(faults) == 1
            assert not faults or faults[0].startswith("log/sessions/0001.json is damaged; it was renamed to")
            assert opened(run)[0] == []


def fingerprint(path):
    return re.search(rb"[0-9a-f]{64}", path.read_bytes())[0]


class TestFrames:
    def damage(self, run):
        """Change a pixel of frame 3 in a way that decodes."""
        path = run / "frames/frame_00003.exr"
        image, stored = read_exr(path), fingerprint(path)
        image[0, 0, 0] += 1
        write_exr(path, image, {"frame": 3})
        path.write_bytes(path.read_bytes().replace(fingerprint(path), stored))
        return path

    def test_film_and_comparison_refuse_a_damaged_frame(self, run, tmp_path):
        path = self.damage(run)
        frames = sorted((run / "frames").iterdir())
        readers = (
            lambda: read_exr(path),
            lambda: compile_video(frames, tmp_path / "film.mp4", 25, Look(1.0)),
            lambda: compare_runs(run, run),
        )
        for read in readers:
            with pytest.raises(InputError, match=r"frame_00003\.exr: is damaged: its pixels do not match"):
                read()

    def test_a_report_leaves_a_damaged_frame_out_and_says_so(self, run):
        self.damage(run)
        page = write_report(run).read_text()
        assert "frame_00003.exr: is damaged: its pixels do not match" in page
        assert 'alt="Frame 2"' in page
        assert 'alt="Frame 3"' not in page

    def test_a_frame_that_was_copied_over_another_with_its_result_is_made_again(self, run):
        for name in ("frames/frame_{:05d}.exr", "log/results/shade-{:05d}.json"):
            shutil.copy(run / name.format(4), run / name.format(3))
        faults, _ = opened(run)
        assert faults == [
            "shade-00003.json is not valid (it is the result of task shade-00004); task shade-00003 will run again"
        ]
        assert not (run / "frames/frame_00003.exr").exists()

    def test_a_frame_that_was_copied_over_another_is_made_again_without_its_result_too(self, run):
        frames = [run / f"frames/frame_0000{number}.exr" for number in (3, 4)]
        right = frames[0].read_bytes()
        shutil.copyfile(frames[1], frames[0])
        (run / "log/results/shade-00003.json").unlink()
        rendered(run, **OPTIONS)
        assert frames[0].read_bytes() == right


class TestScene:
    def test_a_resumed_run_keeps_the_scene_that_is_there(self, run):
        before = (run / "scene.zip").stat()
        opened(run)
        after = (run / "scene.zip").stat()
        assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)

    def test_a_scene_from_elsewhere_is_replaced_and_not_executed(self, run, tmp_path):
        class Trap:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / "taken"),)

        before = (run / "scene.zip").read_bytes()
        with zipfile.ZipFile(run / "scene.zip", "w") as archive:
            archive.writestr("description.pickle", pickle.dumps(Trap()))
        opened(run)
        assert (run / "scene.zip").stat().st_size == len(before)
        assert not (tmp_path / "taken").exists()


class TestStatistics:
    def test_a_report_does_not_show_damaged_statistics(self, run):
        path = run / "stats.json"
        statistics = json.loads(path.read_text())
        path.write_text(json.dumps(statistics | {"makespan_s": 12345.0}))
        page = write_report(run).read_text()
        assert "stats.json: cannot be read (its content does not match" in page
        assert "12345" not in page
        assert "12,345" not in page
