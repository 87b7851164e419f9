"""A search that ends at a default bound continues within what is physically possible."""

from __future__ import annotations

import numpy as np
import pytest
from kit.problems import hung_cube

import collocation_sysid as cs
from collocation_sysid.fem.laws.constants import constant_named
from collocation_sysid.model.parameters import Parameter, Parameters, is_default_bound
from collocation_sysid.runs.second_start import start_beyond_bounds
from collocation_sysid.statistics.assessment import Assessment
from collocation_sysid.statistics.concerns import Concern

UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


def metal_wire(upper: float | None = None) -> cs.Solution:
    """Solution of a tensile test of a wire of 70 GPa."""
    strain = np.linspace(1e-4, 2e-3, 12)
    noise = np.random.default_rng(1).standard_normal(len(strain))
    specimen = cs.Specimen("uniaxial", strain, 70e9 * strain + 1e5 * noise, 1e5)
    return cs.solve(
        cs.Problem(
            [specimen.experiment("neo-hookean", "wire")],
            {"young_pa": cs.Unknown(upper=upper), "poisson": 0.33, **UNDAMPED},
        )
    )


def test_the_modulus_of_a_metal_is_found_beyond_the_default_bound():
    solution = metal_wire()
    assert solution.status.converged
    assert solution.parameters["young_pa"] == pytest.approx(70e9, rel=0.01)
    assert any("default bound young_pa = 1e+09" in note for note in solution.notes)


def test_a_stated_bound_is_kept():
    solution = metal_wire(upper=5e8)
    assert solution.parameters["young_pa"] == pytest.approx(5e8)
    assert start_beyond_bounds(solution) is None


def test_the_ratio_of_an_auxetic_foam_is_found_below_the_default_bound():
    strain = np.linspace(0.01, 0.1, 10)
    random = np.random.default_rng(2)
    specimen = cs.Specimen(
        "uniaxial",
        strain,
        2e4 * strain + 5 * random.standard_normal(10),
        5.0,
        lateral_stretch=1 + 0.2 * strain + 1e-4 * random.standard_normal(10),
        lateral_sigma=1e-4,
    )
    solution = cs.solve(
        cs.Problem(
            [specimen.experiment("neo-hookean", "foam")],
            {"young_pa": cs.Unknown(), "poisson": cs.Unknown(), **UNDAMPED},
        )
    )
    assert solution.status.converged
    assert solution.parameters["poisson"] == pytest.approx(-0.2, abs=0.03)


def test_a_physical_limit_is_no_default_bound():
    share = Parameter("b.share", 0.1, 0.0, 20.0, scale="linear", unit=0.1)
    assert is_default_bound(share, 20.0)
    assert not is_default_bound(share, 0.0)


def test_a_stated_bound_that_equals_the_default_is_no_default_bound():
    (least, most) = constant_named("poisson").bounds
    for lower, upper, expected in ((None, None, True), (least, None, False), (None, most, True)):
        stated = cs.Unknown(0.2, lower, upper)
        (item,) = Parameters.from_mapping({"poisson": stated}).scalars
        assert is_default_bound(item, least) is expected


def test_elements_that_lock_keep_the_upper_bound_of_the_ratio():
    cube = hung_cube()
    truth = {"young_pa": 600.0, "poisson": 0.495, "gamma_r_s": 0.01, "gamma_m_1_s": 1.0}
    tracks_m = cs.simulate(cube, truth, "midpoint", substeps=1).markers_m
    statements = {**truth, "poisson": cs.Unknown(0.49499)}
    solution = cs.solve(cs.Problem([cs.with_markers(cube, tracks_m)], statements))
    assert solution.parameters["poisson"] == pytest.approx(0.495, abs=1e-4)
    assert start_beyond_bounds(solution) is None


def test_a_default_bound_is_the_first_reason_with_the_gravest_grade():
    concerns = Assessment.from_concerns(
        [
            Concern("solve/acceptable"),
            Concern("solve/no-error-bars", "doubtful"),
            Concern("information/default-bound", data={"names": ["young_pa"]}),
        ]
    ).concerns
    assert [each.code for each in concerns] == [
        "information/default-bound",
        "solve/no-error-bars",
        "solve/acceptable",
    ]
    assert concerns[0].grade == "doubtful"


@pytest.mark.long
def test_a_liquid_has_no_long_term_modulus():
    """A ramp to 2 % in 0.2 s, then relaxation to zero with a time of 1 s."""
    times_s = np.linspace(0.0, 4.0, 41)
    strain = np.minimum(times_s / 0.2, 1) * 0.02
    since_s = np.clip(times_s - 0.2, 0.0, None)
    ramp = 1 - np.exp(-np.minimum(times_s, 0.2))
    stress_pa = 1e5 * 0.1 * ramp * np.exp(-since_s)
    stress_pa += 5 * np.random.default_rng(4).standard_normal(len(times_s))
    specimen = cs.Specimen("uniaxial", strain, stress_pa, 5.0, t_s=times_s)
    problem = cs.Problem(
        [specimen.experiment(name="hold", prony=("b",))],
        {
            "young_pa": cs.Unknown(),
            "poisson": 0.4999,
            "b.share": cs.Unknown(),
            "b.tau_s": cs.Unknown(),
            **UNDAMPED,
        },
    )
    result = cs.run(problem)
    values = result.solution.parameters
    assert values["b.tau_s"] == pytest.approx(1.0, rel=0.05)
    assert values["young_pa"] * (1 + values["b.share"]) == pytest.approx(1e5, rel=0.06)
    assert "as that of a liquid" in result.trust.reasons[0]
