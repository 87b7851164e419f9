"""Many values of the parameters simulated together: the motions of single simulations."""

from dataclasses import replace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.program import simulation
from collocation_sysid.program.forward.newton_solver import NewtonFailure, NewtonSolver

T_S = np.linspace(0.0, 0.14, 15)
DRAWS = 5


def swung(body, *, air="none", **options):
    """Return an experiment in which a hand swings the upper end of a body."""
    sway_m = 0.01 * (1 - np.cos(20 * T_S))
    hand = cs.PoseSequence(T_S, np.outer(sway_m, [1, 0.3, 0]), np.tile([0, 0, 0, 1.0], (15, 1)))
    z = body.nodes_m[:, 2]
    held = cs.Grasp(
        np.flatnonzero(z > z.max() - 1e-3),
        hand,
        wrench=cs.Wrench(T_S, np.zeros((15, 6)), sigma_n=0.1, sigma_nm=0.01),
    )
    return cs.Experiment(
        body, T_S, [held], nuisance=cs.Nuisance.none(), air_density_kg_m3=air, **options
    )


def solid(**options):
    mesh = cs.box_mesh((0.04, 0.04, 0.12), (1, 1, 3))
    return cs.Body(mesh, **{"density_kg_m3": 1000.0, "damping": "rayleigh"} | options)


def rod():
    line = np.column_stack([np.zeros(13), np.zeros(13), np.linspace(0.0, 0.3, 13)])
    mesh = cs.rod_mesh(line, cs.CrossSection.round(0.01), sections=13)
    return cs.Body(mesh, density_kg_m3=1000.0, damping="rayleigh")


def draws(body, spread=0.1):
    """Return values of all constants, the damping the same for all."""
    rng = np.random.default_rng(0)
    middle = {"young_pa": 1e6 if body.kind.is_solid is False else 5e4}
    usual = {"lambda_pa": 2e5, "mu_pa": 5e4, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.2}
    usual |= {"density_kg_m3": 900.0, **middle}
    values = {
        name: usual.get(name, 0.3) * np.exp(spread * rng.standard_normal(DRAWS))
        for name in body.constants
    }
    return values | {"gamma_m_1_s": 0.2}


def compare(experiment, values, scheme, substeps=1, singles=0):
    """Compare with single simulations, when `singles` bodies do not converge with the others."""
    alone = []
    with pytest.MonkeyPatch.context() as patch:
        with_steps = simulation._with_steps

        def counted(experiment, thetas, *others):
            alone.extend([0] * (len(thetas) == 1))
            return with_steps(experiment, thetas, *others)

        patch.setattr(simulation, "_with_steps", counted)
        together = cs.simulate_each(experiment, values, scheme, substeps)
    assert len(together) == DRAWS
    assert len(alone) == singles
    columns = np.broadcast_arrays(*values.values())
    each = [dict(zip(values, row, strict=True)) for row in zip(*columns, strict=True)]
    for motion, row in zip(together, each, strict=True):
        single = cs.simulate(experiment, row, scheme, substeps=substeps)
        size_m = np.ptp(experiment.body.nodes_m, axis=0).max()
        assert np.abs(motion.positions_m - single.positions_m).max() < 1e-11 * size_m
        speed_m_s = np.abs(single.velocities_m_s).max()
        assert np.abs(motion.velocities_m_s - single.velocities_m_s).max() < 1e-8 * speed_m_s
        ((mine,), (theirs,)) = motion.wrenches, single.wrenches
        assert np.array_equal(np.isnan(mine), np.isnan(theirs))
        assert np.nanmax(np.abs(mine - theirs)) < 1e-7 * np.nanmax(np.abs(theirs))
    moved = np.array([motion.positions_m[-1] for motion in together])
    assert np.ptp(moved, axis=0).max() > 1e-5  # the draws differ


SCHEMES = ("newmark", "midpoint", "bdf2", "backward-euler")


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("make", [solid, rod])
def test_motions_are_those_of_single_simulations(make, scheme):
    body = make()
    compare(swung(body), draws(body), scheme)


def test_evaluator_without_native_code():
    body = solid(evaluator="casadi")
    compare(swung(body), draws(body), "midpoint")


@pytest.mark.parametrize("scheme", ["newmark", "midpoint"])
def test_air_and_free_density(scheme):
    body = solid().with_free_densities([""])
    assert "density_kg_m3" in body.constants
    compare(swung(body, air=1.2), draws(body), scheme, substeps=2)


@pytest.mark.parametrize("scheme", ["newmark", "midpoint"])
def test_grasp_that_lets_go(scheme):
    experiment = swung(solid())
    experiment = replace(experiment, grasps=[replace(experiment.grasps[0], until_s=0.075)])
    # A body released by Newmark's method needs shorter Newton steps.
    compare(experiment, draws(experiment.body), scheme, singles=5 * (scheme == "newmark"))


def test_bodies_that_do_not_converge_are_simulated_by_themselves(monkeypatch):
    solve_each = NewtonSolver._solve_each

    def failing(self, x, equations):
        """Fail for the softest body."""
        softest = equations.stress.forces.theta[0].argmin()
        if equations.stress.forces.theta[0].min() < 2e5 * np.exp(-0.05):
            raise NewtonFailure(x, f"body {softest}")
        return solve_each(self, x, equations)

    monkeypatch.setattr(NewtonSolver, "_solve_each", failing)
    experiment = swung(solid())
    values = draws(experiment.body)
    assert (values["lambda_pa"] < 2e5 * np.exp(-0.05)).sum() == 1
    for scheme in ("newmark", "midpoint"):
        compare(experiment, values, scheme, singles=2)


def test_order_and_progress(monkeypatch):
    experiment = swung(solid())
    monkeypatch.setattr(simulation, "DOFS_TOGETHER", 2 * experiment.body.pattern.size)
    values, done = draws(experiment.body), []
    motions = cs.simulate_each(experiment, values, "midpoint", progress=done.append)
    assert done == [0.4, 0.8, 1.0]
    last = cs.simulate(
        experiment, {k: np.broadcast_to(v, 5)[4] for k, v in values.items()}, "midpoint", substeps=1
    )
    assert np.abs(motions[4].markers_m - last.markers_m).max(initial=0) < 1e-12
    assert np.abs(motions[4].positions_m - last.positions_m).max() < 1e-12


def test_refuses_what_cannot_be_simulated_together():
    prony = solid(prony=["prony_1"])
    for experiment in (swung(prony), replace(swung(solid()), kind="static")):
        with pytest.raises(cs.InputError, match="call `simulate` with each"):
            cs.simulate_each(experiment, draws(experiment.body))
    with pytest.raises(cs.InputError, match="mu_pa"):
        cs.simulate_each(swung(solid()), {"lambda_pa": np.ones(3)})
