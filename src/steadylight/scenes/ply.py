"""Checks PLY files before Mitsuba loads them: one whose faces name vertices that are not there would crash it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from steadylight.scenes.mitsuba_document import Document


def check_meshes(document: Document) -> None:
    """Add a fault for each PLY shape of a scene whose faces name vertices that are not there."""
    seen: dict[str, str | None] = {}
    for element in document.root.walk():
        name = element.text("filename") if (element.tag, element.kind) == ("shape", "ply") else ""
        if not name:
            continue
        if name not in seen:
            seen[name] = _fault_in(Path(name))
        fault = seen[name]
        if fault is not None:
            document.fault((element.child("filename") or element).place, fault)


def _fault_in(path: Path) -> str | None:
    """What is wrong with the faces of a PLY file; None if nothing is, or if Mitsuba can tell."""
    from trimesh.exchange.ply import load_ply

    try:
        head, end, body = path.read_bytes().partition(b"end_header")
        head = head.decode("ascii", "replace").encode("ascii", "replace")  # comments may be in any encoding
        held = load_ply(io.BytesIO(head + end + body))
        faces, count = np.asarray(held["faces"]), len(held["vertices"])
        wrong = faces[(faces < 0) | (faces >= count)] if faces.dtype.kind in "iu" else faces[:0]
    except Exception:  # noqa: BLE001 - whatever this parser meets in a damaged file, Mitsuba's will report
        return None
    if not wrong.size:
        return None
    return f"{path} is damaged: a face names vertex {wrong.flat[0]}, and there are {count}"
