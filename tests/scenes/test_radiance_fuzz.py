"""Any text as a Radiance scene: it is read, or refused with a message; nothing in it is executed."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from steadylight.errors import SceneError
from steadylight.scenes import load_scene
from steadylight.scenes.radiance import commands

WORDS = st.sampled_from(
    [
        "void", "grey", "plastic", "glass", "light", "glow", "polygon", "sphere", "cone", "source", "alias", "instance",
        "mesh", "brightfunc", "mixfunc", "trans", "0", "1", "3", "4", "5", "7", "9", "-1", "1e309", "nan",
        "99999999999", "\n", "#", '"', "'", "\\\n", "é", "\0",
    ]
)  # fmt: skip
COMMANDS = st.sampled_from(
    [
        "!touch hacked",
        "!xform -t 1 0 0 x.rad; touch hacked",
        "!cat x.rad | touch hacked",
        "!xform '!touch hacked'",
        "!genbox a $(touch hacked) 1 1 1",
        "!genbox a `touch hacked` 1 1 1",
        "!cat x.rad > hacked",
        "!xform -a 9999999 -t 1 0 0 x.rad",
        "!cat it.rad",
        "!xform",
        "!",
        "!genbox grey b 1 1",
        "!cat ../../../etc/passwd",
    ]
)
LINES = st.one_of(
    st.lists(WORDS, max_size=14).map(" ".join),
    COMMANDS,
    st.sampled_from(["void plastic grey 0 0 5 .5 .5 .5 0 0", "grey polygon p 0 0 9 0 0 0 1 0 0 0 1 0"]),
    st.text(max_size=30),
)


@pytest.mark.skipif(find_spec("pyradiance") is None, reason="pyradiance is not installed")
@settings(
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)
@given(lines=st.lists(LINES, max_size=6), tail=st.binary(max_size=8))
def test_any_text_is_read_or_refused_and_nothing_is_executed(tmp_path, monkeypatch, lines, tail):
    monkeypatch.setattr(commands, "MOST_BYTES", 1 << 20)  # what never ends is ended soon
    (tmp_path / "x.rad").write_text("void plastic blue 0 0 5 0 0 1 0 0\n")
    (tmp_path / "it.rad").write_bytes("\n".join(lines).encode("utf-8", "surrogatepass") + tail)
    try:
        load_scene(tmp_path / "it.rad")
    except SceneError as error:
        assert "it.rad" in str(error)  # noqa: PT017 - most texts are faulty, not all
    assert sorted(path.name for path in tmp_path.iterdir()) == ["it.rad", "x.rad"]
