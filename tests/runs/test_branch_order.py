"""Branches of a memory without guesses have the order of their names."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.runs.branch_order import with_ascending_times

TRUTH = {
    "young_pa": 1e5,
    "poisson": 0.49,
    "quick.share": 0.5,
    "quick.tau_s": 0.2,
    "slow.share": 0.2,
    "slow.tau_s": 5.0,
    "gamma_r_s": 0.0,
    "gamma_m_1_s": 0.0,
}


def problem(**stated):
    t_s = np.r_[0.0, np.geomspace(0.02, 20.0, 30)]
    strain = np.minimum(t_s / 0.02, 1.0) * 0.05
    prony = ("quick", "slow")
    blank = cs.Specimen("uniaxial", strain, 0 * strain, 10.0, t_s=t_s)
    values = cs.simulate(blank.experiment(prony=prony), TRUTH).custom_sensor_values[0].ravel()
    specimen = cs.Specimen("uniaxial", strain, values, 10.0, t_s=t_s, strain_zero=0.0)
    fixed = {name: TRUTH[name] for name in ("poisson", "gamma_r_s", "gamma_m_1_s")}
    unknown = {name: cs.Unknown() for name in TRUTH if name not in fixed}
    return cs.Problem([specimen.experiment(prony=prony)], unknown | fixed | stated)


def exchanged(parameters):
    """Values by name, with those of the two branches exchanged."""
    other = {"quick": "slow", "slow": "quick"}

    def source(name):
        branch, _, constant = name.partition(".")
        return f"{other[branch]}.{constant}" if branch in other else name

    return {name: parameters[source(name)] for name in parameters}


@pytest.mark.long
def test_times_ascend_in_the_order_of_the_names():
    stated = problem()
    solution = cs.solve(stated)
    for name in ("quick.share", "quick.tau_s", "slow.share", "slow.tau_s"):
        assert solution.parameters[name] == pytest.approx(TRUTH[name], rel=0.05)
    wrong = problem(
        **{name: cs.Unknown(value) for name, value in exchanged(TRUTH).items() if "." in name}
    )
    other = cs.solve(wrong)
    assert other.parameters["quick.tau_s"] > other.parameters["slow.tau_s"]  # guesses are kept
    ordered = with_ascending_times(other, stated.parameters)
    assert ordered.parameters == pytest.approx(exchanged(other.parameters))
    assert ordered.history[-1].parameters == pytest.approx(exchanged(other.history[-1].parameters))
    residual = np.concatenate([part.x.ravel() for part in ordered.parts])
    np.testing.assert_array_equal(residual, np.concatenate([p.x.ravel() for p in other.parts]))
    assert with_ascending_times(other, wrong.parameters) is other
