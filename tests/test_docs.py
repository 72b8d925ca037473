"""The documents: what they show can be typed, and what they link to is there."""

from __future__ import annotations

import ast
import inspect
import json
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest
import typer.main

import steadylight
from steadylight import cli
from steadylight.camera import load_camera
from steadylight.scenes import BUNDLED, READERS, mitsuba_older
from steadylight.scenes.mitsuba_plugins import PLUGINS
from steadylight.sites import FaultSettings, SiteSettings, TlsSettings, load_site

ROOT = Path(__file__).parent.parent
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
LONGEST_CELL = 240
"""Characters: about three lines of a table with two columns."""
NO_PART_OF_A_ROOM = {
    *(
        "aov",
        "depth",
        "direct",
        "moment",
        "path",
        "ptracer",
        "stokes",
        "volpath",
        "volpathmis",
    ),  # integrators
    *("independent", "ldsampler", "multijitter", "orthogonal", "stratified"),  # samplers
    *("blackbody", "d65", "irregular", "rawconstant", "regular", "srgb", "uniform"),  # spectra
    *("blendphase", "hg", "isotropic", "rayleigh", "sggx", "tabphase"),  # phase functions
    *("constvolume", "gridvolume"),  # volumes
}
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(*languages, documents=None):
    """Fenced blocks of the documents (by name; all if None) in these languages, as test parameters."""
    return [
        pytest.param(text, id=f"{path.name}-{number}")
        for path in DOCUMENTS
        if documents is None or path.name in documents
        for number, (language, text) in enumerate(BLOCK.findall(path.read_text(encoding="utf-8")))
        if language in languages
    ]


def command_lines():
    """Every steadylight command that a document shows."""
    for parameter in blocks("bash", "console", "sh"):
        for line in parameter.values[0].splitlines():
            words = shlex.split(line.removeprefix("$ "))
            if words and Path(words[0]).name == "steadylight":
                yield pytest.param(words[1:], id=line)


def command_of(words):
    """The command of the application that the words name, and the words that are left."""
    command = typer.main.get_command(cli.app)
    while hasattr(command, "commands") and words:
        assert words[0] in command.commands, f"there is no command {words[0]}"
        command, words = command.commands[words[0]], words[1:]
    return command, words


def test_every_block_has_a_language_that_a_test_knows():
    languages = {language for path in DOCUMENTS for language, _ in BLOCK.findall(path.read_text("utf-8"))}
    assert languages <= {"", "bash", "csv", "python", "toml"}


@pytest.mark.parametrize("words", list(command_lines()))
def test_commands_in_the_documents_are_commands(words):
    command, rest = command_of(words)
    known = {option for parameter in command.params for option in parameter.opts}
    assert {word for word in rest if word.startswith("--")} <= known
    # Parsing checks choices and numbers too; nothing is run.
    command.make_context("steadylight", list(rest))


@pytest.mark.parametrize("words", list(command_lines()))
def test_scenes_and_frames_in_the_documents_exist(words):
    if words[0] not in {"render", "plan"} or Path(words[1]).suffix in READERS:
        return
    assert words[1] in BUNDLED


@pytest.mark.parametrize("text", blocks("python"))
def test_python_in_the_documents_uses_names_and_options_that_exist(text):
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "sl":
            assert node.attr in steadylight.__all__
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and getattr(node.func.value, "id", "") == "sl"
        ):
            parameters = inspect.signature(getattr(steadylight, node.func.attr)).parameters
            assert {word.arg for word in node.keywords} <= parameters.keys()


@pytest.mark.parametrize("text", blocks("toml", documents={"clusters.md"}))
def test_site_files_in_the_documents_load(text, tmp_path):
    for name in re.findall(r'"(.*\.pem)"', text):
        (tmp_path / name).touch()
    (tmp_path / "site.toml").write_text(text, encoding="utf-8")
    assert load_site(tmp_path / "site.toml").cores == 16


def test_every_key_of_a_site_file_is_in_the_documents():
    text = (ROOT / "docs" / "clusters.md").read_text("utf-8")
    keys = set(re.findall(r"`([a-z_.]+)`", text))
    own = {f"faults.{key}" for key in FaultSettings.model_fields} | {
        f"tls.{key}" for key in TlsSettings.model_fields
    }
    assert own | SiteSettings.model_fields.keys() - {"faults", "tls", "job_name"} <= keys


@pytest.mark.parametrize("text", blocks("toml", documents={"cameras.md"}))
def test_camera_files_in_the_documents_load(text, tmp_path):
    file = tmp_path / "walk.toml"
    file.write_text(text, encoding="utf-8")
    path, fps = load_camera(file)
    assert path.frame_count(fps) == 101


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_between_the_documents_lead_somewhere(document):
    text = document.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        if not target.startswith(("http://", "https://")):
            assert (document.parent / target).exists(), target


def test_the_architecture_fits_two_screens():
    lines = (ROOT / "ARCHITECTURE.md").read_text("utf-8").splitlines()
    assert len(lines) <= 120
    assert max(map(len, lines)) <= 110


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_cells_of_tables_are_short(document):
    rows = [line for line in document.read_text("utf-8").splitlines() if line.startswith("|")]
    assert [cell for row in rows for cell in row.split("|") if len(cell) > LONGEST_CELL] == []


def test_every_document_can_be_reached_from_the_readme():
    reached, new = set(), {ROOT / "README.md"}
    while new:
        reached |= new
        targets = {
            (page.parent / target).resolve()
            for page in new
            for target in re.findall(r"\]\(([^)#:]+\.md)[^)]*\)", page.read_text("utf-8"))
        }
        new = targets - reached
    assert set(DOCUMENTS) <= reached


def options_in(text):
    """Options named in running text and tables, not in code of other tools."""
    return set(re.findall(r"`(?:steadylight \w+ )?(--[a-z][a-z-]*)", text))


def test_options_named_in_the_readme_exist():
    render, _ = command_of(["render"])
    known = {option for parameter in render.params for option in parameter.opts}
    assert options_in((ROOT / "README.md").read_text("utf-8")) <= known | {"--help"}


def test_every_option_of_render_has_a_line_of_help():
    render, _ = command_of(["render"])
    assert [parameter.name for parameter in render.params if not getattr(parameter, "help", "")] == []


def test_the_first_two_commands_of_the_readme_install_by_themselves():
    first, second = re.findall(r"```bash\n(.*?)\n```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)[:2]
    for command in (first, second):
        script = ROOT / command.split()[0]
        assert script.stat().st_mode & 0o111
        assert "prepare_environment" in script.read_text("utf-8")


@pytest.mark.parametrize(
    "script", ["scripts/environment.sh", "scripts/steadylight", "scripts/test", ".ci/run"]
)
def test_scripts_parse(script):
    assert subprocess.run(["bash", "-n", ROOT / script], check=False).returncode == 0


def test_ci_runs_the_readmes_test_command():
    assert "./scripts/test\n" in (ROOT / ".ci/run").read_text("utf-8")


def test_versions_agree():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    assert f"version: {declared}\n" in (ROOT / "CITATION.cff").read_text("utf-8")
    assert json.dumps(declared) in (ROOT / "pyproject.toml").read_text("utf-8")


def test_the_page_about_scenes_is_the_table_that_the_checks_read():
    text = (ROOT / "docs" / "scenes.md").read_text("utf-8")
    shown = re.findall(r"^\| ([\w ]+) \| `(.+?)` \| (\w+) \| ?(.*?) ?\|$", text, re.MULTILINE)
    assert shown == [
        (row.kind, row.name, row.standing, row.how) for row in (*PLUGINS, *mitsuba_older.PLUGINS)
    ]


def test_the_table_of_plugins_has_every_one_that_mitsuba_comes_with():
    import mitsuba as mi

    present = {path.name.split(".")[0] for path in (Path(mi.__file__).parent / "plugins").iterdir()}
    mentioned = {row.name for row in PLUGINS}
    assert sorted(present - mentioned - NO_PART_OF_A_ROOM) == []
