"""Correction of estimates for systematic effects of known size: machine compliance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.static import PRESSED_M, block

from collocation_sysid import Experiment, Problem, Unknown, Wrench, run, simulate
from collocation_sysid.errors import InputError
from collocation_sysid.problem.options import UncertaintyOptions
from collocation_sysid.program.simulation import with_wrenches
from collocation_sysid.statistics.budget.combined_intervals import combine
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.estimates import Estimate

STATED = {"poisson": 0.3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
YOUNG_PA = 8e3
# Five percent of the compliance of the block, a square of 0.1 m and as high.
COMPLIANCE_M_N, DEVIATION_M_N = 5e-5, 5e-6


def bench(z_m: np.ndarray, symmetry: int = 1, scale: float = 1.0) -> Experiment:
    """The block with its force measured under the upper platen, which is at heights `z_m`; it is
    one part of `symmetry` equal ones of the specimen, with this share of the displacement.
    """
    pressed = block("xyz", z_m=z_m)
    lower, upper, *sides = pressed.grasps
    sensor = Wrench(pressed.t_s, np.zeros((len(pressed.t_s), 6)), 1e-3, 1e-3, symmetry=symmetry)
    return replace(
        pressed,
        markers=None,
        grasps=(lower, replace(upper, wrench=sensor, displacement_scale=scale), *sides),
    )


def measured(symmetry: int, scale: float) -> Experiment:
    """The same in a machine that gives way under the load of the specimen, with the displacement
    behind its frame.
    """
    z_m = np.array(PRESSED_M)
    for _ in range(6):
        (wrench_n,) = simulate(bench(z_m), {"young_pa": YOUNG_PA, **STATED}).wrenches
        z_m = PRESSED_M - COMPLIANCE_M_N * wrench_n[:, 2]
    return with_wrenches(bench(np.array(PRESSED_M), symmetry, scale), [wrench_n])


def solved(compliance: object, symmetry: int = 1, scale: float = 1.0):
    known = dict.fromkeys(Assumptions().collect_deviations(), "none")
    stated = Assumptions(**(known | {"machine_compliance_m_n": compliance}))
    problem = Problem(
        [measured(symmetry, scale)],
        {"young_pa": Unknown(5e3), **STATED},
        uncertainty=UncertaintyOptions(assumptions=stated),
    )
    return run(problem, seek_causes=False)


def test_a_stated_compliance_of_the_machine_corrects_the_modulus():
    left = solved(DEVIATION_M_N).estimates["young_pa"]
    corrected = solved({"mean": COMPLIANCE_M_N, "deviation": DEVIATION_M_N}).estimates["young_pa"]
    assert left.value < 0.97 * YOUNG_PA
    assert corrected.value == pytest.approx(YOUNG_PA, rel=5e-3)
    assert corrected.combined95 is not None
    low, high = corrected.combined95
    assert low < YOUNG_PA < high
    assert corrected.optimum == pytest.approx(left.optimum)
    # What is left is the deviation alone; without the correction the residuals add to it.
    assert corrected.combined_std_error is not None
    assert left.combined_std_error is not None
    ratio = corrected.combined_std_error / corrected.value
    change = np.log(corrected.value / left.value)
    assert ratio == pytest.approx(change * DEVIATION_M_N / COMPLIANCE_M_N, rel=0.01)
    assert ratio < left.combined_std_error / left.value


def test_the_machine_yields_to_the_load_of_the_whole_specimen():
    stated = {"mean": COMPLIANCE_M_N / 4, "deviation": DEVIATION_M_N / 4}
    estimate = solved(stated, symmetry=4).estimates["young_pa"]
    assert estimate.value == pytest.approx(YOUNG_PA, rel=5e-3)


def test_half_of_the_height_takes_half_of_the_lag_of_the_machine():
    stated = {"mean": COMPLIANCE_M_N * 2, "deviation": DEVIATION_M_N * 2}
    estimate = solved(stated, scale=0.5).estimates["young_pa"]
    assert estimate.value == pytest.approx(YOUNG_PA, rel=5e-3)


def test_intervals_are_moved_by_corrections_and_respect_bounds():
    estimate = Estimate(2.0, 0.1, (1.8, 2.2))
    plain = combine("young_pa", estimate, None, 0.1)
    moved = combine("young_pa", estimate, None, 0.1, known_effect=0.2, bounds=(0.0, 2.5))
    assert moved.value == pytest.approx(2.0 * np.exp(0.2))
    assert plain.combined95 is not None
    assert moved.combined95 is not None
    assert moved.combined95[0] == pytest.approx(plain.combined95[0] * np.exp(0.2))
    assert moved.combined95[1] == 2.5


@pytest.mark.parametrize(
    ("name", "stated", "message"),
    [
        ("grip_layer_m", {"mean": -1e-4, "deviation": 1e-4}, "grip_layer_m.mean: found -0.0001"),
        ("grip_layer_m", {"mean": 1e-4}, "grip_layer_m: found"),
        ("mass", {"mean": 0.1, "deviation": 0.1}, "mass: found"),
    ],
)
def test_a_known_effect_has_a_size_and_a_deviation_and_a_sign(name, stated, message):
    with pytest.raises(InputError) as refused:
        Assumptions(**{name: stated})
    assert message in str(refused.value)
