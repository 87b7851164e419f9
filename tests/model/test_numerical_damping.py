"""Numerical damping and period error of schemes: formulas and simulations."""

from __future__ import annotations

import numpy as np
import pytest
from kit.checks import observed_order
from kit.oscillations import oscillation, released_in_a_mode

from collocation_sysid.errors import InputError
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.runs.check.modes import numerical_mode, principal_root, substeps_needed

EULER, MIDPOINT, BDF2 = (SCHEMES[name] for name in ("backward-euler", "midpoint", "bdf2"))
STEP_S = 0.01
SILICONE_RAD_S = 2 * np.pi * 7.7


@pytest.mark.parametrize("h", [0.05, 0.5, 2.0, 20.0])
def test_roots_are_those_worked_out_by_hand(h: float):
    assert principal_root(EULER.regular, h) == pytest.approx(1 / (1 - 1j * h))
    half = 1j * h / 2
    assert principal_root(MIDPOINT.regular, h) == pytest.approx((1 + half) / (1 - half))
    # (3 − 4u + u²) / 2 = ih for u = 1/z, which is one at h = 0
    assert principal_root(BDF2.regular, h) == pytest.approx(1 / (2 - np.sqrt(1 + 2j * h)))


def test_backward_euler_damps_by_half_the_phase_of_a_step():
    mode = numerical_mode(EULER, SILICONE_RAD_S, STEP_S)
    assert mode.damping_ratio == pytest.approx(0.24, abs=0.015)
    small = numerical_mode(EULER, 1.0, 1e-3)
    assert small.damping_ratio == pytest.approx(0.5e-3, rel=1e-4)
    assert small.period_error == pytest.approx(1e-6 / 3, rel=1e-3)


@pytest.mark.parametrize("h", [0.01, 0.5, 3.0])
def test_midpoint_does_not_damp_and_lengthens_the_period(h: float):
    mode = numerical_mode(MIDPOINT, h, 1.0)
    assert abs(mode.damping_ratio) < 1e-12
    assert mode.period_error == pytest.approx(h / (2 * np.arctan(h / 2)) - 1)


def test_bdf2_damps_with_the_third_power_of_the_step():
    steps = np.array([0.02, 0.04, 0.08])
    ratios = [numerical_mode(BDF2, 1.0, h).damping_ratio for h in steps]
    assert observed_order(steps, ratios) == pytest.approx(3, abs=0.05)


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("damping_ratio", [0.0, 0.2])
def test_errors_vanish_with_the_schemes_order(name: str, damping_ratio: float):
    steps = np.array([0.01, 0.02, 0.04])
    roots = [principal_root(SCHEMES[name].regular, h, damping_ratio) for h in steps]
    exact = -damping_ratio + 1j * np.sqrt(1 - damping_ratio**2)
    errors = np.abs(np.log(roots) / steps - exact)
    assert observed_order(steps, errors) == pytest.approx(SCHEMES[name].order, abs=0.1)


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("gamma_m_1_s", [0.0, 5.0])
def test_a_simulation_damps_as_much_as_predicted(name: str, gamma_m_1_s: float):
    theta = np.array([200.0, 300.0, 0.0, gamma_m_1_s])
    released, modes = released_in_a_mode(theta, 0)
    omega, ratio = oscillation(released, modes, 0, theta, name)
    true_omega = modes.angular_frequencies_rad_s[0]
    physical = modes.damping_ratios[0]
    mode = numerical_mode(SCHEMES[name], true_omega, released.timestep_s, physical)
    assert ratio - physical == pytest.approx(mode.damping_ratio, abs=2e-5)
    period_ratio = true_omega * np.sqrt(1 - physical**2) / (omega * np.sqrt(1 - ratio**2))
    assert period_ratio - 1 == pytest.approx(mode.period_error, abs=2e-5)


@pytest.mark.parametrize("scheme", [EULER, BDF2, MIDPOINT], ids=lambda scheme: scheme.name)
def test_the_substeps_named_are_the_fewest_that_suffice(scheme):
    limit = 0.005
    needed = substeps_needed(scheme, SILICONE_RAD_S, STEP_S, limit)
    assert needed is not None

    def good(substeps: int) -> bool:
        mode = numerical_mode(scheme, SILICONE_RAD_S, STEP_S / substeps)
        return mode.damping_ratio <= limit and mode.period_error <= 0.01

    assert good(needed)
    assert not good(needed - 1)


def test_few_substeps_suffice_for_slow_modes_and_none_for_absurd_modes():
    assert substeps_needed(MIDPOINT, 1.0, STEP_S, 0.005) == 1
    assert substeps_needed(EULER, 1e6, STEP_S, 0.005) is None


def test_overdamped_modes_are_refused():
    with pytest.raises(InputError, match=r"damping_ratio = 1, expected"):
        numerical_mode(EULER, 1.0, STEP_S, 1.0)
