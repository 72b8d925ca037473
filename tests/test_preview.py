"""The preview: sizes, plan and doubts by known answers; a page that is whole, for a small scene, in a few seconds."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

from boxes import DIVIDED, FURNISHED, WALLS, Boxes, box
from steadylight.camera import CameraPath, Keyframe
from steadylight.preview.making import looking_around
from steadylight.preview.plan_view import draw_plan
from steadylight.preview.sheet import Words, contact_sheet
from steadylight.preview.size import different_rooms, doubts, eye_heights, room_at
from steadylight.preview.smoothing import Surfaces, smoothed, surfaces_of
from steadylight.report.preview import PreviewPage, preview_page
from steadylight.walking.space import Frame

UP = Frame((0.0, 0.0, 1.0))


def pose(origin, target):
    return CameraPath((Keyframe(0, origin, target),)).pose(0)


class TestSizes:
    def test_a_room(self):
        room = room_at(Boxes(WALLS), UP, pose((2, 1, 1.6), (3, 1, 1.6)), 7)
        assert room.size == pytest.approx((8.0, 4.0, 2.6), abs=0.02)
        assert str(room) == "the room at frame 7 is 8.0 x 4.0 x 2.6 m"

    def test_a_room_that_stands_at_an_angle_has_the_same_size(self):
        turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])

        class Turned(Boxes):
            def cast(self, origins, directions, longest=np.inf):
                hits = super().cast(origins @ turn, directions @ turn, longest)
                return dataclasses.replace(hits, normal=hits.normal @ turn.T)

        at = pose(tuple(turn @ (2, 1, 1.6)), tuple(turn @ (3, 1, 1.6)))
        assert room_at(Turned(WALLS), UP, at, 1).size == pytest.approx((8.0, 4.0, 2.6), abs=0.05)

    def test_under_the_open_sky_it_is_no_room(self):
        assert "what surrounds" in str(room_at(Boxes(WALLS[:1]), UP, pose((2, 1, 1.6), (3, 1, 1.6)), 1))
        assert (
            room_at(Boxes([box(0, 1e-3, 0, 1e-3, -90, -89)]), UP, pose((2, 1, 1.6), (3, 1, 1.6)), 1) is None
        )

    def test_alike_rooms_are_named_once(self):
        rooms = [
            room_at(Boxes(WALLS), UP, pose((x, 1, 1.6), (9, 1, 1.6)), number)
            for number, x in ((1, 2), (2, 3))
        ]
        assert different_rooms(rooms) == rooms[:1]

    def test_heights(self):
        places = np.array([[2.0, 1.0, 1.6], [2.0, 2.0, 1.6], [99.0, 0.0, 1.6]])
        assert eye_heights(Boxes(FURNISHED), UP, places) == pytest.approx([1.6, 0.85, np.nan], nan_ok=True)

    @pytest.mark.parametrize(
        ("eye", "words"),
        [
            (160.0, "the camera is 160 m above the floor; in centimetres, it would be 1.60 m"),
            (63.0, "the camera is 63 m above the floor; in inches, it would be 1.60 m"),
            (
                0.02,
                "the camera is 0.02 m above the floor; is one unit of the scene a metre, and up the right axis?",
            ),
        ],
    )
    def test_absurd_units(self, eye, words):
        assert doubts([], np.full(3, eye)) == [words]

    def test_ordinary_sizes_raise_no_doubt(self):
        room = room_at(Boxes(WALLS), UP, pose((2, 1, 1.6), (3, 1, 1.6)), 1)
        assert doubts([room], np.array([1.6, np.nan])) == []
        large = room_at(Boxes(np.array(WALLS) * 100), UP, pose((200, 100, 160), (300, 100, 160)), 1)
        assert (
            "the room at frame 1 is 800 x 400 x 260 m, which is unusual"
            in doubts([large], np.array([np.nan]))[0]
        )


class TestPlan:
    def test_walls_are_dark_floors_light_and_the_camera_is_marked(self):
        shown = {1: pose((2, 3, 1.6), (3, 3, 1.6))}
        plan = draw_plan(
            Boxes(DIVIDED), UP, np.array([[-0.5, -0.5], [8.5, 4.5]]), list(shown.values()), shown
        )
        assert plan.metres == pytest.approx(9.0)
        height, width, _ = plan.pixels.shape
        assert width / height == pytest.approx(9 / 5, abs=0.01)

        def at(x, y):
            return plan.pixels[int(height * (4.5 - y) / 5), int(width * (x + 0.5) / 9)].astype(int)

        assert at(4.0, 1.0).max() < 90  # the wall between the rooms
        assert at(-0.1, 2.0).max() < 90
        assert at(4.0, 1.95).min() > 120  # the door
        assert at(6.0, 1.0).min() > 120
        red, green, blue = at(2.0, 3.0)
        assert red > 150 > green > 0 < blue < 150


class TestSmoothing:
    def test_the_sky_does_not_shine_over_the_edge_of_a_roof(self):
        seen = surfaces_of(Boxes(WALLS), pose((4, -9, 5), (4, 2, 3)), (48, 36))
        hit = np.linalg.norm(seen.normal, axis=-1) > 0
        assert 0.1 < hit.mean() < 0.9
        truth = np.where(hit[..., None], 0.2, 5.0) * np.ones(3)
        noisy = truth * np.random.default_rng(3).gamma(20, 1 / 20, truth.shape)
        assert smoothed(noisy, seen) == pytest.approx(truth, rel=0.35)

    def test_noise_goes_and_edges_of_surfaces_stay(self):
        seen = surfaces_of(Boxes(DIVIDED), pose((1, 2, 1.6), (8, 2, 1.2)), (64, 48))
        truth = 0.3 + 0.2 * seen.normal + 0.05 * seen.position[..., 2:]
        noisy = truth * np.random.default_rng(3).gamma(4, 1 / 4, truth.shape)
        error = np.abs(smoothed(noisy, seen) - truth).mean() / np.abs(noisy - truth).mean()
        assert error < 0.35

    def test_colours_of_surfaces_stay_exactly_and_no_light_is_a_black_picture(self):
        seen = surfaces_of(Boxes(DIVIDED), pose((1, 2, 1.6), (8, 2, 1.2)), (32, 24))
        colour = np.random.default_rng(3).uniform(0.1, 0.9, seen.colour.shape)
        painted = Surfaces(seen.position, seen.normal, colour)
        assert smoothed(0.7 * colour, painted) == pytest.approx(0.7 * colour, rel=1e-3)
        assert smoothed(np.zeros_like(colour), painted) == pytest.approx(np.zeros_like(colour))

    def test_noise_on_a_texture_with_dark_colours_goes_and_its_hues_stay(self):
        seen = surfaces_of(Boxes(DIVIDED), pose((1, 2, 1.6), (8, 2, 1.2)), (64, 48))
        random = np.random.default_rng(3)
        hues = np.array([[0.4, 0.1, 0.0], [0.3, 0.15, 0.04], [0.02, 0.05, 0.06], [0.6, 0.5, 0.4]])
        colour = hues[random.integers(4, size=seen.colour.shape[:2])]
        truth = 0.7 * colour
        noisy = truth * random.gamma(4, 1 / 4, truth.shape[:2])[..., None]
        error = smoothed(noisy, Surfaces(seen.position, seen.normal, colour)) - truth
        assert np.abs(error[colour < 0.05]).max() < 0.05
        assert np.abs(error).mean() < 0.5 * np.abs(noisy - truth).mean()

    @pytest.mark.parametrize(("size", "least"), [(1, 1.2), (3, 8.0)])
    def test_a_lamp_that_is_painted_black_shines(self, size, least):
        seen = surfaces_of(Boxes(WALLS), pose((1, 2, 1.6), (8, 2, 1.6)), (33, 25))
        lamp = np.zeros(seen.colour.shape[:2], bool)
        lamp[12 : 12 + size, 16 : 16 + size] = True
        colour = np.where(lamp[..., None], 0.0, 0.8) * np.ones(3)
        image = np.where(lamp[..., None], 10.0, 0.8) * np.ones(3)
        shown = smoothed(image, Surfaces(seen.position, seen.normal, colour))
        assert shown[lamp].mean() > least
        assert shown[~lamp] == pytest.approx(0.8, rel=0.1)


def test_the_page_escapes_what_files_say():
    pixels = np.zeros((4, 6, 3), np.uint8)
    page = preview_page(
        PreviewPage(
            title="<b>kitchen",
            pictures={"frame 1": pixels},
            plan=pixels,
            plan_says='a "plan"',
            heights=([1, 2, 3], [1.6, 1.6, 1.5]),
            facts=("the room is <i>",),
            warnings=("<script>",),
            notes=[("left out", "lamp <1>", "it has no counterpart")],
        )
    )
    assert "<script>" not in page.replace("&lt;script&gt;", "")
    assert "<title>&lt;b&gt;kitchen: steadylight preview</title>" in page
    assert "Left out: 1" in page
    assert "http" not in page.replace("http://www.w3.org", "")


def test_a_preview_of_a_file_writes_a_page_and_a_picture(said, folder):
    code, words = said(
        "preview", "room.xml", "--camera", "walk.toml", "--seconds", "0.1", "--pictures", "3", "--json"
    )
    assert code == 0, words
    made = json.loads(words)
    assert made["warnings"] == []
    assert made["facts"][0] == "the room at frame 1 is 2.0 x 2.0 x 2.0 m"
    assert "3 shapes; lights: 1 area" in made["facts"]
    page = (folder / made["page"]).read_text(encoding="utf-8")
    assert page.count("<img") == 4
    assert "Nothing: all of the file is used." in page
    with Image.open(folder / made["sheet"]) as sheet:
        assert sheet.width == 1200
        picture = np.asarray(sheet)[60:300, 12:400]
    assert 60 < picture.mean() < 220
    assert picture.std() > 10


def test_a_sheet_has_room_for_many_upright_pictures_and_long_notes():
    pictures = {f"frame {number}": np.full((40, 20, 3), 200, np.uint8) for number in range(48)}
    words = Words("tower", [f"note {number}: " + 20 * "word " for number in range(60)], ["it is high"])
    sheet = contact_sheet(words, pictures, None, np.zeros(0))
    last = [row.min() < 100 for row in sheet[-30:, 610:]]
    assert sheet.shape[0] > 12 * 580 + 60 * 2 * 22
    assert any(last)


def test_a_still_camera_looks_around():
    first = pose((1, 2, 1.6), (2, 2, 1.5))
    looks = looking_around(first, (0.0, 0.0, 1.0))
    assert list(looks) == [1, 2, 3, 4, 5, 6]
    assert looks[1].to_world == pytest.approx(first.to_world)
    for number, look in looks.items():
        assert look.origin == pytest.approx(first.origin)
        assert look.direction[2] == pytest.approx(first.direction[2])
        level = look.direction[:2] @ first.direction[:2] / np.linalg.norm(first.direction[:2]) ** 2
        assert level == pytest.approx(np.cos(np.radians(60 * (number - 1))))


def test_a_camera_outside_sees_the_scene_from_all_sides():
    centre = np.array([4.0, 2.0, 1.0])
    for look in looking_around(pose((4, -8, 6), (4, 2, 1)), (0.0, 0.0, 1.0), centre).values():
        away = centre - look.origin
        assert np.linalg.norm(away) == pytest.approx(np.sqrt(125))
        assert look.direction == pytest.approx(away / np.linalg.norm(away))


def test_a_preview_that_could_not_be_written_is_refused_before_the_work(said, folder):
    code, words = said("preview", "room.xml", "--output", "a.png")
    assert (code, "--output: a.png: a preview is a page; give a name that ends in .html" in words) == (
        2,
        True,
    )
    assert not (folder / "a.png").exists()
