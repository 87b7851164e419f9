"""A round body that is meshed as a square one of the same width, or the reverse."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.judge.bodies import with_other_section
from collocation_sysid.statistics.budget.shape_error import other_section

WIDTH_M, LENGTH_M = 0.02, 0.1
DENSITY_KG_M3 = 1000.0
TRUTH = {"young_pa": 5e5, "poisson": 0.4, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
LOADS = np.arange(6.0)
NOISE = 2e-3, 1e-4, 1e-4  # N, N m and m


def mesh(shape: str) -> cs.TetMesh:
    if shape == "square":
        return cs.box_mesh((WIDTH_M, WIDTH_M, LENGTH_M), (2, 2, 5))
    return cs.cylinder_mesh(WIDTH_M / 2, LENGTH_M, 2, 5)


def bent(shape: str, is_weighed: bool, pull: bool = False) -> cs.Experiment:
    """Rod that a bench bends at its lower end, or stretches, with the wrench of its clamp."""
    mass_kg = DENSITY_KG_M3 * np.pi / 4 * WIDTH_M**2 * LENGTH_M
    density = {"mass_kg": mass_kg} if is_weighed else {"density_kg_m3": DENSITY_KG_M3}
    keys: dict[str, Any] = {"element": "tet10", **density}
    body = cs.Body(mesh(shape), **keys)
    axis = 0.0 if shape == "round" else WIDTH_M / 2
    middle_m = np.array([axis, axis, LENGTH_M])
    wrench = cs.Wrench(LOADS, np.zeros((6, 6)), *NOISE[:2], point_m=middle_m)
    clamp = cs.Grasp(
        cs.Box((-1, -1, LENGTH_M - 1e-6), (1, 1, 1)), cs.PoseSequence.fixed(), wrench=wrench
    )
    shift_m = np.outer(np.linspace(0, 0.01, 6), [0, 0, -1.0] if pull else [1.0, 0, 0])
    bench = cs.PoseSequence(LOADS, shift_m, np.tile([0, 0, 0, 1.0], (6, 1)))
    tip = cs.Grasp(cs.Box((-1, -1, -1), (1, 1, 1e-6)), bench, axes="xyz" if pull else "x")
    below_m = np.array([[0, 0, -LENGTH_M], [WIDTH_M / 2, 0, -0.06], [0, WIDTH_M / 2, -0.03]])
    places_m = middle_m + below_m
    markers = cs.Markers(LOADS, np.zeros((6, 3, 3)), NOISE[2], places_m=places_m)
    exact: dict[str, Any] = {
        "nuisance": cs.Nuisance.none(),
        "air_density_kg_m3": "none",
        "kind": "static",
    }
    return cs.Experiment(body, LOADS, [clamp, tip], markers, **exact)


@cache
def fitted(shape: str, is_weighed: bool, pull: bool = False) -> cs.Run:
    """Run of a recording of a rod with the other section, as wide."""
    real = "round" if shape == "square" else "square"
    true = bent(real, False, pull)
    seen = cs.simulate(true, TRUTH)
    rng = np.random.default_rng(0)
    stated = bent(shape, is_weighed, pull)
    off_m = (WIDTH_M / 2 if shape == "square" else -WIDTH_M / 2) * np.array([1.0, 1.0, 0.0])
    tracks_m = seen.markers_m + off_m + NOISE[2] * rng.normal(size=seen.markers_m.shape)
    (loads,) = seen.wrenches
    loads = loads + rng.normal(size=(6, 6)) * np.repeat(NOISE[:2], 3)
    clamp, tip = stated.grasps
    assert clamp.wrench is not None
    clamp = replace(clamp, wrench=replace(clamp.wrench, values=loads))
    stated = replace(cs.with_markers(stated, tracks_m), grasps=[clamp, tip])
    return cs.run(cs.Problem([stated], TRUTH | {"young_pa": cs.Unknown(3e5)}))


@pytest.mark.long
def test_a_weight_that_contradicts_the_section_is_named():
    run = fitted("square", False)
    assert run.trust.verdict == "doubtful"
    assert "section of the body is round" in run.trust.reasons[0]


def test_a_section_of_the_same_width_has_another_volume():
    for shape, other, ratio in (("square", "round", np.pi / 4), ("round", "square", 4 / np.pi)):
        experiment = bent(shape, is_weighed=False)
        made = mesh(shape)
        known = other_section(made, made.points_m)
        assert known is not None
        assert known.name == other
        assert known.volume_ratio == pytest.approx(ratio, rel=0.06)
        changed = with_other_section(experiment)
        assert changed is not None
        reached = changed.body.mesh.volume_m3 / made.volume_m3
        assert reached == pytest.approx(known.volume_ratio, rel=1e-6)
        assert changed.body.mass_kg == pytest.approx(reached * experiment.body.mass_kg)
        assert len(changed.grasps[0].nodes) == len(experiment.grasps[0].nodes)


@pytest.mark.parametrize("size_m", [(0.02, 0.03, 0.1), (0.02, 0.02, 0.02)])
def test_only_straight_bodies_of_equal_widths_have_another_section(size_m):
    made = cs.box_mesh(size_m, (2, 2, 2))
    assert other_section(made, made.points_m) is None


def test_the_area_of_a_specimen_is_stated_as_what_moduli_refer_to():
    strain = np.linspace(0.01, 0.1, 6)
    keys: dict[str, Any] = {"length_m": 0.1, "area_m2": 4e-4}
    noise_pa = 100 * np.random.default_rng(0).normal(size=6)
    unknown = {"young_pa": cs.Unknown(), "poisson": 0.4}
    for stated in (keys, {}):
        specimen = cs.Specimen("uniaxial", strain, 1e5 * strain + noise_pa, 100.0, **stated)
        run = cs.run(cs.Problem([specimen.experiment("linear", "pull")], unknown))
        assert any("area_m2" in line for line in run.result.basis) == bool(stated)
