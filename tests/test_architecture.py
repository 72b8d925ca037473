"""The shape of the package: imports go downward, heavy libraries stay behind their fences."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import steadylight

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(steadylight.__file__).parent
MODULES = sorted(ROOT.rglob("*.py"))

LEVELS = (
    {"errors"},
    {"sites"},
    {"settings", "camera", "atomic_file", "llvm"},
    {"scenes", "cache", "images", "storage", "engines"},
    {"metrics", "video", "renderers"},
    {"report"},
    {"animation"},
    {"progress"},
    {"display"},
    {"cli", "__init__"},
    {"__main__"},
)
"""A module imports from lower levels and from its own package, never from beside or above."""

FENCES = {
    "mitsuba": ("renderers/mitsuba/", "scenes/mitsuba_xml.py"),
    "drjit": ("renderers/mitsuba/",),
    "dask": ("engines/",),
    "dask_jobqueue": ("engines/",),
    "distributed": ("engines/",),
    "pyoidn": ("renderers/mitsuba/image/denoising.py",),
    "fsspec": ("animation/store.py",),
    "typer": ("cli.py",),
    "rich": ("cli.py", "display.py", "progress.py"),
    "matplotlib": ("metrics/plot.py", "report/"),
    "jinja2": ("report/",),
    "trimesh": ("scenes/",),
    "av": ("video.py",),
    "OpenEXR": ("images.py",),
    "safetensors": ("cache/file.py",),
    "flip_evaluator": ("metrics/",),
}
"""Where a library may be imported."""

LEVEL = {name: level for level, group in enumerate(LEVELS) for name in group}


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def part_of(path: Path) -> str:
    """The top-level module or package that a file belongs to."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imports(path: Path, *, loading: bool = False) -> Iterator[str]:
    """Every module that a file imports; with `loading` only those it needs to be loaded at all."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body if loading else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{relative(path)}:{node.lineno}: imports are absolute"
            yield from (f"{node.module}.{name.name}" for name in node.names)


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


def test_the_plan_knows_neither_the_tasks_nor_the_renderer():
    names = list(imports(ROOT / "animation/plan.py"))
    assert not [name for name in names if "tasks" in name or "renderers.mitsuba" in name]


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_every_module_opens_with_what_it_is_for(path):
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    assert docstring
    assert docstring.splitlines()[0].strip()


def test_no_module_is_a_drawer_for_odds_and_ends():
    assert not {path.stem for path in MODULES} & {"util", "utils", "helper", "helpers", "common", "misc"}


def test_modules_do_not_import_each_other_in_a_circle():
    names = {
        ".".join(("steadylight", *path.relative_to(ROOT).with_suffix("").parts)): path for path in MODULES
    }
    names = {name.removesuffix(".__init__"): path for name, path in names.items()}

    def known(name):
        while name and name not in names:
            name = name.rpartition(".")[0]
        return name

    needs = {
        name: {known(found) for found in imports(path, loading=True)} & names.keys() - {name}
        for name, path in names.items()
    }
    while True:
        free = {name for name, wanted in needs.items() if not wanted & needs.keys()}
        if not free:
            break
        needs = {name: wanted for name, wanted in needs.items() if name not in free}
    assert sorted(needs) == []
