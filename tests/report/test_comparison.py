"""The comparison page in a browser: players stay together, regions and flicker show what is there."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from handmade_runs import flickering, write_run

from steadylight.errors import InputError
from steadylight.images import write_exr
from steadylight.report import write_comparison

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from visits import Visit

FRAMES = list(range(1, 25))
SETTLED = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
BRIGHTEST = """canvas => Math.max(...canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data
    .filter((_, k) => k % 4 < 3))"""


def data_of(page: Path) -> dict[str, Any]:
    """What the page's script works on."""
    found = re.search('<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.DOTALL)
    assert found is not None
    return dict(json.loads(found[1]))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A steady run, one that flickers on the left, and a copy of the steady one."""
    root = tmp_path_factory.mktemp("runs")
    strengths = {"steady": 0.0, "flickers": 0.2, "again": 0.0}
    return [
        write_run(root / name, FRAMES, flickering(s), mode="single-pass" if s else "two-pass")
        for name, s in strengths.items()
    ]


@pytest.fixture(scope="module")
def page(runs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_comparison(runs, tmp_path_factory.mktemp("page") / "compare.html")


def choose(visited: Visit, layout: str, left: str = "0", right: str = "1") -> None:
    """Show a view of two films."""
    visited.page.check(f"input[name=layout][value={layout}]")
    if visited.page.is_visible("#pair"):
        visited.page.select_option("#left", left)
        visited.page.select_option("#right", right)
    visited.page.evaluate("steadylight.show(5)")


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (400, "dark")])
def test_axe_finds_nothing_and_nothing_is_wider_than_the_screen(
    page: Path, visit: Callable[..., Visit], width: int, scheme: str
) -> None:
    visited = visit(page, width, scheme)
    assert visited.overflow() <= 0
    assert visited.findings() == []
    choose(visited, "difference")
    assert visited.findings() == []
    assert visited.complaints == []
    assert visited.asked == [page.as_uri()]


def test_players_show_one_frame_over_200_steps(page: Path, visit: Callable[..., Visit]) -> None:
    visited = visit(page)
    shown = visited.page.evaluate("""async () => {
        const seen = [];
        for (let k = 0; k < 200; k++) {
            await steadylight.step(k % 7 === 3 ? -1 : 1);
            seen.push([...document.querySelectorAll(".player canvas")].map(canvas => Number(canvas.dataset.frame)));
        }
        return seen;
    }""")
    assert len(shown) == 200
    assert all(len(set(frames)) == 1 for frames in shown)
    assert {frames[0] for frames in shown} == set(FRAMES)


def test_the_picture_of_each_player_is_that_of_the_frame_it_names(
    page: Path, visit: Callable[..., Visit]
) -> None:
    # The strip at the bottom of frame n has brightness 0.05 (n mod 8).
    visited = visit(page)
    levels = []
    for number in (1, 2, 5, 7):
        visited.page.evaluate(f"steadylight.show({number - 1})")
        pixel = "c => c.getContext('2d').getImageData(c.width / 2, c.height - 2, 1, 1).data[0]"
        players = visited.page.locator(".player canvas").all()
        found = {player.evaluate(pixel) for player in players}
        assert max(found) - min(found) <= 3
        levels.append(max(found))
    assert levels == sorted(levels)
    assert len(set(levels)) == 4


def test_playing_goes_through_the_frames_and_comes_back_to_the_first(
    page: Path, visit: Callable[..., Visit]
) -> None:
    visited = visit(page)
    visited.page.click("#play")
    visited.page.wait_for_function("steadylight.state.index > 12")
    visited.page.wait_for_function("steadylight.state.index < 8")
    assert visited.page.inner_text("#play") == "Pause"
    visited.page.keyboard.press("Space")
    assert visited.page.inner_text("#play") == "Play"
    assert visited.page.evaluate("steadylight.state.playing") is False
    assert visited.complaints == []


def test_keys_step_slow_down_and_choose_what_is_shown(page: Path, visit: Callable[..., Visit]) -> None:
    visited = visit(page)
    for key in ("ArrowRight", "ArrowRight", "ArrowLeft", "s", "3"):
        visited.page.keyboard.press(key)
    assert visited.page.inner_text("#frame") == "frame 2"
    assert visited.page.input_value("#speed") == "0.25"
    assert visited.page.is_checked("input[value=wipe]")
    visited.page.evaluate("document.activeElement.blur()")
    visited.page.keyboard.press("End")
    assert visited.page.inner_text("#frame") == f"frame {FRAMES[-1]}"


def test_marking_a_region_with_the_mouse_draws_its_bfm(page: Path, visit: Callable[..., Visit]) -> None:
    visited = visit(page)
    assert visited.page.locator("#regions .card").count() == 1
    box = visited.page.locator(".player canvas").first.bounding_box()
    assert box is not None

    def drag(x0: float, y0: float, x1: float, y1: float) -> str:
        visited.page.mouse.move(box["x"] + x0 * box["width"], box["y"] + y0 * box["height"])
        visited.page.mouse.down()
        visited.page.mouse.move(box["x"] + x1 * box["width"], box["y"] + y1 * box["height"], steps=4)
        visited.page.mouse.up()
        return str(visited.page.locator("#regions .card").last.inner_text())

    left, right = drag(0.05, 0.05, 0.35, 0.6), drag(0.6, 0.05, 0.95, 0.6)
    assert visited.page.locator("#regions .card").count() == 3
    # b alternates between 1.2 and 0.8 of its mean on the left, and never changes on the right.
    assert "flickers: mean 0.4" in left
    assert "steady: mean 0" in left
    assert "flickers: mean 0\n" in right + "\n"
    assert visited.page.locator(".mark-box").count() == 6
    visited.page.get_by_role("button", name=re.compile("^Remove")).first.click()
    assert visited.page.locator("#regions .card").count() == 2
    assert visited.page.locator(".mark-box").count() == 3
    assert visited.complaints == []


@pytest.mark.parametrize("layout", ["difference", "flicker"])
def test_two_equal_runs_are_black_and_others_are_not(
    page: Path, visit: Callable[..., Visit], layout: str
) -> None:
    visited = visit(page)
    choose(visited, layout, "0", "2")
    stage = visited.page.locator("#stage canvas")
    assert stage.evaluate(BRIGHTEST) == 0
    choose(visited, layout, "0", "1")
    assert stage.evaluate(BRIGHTEST) > 50


def test_the_wipe_shows_the_left_film_on_the_left(page: Path, visit: Callable[..., Visit]) -> None:
    visited = visit(page)
    choose(visited, "wipe", "0", "1")
    colour = "canvas => canvas.getContext('2d').getImageData(4, 10, 1, 1).data[0]"
    stage = visited.page.locator("#stage canvas")
    left = stage.evaluate(colour)
    visited.page.locator("#edge").fill("0")
    visited.page.evaluate(SETTLED)
    visited.page.wait_for_function(f"({colour})(document.querySelector('#stage canvas')) !== {left}")


def test_flicker_is_seen_where_it_is(runs: list[Path], tmp_path: Path) -> None:
    data = data_of(write_comparison(runs[:2], tmp_path / "c.html"))
    steady, other = (run["measures"]["temporal deviation"] for run in data["runs"])
    assert other[0] is None
    # Half of the picture changes by 0.08 of about 0.2.
    assert min(other[1:]) > steady[1] + 0.1


def test_errors_are_measured_against_the_reference(runs: list[Path], tmp_path: Path) -> None:
    data = data_of(write_comparison(runs[:2], tmp_path / "c.html", reference=runs[2]))
    steady, other = (run["measures"] for run in data["runs"])
    assert steady["rel_rmse"] == [0.0] * 24
    assert min(other["rel_rmse"]) > 0.1
    assert max(steady["FLIP"]) == 0.0
    assert min(other["FLIP"]) > 0.01


def test_without_aovs_a_moving_camera_has_no_flicker_pictures_and_the_page_says_so(
    runs: list[Path], tmp_path: Path, visit: Callable[..., Visit]
) -> None:
    for name in ("a", "b"):
        run = write_run(tmp_path / name, FRAMES[:3], flickering(0.1))
        record = json.loads((run / "run.json").read_text())
        del record["camera"], record["sha256"]
        (run / "run.json").write_text(json.dumps(record | {"format": 2}))
    visited = visit(write_comparison([tmp_path / "a", tmp_path / "b"], tmp_path / "c.html"))
    assert "--aovs" in visited.page.inner_text(".notice")
    choose(visited, "heat")
    choose(visited, "flicker")
    assert visited.complaints == []


def test_a_running_a_broken_and_an_empty_run_are_compared_as_far_as_they_go(
    runs: list[Path], tmp_path: Path, visit: Callable[..., Visit]
) -> None:
    running = write_run(tmp_path / "running", FRAMES[:5], flickering(0.1), wanted=24)
    broken = write_run(tmp_path / "broken", FRAMES[:6], flickering(0.1))
    damaged = broken / "frames" / "frame_00002.exr"
    damaged.write_bytes(damaged.read_bytes()[:-9])
    (broken / "stats.json").write_text("{")
    empty = write_run(tmp_path / "empty", [], flickering(0.1), wanted=24)
    visited = visit(write_comparison([running, broken, empty, runs[0]], tmp_path / "c.html"))
    notices = "\n".join(visited.page.locator(".notice").all_inner_texts())
    for words in (
        "19 of 24 frames are missing: 6-24",
        "frame_00002.exr: is truncated",
        "stats.json: cannot be read",
    ):
        assert words in notices
    assert "contains no frames" in notices
    visited.page.evaluate("steadylight.show(1)")
    frames = visited.page.locator(".player canvas").all()
    assert [frame.get_attribute("data-frame") for frame in frames] == ["2"] * 4
    assert visited.complaints == []


def test_runs_without_any_frame_cannot_be_compared(tmp_path: Path) -> None:
    empty = write_run(tmp_path / "empty", [], flickering(0.1), wanted=3)
    with pytest.raises(InputError, match="no frames yet"):
        write_comparison([empty], tmp_path / "c.html")
    assert not (tmp_path / "c.html").exists()


def test_runs_whose_frames_are_all_damaged_cannot_be_compared(runs: list[Path], tmp_path: Path) -> None:
    broken = write_run(tmp_path / "broken", FRAMES[:2], flickering(0.1))
    for frame in (broken / "frames").iterdir():
        frame.write_bytes(frame.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"broken: no(ne of its)? frames? can be read"):
        write_comparison([broken], tmp_path / "c.html", runs[0])


def test_the_page_links_to_videos_by_where_they_are_from_it(tmp_path: Path) -> None:
    run = write_run(tmp_path / "a run", FRAMES[:2], flickering(0.1))
    (run / "animation.mp4").write_bytes(b"film")
    (tmp_path / "pages").mkdir()
    page = write_comparison([run], tmp_path / "pages" / "c.html").read_text("utf-8")
    assert 'href="../a%20run/animation.mp4"' in page


def test_folders_of_one_name_are_told_apart(runs: list[Path], tmp_path: Path) -> None:
    places = [write_run(tmp_path / name / "run", FRAMES[:2], flickering(0.1)) for name in ("a", "b")]
    data = data_of(write_comparison(places, tmp_path / "c.html"))
    assert [run["name"] for run in data["runs"]] == [str(place) for place in places]


def test_frames_of_other_sizes_are_refused_by_name(runs: list[Path], tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    write_exr(tmp_path / "other" / "f_0001.exr", np.full((8, 8, 3), 0.1))
    with pytest.raises(InputError, match=r"f_0001\.exr: is 8x8 pixels, but .* is 48x36"):
        write_comparison([runs[0], tmp_path / "other"], tmp_path / "c.html")


def test_names_of_runs_cannot_end_the_script(tmp_path: Path, visit: Callable[..., Visit]) -> None:
    run = write_run(tmp_path / "<script>alert(1)<", FRAMES[:2], flickering(0.1))
    visited = visit(write_comparison([run], tmp_path / "c.html"))
    assert "<script>alert(1)<" in visited.page.inner_text("figcaption")
    assert visited.complaints == []
