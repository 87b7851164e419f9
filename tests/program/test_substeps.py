"""Number of steps per sample, and intervals that include the time-step error."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.problems import TRUTH, hung_cube

import collocation_sysid as cs
from collocation_sysid.methods.solution import Method
from collocation_sysid.pipeline import Run, run
from collocation_sysid.problem import Problem
from collocation_sysid.runs.numerical_error import refine
from collocation_sysid.statistics.budget.discretisation_error import (
    MOST_SUBSTEPS,
    Refinement,
    discretisation_error,
)
from collocation_sysid.statistics.estimates import Estimate

SOFT = {"mu_pa": cs.Unknown(400.0), "gamma_r_s": cs.Unknown(0.005)}


@cache
def twin(noise_m: float, substeps: int | str = "auto") -> Problem:
    """A cube that another integrator has simulated at a sixteenth of the samples' distance."""
    cube = hung_cube(25, divisions=(1, 1, 2))
    tracks_m = cs.simulate(cube, TRUTH, timestep_s=cube.timestep_s / 16).markers_m
    tracks_m = tracks_m + np.random.default_rng(3).normal(scale=noise_m, size=tracks_m.shape)
    sigma_m = np.full(len(cube.markers.names), noise_m)
    seen = replace(cube, markers=replace(cube.markers, positions_m=tracks_m, sigma_m=sigma_m))
    return Problem([seen], {**TRUTH, **SOFT}, substeps=substeps)  # type: ignore[arg-type]


@cache
def found(noise_m: float, substeps: int | str = "auto") -> Run:
    return run(twin(noise_m, substeps), seek_causes=False)


def holds(interval: tuple[float, float] | None, value: float) -> bool:
    assert interval is not None
    return interval[0] < value < interval[1]


# Simulations


def swung_block() -> cs.Experiment:
    """A block of 200 kg/m³ that is swung 12 cm at 2 Hz and sampled at 50 Hz."""
    t_s = np.linspace(0.0, 0.5, 26)
    way_m = np.outer(0.06 * (1 - np.cos(4 * np.pi * t_s)), [1, 0, 0])
    body = cs.Body(cs.box_mesh((0.05, 0.05, 0.15), (1, 1, 3)), density_kg_m3=200.0)
    top = np.flatnonzero(body.nodes_m[:, 2] > 0.149)
    low = body.nodes_m[body.nodes_m[:, 2] < 0.06][::4]
    swing = cs.PoseSequence(t_s, way_m, np.tile([0, 0, 0, 1.0], (len(t_s), 1)))
    markers = cs.Markers(t_s, np.zeros((len(t_s), len(low), 3)), 3e-4, places_m=low)
    return cs.Experiment(body, t_s, [cs.Grasp(top, swing)], markers, nuisance=cs.Nuisance.none())


BLOCK = {"young_pa": 20e3, "poisson": 0.3, "gamma_r_s": 4e-3, "gamma_m_1_s": 0.2}


@pytest.mark.long
@pytest.mark.parametrize("integrator", ["midpoint", "newmark"])
def test_a_run_recovers_the_constants_of_a_simulation_with_default_steps(integrator):
    """With one step a sample the midpoint rule's twin gave E = 18.7 kPa (18.5 to 18.9)."""
    block = swung_block()
    tracks_m = cs.simulate(block, BLOCK, integrator).markers_m
    tracks_m = tracks_m + np.random.default_rng(0).normal(scale=3e-4, size=tracks_m.shape)
    unknown = {"young_pa": cs.Unknown(10e3), "gamma_r_s": cs.Unknown(2e-3)}
    problem = Problem([cs.with_markers(block, tracks_m)], {**BLOCK, **unknown})
    answer = run(problem, seek_causes=False)
    for name in unknown:
        assert holds(answer.interval(name), BLOCK[name])


@pytest.mark.long
def test_a_simulation_chooses_its_steps_and_reports_its_error():
    block = swung_block()
    chosen = cs.simulate(block, BLOCK, "midpoint")
    fine = cs.simulate(block, BLOCK, "midpoint", substeps=64).positions_m
    off_m = np.linalg.norm(chosen.positions_m - fine, axis=2).max()
    assert 2 <= chosen.steps_per_sample <= 32
    assert off_m < 2e-4 * 0.12
    assert chosen.step_error_m == pytest.approx(off_m, rel=0.3)
    stated = cs.simulate(block, BLOCK, "midpoint", substeps=2)
    assert (stated.steps_per_sample, stated.step_error_m) == (2, None)


def test_where_every_parameter_ends_at_a_bound_the_steps_are_checked_too():
    """Coarse steps may have driven it there, and no error bar tells whether they did."""
    block = hung_cube(10, divisions=(1, 1, 1))
    seen = cs.with_markers(block, cs.simulate(block, TRUTH).markers_m)
    bounded = cs.Unknown(TRUTH["mu_pa"] / 3, TRUTH["mu_pa"] / 4, TRUTH["mu_pa"] / 2)
    answer = run(Problem([seen], {**TRUTH, "mu_pa": bounded}), seek_causes=False)
    assert answer.solution.collocation.substeps == MOST_SUBSTEPS
    assert any("every parameter ends at a bound" in note for note in answer.solution.notes)
    assert answer.trust.verdict != "good"


@pytest.mark.parametrize("substeps", [0, "many"])
def test_steps_that_cannot_be_are_refused(substeps):
    with pytest.raises(cs.InputError, match="substeps"):
        cs.simulate(swung_block(), BLOCK, "midpoint", substeps=substeps)


# Intervals


def test_the_interval_with_the_step_error_holds_the_truth():
    coarse = found(3e-4, 1)
    noise = coarse.optimum["mu_pa"]
    assert not holds(noise.statistical95, TRUTH["mu_pa"])
    assert holds(coarse.interval("mu_pa"), TRUTH["mu_pa"])
    assert holds(coarse.interval("young_pa"), 720.0)
    assert "time_step" in coarse.budget["mu_pa"].shares


def test_the_value_is_corrected_for_the_step_and_lies_within_both_intervals():
    coarse = found(3e-4, 1)
    for name in SOFT:
        each, optimum = coarse.estimates[name], coarse.optimum[name].value
        assert holds(each.statistical95, each.value)
        assert holds(each.combined95, each.value)
        # The standard error by noise alone is half of the error of the optimum.
        assert abs(each.value - TRUTH[name]) < 0.7 * abs(optimum - TRUTH[name])
        assert coarse.result.parameters[name].optimum == optimum
        assert coarse.parameters[name] == each.value


@pytest.mark.long
def test_a_scheme_of_first_order_has_its_error_in_the_interval_too():
    euler = run(replace(twin(3e-4, 4), scheme="backward-euler"), seek_causes=False)
    noise = euler.optimum["gamma_r_s"]
    assert not holds(noise.statistical95, TRUTH["gamma_r_s"])
    assert holds(euler.interval("gamma_r_s"), TRUTH["gamma_r_s"])


def test_unestimated_parameters_are_not_reported_as_held():
    coarse = found(3e-4, 1)
    unseen = replace(coarse.problem, rollout=cs.RolloutOptions("scheme"))
    blind = run(unseen, seek_causes=False)
    assert "time_step" not in blind.budget["mu_pa"].shares
    assert "but not the step error (measured by refine)" in blind.table()


# As many as the error bars ask for


@pytest.mark.long
def test_as_many_steps_are_taken_as_leave_half_a_standard_error():
    finer = found(3e-4)
    assert 1 < finer.solution.collocation.substeps < MOST_SUBSTEPS
    assert finer.budget["mu_pa"].shares["time_step"] < 0.1
    assert holds(finer.interval("mu_pa"), TRUTH["mu_pa"])
    assert finer.trust.verdict == "good"


def test_the_chosen_substeps_are_reported_with_the_reason():
    finer = found(3e-4)
    (said,) = [note for note in finer.solution.notes if "standard errors" in note]
    many = finer.solution.collocation.substeps
    assert said.startswith("with one time step per sample, the estimated time-step error of ")
    assert f"solved again with {many} " in said
    assert finer.result.problem.substeps == many
    assert finer.result.iterations > found(3e-4, many).solution.iterations


def test_the_guess_and_the_history_are_kept():
    finer = found(3e-4)
    assert finer.solution.collocation.parameters.guesses["mu_pa"] == pytest.approx(400.0)
    numbers = [line.number for line in finer.solution.history]
    assert numbers == sorted(numbers)
    assert finer.solution.history[0].parameters["mu_pa"] == pytest.approx(400.0)


def counting(solved: list[int]) -> Method:
    def method(collocation, watch=None, start=None):
        solved.append(collocation.substeps)
        return cs.ReducedSpace()(collocation, watch, start)

    return method


def test_nothing_is_solved_twice_where_one_step_is_enough():
    solved: list[int] = []
    once = run(twin(1e-2), counting(solved), seek_causes=False)
    assert once.solution.collocation.substeps == 1
    assert solved == [1]


def test_a_number_that_is_stated_is_kept():
    solved: list[int] = []
    twice = run(twin(3e-4, 2), counting(solved), seek_causes=False)
    assert "time_step" in twice.budget["mu_pa"].shares
    assert solved == [2]


def test_substeps_have_an_upper_limit():
    estimates = {"mu_pa": Estimate(100.0, 0.1, (99.8, 100.2))}

    def suggested(half: float, order: float, each: dict = estimates) -> int:
        error = discretisation_error("mu_pa", each["mu_pa"], [half], [], order)
        return Refinement({"mu_pa": error}).suggested_substeps(each, order)

    for half, order, needed in ((100.01, 2, 1), (100.14, 2, 2), (100.14, 1, 3), (110.0, 2, 8)):
        assert suggested(half, order) == needed
    precise = {"mu_pa": replace(estimates["mu_pa"], statistical_std_error=1e-3)}
    # Corrections of 0.093, 0.107, 0.67 and 80 %.
    for half, needed in ((100.07, 1), (100.08, 2), (100.5, 3), (160.0, MOST_SUBSTEPS)):
        assert suggested(half, 2, precise) == needed
    assert suggested(160.0, 2, {"mu_pa": Estimate(100.0)}) == 1


def fails_at_finer_steps(how: BaseException | cs.Status) -> Method:
    def method(collocation, watch=None, start=None):
        solution = cs.ReducedSpace()(collocation, watch, start)
        if collocation.substeps == 1:
            return solution
        if isinstance(how, cs.Status):
            return replace(solution, status=how)
        raise how

    return method


def test_the_first_answer_counts_where_the_finer_is_not_found():
    kept = run(twin(3e-4), fails_at_finer_steps(cs.Status.STALLED), seek_causes=False)
    assert kept.parameters["mu_pa"] == pytest.approx(found(3e-4, 1).parameters["mu_pa"])
    assert kept.solution.status.converged
    assert any("the solve with" in note and "failed" in note for note in kept.notes)


@pytest.mark.parametrize("how", [cs.Status.INTERRUPTED, KeyboardInterrupt()])
def test_an_interrupt_at_finer_steps_leaves_the_first_answer_with_a_note(how):
    kept = run(twin(3e-4), fails_at_finer_steps(how), seek_causes=False)
    assert kept.parameters["mu_pa"] == pytest.approx(found(3e-4, 1).optimum["mu_pa"].value)
    assert "a finer time step" in kept.omitted_checks
    assert np.isnan(kept.interval("mu_pa")).all()  # systematic effects were not evaluated
    assert "systematic effects were not evaluated" in kept.table()


@pytest.mark.parametrize("given", ["some", 0, -1])
def test_other_numbers_are_refused(given):
    with pytest.raises(cs.InputError, match="substeps"):
        replace(twin(3e-4), substeps=given).collocation()


def test_refine_goes_on_from_the_steps_that_were_chosen():
    finer = found(3e-4)
    refined = refine(finer).refinement
    assert refined is not None
    rows = {level.refined: level.timesteps for level in refined.levels}
    many = finer.solution.collocation.substeps
    assert rows == {"step": 25 * 2 * many + 1, "mesh": 25 * many + 1}
    assert refined.contributions == ("noise", "step", "mesh")


# Value, interval, verdict and what the interval holds, together


def test_every_view_has_value_interval_and_verdict():
    coarse = found(3e-4, 1)
    low, high = coarse.interval("mu_pa")
    contained = "noise, the step error, the mesh error and systematic effects"
    assert contained in coarse.table()
    for said in (str(coarse), coarse.table()):
        assert "Verdict: good" in said
        assert f"{coarse.parameters['mu_pa']:.4g}" in said
        assert f"{low:.4g} … {high:.4g}" in said
    assert coarse.result.parameters["mu_pa"].combined95 == (low, high)
    assert f"[{low:.5g}, {high:.5g}]" in repr(coarse)
    assert ", good: " in repr(coarse)
