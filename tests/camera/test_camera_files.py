"""Camera files of every format give the same path for the same poses, and what is wrong is said with its place."""

from __future__ import annotations

import codecs
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from steadylight.camera import CameraPath, Keyframe, load_camera
from steadylight.camera.files import FORMATS, LARGEST_FILE
from steadylight.camera.orbit import Orbit
from steadylight.errors import CameraError

HALF = math.sqrt(0.5)

WALK = (
    Keyframe(0.0, (0.0, 0.0, 1.5), (1.0, 0.0, 1.5), (0.0, 0.0, 1.0), 60.0),
    Keyframe(0.5, (1.0, 0.0, 1.5), (1.0, 1.0, 1.5), (0.0, 0.0, 1.0), 60.0),
    Keyframe(1.0, (1.0, 2.0, 1.5), (1.0, 3.0, 1.5), (0.0, 0.0, 1.0), 60.0),
)
"""Along x, round a corner to the left, along y."""

# An OpenCV camera (x right, y down, z ahead) that looks along x, then along y, with z up.
TUM = f"""# timestamp tx ty tz qx qy qz qw
# fov: 60
1305031102.0 0 0 1.5 -0.5 0.5 -0.5 0.5
1305031102.5 1 0 1.5 {-HALF} 0 0 {HALF}
1305031103.0 1 2 1.5 {-HALF} 0 0 {HALF}
"""

CSV = """time,origin_x,origin_y,origin_z,target_x,target_y,target_z,fov
0,0,0,1.5,1,0,1.5,60
0.5,1,0,1.5,1,1,1.5,60
1,1,2,1.5,1,3,1.5,60
"""

DIRECTIONS = """# up: 0 0 1
# fps = 2
Frame;Pos X [m];Pos Y [m];Pos Z [m];Dir-X;Dir-Y;Dir-Z;"Raum; Höhe"
1;0;0;1,5;2;0;0;"die ""große"" Küche"
2;1;0;1,5;0;2;0;Flur
3;1;2;1,5;0;2;0;Flur
"""

VIEWS = """#RADIANCE view sequence
rvu -vtv -vp 0 0 1.5 -vd 1 0 0 -vu 0 0 1 -vh 60 -vv 45 -vo 0 -va 0 -vs 0 -vl 0

VIEW= -vp 1 0 1.5 -vd 0 1 0
rpict -vp 1 2 1.5 -x 512
"""


def written(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def assert_same_poses(path: CameraPath, times: float = 1.0) -> None:
    """That a path is WALK, `times` as slow."""
    assert len(path.keyframes) == 3
    for found, wanted in zip(path.keyframes, WALK, strict=True):
        assert found.time == pytest.approx(wanted.time * times)
        assert found.origin == pytest.approx(wanted.origin)
        assert found.view == pytest.approx(wanted.view, abs=1e-12)
        assert found.up == pytest.approx(wanted.up, abs=1e-12)
        assert found.fov == wanted.fov


class TestFormats:
    @pytest.mark.parametrize(("name", "text"), [("walk.txt", TUM), ("walk.tum", TUM), ("walk.csv", CSV)])
    def test_poses_with_times(self, tmp_path, name, text):
        path, fps = load_camera(written(tmp_path, name, text))
        assert fps is None
        assert_same_poses(path)

    def test_frames_directions_semicolons_decimal_commas_umlauts_and_quotes(self, tmp_path):
        path, fps = load_camera(written(tmp_path, "Büro.csv", DIRECTIONS))
        assert fps == 2
        assert_same_poses(path)

    def test_tabs(self, tmp_path):
        assert_same_poses(load_camera(written(tmp_path, "a.tsv", CSV.replace(",", "\t")))[0])

    def test_a_rotation_of_an_opengl_camera(self, tmp_path):
        # x right, y up, looking along -z: half a turn about x from the OpenCV camera.
        lines = [f"{k.time} {k.origin[0]} {k.origin[1]} {k.origin[2]}" for k in WALK]
        turns = ("0.5 -0.5 -0.5 0.5", f"{HALF} 0 0 {HALF}", f"{HALF} 0 0 {HALF}")
        text = "# axes: opengl\n" + "\n".join(f"{a} {b}" for a, b in zip(lines, turns, strict=True))
        assert_same_poses(load_camera(written(tmp_path, "a.tum", text))[0])

    def test_radiance_views_carry_over_what_they_do_not_say(self, tmp_path):
        path, fps = load_camera(written(tmp_path, "walk.vf", VIEWS))
        assert fps == 25
        assert_same_poses(path, times=2 / 25)

    def test_a_single_view_is_a_still(self, tmp_path):
        path, fps = load_camera(written(tmp_path, "a.vf", "rvu -vp 1 2 3 -vd 0 5 0"))
        assert (path, fps) == (CameraPath((Keyframe(0, (1, 2, 3), (1, 7, 3), (0, 0, 1), 45),)), None)

    @pytest.mark.parametrize(
        ("mark", "encoding"),
        [(codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"), (b"", "utf-8")],
    )
    @pytest.mark.parametrize("ending", ["\r\n", "\r", "\n"])
    def test_byte_order_marks_and_line_ends(self, tmp_path, mark, encoding, ending):
        text = DIRECTIONS.replace("\n", ending)
        path, _ = load_camera(written(tmp_path, "a.csv", mark + text.encode(encoding)))
        assert_same_poses(path)

    def test_every_format_is_in_the_documentation_whose_examples_can_be_read(self, tmp_path):
        page = (Path(__file__).parents[2] / "docs/cameras.md").read_text(encoding="utf-8")
        table, views = (
            re.search(start + r"(.*?)```", page, re.DOTALL)[1] for start in ("```csv\n", "```\n(?=rvu)")
        )
        assert len(load_camera(written(tmp_path, "a.csv", table))[0].keyframes) == 2
        assert len(load_camera(written(tmp_path, "a.vf", views))[0].keyframes) == 2
        assert [ending for ending in FORMATS if f"`{ending}`" not in page] == []


class TestFirstFrame:
    entries = tuple(
        {"frame": int(2 * k.time), "origin": k.origin, "target": k.target, "fov": k.fov} for k in WALK
    )

    def test_a_file_that_counts_from_0_is_told_so(self, tmp_path):
        file = written(tmp_path, "a.json", json.dumps({"fps": 2, "keyframes": self.entries}))
        with pytest.raises(CameraError, match=r"counts its frames from 0, .*first_frame.*--first-frame 0"):
            load_camera(file)
        assert_same_poses(load_camera(file, first_frame=0)[0])

    def test_the_file_may_say_so_itself(self, tmp_path):
        content = {"fps": 2, "first_frame": 0, "keyframes": self.entries}
        assert_same_poses(load_camera(written(tmp_path, "a.json", json.dumps(content)))[0])

    def test_a_table_may_start_anywhere(self, tmp_path):
        text = DIRECTIONS.replace("\n1;", "\n340;").replace("\n2;", "\n341;").replace("\n3;", "\n342;")
        assert_same_poses(load_camera(written(tmp_path, "a.csv", "# first_frame: 340\n" + text))[0])
        with pytest.raises(CameraError, match=r"line 4: `frame` is 0: .* `# first_frame: 0`"):
            load_camera(written(tmp_path, "a.csv", DIRECTIONS.replace("\n1;", "\n0;")))


class TestFaults:
    @pytest.mark.parametrize(
        ("right", "wrong", "words"),
        [
            ("0.5,1,0,1.5", "0.5,1,O,1.5", r"line 3: `origin_y` is 'O', not a number"),
            ("0.5,1,0,1.5", "0.5,1,,1.5", r"line 3: column 3 \(`origin_y`\) is empty"),
            ("0.5,1,0,1.5", "0.5,1,inf,1.5", r"line 3: `origin_y` is inf; it must be a finite"),
            ("0.5,1,0,1.5,", "0.5,1,0,", r"line 3: has 7 cells; the first row names 8 columns"),
            ("0.5,", "0,", r"line 3: `time` 0 is not later than that of the row before"),
            ("1,3,1.5,60", "1,2,1.5,60", r"line 4: `origin` and `target` are the same point"),
            (",60\n1", ",190\n1", r"line 3: `fov` is 190; it must be between 0 and 180"),
            ("origin_y", "orgin_y", r"line 1: column `origin_y` is missing \(is it `orgin_y`\?\)"),
            ("origin_y", "x", r"line 1: columns `origin_x` and `x` both give `origin_x`; keep only one"),
            ("time", "tine", r"line 1: a column `time` .* is missing \(is it `tine`\?\)"),
            (
                "target_x,target_y,target_z",
                "a,b,c",
                r"line 1: has no columns for the view; give one of: target_x",
            ),
            (CSV.split("\n", 1)[0], "0,0,0,0,0,0,1,60", r"line 1: the first row must name the columns"),
            ("0.5,1", '"0.5,1', r"line \d+: is not valid CSV: unexpected end of data"),
            (CSV, "", r"is empty; its first row names the columns"),
            (CSV[CSV.index("0.5") :], "", r"has 1 pose; a camera path needs at least two"),
            ("time", "# axes: blender\ntime", r"line 1: `axes` is 'blender'; it must be opencv"),
        ],
    )
    def test_of_a_table(self, tmp_path, right, wrong, words):
        assert right in CSV
        with pytest.raises(CameraError, match=r"/a\.csv: " + words):
            load_camera(written(tmp_path, "a.csv", CSV.replace(right, wrong, 1)))

    @pytest.mark.parametrize(
        ("right", "wrong", "words"),
        [
            (
                "0 0 1.5 -0.5",
                "0 0 -0.5",
                r"line 3: has 7 values; a TUM pose is eight numbers: timestamp tx ty tz",
            ),
            ("-0.5 0.5 -0.5 0.5", "1 2 3 4", r"line 3: the quaternion .* has length 5.48"),
            ("1305031102.5", "1305031101.5", r"line 4: `time` 1305031101.5 is not later"),
            ("fov: 60", "fov: wide", r"line 2: `fov` is 'wide', not a number"),
        ],
    )
    def test_of_tum_poses(self, tmp_path, right, wrong, words):
        assert right in TUM
        with pytest.raises(CameraError, match=r"/a\.txt: " + words):
            load_camera(written(tmp_path, "a.txt", TUM.replace(right, wrong, 1)))

    @pytest.mark.parametrize(
        ("right", "wrong", "words"),
        [
            ("-vtv", "-vta", r"line 2: `-vta` is an angular fisheye; only perspective"),
            ("-vp 0 0 1.5 -vd", "-vp 0 0 -vd", r"line 2: `-vp` is '-vd', not a number"),
            ("-vs 0", "-vs 0.5", r"line 2: `-vs` shifts the image"),
            ("-vp 0 0 1.5", "", r"line 2: `-vp`, the position of the camera, is missing"),
            ("1 2 1.5 -x 512", "1", r"line 5: `-vp` needs 3 numbers, and has 1"),
            (VIEWS, "#?RADIANCE\n", r"has no view; a view is a line such as"),
        ],
    )
    def test_of_views(self, tmp_path, right, wrong, words):
        assert right in VIEWS
        with pytest.raises(CameraError, match=r"/a\.vf: " + words):
            load_camera(written(tmp_path, "a.vf", VIEWS.replace(right, wrong, 1)))

    def test_text_of_another_encoding_is_named_with_its_place(self, tmp_path):
        with pytest.raises(CameraError, match=r"line 3, column 63: is not UTF-8 text \(byte 0xf6\)"):
            load_camera(written(tmp_path, "a.csv", DIRECTIONS.encode("latin-1")))

    def test_an_unknown_extension_is_answered_with_all_that_are_known(self, tmp_path):
        with pytest.raises(
            CameraError, match=r"did you mean \.csv\?; camera files end in \.toml \(keyframes\)"
        ):
            load_camera(written(tmp_path, "a.csw", CSV))

    def test_what_never_ends_is_not_read_to_the_end(self, tmp_path):
        (tmp_path / "endless.csv").symlink_to("/dev/zero")
        with pytest.raises(CameraError, match=r"endless\.csv: is not a regular file"):
            load_camera(tmp_path / "endless.csv")
        with (tmp_path / "large.csv").open("wb") as file:
            file.truncate(LARGEST_FILE + 1)
        with pytest.raises(CameraError, match="is larger than 64 MiB"):
            load_camera(tmp_path / "large.csv")


PIECES = st.sampled_from(
    (
        *"0123456789.,;-+eE#:=\"'\t\n\r []{}",
        *(
            "nan",
            "inf",
            "1e308",
            "1e-320",
            "10" * 400,
            "time",
            "frame",
            "fps",
            "origin_x",
            "-vp",
            "-vd",
            "# fov: ",
        ),
        *(
            "# up: ",
            "qw",
            "\ufeff",
            "\0",
            "ü",
            "٣",
            "[[keyframes]]\n",
            TUM,
            CSV,
            DIRECTIONS,
            VIEWS,
            "[" * 3000,
        ),
        json.dumps({"keyframes": TestFirstFrame.entries}),
    )
)


@pytest.mark.parametrize(
    ("column", "remedy"),
    [("Roll", "`up_x`, `up_y` and `up_z`"), ("v_fov", "horizontal angle"), ("focal_length [mm]", "`fov`")],
)
def test_columns_that_would_change_the_picture_are_not_passed_over(tmp_path, column, remedy):
    (tmp_path / "a.csv").write_text(f"time,x,y,z,dx,dy,dz,{column}\n0,0,0,0,1,0,0,5\n1,1,0,0,1,0,0,5\n")
    with pytest.raises(CameraError, match=r"line 1: column `.*` is not read; .*, or leave it out") as error:
        load_camera(tmp_path / "a.csv")
    assert remedy in str(error.value)


@settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    text=st.one_of(st.lists(PIECES, max_size=30).map("".join).map(str.encode), st.binary(max_size=200)),
    cut=st.tuples(st.integers(0, 2000), st.integers(0, 40), st.lists(PIECES, max_size=3).map("".join)),
    suffix=st.sampled_from(sorted(FORMATS)),
    first_frame=st.sampled_from([None, 0, 1, 10**30]),
)
def test_any_bytes_are_a_path_or_a_camera_error(tmp_path_factory, text, cut, suffix, first_frame):
    place, length, patch = cut
    text = text[:place] + patch.encode() + text[place + length :]
    file = tmp_path_factory.getbasetemp() / f"fuzz{suffix}"
    file.write_bytes(text)
    try:
        path, fps = load_camera(file, first_frame)
    except CameraError as error:
        message = str(error)
    else:
        message = f"{file}: a path"
        assert fps is None or fps > 0
        for pose in path.poses(np.linspace(0, path.duration, 5)):
            assert np.isfinite(pose.to_world).all()
            assert 0 < pose.fov < 180
    assert message.startswith(f"{file}: ")
    assert len(message) < 2000


class TestOrbits:
    def test_round_a_point(self):
        orbit = Orbit.parse("radius=4,height=3,around=1:2:0.5,frames=100,fov=50")
        path = orbit.path((0, 0, 1), 25)
        assert path.loop
        assert path.frame_count(25) == 100
        for pose in path.frame_poses(range(1, 101), 25):
            assert np.linalg.norm(pose.origin[:2] - (1, 2)) == pytest.approx(4, abs=1e-3)
            assert pose.origin[2] == pytest.approx(3.5)
            assert pose.direction == pytest.approx((np.array((1, 2, 0.5)) - pose.origin) / 5, abs=1e-3)
            assert pose.fov == 50
        quarter = path.pose(1.0).origin - (1, 2, 3.5)
        assert quarter == pytest.approx((0, 4, 0), abs=1e-3)  # counter-clockwise from above

    @pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1)])
    def test_part_of_a_turn_does_not_repeat(self, up):
        path = Orbit.parse("radius=2,around=0:0:0,turns=-0.5,frames=26").path(up, 25)
        assert not path.loop
        assert path.frame_count(25) == 26
        first, last = path.pose(0).origin, path.pose(1).origin
        assert first == pytest.approx(-last)
        assert first @ np.array(up) == pytest.approx(0)

    def test_round_the_scene_all_of_it_is_in_the_picture(self):
        bounds = np.array([[-1.0, -2.0, 0.0], [3.0, 2.0, 3.0]])
        path = Orbit.parse("scene").path((0, 0, 1), 25, bounds)
        corners = np.array(np.meshgrid(*bounds.T)).reshape(3, -1).T
        for pose in path.frame_poses(range(1, 251, 10), 25):
            seen = (corners - pose.origin) @ pose.to_world[:3, :3]
            assert (np.abs(seen[:, 0]) < seen[:, 2] * math.tan(math.radians(30))).all()

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("radios=4", r"`radios=4` is not valid; did you mean `radius`\?"),
            ("radius", r"`radius` is not valid; give scene, or some of radius=4"),
            ("radius=-1", r"`radius` is -1; it must be greater than 0"),
            ("around=1:2", r"`around` is '1:2'; it must be a point X:Y:Z"),
            ("turns=0", r"`turns` is 0; it must not be 0"),
            ("frames=1.5", r"`frames` is 1.5; it must be a whole number"),
        ],
    )
    def test_what_is_wrong_is_named(self, text, words):
        with pytest.raises(CameraError, match="--orbit: " + words):
            Orbit.parse(text)
