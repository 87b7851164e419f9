"""The limit of the time of a run: the best result, and the reason."""

from __future__ import annotations

import numpy as np
import pytest
from kit.problems import TRUTH, hung_cube, measured

import collocation_sysid as cs
from collocation_sysid import pipeline
from collocation_sysid.common.limits import TimeLimitReached, require_time, time_limit, unlimited
from collocation_sysid.methods.solution import Status
from collocation_sysid.methods.starts.stiffness_scan import TrialSimulation
from collocation_sysid.runs import solving

SOON = cs.ReducedSpace(max_time_s=1e-9)


def problem() -> cs.Problem:
    return cs.Problem([measured(hung_cube())], TRUTH | {"mu_pa": cs.Unknown(290.0)})


def test_the_earlier_of_two_limits_counts_and_steps_to_an_answer_have_none():
    with time_limit(-1.0), time_limit(10.0):
        with pytest.raises(TimeLimitReached):
            require_time()
        with unlimited():
            require_time()
    require_time()


def test_a_search_ends_with_the_best_iterate_and_its_reason():
    solution = SOON(problem().collocation())
    assert solution.status is Status.TIME_LIMIT
    assert solution.parameters["mu_pa"] == pytest.approx(290.0)
    assert np.isfinite(solution.z).all()


def test_a_run_states_what_the_limit_left_out(monkeypatch):
    monkeypatch.setattr(pipeline, "time_limit", lambda _: time_limit(-1.0))
    answer = cs.run(problem(), cs.ReducedSpace(max_time_s=100.0))
    assert answer.parameters["mu_pa"] == pytest.approx(300.0, rel=1e-3)
    assert answer.trust.verdict == "doubtful"
    (reason,) = (each.message for each in answer.trust.concerns)
    assert reason.startswith("interrupted: at the limit of 100 s")
    assert "no error bars" in reason


def test_the_best_start_is_kept_if_the_limit_ends_the_scan(monkeypatch):
    evaluate_at = TrialSimulation.evaluate_at
    tried = []

    def limited(self, young_pa, guess):
        tried.append(young_pa)
        with time_limit(-1.0 if len(tried) > 6 else 1e3):
            require_time()
            return evaluate_at(self, young_pa, guess)

    monkeypatch.setattr(TrialSimulation, "evaluate_at", limited)
    unguessed = cs.Problem([measured(hung_cube())], TRUTH | {"mu_pa": cs.Unknown()})
    solution = cs.solve(unguessed, cs.ReducedSpace(max_time_s=100.0))
    assert solution.status is Status.TIME_LIMIT
    assert solution.parameters["mu_pa"] < tried[0]
    assert np.isfinite(solution.z).all()


@pytest.mark.parametrize("method", [SOON, cs.ReducedSpace()])
def test_a_run_without_a_start_names_elements_that_are_not_made_for_incompressible_bodies(
    method, monkeypatch
):
    monkeypatch.setattr(solving, "START_S", -1.0)
    body = cs.Body(
        cs.box_mesh((0.02, 0.02, 0.04), (1, 1, 1)), density_kg_m3=1000.0, element="tet10"
    )
    t_s = 0.01 * np.arange(5)
    grasp = cs.Grasp(np.flatnonzero(body.nodes_m[:, 2] > 0.039), cs.PoseSequence.fixed())
    markers = cs.Markers(t_s, np.zeros((5, 1, 3)), 1e-4, places_m=[[0.0, 0.0, 0.0]])
    experiment = cs.Experiment(body, t_s, [grasp], markers, nuisance=cs.Nuisance.none())
    values = {"poisson": 0.4999, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}
    with pytest.raises(cs.InputError, match="tet10-p0") as refused:
        cs.solve(cs.Problem([experiment], values | {"young_pa": cs.Unknown()}), method)
    assert "max_time_s" in str(refused.value)
