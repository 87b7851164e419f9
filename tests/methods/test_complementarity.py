"""Contact as complementarity, the limit of increasingly stiff contact energies."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.checks import observed_order
from kit.problems import nodes_where

import collocation_sysid as cs
from collocation_sysid.methods.complementarity import RELAXED
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.solution import Solution
from collocation_sysid.model.contact.force import contact_terms
from collocation_sysid.recording import Experiment
from collocation_sysid.runs.forward_simulation import ForwardSimulation, simulate_experiment

TRUTH = {"young_pa": 1e4, "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 0.3}
STIFFER = np.array([1.0, 10.0])
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
UP = np.array([0.0, 0.0, 1.0])


def along_z(t_s: np.ndarray, way_m: np.ndarray) -> cs.PoseSequence:
    return cs.PoseSequence(t_s, np.outer(way_m, [0.0, 0.0, 1.0]), np.tile(UPRIGHT, (len(t_s), 1)))


def pressed(shape: cs.Plane | cs.Sphere, **changes) -> Experiment:
    """A block that something comes down on, and whose force is measured."""
    body = cs.Body(cs.box_mesh((0.06, 0.06, 0.03), (2, 2, 1)), density_kg_m3=50.0)
    t_s = np.arange(3.0)
    held = cs.Grasp(nodes_where(body, 2, 0.0), cs.PoseSequence.fixed())
    comes = cs.Obstacle(
        shape=shape,
        poses=along_z(t_s, -np.array([-0.0005, 0.001, 0.003])),
        name="plate",
        wrench=cs.Wrench(t_s, np.zeros((3, 3)), 1e-3),
    )
    still = {"kind": "static", "gravity_m_s2": (0.0, 0.0, 0.0), "nuisance": cs.Nuisance.none()}
    return Experiment(body, t_s, [held, replace(comes, **changes)], None, name="press", **still)


def let_down() -> Experiment:
    """A block that a gripper sets on a table."""
    body = cs.Body(cs.box_mesh((0.05, 0.05, 0.05), (1, 1, 2)), density_kg_m3=100.0)
    t_s = np.linspace(0.0, 0.3, 13)
    held = cs.Grasp(
        nodes_where(body, 2, 0.05), along_z(t_s, -0.002 * (1 - np.cos(np.pi * t_s / 0.3)))
    )
    table = cs.Obstacle(shape=cs.Plane(UP, -0.002 * UP), name="table")
    seen = cs.Markers(t_s, np.zeros((13, 1, 3)), 1e-3, places_m=[[0.05, 0.05, 0.025]])
    still = {"start": "undeformed", "nuisance": cs.Nuisance.none()}
    return Experiment(body, t_s, [held, table], seen, name="set down", **still)


MADE = {"plane": lambda: pressed(cs.Plane(-UP, 0.03 * UP)), "let down": let_down}


def stiffer(experiment: Experiment, factor: float) -> Experiment:
    """With κ so much larger, and δ smaller: at the same pressure the gap is zero."""
    edges = [each.contact_surface(experiment.body).edge_m for each in experiment.obstacles]
    return experiment.with_obstacles(
        [
            replace(
                each,
                stiffness_pa_m=factor * 100 * TRUTH["young_pa"] / edge_m,
                width_m=0.002 * edge_m / factor,
            )
            for each, edge_m in zip(experiment.obstacles, edges, strict=True)
        ]
    )


def seen(experiment: Experiment) -> Experiment:
    """With what its instruments read."""
    motion = cs.simulate(experiment, TRUTH, "bdf2", substeps=1)
    ours = experiment.obstacles[0]
    if ours.wrench is None:
        return cs.with_markers(experiment, motion.markers_m)
    felt = replace(ours.wrench, values=motion.wrenches[-1][:, :3])
    return experiment.with_obstacles([replace(ours, wrench=felt)])


def solved(experiment: Experiment, parameters: cs.Parameters | None = None) -> Solution:
    known = parameters or cs.Parameters.from_mapping(TRUTH)
    problem = cs.Problem([seen(experiment)], known, scheme="bdf2")
    return InteriorPoint(contact="complementarity")(problem.collocation())


@cache
def answered(name: str) -> tuple[Experiment, Solution]:
    experiment = MADE[name]()
    return experiment, solved(experiment)


@pytest.mark.long
@pytest.mark.parametrize("name", MADE)
def test_complementarity_is_the_limit_of_ever_stiffer_energies(name: str):
    experiment, answer = answered(name)
    assert answer.status.converged
    (hard,) = answer.positions_m
    own = slice(len(experiment.body.mesh.points_m))
    apart_m = []
    for factor in STIFFER:
        motion = cs.simulate(stiffer(experiment, factor), TRUTH, "bdf2", substeps=1)
        apart_m.append(np.abs(motion.positions_m - hard)[:, own].max())
    assert apart_m[-1] < 1e-5
    assert observed_order(1 / STIFFER, apart_m) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("name", ["plane", pytest.param("let down", marks=pytest.mark.long)])
def test_nothing_is_entered_and_pressure_times_gap_is_small(name: str):
    experiment, answer = answered(name)
    (hard,) = answer.positions_m
    hard = hard.reshape(len(hard), -1)
    (term,) = contact_terms(experiment)
    gaps = term.law_of_contact.gaps(term.points.vectors(hard))
    assert gaps.min() >= -1e-9
    relaxed = experiment.with_obstacles(
        [replace(each, relaxed=RELAXED[-1]) for each in experiment.obstacles]
    )
    (term,) = contact_terms(relaxed)
    product_m2 = term.scaled_pressures(hard)[0] * gaps
    assert product_m2.max() <= 1.000001 * RELAXED[-1] * term.law_of_contact.largest_width_m**2
    assert np.any(term.scaled_pressures(hard) > 0.01 * term.law_of_contact.largest_width_m)


@pytest.mark.long
def test_a_stiffness_is_that_of_an_ever_stiffer_energy():
    unknown = cs.Parameters.from_mapping({**TRUTH, "young_pa": cs.Unknown(7e3)})
    poked = stiffer(pressed(cs.Sphere(0.03, (0.03, 0.03, 0.06))), 10.0)
    answer = solved(poked, unknown)
    assert answer.status.converged
    assert answer.parameters["young_pa"] == pytest.approx(TRUTH["young_pa"], rel=5e-3)


def test_friction_is_refused():
    rough = pressed(cs.Plane(-UP, 0.03 * UP), friction=0.3)
    with pytest.raises(
        cs.InputError, match='plate has friction, which contact = "complementarity"'
    ):
        solved(rough)


def test_friction_of_a_recording_for_validation_is_simulated_by_the_contacts_energy():
    smooth, answer = answered("plane")
    rough = seen(pressed(cs.Plane(-UP, 0.03 * UP), friction=0.3))
    predicted = replace(rough, name="rubbed", validation=True)
    hard = InteriorPoint(contact="complementarity")
    problem = cs.Problem([seen(smooth), predicted], TRUTH, scheme="bdf2", method=hard)
    simulated = simulate_experiment(problem, answer, predicted)
    assert isinstance(simulated, ForwardSimulation), simulated
    assert simulated.rms_m < 1e-4
