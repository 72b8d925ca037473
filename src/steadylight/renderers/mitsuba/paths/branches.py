"""The branches of a camera path: from some surfaces it continues in several directions, one after the other.

Each branch begins again at the camera, with the same ray. The surface that the camera sees, directly or through clear
glass, is the *primary* surface. Branch 0 is transmitted by every delta dielectric on its way, branch 1 is reflected by
the first of them, branch 2 by the second, and so on. The next branches leave a glossy primary surface in further
directions. If an emitter is near, a last branch leaves the diffuse base under a specular layer.

Random numbers belong to branch and vertex, so branches are independent of each other: a kernel that omits some of them
(the audit does not look for emitters) follows the others exactly as the frame does.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from steadylight.cache.lookup import ANSWERED
from steadylight.renderers.mitsuba.bsdf.lobes import GLOSSY_FLAGS, MOST_DIELECTRICS, BSDFTraits, DiffuseLobe
from steadylight.renderers.mitsuba.light.emitters import NO_ROW
from steadylight.renderers.mitsuba.quality import ShadingQuality
from steadylight.renderers.mitsuba.records.lookup import DeviceAnswer, DeviceCache
from steadylight.renderers.mitsuba.sampling import (
    Draw,
    Purpose,
    Samples,
    VertexSamples,
    roulette,
    spread,
)

PARTED = 0xFFFFFFFF
"""Value of `Branches.shared` after the branch has departed from the path of branch 0."""

MANY = 0.1
"""`negligible` where a pixel takes many samples: glossy chains of throughput below a tenth took half of their time."""

UNSCATTERED = 1e-3
"""`negligible` for paths of panes and mirrors alone."""


class PathLimits:
    """How far camera paths are followed. Not a dataclass: kernels read it, but it is not one of their loop variables.

    Attributes:
        depth: maximum number of non-diffuse interactions.
        glossy_branches: directions sampled from the BSDF of a glossy primary surface; later surfaces have one.
        sky_directions: directions in which a rough layer over a diffuse base looks for the cached sky.
        negligible: throughput below which Russian roulette applies to scattered paths.
        faint: share of the sample below which surfaces seen by glossy reflection look up no records; 0: all do.
        secondary: the secondary cache, which such surfaces look up in a frame; None if there is none.
        first_row: row of the first record of `secondary` in the emitter table.
        recorded: whether records are looked up; if not, `secondary` is used for all surfaces beyond the first.
    """

    def __init__(self, depth: int, quality: ShadingQuality) -> None:
        self.depth = dr.opaque(mi.UInt32, depth)
        self.faint, self.first_row = dr.opaque(mi.Float, 0), dr.opaque(mi.UInt32, 0)
        self.secondary: DeviceCache | None = None
        self.recorded = True
        self.glossy_branches = dr.opaque(mi.UInt32, quality.glossy_samples)
        self.sky_directions = dr.opaque(mi.UInt32, quality.sky_samples)
        self.negligible = dr.opaque(mi.Float, quality.negligible)

    def asking(self, faint: float) -> PathLimits:
        """A copy with another bound `faint`."""
        limits = copy.copy(self)
        limits.faint = dr.opaque(mi.Float, faint)
        return limits

    def answered(self, secondary: DeviceCache, first_row: int) -> PathLimits:
        """A copy with a secondary cache for faint surfaces; see the attributes."""
        limits = copy.copy(self)
        limits.secondary, limits.first_row = secondary, dr.opaque(mi.UInt32, first_row)
        return limits

    def unrecorded(self, *, many: bool = False) -> PathLimits:
        """A copy for paths that were not audited: no records are looked up.

        Args:
            many: the pixel takes so many samples that each continues in one direction only.
        """
        limits = copy.copy(self)
        limits.recorded = False
        if many:
            limits.glossy_branches = dr.opaque(mi.UInt32, 1)
            limits.negligible = dr.opaque(mi.Float, MANY)
        return limits

    def state(self) -> list[object]:
        """All that a kernel reads through this object, or that is compiled into it, for `frozen`."""
        known = [] if self.secondary is None else self.secondary.arrays()
        numbers = (self.depth, self.glossy_branches, self.sky_directions, self.negligible)
        return [*numbers, self.faint, self.first_row, known, self.recorded]

    def answer(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        diffuse: DiffuseLobe,
        numbers: VertexSamples,
        faint: mi.Bool,
    ) -> DeviceAnswer:
        """Irradiance of a surface seen faintly by glossy reflection, from one visible record of the secondary cache.

        As in a gather, a record is used only if the last ray is longer than its radius: over shorter distances, light
        varies faster than such coarse records resolve. If `recorded` is false, it is used in any case.

        Args:
            scene: for visibility of the record.
            si: the surface.
            diffuse: its diffuse lobe.
            numbers: random numbers of the vertex.
            faint: lanes that need it.

        Returns:
            Its irradiance, and its row in the emitter table; black and NO_ROW if no record is used.
        """
        if self.secondary is None:
            return DeviceAnswer(mi.Color3f(0), mi.Float(0), mi.UInt32(NO_ROW))
        number = numbers.sample_1d(Purpose.RECORD)
        said = self.secondary.draw_in_sight(scene, si.p, diffuse.normal, number, faint, diffuse.facing)
        answers = said.weight >= ANSWERED
        if self.recorded:
            answers &= si.t > self.secondary.radius_of(said.row)
        row = dr.select(answers, self.first_row + said.row, NO_ROW)
        return DeviceAnswer(dr.select(answers, said.irradiance, 0), said.weight, row)


@dataclass
class CameraPath:
    """State of a path: variables of a kernel's loop.

    Attributes:
        ray: to the next vertex.
        throughput: of the lobes that are not served by the cache.
        ways: number of directions among which the throughput was divided at the primary surface; 1 if undivided.
        clear: whether all interactions so far were specular: reflection or transmission without scattering.
        depth: vertices of this branch so far.
        active: whether the path continues.
        camera_ray: first ray of every branch.
    """

    ray: mi.Ray3f
    throughput: mi.Color3f
    ways: mi.Float
    clear: mi.Bool
    depth: mi.UInt32
    active: mi.Bool
    camera_ray: mi.Ray3f

    @classmethod
    def begin(cls, ray: mi.Ray3f) -> CameraPath:
        """At the camera."""
        one, clear, depth, active = mi.Float(1), mi.Bool(True), mi.UInt32(0), mi.Bool(True)
        return cls(mi.Ray3f(ray), mi.Color3f(1), one, clear, depth, active, mi.Ray3f(ray))

    def is_faint(self, limits: PathLimits, margin: float = 1.0) -> mi.Bool:
        """Whether the next vertex is seen faintly by glossy reflection, and the path may continue beyond it.

        Its share of the sample is the throughput of all `ways` together. The path may need one more vertex, since the
        secondary cache may have no record for this one.

        Args:
            limits: contains the bound `faint`.
            margin: factor on that bound.
        """
        share = self.ways * dr.max(dr.abs(self.throughput))
        return ~self.clear & (share < margin * limits.faint) & (self.depth < limits.depth)

    def roulette(self, numbers: VertexSamples, negligible: mi.Float) -> None:
        """Apply Russian roulette to paths of negligible throughput.

        A path of specular interactions alone adds no noise, and behind dark glass it may be all that a pixel shows, so
        it is followed much further, to `UNSCATTERED`.

        Args:
            numbers: random numbers of the current vertex.
            negligible: throughput below which other paths may end; the throughput of survivors is raised to it.
        """
        least = dr.select(self.clear, mi.Float(UNSCATTERED), negligible)
        survival = dr.minimum(dr.max(dr.abs(self.throughput)) / least, 1)
        self.throughput, self.active = roulette(numbers, self.throughput, survival, self.active)


@dataclass
class Branches:
    """State of the branching of a path: variables of a kernel's loop.

    Attributes:
        number: of the current branch.
        pending: number of branches still to come.
        shared: delta dielectrics passed so far, if all interactions were those of branch 0; else PARTED.
    """

    number: mi.UInt32
    pending: mi.UInt32
    shared: mi.UInt32

    @classmethod
    def begin(cls) -> Branches:
        """The first branch."""
        return cls(mi.UInt32(0), mi.UInt32(0), mi.UInt32(0))

    def fresh(self) -> mi.Bool:
        """Whether no earlier branch has met the next vertex."""
        return self.shared >= self.number

    def primary(self, depth: mi.UInt32) -> mi.Bool:
        """Whether the next vertex is what the camera sees, directly or through delta dielectrics."""
        return depth == self.shared

    def numbers(self, samples: Samples, depth: mi.UInt32) -> VertexSamples:
        """Random numbers of the next vertex."""
        return samples.at(self.number, depth)

    def draw(self, samples: Samples, depth: mi.UInt32, ways: mi.UInt32, split: mi.Bool) -> Draw:
        """Random numbers of the direction in which the path leaves the next vertex.

        If it continues in several directions, each branch samples its own stratum of the unit square: 16 samples of
        four directions are nearly as well stratified as 64 samples.

        Args:
            samples: random numbers of the camera rays.
            depth: vertices of this branch so far.
            ways: number of directions from a primary surface, where `split`.
            split: lanes that continue in several directions.
        """
        lobe = self.numbers(samples, depth).sample_1d(Purpose.LOBE)
        place = samples.at(dr.select(split, mi.UInt32(0), self.number), depth).sample_2d(Purpose.DIRECTION)
        # Branches between the first and these were reflected by the delta dielectrics on the way here.
        way = dr.select(self.number == 0, mi.UInt32(0), self.number - self.shared)
        return Draw(lobe, dr.select(split, spread(place, way, dr.rcp(mi.Float(ways))), place))

    def add(self, branches: int, where: mi.Bool) -> None:
        """Request further branches; only the first branch can."""
        self.pending = self.pending + dr.select(where & (self.number == 0), mi.UInt32(branches), 0)

    def at_dielectric(self, bsdfs: BSDFTraits, bsdf: mi.BSDFPtr, active: mi.Bool) -> tuple[mi.Bool, mi.Bool]:
        """Whether a surface is a delta dielectric where the path branches, and whether it reflects this branch."""
        if bsdfs.dielectric is None:
            return mi.Bool(False), mi.Bool(False)
        dielectric = active & (self.shared < MOST_DIELECTRICS) & bsdfs.is_dielectric(bsdf, active)
        self.add(1, dielectric)
        return dielectric, dielectric & (self.number == self.shared + 1)

    def at_gloss(self, bsdfs: BSDFTraits, flags: mi.UInt32, ways: mi.UInt32, where: mi.Bool) -> mi.Bool:
        """Whether a primary surface has a glossy lobe where the path branches; requests its branches.

        Args:
            bsdfs: of the scene.
            flags: of the lobes of the surface.
            ways: number of directions.
            where: lanes at a primary surface that the path does not leave by its specular layer alone.
        """
        split = where & ((flags & GLOSSY_FLAGS) != 0) & bsdfs.glossy
        self.add(ways - 1, split)
        return split

    def leave(self, bsdfs: BSDFTraits, path: CameraPath, dielectric: mi.Bool, reflected: mi.Bool) -> mi.Bool:
        """Continue at the next vertex, or with the next branch if the path has ended.

        Args:
            bsdfs: of the scene.
            path: with the ray to the next vertex; restarted if it has ended and a branch is pending.
            dielectric: whether the vertex is a delta dielectric where the path branches.
            reflected: ... and reflects this branch.

        Returns:
            Lanes that begin the next branch.
        """
        path.depth = path.depth + 1
        self.shared = dr.select(dielectric & ~reflected, self.shared + 1, PARTED)
        if not bsdfs.branching:
            return mi.Bool(False)
        restart = ~path.active & (self.pending > 0)
        # Count here, not at the surface: on an edge, the same ray may hit another surface the second time.
        self.pending = dr.select(restart, self.pending - 1, self.pending)
        self.number = dr.select(restart, self.number + 1, self.number)
        self.shared = dr.select(restart, 0, self.shared)
        path.ray = dr.select(restart, path.camera_ray, path.ray)
        path.throughput = dr.select(restart, mi.Color3f(1), path.throughput)
        path.ways = dr.select(restart, mi.Float(1), path.ways)
        path.clear = path.clear | restart
        path.depth = dr.select(restart, mi.UInt32(0), path.depth)
        path.active = path.active | restart
        return restart
