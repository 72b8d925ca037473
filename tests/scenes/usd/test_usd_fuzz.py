"""USD files that are damaged at random: one message or a description, never a traceback, a crash or a hang."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from usd_stages import FLOOR, light, usda

from steadylight.errors import InputError
from steadylight.scenes.usd.request import Request

TEXT = usda(
    FLOOR
    + light("RectLight", at=(0, 0, 2), intensity=5)
    + 'def Sphere "Ball" {}\ndef PointInstancer "P" { rel prototypes = [</Ball>]\nint[] protoIndices = [0, 0]\n'
    + "point3f[] positions = [(0, 0, 0), (1, 1, 1)] }\n"
    + 'def Camera "Eye" { float focalLength.timeSamples = { 1: 20, 3: 30 } }\n'
    + 'def Material "M" { token outputs:surface.connect = </M/S.outputs:surface>\n'
    + 'def Shader "S" { uniform token info:id = "UsdPreviewSurface"\ncolor3f inputs:diffuseColor = (1, 0, 0)\n'
    + "token outputs:surface } }",
    more="startTimeCode = 1\n endTimeCode = 3",
)
SWAPS = (
    "-1",
    "1e30",
    "nan",
    "inf",
    "()",
    "[]",
    "None",
    '"x"',
    "</M>",
    "</Nothing>",
    "999999999999",
    "@/dev/zero@",
    "@x@",
)


def _work(requests, answers) -> None:
    """Reads one file after the other in a process of its own, as `apart` does for one."""
    import os
    import traceback

    from steadylight.scenes.apart import Reading, answer_to

    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    for request in iter(requests.get, None):
        try:
            kind, content = answer_to(
                Reading(request.path, "USD", "steadylight.scenes.usd.isolation", request)
            )
        except Exception:  # noqa: BLE001 - any is a fault of ours
            kind, content = "fault of ours", traceback.format_exc()
        answers.put((kind, str(content) if kind != "description" else ""))


class Reader:
    """A process that reads files, and is started again if it dies."""

    def __init__(self) -> None:
        self.context = multiprocessing.get_context("spawn")
        self.process = None
        self.crashes: list[bytes] = []

    def answer(self, path: Path) -> tuple[str, str]:
        if self.process is None or not self.process.is_alive():
            self.requests, self.answers = self.context.Queue(), self.context.Queue()
            self.process = self.context.Process(target=_work, args=(self.requests, self.answers), daemon=True)
            self.process.start()
        self.requests.put(Request(path))
        for _ in range(600):
            try:
                return self.answers.get(timeout=0.1)
            except Exception:  # noqa: BLE001 - queue.Empty
                if not self.process.is_alive():
                    self.crashes.append(path.read_bytes())
                    return "crash", ""
        self.process.kill()
        pytest.fail(f"hangs: {path.read_bytes()!r}")

    def close(self) -> None:
        if self.process is not None and self.process.is_alive():
            self.requests.put(None)
            self.process.join()


@pytest.fixture(scope="module")
def reader():
    made = Reader()
    yield made
    made.close()


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture(scope="module")
def binary(place):
    from pxr import Sdf

    (place / "whole.usda").write_text(TEXT)
    Sdf.Layer.FindOrOpen(str(place / "whole.usda")).Export(str(place / "whole.usdc"))
    return (place / "whole.usdc").read_bytes()


QUICK = settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
    database=None,
)
_number = iter(range(10**9))


def check(reader: Reader, place: Path, content: bytes, suffix: str) -> None:
    """One message of one line, or a description; what crashes the library crashes a process of its own."""
    path = place / f"{next(_number)}{suffix}"
    path.write_bytes(content)
    kind, message = reader.answer(path)
    path.unlink()
    if kind == "description":
        return
    assert kind in {"crash", *(error.__name__ for error in (InputError, *InputError.__subclasses__()))}, (
        message
    )
    assert "\n" not in message
    assert "Traceback" not in message


@QUICK
@given(st.data())
def test_text_that_was_changed_anywhere(reader, place, data):
    words = TEXT.split(" ")
    for _ in range(data.draw(st.integers(1, 3))):
        words[data.draw(st.integers(0, len(words) - 1))] = data.draw(
            st.sampled_from(SWAPS) | st.text(max_size=6)
        )
    check(reader, place, " ".join(words).encode("utf-8", "replace"), ".usda")


@QUICK
@given(st.data())
def test_binary_files_that_end_early_or_have_other_bytes(reader, place, binary, data):
    content = bytearray(binary)
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    check(reader, place, bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))]), ".usdc")


@QUICK
@given(st.binary(max_size=300))
def test_any_bytes(reader, place, content):
    check(reader, place, content, ".usd")
