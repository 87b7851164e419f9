"""The last result of a function for each object."""

from __future__ import annotations

import gc
import weakref

import numpy as np
from kit.problems import cube_with_nuisance

import collocation_sysid as cs
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.statistics.linearised import known_at_last, linearise_fit


def test_a_result_is_computed_again_for_another_array_or_object_only():
    class Owner:
        pass

    calls = []

    @known_at_last
    def total(owner: Owner, at: np.ndarray) -> float:
        calls.append(owner)
        return float(at.sum())

    one, other = Owner(), Owner()
    assert [total(one, np.ones(3)) for _ in range(2)] == [3.0, 3.0]
    assert total(other, np.ones(3)) == 3.0
    assert total(one, np.ones(4)) == 4.0
    assert calls == [one, other, one]


def test_a_linearised_fit_does_not_keep_its_program():
    parameters = {
        "lambda_pa": cs.Unknown(200.0),
        "mu_pa": 300.0,
        "gamma_r_s": 0.0,
        "gamma_m_1_s": 1.0,
    }
    collocation = cs.Problem([cube_with_nuisance(4)], parameters).collocation()
    z, _ = initial_variables(collocation)
    fit = linearise_fit(collocation, z)
    assert linearise_fit(collocation, z.copy()) is fit
    program = weakref.ref(collocation)
    del collocation
    gc.collect()
    assert program() is None
    assert fit.blocks
