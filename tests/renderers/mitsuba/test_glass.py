"""Radiance's glass as a BSDF: how much goes straight through, and how much is reflected, at which angle."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits


def pane(*transmissivity, ior=1.52):
    colour = {"type": "rgb", "value": list(transmissivity)}
    return mi.load_dict({"type": "glasspane", "transmissivity": colour, "ior": ior})


def seen_at(*cosines):
    si = dr.zeros(mi.SurfaceInteraction3f, len(cosines))
    z = np.array(cosines, np.float32)
    si.wi = mi.Vector3f(np.sqrt(1 - z * z), 0, z)
    return si


def through(bsdf, *cosines):
    return np.array(bsdf.eval_null_transmission(seen_at(*cosines))).T


def test_usual_glass_transmits_what_the_manual_of_radiance_says():
    # Single glazing of transmissivity 0.96 transmits 0.88 at normal incidence.
    assert through(pane(0.96, 0.96, 0.96), 1.0)[0] == pytest.approx(0.88, abs=0.002)


def test_clear_glass_loses_nothing_and_is_a_mirror_at_grazing_angles():
    bsdf, cosines = pane(1, 1, 1), (1.0, 0.5, 0.1, 0.01)
    sample = dr.full(mi.Float, 0, 4)
    bs, weight = bsdf.sample(mi.BSDFContext(), seen_at(*cosines), sample, mi.Point2f(0.5))
    reflected = np.array(weight * bs.pdf).T
    assert reflected + through(bsdf, *cosines) == pytest.approx(1, abs=1e-5)
    # Two faces of 4.26 % each, and what goes to and fro.
    assert reflected[0] == pytest.approx(2 * 0.0426 / 1.0426, abs=1e-3)
    assert (reflected[3] > 0.9).all()


def test_absorption_grows_with_the_way_through_the_glass():
    # At 60 degrees the sine within is 0.866 / 1.52, and the way 1 / 0.8218 as long; so dark, nothing goes to and fro.
    darker, dark = through(pane(1e-4, 1e-4, 1e-4), 0.5)[0, 0], through(pane(1e-2, 1e-2, 1e-2), 0.5)[0, 0]
    assert dark / darker == pytest.approx(100 ** (1 / 0.8218), rel=1e-3)


def test_kernels_take_it_for_a_delta_dielectric():
    scene = mi.load_dict({"type": "scene", "s": {"type": "rectangle", "b": pane(0.9, 0.8, 0.7)}})
    bsdfs = BSDFTraits(scene)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 2), mi.Vector3f(0, 0, -1)))
    assert bsdfs.is_dielectric(si.bsdf(), mi.Bool(True))[0]
    assert np.array(si.bsdf().eval_null_transmission(si)).ravel() == pytest.approx(
        through(pane(0.9, 0.8, 0.7), 1.0).ravel()
    )
