"""The shape of the package: imports go downward, heavy libraries stay behind their fences."""

from __future__ import annotations

import ast
import functools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import steadylight
from steadylight.images import read_exr

ROOT = Path(steadylight.__file__).parent
MODULES = sorted(ROOT.rglob("*.py"))

LEVELS = (
    {"errors"},
    {"sites", "quality", "camera", "atomic_file", "checksum", "llvm", "redaction", "tone"},
    {"settings", "images"},
    {"scenes", "cache", "storage", "engines"},
    {"metrics", "video", "renderers"},
    {"report", "walking"},
    {"animation"},
    {"progress", "preview"},
    {"display", "interactive", "live"},
    {"cli", "__init__"},
    {"__main__"},
)
"""A module imports from lower levels and from its own package, never from beside or above."""

FENCES = {
    "mitsuba": ("renderers/mitsuba/", "renderers/radiance/appearance.py", "scenes/mitsuba_"),
    "drjit": ("renderers/mitsuba/", "renderers/radiance/appearance.py"),
    "dask": ("engines/",),
    "dask_jobqueue": ("engines/",),
    "distributed": ("engines/",),
    "pyoidn": ("renderers/mitsuba/image/denoising.py",),
    "fsspec": ("storage/store.py",),
    "typer": ("cli/",),
    "rich": ("cli/", "display.py", "interactive.py", "progress.py"),
    "matplotlib": ("metrics/plot.py", "report/"),
    "jinja2": ("report/",),
    "trimesh": ("scenes/",),
    "pxr": ("scenes/usd/",),
    "ifcopenshell": ("scenes/ifc.py",),
    "astral": ("scenes/sun.py",),
    "bpy": ("scenes/blender_export.py",),
    "mapbox_earcut": ("scenes/polygons.py", "scenes/radiance/surfaces.py"),
    "DracoPy": ("scenes/gltf/geometry.py",),
    "av": ("video.py",),
    "OpenEXR": ("images/exr.py",),
    "PyOpenColorIO": ("tone.py",),
    "safetensors": ("cache/file.py",),
    "flip_evaluator": ("metrics/",),
    "pycvvdp": ("metrics/perceptual.py",),
    "torch": ("metrics/perceptual.py",),
}
"""Where a library may be imported."""

LEVEL = {name: level for level, group in enumerate(LEVELS) for name in group}


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def part_of(path: Path) -> str:
    """The top-level module or package that a file belongs to."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


@functools.cache
def imports(path: Path) -> tuple[str, ...]:
    """Every module that a file imports: also for types, and within functions."""
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{relative(path)}:{node.lineno}: imports are absolute"
            names += [f"{node.module}.{name.name}" for name in node.names]
    return tuple(names)


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_imports_go_downward(path):
    own = part_of(path)
    for name in imports(path):
        package, *rest = name.split(".")
        if package != "steadylight":
            continue
        target = rest[0] if rest and rest[0] in LEVEL else "__init__"
        assert target == own or LEVEL[target] < LEVEL[own] or name == "steadylight.__version__", (
            f"{relative(path)} imports {name}"
        )


def test_every_module_has_a_level():
    assert {part_of(path) for path in MODULES} <= LEVEL.keys()


@pytest.mark.parametrize("library", FENCES)
def test_a_library_stays_behind_its_fence(library):
    outside = [
        relative(path)
        for path in MODULES
        if library in {name.split(".")[0] for name in imports(path)}
        and not relative(path).startswith(FENCES[library])
    ]
    assert outside == []


WITHOUT_RENDERER = [
    path
    for path in MODULES
    if part_of(path)
    in {
        *("animation", "cli", "display", "engines", "progress", "report", "settings", "sites", "storage"),
        "walking",
    }
]
"""Modules that know no renderer."""

OF_A_RENDERER = (
    "mitsuba",
    "drjit",
    "steadylight.renderers.mitsuba",
    "steadylight.renderers.radiance",
    "steadylight.cache",
)


@pytest.mark.parametrize("path", WITHOUT_RENDERER, ids=relative)
def test_what_runs_an_animation_knows_no_renderer(path):
    assert not [
        name for name in imports(path) if any(f"{name}.".startswith(f"{inner}.") for inner in OF_A_RENDERER)
    ]


@pytest.mark.parametrize("path", WITHOUT_RENDERER, ids=relative)
def test_what_runs_an_animation_knows_the_renderers_only_by_their_interface(path):
    known = (
        "steadylight.renderers.base.",
        "steadylight.renderers.find_renderer",
        "steadylight.renderers.geometry_of",
        "steadylight.renderers.renderer",
    )
    found = [name for name in imports(path) if name.startswith("steadylight.renderers")]
    assert not [name for name in found if not name.startswith(known)]


def test_an_engine_knows_neither_renderer_nor_animation():
    names = [name for path in MODULES if part_of(path) == "engines" for name in imports(path)]
    assert not [name for name in names if name.startswith(("steadylight.renderers", "steadylight.animation"))]


@pytest.fixture
def foreign(tmp_path):
    """Environment in which another package with a renderer is installed."""
    package = tmp_path / "packages" / "constant-1.dist-info"
    package.mkdir(parents=True)
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: constant\nVersion: 1\n")
    (package / "entry_points.txt").write_text(
        "[steadylight.renderers]\nconstant = constant_renderer:RENDERER\n"
    )
    paths = (str(package.parent), str(Path(__file__).parent), *sys.path)
    return os.environ | {"PYTHONPATH": os.pathsep.join(path for path in paths if path)}


def test_a_renderer_of_another_package_renders_an_animation_on_two_workers(foreign, tmp_path):
    words = (
        "render",
        "furnace",
        "--renderer",
        "constant",
        "--frames",
        "8",
        "--size",
        "16x8",
        "--workers",
        "2",
    )
    given = [sys.executable, "-m", "steadylight", *words, "--output", "out"]
    done = subprocess.run(
        given, cwd=tmp_path, env=foreign, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    run = tmp_path / "out"
    statistics = json.loads((run / "stats.json").read_text())
    assert statistics["workers"] == 2
    assert statistics["merge"]["records_out"] == len(statistics["selected_frames"]) == 3
    assert statistics["second_pass"]["new_records"] == 0
    assert "coverage" not in statistics
    frames = [read_exr(path) for path in sorted(run.glob("frames/*.exr"))]
    assert len(frames) == 8
    assert all((frame == np.float32(np.mean(statistics["selected_frames"]))).all() for frame in frames)
    assert {"run.json", "animation.mp4", "report.html"} <= {path.name for path in run.iterdir()}
    assert json.loads((run / "run.json").read_text())["settings"]["renderer"] == "constant"


def test_a_renderer_is_no_longer_than_a_screen():
    lines = (Path(__file__).parent / "constant_renderer.py").read_text().splitlines()
    assert len(lines) <= 60


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_every_module_opens_with_what_it_is_for(path):
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    assert docstring
    assert docstring.splitlines()[0].strip()


FOLDERS = [path for path in MODULES if path.name == "__init__.py" and path.parent != ROOT]


@pytest.mark.parametrize("path", FOLDERS, ids=relative)
def test_every_folder_says_in_two_sentences_what_lives_there(path):
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    assert len(re.findall(r"[.](?=\s|$)", docstring)) >= 2


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_no_function_is_longer_than_120_lines(path):
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    lengths = {
        node.name: node.end_lineno - node.lineno + 1
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, functions)
    }
    assert {name: length for name, length in lengths.items() if length > 120} == {}


ROOMS = (
    {
        "backend",
        "collected",
        "frozen",
        "geometry",
        "memory",
        "merged_meshes",
        "quality",
        "sampling",
        "scene",
        "search",
        "upload",
    },
    {"bsdf", "light", "image"},
    {"records"},
    {"paths"},
    {"view"},
    {"coverage", "frame"},
    {"survey", "probe", "renderer", "irradiance_cache"},
    {"plugin"},
)
"""Within the Mitsuba renderer, imports go from later rooms to earlier ones, or to the own."""


def test_within_the_mitsuba_renderer_imports_go_downward():
    home = ROOT / "renderers/mitsuba"
    level = {name: number for number, names in enumerate(ROOMS) for name in names}
    wrong = []
    for path in sorted(home.rglob("*.py")):
        own = path.relative_to(home).parts[0].removesuffix(".py")
        for name in imports(path):
            if name.startswith("steadylight.renderers.mitsuba.") and own != "__init__":
                target = name.split(".")[3]
                if own not in ("backend", target) and level[target] > level[own]:
                    wrong.append(f"{relative(path)} imports {name}")
    assert wrong == []


HOME_MADE = r"\b(aids|glares?|suffices?|soft sky|unanswered|(first|second) look|panes? of glass)\b"
"""Words of our own where the field has one; a page on what was tried may quote them."""


def test_no_home_made_word_is_left_in_the_renderers_and_the_docs():
    repository = Path(__file__).parent.parent
    pages = [*repository.glob("*.md"), *repository.glob("docs/*.md")]
    texts = [*(ROOT / "renderers").rglob("*.py"), *(ROOT / "cache").rglob("*.py"), *pages]
    found = {
        path.name: re.findall(HOME_MADE, path.read_text(encoding="utf-8"), re.IGNORECASE)
        for path in texts
        if path.name not in {"experiments.md", "CHANGELOG.md"}
    }
    assert {name: words for name, words in found.items() if words} == {}


def test_no_two_modules_of_tests_have_one_name():
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))  # pytest could collect only one of them


def test_no_module_is_a_drawer_for_odds_and_ends():
    assert not {path.stem for path in MODULES} & {"util", "utils", "helper", "helpers", "common", "misc"}


def test_modules_do_not_import_each_other_in_a_circle_not_even_for_types():
    names = {
        ".".join(("steadylight", *path.relative_to(ROOT).with_suffix("").parts)): path for path in MODULES
    }
    names = {name.removesuffix(".__init__"): path for name, path in names.items()}

    def known(name):
        while name and name not in names:
            name = name.rpartition(".")[0]
        return name

    needs = {
        name: {known(found) for found in imports(path)} & names.keys() - {name}
        for name, path in names.items()
    }
    while True:
        free = {name for name, wanted in needs.items() if not wanted & needs.keys()}
        if not free:
            break
        needs = {name: wanted for name, wanted in needs.items() if name not in free}
    assert sorted(needs) == []
