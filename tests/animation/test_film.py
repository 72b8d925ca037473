"""Video and pictures of finished frames: they follow the options of the last command, and the frames do not."""

import json
import math

import av
import numpy as np
import pytest
from fake_tasks import names, rendered
from PIL import Image

from steadylight.animation.film import read_display
from steadylight.errors import SettingsError
from steadylight.images import animation_exposure, read_exr, tone_map
from steadylight.settings import DisplaySettings
from steadylight.storage import RunDirectory

OPTIONS = {"frames": 3}


@pytest.fixture
def run(tmp_path):
    """A finished run."""
    rendered(tmp_path / "run", **OPTIONS)
    return tmp_path / "run"


def kept(run):
    """Bytes of what must not depend on the display."""
    fixed = [name for name in names(run) if name.startswith(("frames/", "cache/", "log/results/"))]
    return {name: (run / name).read_bytes() for name in (*fixed, "run.json", "scene.zip")}


def middle(video):
    """Mean of the second frame of a video, 0 to 255."""
    with av.open(str(video)) as container:
        return [frame.to_ndarray(format="rgb24").mean() for frame in container.decode(video=0)][1]


def test_another_tone_and_exposure_change_video_and_pictures_only(run):
    before, video = kept(run), (run / "animation.mp4").read_bytes()
    again = rendered(run, **OPTIONS, tone="agx", exposure=1, frames_as="png", video_crf=30)
    assert kept(run) == before
    assert (run / "animation.mp4").read_bytes() != video
    assert again.statistics["exposure"] == 2.0
    shown = {"tone": "agx", "exposure": 1.0, "ev": 1.0, "video_crf": 30, "frames_as": "png"}
    assert again.statistics["display"] == shown


def test_pictures_show_each_frame_and_follow_later_commands(run):
    rendered(run, **OPTIONS, exposure=0, frames_as="png")
    paths = sorted((run / "pictures").iterdir())
    assert [path.name for path in paths] == ["frame_00001.png", "frame_00002.png", "frame_00003.png"]
    frame = read_exr(run / "frames/frame_00002.exr")
    np.testing.assert_array_equal(np.asarray(Image.open(paths[1])), tone_map(frame, 1.0))
    rendered(run, **OPTIONS, exposure=-1, tone="filmic")  # they are there, so they are kept like the video
    np.testing.assert_array_equal(np.asarray(Image.open(paths[1])), tone_map(frame, 0.5, "filmic"))


def test_no_pictures_are_written_unasked(run):
    assert not (run / "pictures").exists()


def test_a_stop_more_is_brighter_in_the_video(run):
    rendered(run, **OPTIONS, exposure=-1)
    dark = middle(run / "animation.mp4")
    rendered(run, **OPTIONS, exposure=0)
    assert middle(run / "animation.mp4") > dark + 20


def test_a_locked_exposure_is_that_of_the_first_frame(run):
    first = read_exr(run / "frames/frame_00001.exr")
    found = rendered(run, **OPTIONS, exposure="lock").statistics
    assert found["exposure"] == pytest.approx(animation_exposure([first]))
    assert found["display"]["ev"] == pytest.approx(math.log2(0.18 / 0.1), abs=1e-3)


@pytest.mark.parametrize("given", ["bright", "nan", "1e9", True])
def test_an_exposure_that_is_none_names_what_is(tmp_path, given):
    with pytest.raises(
        SettingsError, match=r"--exposure: .* is not valid; .*give auto, lock, or a number of stops"
    ):
        rendered(tmp_path / "run", **OPTIONS, exposure=given)
    assert not (tmp_path / "run").exists()


def test_what_a_command_was_asked_for_is_there_for_those_that_finish_the_run(run):
    assert read_display(RunDirectory(run)) == DisplaySettings()
    rendered(run, **OPTIONS, tone="none")
    assert read_display(RunDirectory(run)) == DisplaySettings(tone="none")
    path = run / "display.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"tone": "agx"}))
    with pytest.raises(SettingsError, match=r"display\.json: cannot be read .* remove it"):
        read_display(RunDirectory(run))
    rendered(run, **OPTIONS, tone="none")  # a render command says how, and rewrites it
    assert read_display(RunDirectory(run)) == DisplaySettings(tone="none")
