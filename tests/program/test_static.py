"""Static experiments: a block between platens, and properties of equilibria."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import pictures_drawn
from kit.problems import (
    EDGE_M,
    GUESS,
    IDEAL,
    TRUTH,
    as_theta,
    box,
    hung_cube,
    nodes_where,
    vertex_markers,
)
from kit.static import ELASTIC_ONLY, HANGING, PRESSED_M, TIMES, block, pressed
from scipy.optimize import brentq

import collocation_sysid as cs
from collocation_sysid.common.display import plain_text
from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.comparison.shooting import Shooting
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.pipeline import run
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.forward.newton_solver import NewtonSolver
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import (
    Experiment,
    Grasp,
    Nuisance,
    PoseSequence,
    displaced_axes,
    read_displacement,
)
from collocation_sysid.result.check_sections import full_check_tables
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.check import check_problem
from collocation_sysid.runs.derivatives import derivative_fault, taylor_rates
from collocation_sysid.runs.forward_simulation import ForwardSimulation
from collocation_sysid.statistics.scale_identifiability import static_concerns


def lateral(stretch: float, mu: float, lame: float) -> float:
    """The stretch across of a Neo-Hookean bar that is free to contract."""

    def stress(b: float) -> float:
        return mu * (b - 1 / b) + lame * np.log(stretch * b * b) / b

    return float(brentq(stress, 0.5, 2.0, xtol=1e-15, rtol=1e-15))


def test_a_block_between_lubricated_platens_is_the_analytic_uniaxial_solution():
    experiment = block()
    positions = simulate(experiment, TRUTH).positions_m
    for x, z_m in zip(positions, PRESSED_M, strict=True):
        along = 1 + z_m / EDGE_M
        across = lateral(along, TRUTH["mu_pa"], TRUTH["lambda_pa"])
        expected = experiment.body.nodes_m * [across, across, along]
        np.testing.assert_allclose(x, expected, atol=1e-11)


def test_sticking_platens_hold_every_axis_and_let_the_side_bulge():
    experiment = block("xyz")
    positions = simulate(experiment, TRUTH).positions_m
    ends = np.concatenate([g.nodes for g in experiment.grasps[:2]])
    np.testing.assert_allclose(positions[-1, ends, :2], experiment.body.nodes_m[ends, :2])
    middle = np.flatnonzero(np.abs(experiment.body.nodes_m[:, 2] - EDGE_M / 2) < 1e-9)
    assert positions[-1, middle, 0].max() > 1.05 * EDGE_M


def test_a_body_follows_platens_that_press_far_in_one_step(monkeypatch):
    """Moved alone, the platen's nodes would crush the elements below them."""
    tried = []
    newton = NewtonSolver.solve_equilibrium
    monkeypatch.setattr(
        NewtonSolver, "solve_equilibrium", lambda *a, **k: (tried.append(1), newton(*a, **k))[1]
    )
    experiment = block("xyz", np.array([0.0, 1.0]), np.array([0.0, -0.03]))
    rubber = TRUTH | {"lambda_pa": 100 * TRUTH["mu_pa"]}
    far = simulate(experiment, rubber).positions_m[-1]
    assert len(tried) == 2  # one for each sample
    near = block("xyz", np.arange(7.0), np.linspace(0.0, -0.03, 7))
    np.testing.assert_allclose(far, simulate(near, rubber).positions_m[-1], atol=1e-9)


def test_each_static_sample_is_the_rest_state_of_its_time():
    experiment = block("xyz", gravity_m_s2=(0.0, 0.0, -9.81))
    positions = simulate(experiment, TRUTH).positions_m
    for x, time_s in zip(positions, TIMES, strict=True):
        rest = equilibrium(experiment, as_theta(TRUTH), time_s)
        np.testing.assert_allclose(x.ravel(), rest, atol=1e-10)


def test_static_constraints_vanish_at_the_simulation_alone():
    experiment = block("xyz")
    transcription = Collocation([experiment], GUESS.with_guess(TRUTH), substeps=3).transcriptions[0]
    assert transcription.grid_times == len(TIMES)
    x = simulate(experiment, TRUTH).positions_m.reshape(len(TIMES), -1)
    residual = transcription.residual_n(
        x, transcription.equations_at(transcription.parameters.guess_q, np.zeros(0))
    )
    assert np.abs(residual).max() < 1e-9 * transcription.force_n
    x[2, experiment.free_dofs] += 1e-3 * EDGE_M
    moved = transcription.residual_n(
        x, transcription.equations_at(transcription.parameters.guess_q, np.zeros(0))
    )
    assert (np.abs(moved).max(axis=1) > 1e-6 * transcription.force_n).tolist() == [0, 0, 1, 0]


def test_one_sample_is_enough():
    experiment = block(t_s=np.array([2.0]), z_m=np.array([-0.03]))
    positions = simulate(experiment, TRUTH).positions_m
    np.testing.assert_allclose(positions[0, :, 2], 0.7 * experiment.body.nodes_m[:, 2], atol=1e-11)


def drooping_bar() -> Experiment:
    """A slender bar, clamped at one end, whose tip hangs lower than it is far out; one sample."""
    body, t_s = box((0.3, 0.02, 0.02), (15, 1, 1)), np.zeros(1)
    grasp = Grasp(nodes_where(body, 0, 0.0), PoseSequence.fixed())
    markers = vertex_markers(body, nodes_where(body, 0, 0.3), t_s)
    bar = Experiment(body, t_s, [grasp], markers, name="bar", nuisance=IDEAL, kind="static")
    seen_m = simulate(bar, DROOPING).markers_m
    assert (seen_m[0, :, 2] < -seen_m[0, :, 0]).all()
    return with_markers(bar, seen_m)


DROOPING = {"lambda_pa": 2e3, "mu_pa": 2e3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


# Declares that the bar was simulated with the elements that are fitted.
SIMULATED = cs.UncertaintyOptions(assumptions=cs.Assumptions(damping_law="none"))


@pytest.mark.long
def test_a_body_that_bends_far_is_found_in_few_sweeps_and_saved(tmp_path):
    """A step along the tangent stretches it, and would be refused unless it were short."""
    guess = {"lambda_pa": cs.Unknown(guess=3e3), "mu_pa": cs.Unknown(guess=3e3)}
    found = run(
        cs.Problem([drooping_bar()], DROOPING | guess, uncertainty=SIMULATED), seek_causes=False
    )
    assert found.parameters["mu_pa"] == pytest.approx(DROOPING["mu_pa"], rel=1e-6)
    assert found.solution.iterations < 10
    with pictures_drawn():
        found.save(tmp_path / "run")
    assert len(list((tmp_path / "run" / "frames").iterdir())) == 1
    # Single samples tell nothing of an error that markers share.
    assert found.trust.verdict == "good"
    bar = found.problem.experiments[0]
    coarse = replace(bar, markers=replace(bar.markers, sigma_m=0.005))
    allowed = run(cs.Problem([coarse], DROOPING | guess), seek_causes=False)
    assert "sigma_m = 5 mm is 0.017 of the body's size" in " ".join(allowed.trust.reasons)


def test_a_large_step_of_a_platen_is_taken_in_parts():
    once = block("xyz", t_s=np.array([0.0, 1.0]), z_m=np.array([0.0, -0.05]))
    slowly = block("xyz", t_s=np.arange(11.0), z_m=-0.005 * np.arange(11))
    found, expected = (simulate(e, TRUTH).positions_m[-1] for e in (once, slowly))
    np.testing.assert_allclose(found, expected, atol=1e-10)


def measured(experiment: Experiment, values=TRUTH) -> Experiment:
    return with_markers(experiment, simulate(experiment, values).markers_m)


def noisy(experiment: Experiment, sigma_m: float = 1e-4) -> Experiment:
    found = measured(experiment)
    rng = np.random.default_rng(1)
    tracks = found.markers.positions_m
    return with_markers(found, tracks + sigma_m * rng.normal(size=tracks.shape))


def test_interior_point_reduced_space_and_shooting_find_the_same_static_optimum():
    collocation = Collocation([noisy(block("xyz", gravity_m_s2=HANGING))], ELASTIC_ONLY)
    found = [
        method(collocation).parameters for method in (ReducedSpace(), InteriorPoint(), Shooting())
    ]
    for other in found[1:]:
        assert other == pytest.approx(found[0], rel=1e-6)


def test_static_and_dynamic_experiments_share_their_parameters():
    static = noisy(block("xyz", gravity_m_s2=HANGING))
    moving = noisy(hung_cube(6))
    collocation = Collocation([static, moving], GUESS)
    found = ReducedSpace()(collocation).parameters
    assert InteriorPoint()(collocation).parameters["mu_pa"] == pytest.approx(
        found["mu_pa"], rel=1e-5
    )
    assert found["mu_pa"] == pytest.approx(TRUTH["mu_pa"], rel=0.05)
    assert found["gamma_r_s"] == pytest.approx(TRUTH["gamma_r_s"], rel=0.3)


def test_the_zero_of_a_displacement_is_found_with_its_derivatives():
    true, experiment = (0.5e-3, block("xyz", nuisance=Nuisance.none(displacement_zero_m=1e-3)))
    top = experiment.grasps[1]
    shifted = replace(top, poses=top.poses.with_shift([0.0, 0.0, true]))
    tracks = measured(replace(experiment, grasps=replaced(experiment.grasps, shifted))).markers
    unsure = replaced(experiment.grasps, replace(top, zero="z"))
    seen = with_markers(replace(experiment, grasps=unsure), tracks.positions_m)
    collocation = Collocation([seen], ELASTIC_ONLY.with_guess(TRUTH))
    z, _ = initial_variables(collocation)
    assert not derivative_fault(collocation, z, taylor_rates(collocation, z))
    solution = ReducedSpace()(collocation)
    (phi,) = [part.phi for part in collocation.iterates(solution.z)]
    assert collocation.transcriptions[0].nuisance.names == ("block: zero of grasp 2, z [m]",)
    # The prior, about zero, has its say beside markers of a millimetre.
    assert phi[0] * 1e-3 == pytest.approx(true, rel=0.1)


def replaced(grasps, top):
    return (grasps[0], top, *grasps[2:])


def test_a_static_problem_reports_no_damping_before_and_after():
    problem = cs.Problem([noisy(block("xyz", gravity_m_s2=HANGING))], parameters=GUESS)
    (note,) = static_concerns(problem.experiments, GUESS)
    assert note.message.startswith(
        "'block' is static: no information on damping; fix gamma_r_s and"
    )
    found = run(problem, seek_causes=False)
    assert found.estimates["gamma_r_s"].statistical_std_error is None
    for name in ("gamma_r_s", "gamma_m_1_s"):
        assert found.estimates[name].reason == "the data do not determine it"
    assert isinstance(found.rollouts["block"], ForwardSimulation)
    assert found.rollouts["block"].rms_m == pytest.approx(found.solution.rms_m, rel=1e-6)


def test_a_held_block_relaxes_as_the_standard_linear_solid():
    share, tau_s = 0.5, 2.0
    t_s = np.array([0.0, 0.3, 1.0, 2.5, 7.0])
    body = Body(box_mesh((EDGE_M,) * 3, (1, 1, 1)), density_kg_m3=30.0, prony=["prony_1"])
    everywhere = Grasp(np.arange(len(body.nodes_m)), pressed(t_s, 0.0 * t_s))
    free = Experiment(
        body,
        t_s,
        [everywhere],
        vertex_markers(body, [0], t_s),
        gravity_m_s2=(0.0, 0.0, 0.0),
        kind="static",
        loaded_since_s=0.0,
        start="equilibrium",
    )
    values = TRUTH | {"prony_1.share": share, "prony_1.tau_s": tau_s}
    theta = body.theta_from_values(values)
    x = np.tile((body.nodes_m * [1.0, 1.0, 0.8]).ravel(), (len(t_s), 1))
    dynamics = Dynamics.from_experiment(free, "midpoint").with_theta(theta)
    carried = dynamics.forces_with_histories(dynamics.histories(x)).memory_state
    force = body.force(x, 0 * x, theta, memory_input=carried)
    relaxed = body.force(x[:1], 0 * x[:1], theta)
    expected = (1 + share * np.exp(-t_s / tau_s))[:, None] * relaxed
    np.testing.assert_allclose(force, expected, rtol=1e-12, atol=1e-12)


def test_a_relaxing_block_between_platens_creeps_towards_its_rest():
    body = Body(box_mesh((EDGE_M,) * 3, (2, 2, 2)), density_kg_m3=30.0, prony=["prony_1"])
    values = TRUTH | {"prony_1.share": 0.5, "prony_1.tau_s": 2.0}
    t_s = np.array([0.0, 0.1, 1.0, 40.0])
    z_m = np.array([0.0, -0.02, -0.02, -0.02])
    pressing = block("xyz", t_s, z_m, body=body, gravity_m_s2=(0.0, 0.0, -9.81))
    x = simulate(pressing, values).positions_m
    rest = equilibrium(pressing, body.theta_from_values(values), 40.0).reshape(-1, 3)
    off = np.abs(x[1:] - rest).max(axis=(1, 2))
    # Over the last interval the stress is taken to fall evenly.
    assert off[2] < 0.05 * off[1] < 0.05 * off[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "slow"}, "kind is 'slow'; expected 'dynamic' or 'static'"),
        ({"start": "undeformed"}, "start is 'undeformed', but the experiment is static"),
        ({"start_rule": "paper"}, "start_rule is 'paper', but the experiment is static"),
        ({"t_s": TIMES[[0, 2, 1, 3]]}, "row 3: t_s: t_s = 1 follows 1.5; time must increase"),
        ({"markers": None}, "nothing is measured: there are no markers, no measured wrench"),
    ],
)
def test_static_experiments_that_make_no_sense_are_refused(change, message):
    with pytest.raises(InputError, match=re.escape(message)):
        replace(block(), **change)


@pytest.mark.parametrize(
    ("kept", "free"),
    [
        ([1], "it can translate along x and translate along y and rotate about z"),
        ([1, 2], "it can translate along y"),
        ([2, 3], "it can translate along z"),
        ([], "it can translate and rotate as a rigid body"),
    ],
)
def test_the_motion_that_is_left_free_is_named(kept, free):
    experiment = block()
    with pytest.raises(InputError, match=re.escape(free)):
        replace(experiment, grasps=[experiment.grasps[k] for k in kept])


def test_grasps_may_share_nodes_along_different_axes_only():
    experiment = block()
    top = experiment.grasps[1]
    replace(experiment, grasps=(*experiment.grasps[:3], replace(experiment.grasps[3], axes="y")))
    with pytest.raises(InputError, match="held by the grasps 2 and 5 at the same time along z"):
        replace(experiment, grasps=(*experiment.grasps, replace(top, axes="xz")))
    with pytest.raises(InputError, match="axes of a grasp is 'zx'; expected 'x', 'y', 'z', 'xy'"):
        replace(top, axes="zx")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t_s,z\n0,0\n1,1\n", "column z names no unit; expected one of m, cm, mm"),
        ("t_s,q_m\n0,0\n", "expected t_s and any of x_m, y_m, z_m, displacement_m"),
        ("t_s,z_m,z_mm\n0,0,0\n", "the columns z_m, z_mm could all be z"),
        ("z_m\n0\n", "expected t_s and any of"),
        ("t_s,z_m\n0,0\n0,1\n", "line 3: t_s = 0 follows 0; time must increase"),
        ("t_s,z_m\n0,\n", "line 1: column z_m has no values"),
        ("t_s\n0\n", "expected t_s and any of"),
    ],
)
def test_displacements_that_make_no_sense_are_refused(tmp_path, text, message):
    file = tmp_path / "crosshead.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_displacement(file)
    assert message in str(caught.value)


def test_a_displacement_is_a_shift_in_metres(tmp_path):
    file = tmp_path / "crosshead.csv"
    file.write_text("t_s,z_mm,x_m\n0,0,0\n2,-3,0.1\n", encoding="utf-8")
    poses = read_displacement(file)
    np.testing.assert_allclose(poses.positions_m, [[0, 0, 0], [0.1, 0, -3e-3]])
    np.testing.assert_array_equal(poses.quaternions_xyzw[:, 3], 1.0)
    assert displaced_axes(file) == "xz"


# Problem files ------------------------------------------------------------------------------------

BENCH = """
[object]
mesh = "block.vtu"
material = "neo-hookean"
density_kg_m3 = 1000.0

[parameters]
young_pa = { guess = 5e4 }
poisson = { fixed = 0.3 }
gamma_r_s = { fixed = 0.0 }
gamma_m_1_s = { fixed = 0.0 }

[[experiment]]
name = "press"
kind = "static"
gravity_m_s2 = [0.0, 0.0, 0.0]

[experiment.nuisance]
displacement_zero = { prior_m = 2e-3 }

[[experiment.grasp]]
nodes = { box_m = [[-1, -1, -1e-4], [1, 1, 1e-4]] }
axes = "z"

[[experiment.grasp]]
nodes = { box_m = [[-1, -1, 0.0999], [1, 1, 1]] }
axes = "z"
displacement = "crosshead.csv"
wrench = { file = "force.csv", sigma_n = 0.01 }

[[experiment.grasp]]
nodes = { box_m = [[-1e-4, -1, -1], [1e-4, 1, 1]] }
axes = "x"

[[experiment.grasp]]
nodes = { box_m = [[-1, -1e-4, -1], [1, 1e-4, 1]] }
axes = "y"
"""


def bench(folder, zero_m: float = 1e-3) -> Path:
    """A block pressed between lubricated platens, its load from the analytic solution."""
    box_mesh((EDGE_M,) * 3, (1, 1, 1)).write(folder / "block.vtu")
    lame, mu = 1e5 * 0.3 / 1.3 / 0.4, 1e5 / 2.6  # of E = 1e5 Pa, ν = 0.3
    t_s, z_m = (np.array([0.0, 1.0, 3.0, 4.0, 8.0]), -np.array([0.005, 0.01, 0.02, 0.03, 0.035]))
    force_n = []
    for z in z_m:
        along = 1 + (z + zero_m) / EDGE_M
        across = lateral(along, mu, lame)
        stress = mu * (along - 1 / along) + lame * np.log(along * across**2) / along
        force_n.append(EDGE_M**2 * stress)
    for file, name, values in (("crosshead", "z_m", z_m), ("force", "fz_n", force_n)):
        rows = "".join(f"{t},{value!r}\n" for t, value in zip(t_s, map(float, values), strict=True))
        (folder / f"{file}.csv").write_text(f"t_s,{name}\n{rows}", encoding="utf-8")
    (folder / "problem.toml").write_text(BENCH, encoding="utf-8")
    return folder / "problem.toml"


@pytest.mark.long
def test_a_test_bench_without_markers_determines_stiffness_and_zero(tmp_path):
    found = run(cs.Problem.read(bench(tmp_path)), seek_causes=False)
    assert found.estimates["young_pa"].value == pytest.approx(1e5, rel=2e-3)
    (part,) = found.solution.collocation.iterates(found.solution.z)
    nuisance = part.transcription.nuisance
    (zero,) = nuisance.displacement_zero_indices(1)
    assert part.phi[zero] * nuisance.scales[zero] == pytest.approx(1e-3, rel=0.05)
    with pictures_drawn():
        found.save(tmp_path / "run")
    assert (tmp_path / "run" / "wrench_press.png").is_file()
    assert not list((tmp_path / "run").glob("tracks_*"))


def test_forces_between_equilibria_are_not_read_off_their_chord(tmp_path):
    thinned = cs.Problem.read(bench(tmp_path), ["experiment.press.every=2"])
    (experiment,) = thinned.experiments
    assert experiment.t_s.tolist() == [0.0, 3.0, 8.0]
    assert experiment.grasps[1].wrench.t_s.tolist() == [0.0, 3.0, 8.0]


def test_a_test_bench_without_markers_is_checked(tmp_path):
    findings = check_problem(cs.Problem.read(bench(tmp_path)))
    assert not findings.derivative_fault
    assert findings.samples == 0
    assert not findings.motions
    said = plain_text(full_check_tables(findings))
    assert "Modes" not in said
    assert "deviates from the markers" not in said


def test_a_run_without_markers_speaks_of_forces(tmp_path):
    found = run(cs.Problem.read(bench(tmp_path)), seek_causes=False)
    said = plain_text(run_summary(found.result, tmp_path, details=True))
    assert " mm RMS" not in said
    assert re.search(r"wrench of 'press': \S+ N RMS \(sigma 0.01 N\)", said)
    assert re.search(r"forward simulation 'press': \S+ N RMS", said)
    assert "a finer step" not in said
    assert re.search(r"zero error of a displacement: up to 1(\.0)? mm \(prior ±2(\.0)? mm\)", said)
    assert found.solution.max_violation_relative < 1e-6


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('kind = "static"', 'kind = "slow"', "experiment 'press'"),
        (
            'kind = "static"',
            'kind = "static"\nstart = "undeformed"',
            'together with kind = "static"',
        ),
        ('kind = "static"', 'kind = "static"\nresample_hz = 10.0', "found resample_hz together"),
        ("displacement_zero =", "time_shift = { prior_s = 1.0 }  #", "found nuisance.time_shift"),
        ('displacement = "', 'poses = "p.csv"\ndisplacement = "', "poses and displacement"),
        ('displacement = "', 'length_unit = "mm"\ndisplacement = "', "length_unit without poses"),
        (
            "wrench =",
            "# wrench =",
            "nothing is measured: expected markers, a wrench, a reading, or depth",
        ),
        ('axes = "x"', 'axes = "xz"', "held by the grasps 1 and 3 at the same time along z"),
        ('axes = "x"', 'axes = "w"', "grasp.2.axes"),
        ('axes = "y"', 'axes = "y"\nfrom_s = 7.0', "it can translate along y"),
        (
            "[[experiment]]",
            "[transcription]\nsubsteps = 3\n[[experiment]]",
            "no time steps between equilibria",
        ),
        ('"crosshead.csv"', '"lost.csv"', "lost.csv does not exist"),
    ],
)
def test_test_benches_that_make_no_sense_are_refused(tmp_path, old, new, message):
    file = bench(tmp_path)
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        cs.Problem.read(file)
    assert message in str(caught.value)
