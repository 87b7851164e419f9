"""What a caller may expect of every method."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from kit.problems import GUESS, TRUTH, hung_cube, measured, relative_errors

from collocation_sysid.fem.laws.moduli import engineering_constants
from collocation_sysid.methods.comparison.casadi_nlp import PLUGINS
from collocation_sysid.methods.comparison.shooting import Shooting
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Iteration, Status
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.program.collocation import Collocation

FIND_THE_TRUTH = {"interior-point": InteriorPoint(tolerance=1e-11), "reduced-space": ReducedSpace()}
WITHOUT_LIFTING = {
    "reduced-space": ReducedSpace(),
    "shooting": Shooting(),
    "adjoint": Shooting("adjoint"),
}
METHODS = FIND_THE_TRUTH | WITHOUT_LIFTING | {name: make() for name, make in PLUGINS.items()}


@cache
def experiment():
    return measured(hung_cube())


@pytest.mark.parametrize("name", FIND_THE_TRUTH)
def test_fixed_parameters_stay_and_the_others_are_found(name: str):
    fixed = [Parameter(name, TRUTH[name], is_fixed=True) for name in ("gamma_r_s", "gamma_m_1_s")]
    collocation = Collocation([experiment()], Parameters((*GUESS.items[:2], *fixed)))
    solution = FIND_THE_TRUTH[name](collocation)
    assert np.abs(relative_errors(solution)).max() < (1e-6 if name == "reduced-space" else 1e-5)
    assert solution.parameters["gamma_r_s"] == TRUTH["gamma_r_s"]


@pytest.mark.parametrize("name", FIND_THE_TRUTH)
def test_young_and_poisson_are_found(name: str):
    elastic = (Parameter("young_pa", 300.0, 10.0, 1e5), Parameter("poisson", 0.4, 0.01, 0.49))
    parameters = Parameters((*elastic, *GUESS.items[2:]))
    solution = FIND_THE_TRUTH[name](Collocation([experiment()], parameters))
    young_pa, poisson = engineering_constants(TRUTH["lambda_pa"], TRUTH["mu_pa"])
    rel = 1e-6 if name == "reduced-space" else 1e-5
    assert solution.parameters["young_pa"] == pytest.approx(young_pa, rel=rel)
    assert solution.parameters["poisson"] == pytest.approx(poisson, rel=rel)


@pytest.mark.parametrize("name", WITHOUT_LIFTING)
def test_a_search_with_all_parameters_fixed_simulates(name: str):
    fixed = Parameters(tuple(Parameter(name, TRUTH[name], is_fixed=True) for name in TRUTH))
    solution = WITHOUT_LIFTING[name](Collocation([experiment()], fixed))
    assert solution.status is Status.CONVERGED
    assert solution.rms_m < 1e-9
    assert solution.kkt_residual < 1e-8
    assert name == "reduced-space" or solution.iterations == 1


@pytest.mark.parametrize("name", METHODS)
def test_an_error_in_the_callers_function_reaches_the_caller(name: str, capfd):
    def broken(iteration: Iteration) -> None:
        raise ZeroDivisionError("in watch")

    with pytest.raises(ZeroDivisionError, match="in watch"):
        METHODS[name](Collocation([experiment()], GUESS), watch=broken)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", FIND_THE_TRUTH)
def test_timings_are_parts_of_the_whole(name: str):
    timing = FIND_THE_TRUTH[name](Collocation([experiment()], GUESS)).timing
    parts = (timing.build, timing.evaluations, timing.linear_algebra)
    assert min(parts) >= 0
    assert timing.evaluations > 0
    assert sum(parts) <= timing.total
