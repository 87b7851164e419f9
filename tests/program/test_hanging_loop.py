"""Loops of wire that hang between two clamps, drawn in a photograph.

The drawn shapes are those of a plane chain of bars with springs between them: another model of the
same wire, solved for the angles of the bars.
"""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.selection import Along
from collocation_sysid.judge.modes import find_misspecifications_by_modes
from collocation_sysid.program.markers.association import MarkerAssociation

BENDING_N_M2, MASS_PER_LENGTH_KG_M, LENGTH_M, BARS = 1e-3, 0.025, 1.2, 240
GAP_M = np.array([-0.12, 0.0])
OTHERS = {"torsion_n_m2": 1e-3, "axial_n": 100.0, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


def chain_loop(directions_rad: tuple[float, float], curvature_1_m: np.ndarray) -> np.ndarray:
    """Ends of the bars (BARS + 1, 2) of a loop between clamps, in a plane with z up, with a natural
    curvature (BARS + 1,) at the springs.
    """
    h = LENGTH_M / BARS
    weight_n = MASS_PER_LENGTH_KG_M * 9.81 * h * (BARS - np.arange(BARS) - 0.5)
    spring = np.full(BARS + 1, BENDING_N_M2 / h)
    spring[[0, -1]] *= 2  # half a bar from the clamp
    angles = np.linspace(*directions_rad, BARS + 2)[1:-1]
    force_n = np.zeros(2)
    for _ in range(400):
        bend = np.diff(angles, prepend=directions_rad[0], append=directions_rad[1])
        share = np.full(BARS + 1, h)
        share[[0, -1]] /= 2
        moment = spring * (bend - curvature_1_m * share)
        c, s = np.cos(angles), np.sin(angles)
        slope = moment[:-1] - moment[1:] + h * weight_n * c + h * (force_n @ [-s, c])
        gap = h * np.array([c.sum(), s.sum()]) - GAP_M
        matrix = np.diag(spring[:-1] + spring[1:] - h * weight_n * s - h * (force_n @ [c, s]))
        matrix -= np.diag(spring[1:-1], 1) + np.diag(spring[1:-1], -1)
        coupling = h * np.array([-s, c])
        complete = np.block([[matrix, coupling.T], [coupling, np.zeros((2, 2))]])
        step = np.linalg.solve(complete, -np.append(slope, gap))
        share_of_step = min(1.0, 0.1 / np.abs(step[:BARS]).max())
        angles, force_n = (
            angles + share_of_step * step[:BARS],
            force_n + share_of_step * step[BARS:],
        )
        if np.abs(step[:BARS]).max() < 1e-10:
            break
    bars = h * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.vstack([np.zeros(2), np.cumsum(bars, axis=0)])


def in_space(plane_m: np.ndarray) -> np.ndarray:
    return np.column_stack([plane_m[:, 0], np.zeros(len(plane_m)), plane_m[:, 1]])


def drawn_problem(
    loop_m: np.ndarray, parts: int, sigma_m: float, clamp_rad: float | None
) -> cs.Problem:
    """EI from the points (k, 3) of a drawing, without correspondence to places on the wire."""
    mesh = cs.rod_mesh(
        loop_m,
        cs.CrossSection.round(0.003),
        sections=61,
        first_director=[0.0, 1.0, 0.0],
        is_straight_at_rest=True,
    )
    cells = np.array_split(np.arange(len(mesh.tetrahedra)).reshape(-1, 3), parts) if parts else []
    body = Body(
        mesh,
        "cable",
        mass_kg=MASS_PER_LENGTH_KG_M * mesh.s_m[-1],
        regions=[cs.Region(f"part{k}", each.ravel()) for k, each in enumerate(cells)],
        natural_curvature=parts > 0,
    )
    still = np.eye(4)[None]
    ends = (Along(0.0, 0.0), Along(mesh.s_m[-1], mesh.s_m[-1]))
    drawn_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(loop_m, axis=0), axis=1)))
    places = [mesh.place_m(s) for s in (drawn_m * mesh.s_m[-1] / drawn_m[-1])[1:-1]]
    seen_m = loop_m[1:-1].copy()
    seen_m[:, 1] = np.nan
    markers = cs.Markers([0.0], seen_m[None], sigma_m, places_m=places, places_sigma_m=0.01)
    experiment = cs.Experiment(
        body,
        [0.0],
        [cs.Grasp(end, still) for end in ends],
        markers,
        kind="static",
        name="loop",
        nuisance=cs.Nuisance.none(clamp_turn_rad=clamp_rad),
        air_density_kg_m3="none",
    )
    parameters = OTHERS | {"bending_n_m2": cs.Unknown(0.7e-3)}
    for k in range(parts):
        parameters |= {f"part{k}.curvature_2_1_m": 0.0, f"part{k}.twist_1_m": 0.0}
        parameters[f"part{k}.curvature_1_1_m"] = cs.Unknown(0.0, prior=(0.0, 2.0))
    return cs.Problem([experiment], parameters)


@pytest.mark.parametrize("stretch", [1.0, 1.3])
def test_a_straight_wire_finds_its_equilibrium_from_a_drawn_loop(stretch):
    """Also from a drawing that is far from the equilibrium."""
    loop_m = in_space(chain_loop((-0.3, -6.0), np.zeros(BARS + 1)))[::6]
    drawn_m = loop_m * [stretch, 1.0, 1 / stretch]
    drawn_m[:, 0] += (loop_m[-1, 0] - drawn_m[-1, 0]) * np.linspace(0, 1, len(loop_m))
    (experiment,) = drawn_problem(drawn_m, 0, 1e-3, None).experiments
    shape_m = cs.simulate(experiment, OTHERS | {"bending_n_m2": BENDING_N_M2}).markers_m[0]
    away_m = np.abs(shape_m - loop_m[1:-1]).max()
    assert away_m < 2e-3 if stretch == 1 else np.abs(shape_m[:, 1]).max() < 1e-9


def test_places_of_drawn_points_move_smoothly_from_one_element_to_the_next():
    loop_m = in_space(chain_loop((-0.3, -6.0), np.zeros(BARS + 1)))[::6]
    (experiment,) = drawn_problem(loop_m, 0, 1e-3, None).experiments
    association = MarkerAssociation.from_experiment(experiment)
    mesh, nodes_m = experiment.body.mesh, experiment.body.nodes_m
    assert isinstance(mesh, cs.RodMesh)
    stated_m = mesh.nearest_s_m(association.prior_places_m)
    section = np.searchsorted(mesh.s_m, stated_m)
    coordinates = (mesh.s_m[section] - stated_m)[:, None] / 0.01
    points = []
    for side in (-1e-9, 1e-9):
        moved, same = association.follow_estimates(coordinates + side)
        np.testing.assert_array_equal(moved.cells, section - (side < 0))
        np.testing.assert_allclose(same, coordinates + side, atol=1e-12)
        nodes, shape = moved.shape_functions(same)
        points.append([np.einsum("ma...,mai->mi...", w, nodes_m[nodes]) for w in shape[:2]])
    np.testing.assert_allclose(points[0][0], mesh.centres_of_sections_m[section], atol=1e-10)
    np.testing.assert_allclose(points[1][0], points[0][0], atol=1e-10)
    np.testing.assert_allclose(points[1][1], points[0][1], atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(points[0][1], axis=1), 0.01, rtol=0.01)


def test_stiffness_factors_scale_the_energy_of_a_rod():
    loop_m = in_space(chain_loop((-0.3, -6.0), np.zeros(BARS + 1)))[::6]
    body = drawn_problem(loop_m, 0, 1e-3, None).bodies[0]
    constants = OTHERS | {"bending_n_m2": BENDING_N_M2}
    stiffer = body.with_stiffness_factors(np.full(len(body.cells), 1.3))
    expected = 1.3 * body.energy(body.nodes_m, **constants)
    assert stiffer.energy(body.nodes_m, **constants) == pytest.approx(expected, rel=1e-9)


def test_a_photograph_without_depth_is_judged():
    loop_m = in_space(chain_loop((-0.3, -6.0), np.zeros(BARS + 1)))[::6]
    (experiment,) = drawn_problem(loop_m, 0, 1e-3, None).experiments
    constants = OTHERS | {"bending_n_m2": BENDING_N_M2}
    assert find_misspecifications_by_modes(experiment, constants) == ()


def test_uniform_natural_curvature_does_not_change_a_loop_between_clamps():
    straight, curved = (chain_loop((-0.3, -6.0), np.full(BARS + 1, each)) for each in (0.0, -6.0))
    np.testing.assert_allclose(curved, straight, atol=1e-8)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bending_stiffness_is_in_its_interval_with_unknown_curvature_and_clamps(seed):
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, BARS + 1)
    waves = np.array([np.cos(np.pi * k * s) for k in range(1, 6)])
    curvature = -6.0 + rng.normal(0, 1.0, 5) @ waves
    plane_m = chain_loop((-0.3 + rng.normal(0, 0.2), -6.0 + rng.normal(0, 0.2)), curvature)
    places = np.clip(np.linspace(0, BARS, 41) + rng.normal(0, 1.0, 41), 0, BARS)
    places[[0, -1]] = 0, BARS
    drawn_m = np.array([np.interp(places, np.arange(BARS + 1), each) for each in plane_m.T]).T
    drawn_m[1:-1] += rng.normal(0, 1e-3, (39, 2))
    run = cs.run(drawn_problem(in_space(drawn_m), 10, 1e-3, 0.5))
    low, high = run.interval("bending_n_m2")
    assert low <= BENDING_N_M2 <= high
    assert high < 10 * low
