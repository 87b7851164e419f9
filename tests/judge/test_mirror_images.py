"""Rods whose mirror image by the plane of the measurements fits as well."""

from __future__ import annotations

import numpy as np
import pytest
from kit.problems import IDEAL

import collocation_sysid as cs
from collocation_sysid.kinds.rod.doubts import mirror_images

LENGTH_M = 0.6
NATURAL = {"curvature_1_1_m": 1.0, "curvature_2_1_m": -1.5, "twist_1_m": 2.5}
KNOWN = {"torsion_n_m2": 3e-3, "axial_n": 200.0, "gamma_r_s": 6e-3, "gamma_m_1_s": 0.3}
BENDING = {"bending_n_m2": 4e-3}
PLACES_M = (0.15, 0.3, 0.45, 0.6)


def filmed(
    stated: dict[str, float], across: tuple[int, ...] = (), director: tuple[float, ...] = (0, 1, 0)
) -> cs.Problem:
    """A cable that is moved up and down, with markers in the plane x, z and some of them across it."""
    section = cs.CrossSection.round(0.006)
    mesh = cs.rod_mesh([[0, 0, 0], [LENGTH_M, 0, 0]], section, 13, [0.05], director)
    body = cs.Body(mesh, "cable", mass_kg=0.02, natural_curvature=True)
    t_s = np.linspace(0, 1, 41)
    moved_m = np.outer(0.05 * (1 - np.cos(2 * np.pi * t_s)), [0, 0, 1])
    hand = cs.PoseSequence(t_s, moved_m, np.tile([0, 0, 0, 1.0], (41, 1)))
    markers = cs.Markers(
        t_s, np.zeros((41, 4, 3)), 5e-4, places_m=[mesh.place_m(s_m) for s_m in PLACES_M]
    )
    experiment = cs.Experiment(
        body,
        t_s,
        [cs.Grasp(cs.Along(0, 0.05), hand)],
        markers,
        nuisance=IDEAL,
        air_density_kg_m3="none",
    )
    tracks_m = cs.simulate(experiment, KNOWN | BENDING | NATURAL).markers_m.copy()
    tracks_m += np.random.default_rng(3).normal(scale=5e-4, size=tracks_m.shape)
    unseen = [k for k in range(4) if k not in across]
    tracks_m[:, unseen, 1] = np.nan
    prior = (0.0, 0.5 / LENGTH_M)
    unknown = {name: cs.Unknown(0.0, prior=prior) for name in NATURAL.keys() - stated.keys()}
    unknown |= {"bending_n_m2": cs.Unknown(5e-3)}
    return cs.Problem([cs.with_markers(experiment, tracks_m)], KNOWN | unknown | stated)


@pytest.mark.long
@pytest.mark.parametrize("director", [(0, 1, 0), (0, 0.6, 0.8)])
def test_a_sign_that_markers_in_a_plane_do_not_determine_is_named(director):
    run = cs.run(filmed({}, director=director))
    assert run.trust.verdict == "check"
    (reason,) = (each for each in run.trust.reasons if "mirror image" in each)
    twist = run.solution.parameters["twist_1_m"]
    assert f"τ = {twist:.3g} 1/m, so that" in reason
    assert "state one of these natural curvatures, or measure a marker across the plane" in reason


@pytest.mark.long
@pytest.mark.parametrize("stated", ["curvature_2_1_m", "twist_1_m"])
def test_one_stated_curvature_determines_the_others(stated):
    run = cs.run(filmed({stated: NATURAL[stated]}))
    assert run.trust.verdict == "good"
    for name in NATURAL.keys() - {stated}:
        low, high = run.interval(name)
        assert low <= NATURAL[name] <= high


@pytest.mark.long
def test_a_marker_across_the_plane_determines_the_curvatures():
    run = cs.run(filmed({}, across=(3,)))
    assert run.trust.verdict == "good"
    for name, true in NATURAL.items():
        low, high = run.interval(name)
        assert low <= true <= high


def test_the_curvature_in_the_plane_leaves_the_mirror_image():
    """The curvature about d₁, the normal of the plane, is that of the mirror image, too."""
    solution = cs.solve(filmed({"curvature_1_1_m": NATURAL["curvature_1_1_m"]}))
    (found,) = mirror_images(solution, {})
    signs = [np.sign(solution.parameters[name]) for name in ("curvature_2_1_m", "twist_1_m")]
    assert [np.sign(float(each.split()[2])) for each in found.data["found"]] == [-s for s in signs]


def test_a_rod_whose_curvatures_are_known_has_no_mirror_image():
    assert not mirror_images(cs.solve(filmed(NATURAL)), {})
