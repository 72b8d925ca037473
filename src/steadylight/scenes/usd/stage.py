"""Opens a USD stage: allows only files in the scene's folder, finds units and axes, and explains USD's errors."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.description import Note
from steadylight.scenes.world import Z_UP

_MOST_LAYERS: Final = 10_000
_REPORTED: Final = re.compile(r"Error in '.*?' at line \d+ in file \S+ : '(.*?)'\s*(?:$|(?=\n))", re.DOTALL)
_OWN_NAMES: Final = re.compile(r"pxrInternal_v\w+?__pxrReserved__::|Sdf_TextFileFormatParser::")


def explain(error: Exception) -> str:
    """USD's error message in one line, without the names of its source files."""
    text = str(error)
    found = _REPORTED.findall(text) or [text]
    line = " ".join(_OWN_NAMES.sub("", found[0]).split())
    return line if len(line) < 400 else f"{line[:400]} ..."


@dataclass
class Assets:
    """The files that a scene refers to.

    Attributes:
        path: the scene file.
        outside: whether files outside its folder may be read.
        folder: that folder, or None for that of `path`.
        passing: a temporary folder, whose files are read as bytes.
        missing: files that were not found, and where they are named.
        hashes: SHA-256 of the files that the description names, by absolute path.
    """

    path: Path
    outside: bool
    folder: Path | None = None
    passing: Path | None = None
    missing: list[str] = field(default_factory=list)
    hashes: dict[str, str] = field(default_factory=dict)
    _packed: dict[str, NDArray[np.uint8]] = field(default_factory=dict)

    def check(self, resolved: str, where: str) -> None:
        """Refuse a file outside the scene's folder; `resolved` may name a file within a package (usdz)."""
        from pxr import Ar

        file = Path(Ar.SplitPackageRelativePathOuter(resolved)[0])
        real = file.resolve()
        allowed = (self.folder or self.path.parent, self.passing)
        if self.outside or any(
            real.is_relative_to(folder.resolve()) for folder in allowed if folder is not None
        ):
            return
        raise SceneError(
            f"{self.path}: {where} refers to {file}, outside the scene's folder; move it there, or allow it with "
            "--allow-outside"
        )

    def source(self, asset: Any, where: str, *, named: bool = True) -> NDArray[np.uint8] | str | None:
        """The file that an attribute names: its absolute path, or its bytes if it is in a package; None if missing.

        Args:
            asset: the attribute's value.
            where: name of the attribute's owner in messages.
            named: whether the description will name the file.
        """
        from pxr import Ar

        resolved = str(asset.resolvedPath)
        if not resolved:
            self.missing.append(f"{asset.path} ({where})")
            return None
        self.check(resolved, where)
        passing = self.passing is not None and Path(resolved).is_relative_to(self.passing)
        if not Ar.IsPackageRelativePath(resolved) and not passing:
            return self.named(Path(resolved), where) if named else resolved
        if resolved not in self._packed:
            opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
            if not opened:
                raise SceneError(f"{self.path}: {where}: {asset.path} cannot be read from its package")
            self._packed[resolved] = np.frombuffer(opened.GetBuffer(), np.uint8)
        return self._packed[resolved]

    def named(self, file: Path, where: str) -> str:
        """Hash a file that the description names, and return its path."""
        name = str(file.resolve())
        if name not in self.hashes:
            try:
                with Path(name).open("rb") as stream:
                    self.hashes[name] = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                raise SceneError(f"{self.path}: {where}: {file} cannot be read: {error.strerror}") from None
        return name

    def refuse_missing(self) -> None:
        """Raise one error for all files that were not found."""
        if self.missing:
            raise SceneError(f"{self.path}: files are missing: {'; '.join(sorted(set(self.missing)))}")


@dataclass(frozen=True)
class Stage:
    """An open stage.

    Attributes:
        stage: USD's object for it.
        assets: files of the scene.
        to_ours: (4, 4) from the stage's world to ours: z up, metres.
        unit: metres per unit of length of the stage.
        start: time code at which everything except the camera is read.
        blender: version of Blender that wrote the file, or None.
    """

    stage: Any
    assets: Assets
    to_ours: NDArray[np.float64]
    unit: float
    start: Any
    blender: str | None

    def world(self, prim: Any, time: Any = None) -> NDArray[np.float64]:
        """Matrix from a prim's own frame to our world, (4, 4), metres."""
        from pxr import UsdGeom

        local = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(self.start if time is None else time)
        return self.to_ours @ matrix_of(local)


def matrix_of(matrix: Any) -> NDArray[np.float64]:
    """USD's matrix (for row vectors) as one for column vectors, (4, 4)."""
    return np.array(matrix, dtype=np.float64).reshape(4, 4).T


def label(prim: Any) -> str:
    """Name of a prim for messages: its name in the modelling program if the file has it, otherwise its path."""
    for holder in (prim.GetParent(), prim):
        attribute = holder.GetAttribute("userProperties:blender:object_name")
        if attribute and isinstance(attribute.Get(), str):
            return str(attribute.Get())
    return str(prim.GetPath())


def open_stage(assets: Assets, file: Path | None = None) -> tuple[Stage, list[Note]]:
    """Open a stage with all its references and payloads.

    Args:
        assets: the scene's.
        file: the stage, if it is not the scene's own file.

    Raises:
        SceneError: a file is damaged, missing, or outside the scene's folder.
    """
    from pxr import Tf, Usd

    path = assets.path
    try:
        _check_layers(file or path, assets)
        assets.refuse_missing()
        stage = Usd.Stage.Open(str(file or path), Usd.Stage.LoadAll)
    except (Tf.ErrorException, RuntimeError) as error:
        raise SceneError(f"{path}: USD cannot read it: {explain(error)}") from None
    notes = [Note("warning", "references", _sentence(str(error))) for error in stage.GetCompositionErrors()]
    to_ours, unit, more = _frame(path, stage)
    comment = str(stage.GetRootLayer().documentation or "")
    found = re.match(r"Blender v([\d.]+)", comment)
    start = (
        Usd.TimeCode(stage.GetStartTimeCode())
        if stage.HasAuthoredTimeCodeRange()
        else Usd.TimeCode.EarliestTime()
    )
    opened = Stage(stage, assets, to_ours, unit, start, found[1] if found else None)
    refuse_outside(opened)
    return opened, notes + more


def refuse_outside(stage: Stage) -> None:
    """Refuse open layers that are outside the scene's folder.

    Raises:
        SceneError: there is such a layer.
    """
    for layer in stage.stage.GetUsedLayers():
        if layer.realPath:
            stage.assets.check(layer.realPath, "the scene")


def _sentence(text: str) -> str:
    return " ".join(text.split()).rstrip(".")


def _check_layers(path: Path, assets: Assets) -> None:
    """Check every layer that references, payloads and sublayers name, before the stage opens any of them."""
    from pxr import Ar, Sdf

    pending, seen = [(str(path), "")], set()
    while pending:
        name, where = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        if len(seen) > _MOST_LAYERS:
            raise SceneError(f"{path}: refers to more than {_MOST_LAYERS:,} files")
        resolved = str(Ar.GetResolver().Resolve(name))
        if not resolved:
            assets.missing.append(f"{name} ({where})")
            continue
        assets.check(resolved, where or "the scene")
        layer = Sdf.Layer.FindOrOpen(name)
        if not layer:
            raise SceneError(f"{path}: {name} cannot be read")
        own = Path(layer.identifier).name
        named = sorted(layer.GetCompositionAssetDependencies())
        pending.extend(
            (Sdf.ComputeAssetPathRelativeToLayer(layer, asset), own)
            for asset in named
            if asset and not asset.startswith(("`", "anon:"))
        )


def _frame(path: Path, stage: Any) -> tuple[NDArray[np.float64], float, list[Note]]:
    """Transform to our axes and unit, the stage's unit in metres, and notes."""
    from pxr import UsdGeom

    notes = []
    unit = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not (np.isfinite(unit) and unit > 0):
        raise SceneError(f"{path}: metersPerUnit is {unit:g}; it must be greater than 0")
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        text = "is not given, so lengths are in centimetres, as USD prescribes"
        notes.append(Note("warning", "metersPerUnit", text))
    up = str(UsdGeom.GetStageUpAxis(stage))
    axes = Z_UP if up == "Y" else np.eye(4)
    return axes @ np.diag([unit, unit, unit, 1.0]), unit, notes
