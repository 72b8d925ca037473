"""What the number of quality stands for in this renderer."""

from __future__ import annotations

import ast
import dataclasses
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from steadylight.quality import LEAST, MOST, WORDS
from steadylight.renderers.mitsuba.quality import (
    MitsubaQuality,
    RecordQuality,
    mitsuba_quality,
    quality_of,
)
from steadylight.settings import FirstPass, RenderSettings

SWEEP = np.geomspace(LEAST, MOST, 65).tolist()

# What grows with quality, and what shrinks; everything else is the same at every quality.
GROWS = {
    "number",
    "polar_strata",
    "azimuth_strata",
    "refinement_paths[0]",
    "refinement_paths[-1]",
    "emitter_samples",
    "glossy_samples",
    "sky_samples",
    "emitter_rays",
    "pixels",
    "emission_samples",
    "rays",
    "firefly",
    "large_network",
}
SHRINKS = {
    "standard_error",
    "accuracy",
    "minimum_spacing",
    "tolerance",
    "negligible",
    "threshold",
    "worth_rest",
    "worth_indirect",
}


def leaves(part: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, (*path, field.name))
        elif isinstance(value, tuple):
            yield (*path, f"{field.name}[0]"), value[0]
            yield (*path, f"{field.name}[-1]"), value[-1]
        else:
            yield (*path, field.name), value


def test_normal_is_what_the_defaults_say() -> None:
    assert mitsuba_quality(1.0) == MitsubaQuality()
    assert mitsuba_quality(1.0).records == RecordQuality(
        polar_strata=10, azimuth_strata=40, refinement_paths=(400, 784, 1600, 3136), standard_error=0.033
    )


def test_every_budget_grows_with_quality_and_every_tolerance_shrinks() -> None:
    sweep = [dict(leaves(mitsuba_quality(q))) for q in SWEEP]
    for path, value in sweep[0].items():
        values = [each[path] for each in sweep]
        if path[-1] in GROWS:
            assert all(a <= b for a, b in itertools.pairwise(values)), path
        elif path[-1] in SHRINKS:
            assert all(a >= b for a, b in itertools.pairwise(values)), path
        else:
            assert set(values) == {value}, path


@pytest.mark.parametrize("word", WORDS)
def test_words_differ_in_what_a_record_costs(word: str) -> None:
    quiet, noisy = mitsuba_quality(WORDS[word]).records.paths_per_record
    assert (quiet, noisy) == {"draft": (512, 1280), "normal": (800, 3536), "high": (968, 8228)}[word]


def test_a_short_film_has_records_further_apart_but_for_the_published_first_pass() -> None:
    def spacing(frames: int, first_pass: FirstPass = "surface") -> float:
        numbers = tuple(range(1, frames + 1))
        settings = RenderSettings(frames=numbers, width=64, height=48, first_pass=first_pass)
        return quality_of(settings).records.minimum_spacing

    long = RecordQuality().minimum_spacing
    assert spacing(24) == spacing(1000) == spacing(3, "frames") == long
    assert spacing(1) == spacing(12) == pytest.approx(1.4 * long)
    assert long < spacing(18) < spacing(12)


def test_the_radii_are_a_method_and_no_matter_of_quality() -> None:
    split, hessian = mitsuba_quality(1.0, "split-sphere"), mitsuba_quality(1.0)
    assert split.records == dataclasses.replace(hessian.records, radii="split-sphere")
    assert split.secondary == hessian.secondary


ROOT = Path(__file__).parents[3]


def module_constants(folder: Path) -> Iterator[str]:
    """`module.NAME` of every public constant that a module of a folder sets."""
    for path in sorted(folder.rglob("*.py")):
        for statement in ast.parse(path.read_text()).body:
            targets = statement.targets if isinstance(statement, ast.Assign) else []
            targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
            for target in targets:
                for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                    if isinstance(name, ast.Name) and name.id.isupper() and name.id[0] != "_":
                        yield f"{path.stem}.{name.id}"


def test_every_constant_that_quality_leaves_alone_is_listed_with_what_it_is_for() -> None:
    listed = set(re.findall(r"`(\w+\.[A-Z_0-9]+)`", (ROOT / "docs" / "quality-settings.md").read_text()))
    source = ROOT / "src" / "steadylight"
    found = {
        constant
        for folder in (source / "cache", source / "renderers" / "mitsuba")
        for constant in module_constants(folder)
    }
    found -= {"plugin.RENDERER", "plugin.AUDIT_ROUNDS"}
    assert sorted(found - listed) == []
    assert sorted(listed - found) == []
