"""Radiance behind the renderer interface: the paper's own system, with the programs that pyradiance provides.

Importing this module is cheap: it does not import pyradiance, and searches for its programs when a scene is checked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from steadylight.errors import CacheFileError, RunError, SceneError, SettingsError
from steadylight.renderers.base import Backend, Capabilities, Counts, Job, SceneRenderer, Survey
from steadylight.renderers.radiance.ambient import (
    concatenated,
    encode_ambient,
    numbers,
    positions,
    read_ambient,
    values,
)
from steadylight.renderers.radiance.geometry import RadianceGeometry
from steadylight.renderers.radiance.merging import thinned, united
from steadylight.renderers.radiance.passes import ScenePasses, write_octree
from steadylight.renderers.radiance.picture import check_film
from steadylight.renderers.radiance.quality import REDUNDANT, WORKING, ambient_options
from steadylight.renderers.radiance.view import check_sensor
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.radiance.programs import version as programs_version
from steadylight.settings import RenderSettings

AUDIT_ROUNDS: Final = 3
"""Rounds of the audit: one that looks up every point, and others that check that each frame needs no more records."""


class AmbientFiles:
    """Ambient files for `steadylight cache`, from steadylight or from Radiance's own programs."""

    def describe(self, path: Path) -> Mapping[str, str]:
        """Number of records by level, scene, bounds, radii and mean irradiance of an ambient file, and its command."""
        ambient = read_ambient(path)
        records = ambient.records
        by_level = np.bincount(records["level"]).tolist()
        lines = {
            "records": f"{len(records):,}",
            "by level": ", ".join(f"{count:,}" for count in by_level) or "none",
            "scene": ambient.scene or "unknown",
            "made by": ambient.header[1].strip() if len(ambient.header) > 1 else "unknown",
        }
        if ambient.clean:
            lines["frames without a miss"] = f"{len(ambient.clean)}"
        if len(records):
            place, radius = positions(records), numbers(records["radius"])
            lines["bounds"] = f"{_vector(place.min(axis=0))} to {_vector(place.max(axis=0))}"
            lines["radii"] = f"{radius.min():.4g} to {radius.max():.4g}, median {np.median(radius):.4g}"
            lines["mean irradiance"] = f"{_vector(np.pi * values(records).mean(axis=0))} W/m²"
        return lines

    def merge(self, paths: Sequence[Path], output: Path) -> Counts:
        """Merge ambient files into one without redundant records, with the header of the first.

        Raises:
            CacheFileError: a file cannot be read, or was made from another scene or with other options than the first.
        """
        files = [read_ambient(path) for path in paths]
        for path, file in zip(paths, files, strict=True):
            if file.origin != files[0].origin or file.records.dtype != files[0].records.dtype:
                raise CacheFileError(
                    f"{path}: made from another scene or with other options than {paths[0]}; merge files of one "
                    "scene only"
                )
        together = concatenated([file.records for file in files])
        records = thinned(together, files[0].accuracy)
        output.write_bytes(encode_ambient(files[0].with_records(records)))
        return {"records_in": len(together), "records_out": len(records)}

    def differences(self, path: Path, other: Path) -> tuple[bool, Mapping[str, str]]:
        """Whether two files hold the same records in any order, and how many are in only one of them."""
        a, b = read_ambient(path), read_ambient(other)
        lines = {
            "records": f"{len(a.records):,} and {len(b.records):,}",
            "scene and options": "the same" if a.origin == b.origin else "others",
        }
        if a.records.dtype != b.records.dtype:
            return False, lines | {"components": "different numbers"}
        ours, theirs = united([a.records]), united([b.records])
        shared = len(ours) + len(theirs) - len(united([ours, theirs]))
        lines["in one of them only"] = f"{len(ours) - shared:,} and {len(theirs) - shared:,}"
        return a.origin == b.origin and len(ours) == len(theirs) == shared, lines


def _vector(figures: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    """Numbers as `(x, y, z)`."""
    return "(" + ", ".join(f"{figure:.4g}" for figure in figures) + ")"


class RadianceRenderer:
    """RADIANCE's `rtrace` with its ambient cache."""

    name = "radiance"
    capabilities = Capabilities(
        scenes=("radiance", "mitsuba"),
        modes=("two-pass", "single-pass", "path"),
        audit_rounds=AUDIT_ROUNDS,
        cache_suffix=".amb",
        misses_suffix=".amb",
        seconds_per_sample=200e-6,  # gallery, 6 frames of 256x144
    )
    cache_files = AmbientFiles()

    def check(
        self, scene: SceneDescription, settings: RenderSettings, variant: str, *, build: bool
    ) -> Backend:
        """Check that the programs are installed, and that they support everything in the scene."""
        programs = programs_version()
        if variant == "cuda":
            raise SettingsError(
                "--variant: cuda is not valid with --renderer radiance, which runs on processors only"
            )
        if settings.radii != "occlusion-hessian":
            raise SettingsError(
                f"--radii: {settings.radii} is not valid with --renderer radiance, whose record radii always follow "
                "the occlusion Hessian; leave it out"
            )
        if settings.panes != "refract":
            raise SettingsError(
                f"--panes: {settings.panes} is not valid with --renderer radiance, where the scene says what is a "
                "pane (`glass`); leave it out"
            )
        check_sensor(scene)
        check_film(scene)
        if build:
            with TemporaryDirectory(prefix="steadylight-radiance-") as folder:
                try:
                    write_octree(scene, Path(folder))
                except RunError as error:
                    raise SceneError(f"scene {scene.name}: {error}") from error
        versions = {"radiance": programs, "pyradiance": _version("pyradiance")}
        if scene.format == "mitsuba":  # its exporter evaluates materials and skies with Mitsuba
            versions |= {name: _version(name) for name in ("mitsuba", "drjit")}
        constants = {
            **asdict(ambient_options(settings.quality)),
            "redundant": REDUNDANT,
            "options": dict(WORKING),
        }
        return Backend("rtrace", versions, constants)

    def survey(self, job: Job) -> Survey:
        """One part: every frame reads the whole file."""
        return Survey.undivided(len(job.windows))

    def geometry(self, scene: SceneDescription, variant: str) -> RadianceGeometry | None:  # noqa: ARG002 - as others
        """The surfaces of an octree, through `rtrace`; other scene formats are left to other renderers."""
        return RadianceGeometry(scene) if scene.format == "radiance" else None

    def validate(self, path: Path, scene_hash: str) -> None:
        """Read a file back and verify its checksum."""
        read_ambient(path, scene_hash=scene_hash)

    def open(self, job: Job, threads: int | None) -> SceneRenderer:  # noqa: ARG002 - each program runs on one core
        """Keep the job; the octree is made when a task needs it."""
        return ScenePasses(job)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


RENDERER: Final = RadianceRenderer()
