"""Sliders over the parameters of a run, moved as in a notebook."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from functools import cache
from importlib import util

import numpy as np
import pytest
from kit.problems import TRUTH, hung_cube

import collocation_sysid as cs
from collocation_sysid.result import parameter_sliders
from collocation_sysid.result.parameter_sliders import ParameterSliders, SliderRange
from collocation_sysid.runs.result_content import ReportedEstimate

pytest.importorskip("ipywidgets")

NOISE_M = 1e-3
PNG = b"\x89PNG"


@cache
def identified(tie: bool = False) -> cs.Run:
    """A swinging cube, whose λ and μ are estimated from noisy tracks; λ may be tied to μ."""
    hung = hung_cube(20)
    tracks = cs.simulate(hung, TRUTH).markers_m
    tracks = tracks + NOISE_M * np.random.default_rng(0).standard_normal(tracks.shape)
    sigma_m = np.full(tracks.shape[1], NOISE_M)
    seen = replace(hung.markers, positions_m=tracks, sigma_m=sigma_m)
    lame = cs.Tied("mu_pa", TRUTH["lambda_pa"] / TRUTH["mu_pa"]) if tie else cs.Unknown(220.0)
    stated = {**TRUTH, "lambda_pa": lame, "mu_pa": cs.Unknown(280.0)}
    problem = cs.Problem([replace(hung, markers=seen)], stated, substeps=2)
    return cs.run(problem, "reduced-space", seek_causes=False)


@pytest.mark.long
def test_sliders_begin_at_the_estimates_within_their_ranges():
    run = identified()
    sliders = ParameterSliders.from_run(run).sliders
    assert [*sliders] == ["lambda_pa", "mu_pa"]
    for name, slider in sliders.items():
        estimate = run.estimates[name]
        assert slider.value == pytest.approx(estimate.value)
        low, high = (slider.base**end for end in (slider.min, slider.max))
        assert low < estimate.combined95[0] < estimate.combined95[1] < high
        assert slider.continuous_update is False
    assert sliders["mu_pa"].description == "μ Pa"


@pytest.mark.long
def test_the_first_simulation_is_the_forward_simulation_of_the_run():
    run = identified()
    shown = ParameterSliders.from_run(run)
    optimum = run.solution.parameters
    for name, slider in shown.sliders.items():
        slider.value = optimum[name]
    (rollout,) = run.rollouts.values()
    assert shown.simulation.rms_m == pytest.approx(rollout.rms_m, rel=1e-6)
    assert bytes(shown.picture.value).startswith(PNG)
    assert shown.message.value.startswith("markers: ")


@pytest.mark.long
def test_a_moved_slider_simulates_again():
    shown = ParameterSliders.from_run(identified())
    before = shown.simulation
    picture = shown.picture.value
    slider = shown.sliders["mu_pa"]
    slider.value = slider.value / 1.4
    assert shown.read_values()["mu_pa"] == pytest.approx(slider.value, rel=1e-9)
    assert shown.simulation.rms_m > 1.5 * before.rms_m
    assert shown.picture.value != picture
    assert shown.message.value.startswith("markers: ")


@pytest.mark.long
def test_the_button_returns_to_the_estimates_with_one_simulation(monkeypatch):
    shown = ParameterSliders.from_run(identified())
    before = shown.simulation.rms_m
    for slider in shown.sliders.values():
        slider.value = slider.value * 1.2
    assert shown.simulation.rms_m != before
    count = 0
    simulate = parameter_sliders.simulate_with_parameters

    def counted(*given, **named):
        nonlocal count
        count += 1
        return simulate(*given, **named)

    monkeypatch.setattr(parameter_sliders, "simulate_with_parameters", counted)
    shown.reset_button.click()
    assert count == 1
    assert shown.simulation.rms_m == before


@pytest.mark.long
def test_a_tied_parameter_follows_its_slider():
    run = identified(tie=True)
    shown = ParameterSliders.from_run(run)
    assert [*shown.sliders] == ["mu_pa"]
    shown.sliders["mu_pa"].value = 360.0
    assert shown.read_values()["lambda_pa"] == pytest.approx(240.0)
    assert shown.read_values()["gamma_m_1_s"] == TRUTH["gamma_m_1_s"]


def test_a_simulation_that_fails_says_why_and_keeps_the_picture(monkeypatch):
    shown = ParameterSliders.from_run(identified())
    picture = shown.picture.value

    def fail(*_, **__):
        raise cs.SimulationError("an element is inverted", 0.1)

    monkeypatch.setattr(parameter_sliders, "simulate_with_parameters", fail)
    shown.sliders["mu_pa"].value *= 1.1
    assert shown.message.value == "not simulated: an element is inverted (t = 0.1 s)"
    assert shown.simulation is None
    assert shown.picture.value == picture


def test_the_run_returns_the_box_of_widgets():
    run = identified()
    box = run.interactive()
    controls, picture = box.children
    assert bytes(picture.value).startswith(PNG)
    assert len(controls.children) == 4
    with pytest.raises(cs.InputError, match="nod"):
        run.interactive("nod")


def test_a_run_without_estimates_has_nothing_to_slide():
    hung = hung_cube(20)
    markers = replace(hung.markers, positions_m=cs.simulate(hung, TRUTH).markers_m)
    run = cs.run(cs.Problem([replace(hung, markers=markers)], TRUTH), seek_causes=False)
    with pytest.raises(cs.InputError, match="no parameter was estimated"):
        run.interactive()


def test_without_the_extra_the_error_names_it(monkeypatch):
    find = util.find_spec
    monkeypatch.setattr(
        parameter_sliders, "find_spec", lambda name: None if name == "ipywidgets" else find(name)
    )
    with pytest.raises(cs.InputError, match=r"pip install 'collocation-sysid\[interactive\]'"):
        identified().interactive()


@pytest.mark.long
def test_a_run_needs_no_widgets():
    code = "import sys; import collocation_sysid.pipeline; assert 'ipywidgets' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("value", "interval", "linear", "bounds", "expected"),
    [
        (100.0, (80.0, 125.0), False, (1.0, 1e6), (100 / 1.25**3, 100 * 1.25**3, True)),
        (100.0, (99.0, 101.0), False, (1.0, 1e6), (100 / 1.5, 150.0, True)),
        (100.0, None, False, (90.0, 1e6), (90.0, 150.0, True)),
        (0.3, (0.2, 0.4), True, (0.0, 0.5), (0.0, 0.5, False)),
        (-2.0, (-3.0, -1.0), True, (-np.inf, np.inf), (-5.0, 1.0, False)),
        (0.0, None, True, (-np.inf, np.inf), (-1.0, 1.0, False)),
    ],
)
def test_the_range_of_a_slider(value, interval, linear, bounds, expected):
    estimate = ReportedEstimate(value, None, None, combined95=interval)
    found = SliderRange.from_estimate(estimate, linear=linear, bounds=bounds)
    assert (found.low, found.high) == pytest.approx(expected[:2])
    assert found.is_logarithmic is expected[2]
    assert found.value == value
