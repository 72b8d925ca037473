"""Small USD files for tests."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from steadylight.scenes.description import SceneDescription
from steadylight.scenes.usd.reading import describe
from steadylight.scenes.usd.request import Request

FLOOR = """
def Mesh "Floor" {
    uniform token subdivisionScheme = "none"
    point3f[] points = [(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]
}
"""


def usda(body: str, *, up: str = "Z", metres: float = 1.0, more: str = "") -> str:
    """A stage as text; braces get the line breaks that USD demands."""
    header = f'#usda 1.0\n(\n upAxis = "{up}"\n metersPerUnit = {metres}\n {more}\n)\n'
    return header + body.replace("{", "{\n").replace("}", "\n}\n")


def light(kind: str, *, lines: Sequence[str] = (), api: str = "", at: Sequence[float] = (), **inputs) -> str:
    """A light with inputs: numbers, booleans, and file names between @."""
    words = {bool: "bool", str: "asset"}
    body = [
        f"{words.get(type(value), 'float')} inputs:{name.replace('__', ':')} = {_word(value)}"
        for name, value in inputs.items()
    ]
    if at:
        body += [
            f"double3 xformOp:translate = ({', '.join(map(str, at))})",
            'uniform token[] xformOpOrder = ["xformOp:translate"]',
        ]
    apis = f'(prepend apiSchemas = ["{api}"])' if api else ""
    return "\n".join([f'def {kind} "L" {apis}', "{", *body, *lines, "}"])


def _word(value) -> str:
    return str(int(value)) if isinstance(value, bool) else str(value)


def read(
    folder: Path,
    body: str,
    sensor: str | None = None,
    *,
    outside: bool = False,
    name: str = "scene.usda",
    **header,
) -> SceneDescription:
    """The description of a stage of this text, read in this process."""
    path = folder / name
    path.write_text(usda(body, **header), encoding="utf-8")
    return describe(Request(path, sensor, outside))


def texts(description: SceneDescription) -> str:
    """All notes, as text."""
    return "\n".join(f"{note.kind}: {note.where}: {note.text}" for note in description.notes)
