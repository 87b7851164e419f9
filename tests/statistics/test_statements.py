"""Statements of one answer do not contradict each other."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.kinds.specimen.concerns import as_specimen_concerns
from collocation_sysid.runs.check.body import bending_concerns
from collocation_sysid.statistics.assessment import _noisy_marker_concerns
from collocation_sysid.statistics.concerns import Concern
from collocation_sysid.statistics.estimates import derived_estimates
from collocation_sysid.statistics.linearised import DerivedModuli
from collocation_sysid.statistics.residuals.diagnostics import Outlier


def estimated(name, value, slopes, reasons=()):
    """Estimate of one modulus with derivatives by two parameters of variances 0.01."""
    derived = DerivedModuli({name: value}, {name: np.array(slopes)})
    no = np.zeros(2, dtype=bool)
    return derived_estimates(derived, 0.01 * np.eye(2), no, np.full(2, 2.0), reasons)[name]


def test_a_negative_poisson_ratio_has_an_interval():
    estimate = estimated("poisson", -0.3, [0.2, 0.0])
    assert estimate.statistical_std_error == pytest.approx(0.02)
    assert estimate.statistical95 == pytest.approx((-0.34, -0.26))


def test_a_poisson_ratio_of_rounding_is_zero():
    estimate = estimated("poisson", 4.5e-13, [9e-14, 1e-14])
    assert estimate.value == 0.0
    assert estimate.statistical95 is None


def test_a_modulus_of_one_parameter_is_as_identifiable_as_this():
    reason = "confounded with share (correlation 0.999)"
    estimate = estimated("young_pa", 3e4, [3e4, 0.0], (reason, None))
    assert estimate.reason == reason
    assert estimate.statistical_std_error is None
    assert estimate.statistical95 is not None
    # The sum of two confounded parameters may be determined.
    assert estimated("young_pa", 3e4, [3e4, 1e4], (reason, reason)).reason is None


def test_fewer_elements_than_needed_are_shown_as_fewer():
    body: Any = SimpleNamespace(element=SimpleNamespace(name="tet10-p0"))
    (concern,) = bending_concerns(body, 1.0, 0.02, 1.97)
    assert "only about 1.9 tet10-p0 elements" in concern.message
    assert "to 2 or more" in concern.message


def test_an_outlier_in_a_table_without_times_has_a_row():
    test = cs.Specimen("uniaxial", [0.1, 0.2, 0.3], [1e3, 2e3, 3e3], 10.0)
    outlier = Outlier("pull/stress", 2, 2.0, 0.9, 12.0, is_relaxed_start=False)
    (concern,) = as_specimen_concerns([outlier.to_concern()], [test.experiment(name="pull")])
    assert "sample 3 (strain 0.3) deviates" in concern.message
    assert " s " not in concern.message
    assert isinstance(concern, Concern)


def test_an_outlier_in_a_table_of_moduli_has_a_modulus_and_comes_first():
    frequency_hz, modulus_pa = [0.1, 1.0, 10.0], [1e5, 1.1e5, 1.2e5]
    dma = cs.Specimen.harmonic(frequency_hz, modulus_pa, [1e3, 2e3, 1e3], 0.01)
    relaxed = cs.Specimen.relaxation([0.5, 2.0, 8.0], modulus_pa[::-1], 1e3)
    tests = [
        dma.experiment(name="dma", prony=("slow",)),
        relaxed.experiment(name="hold", prony=("slow",)),
    ]
    large = Concern("noise/larger", "doubtful", {"factor": 9.0, "stated": "sigma"})
    # Harmonic samples begin with the shortest period and alternate between E' and E".
    for series, sample, named in (
        ("dma/stress", 4, "dma: the loss modulus at 1 Hz"),
        ("dma/stress", 5, "dma: the storage modulus at 0.1 Hz"),
        ("hold/stress", 3, "hold: the relaxation modulus at 2 s"),
    ):
        outlier = Outlier(series, sample, 2.0, 0.9, 12.0, is_relaxed_start=False).to_concern()
        first, second = as_specimen_concerns([large, outlier], tests)
        assert first.message.startswith(f"{named} deviates by 12 sigma")
        assert first.grade == "doubtful"
        assert second.code == "specimen/branches"
    half = replace(outlier, data={**outlier.data, "percent": 60.0})
    assert as_specimen_concerns([large, half], tests)[0].code == "specimen/branches"


@pytest.mark.parametrize(("tests", "key"), [("dma", "relative_sigma"), ("pull", "sigma_pa")])
def test_too_large_noise_is_named_by_the_key_of_its_test(tests, key):
    by_name = {
        "dma": cs.Specimen.harmonic([0.1, 1.0], [1e5, 1.1e5], [1e3, 2e3], 0.01),
        "pull": cs.Specimen("uniaxial", [0.1, 0.2], [1e3, 2e3], 10.0),
    }
    small = Concern("noise/smaller", data={"factor": 35.0, "stated": "sigma"})
    (concern,) = as_specimen_concerns(
        [small], [by_name[tests].experiment(name=tests, prony=("slow",))]
    )
    assert concern.message.startswith(f"{key} seems 35 times too large")


def test_noisy_residuals_of_a_force_are_not_those_of_a_marker():
    names = tuple(f"swing/m{k}" for k in range(5))
    level: Any = SimpleNamespace(
        unequal_p=0.0,
        factors=dict.fromkeys(names, 1.0) | {"swing/force": 8.4},
        sigma_keys=dict.fromkeys(names, "sigma_m") | {"swing/force": "sigma_n"},
    )
    (concern,) = _noisy_marker_concerns(level)
    assert "swing/force are 8.4 times sigma_n: check sigma_n" in concern.message
    for word in ("label", "reference_m", "sigma_m"):
        assert word not in concern.message
