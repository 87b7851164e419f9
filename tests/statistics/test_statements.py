"""Statements of one answer do not contradict each other."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.features.specimens.concerns import as_specimen_concerns
from collocation_sysid.result.alternative_sentences import alternative_sentences
from collocation_sysid.result.probe_sections import _conclusions, is_another_effect
from collocation_sysid.runs.check.body import bending_concerns
from collocation_sysid.statistics.assessment import (
    Assessment,
    _noisy_marker_concerns,
    _relaxed_estimate,
)
from collocation_sysid.statistics.budget.alternatives import Alternative
from collocation_sysid.statistics.concerns import Concern
from collocation_sysid.statistics.estimates import derived_estimates
from collocation_sysid.statistics.linearised import DerivedModuli
from collocation_sysid.statistics.probes.relaxed_assumptions import EstimateChange
from collocation_sysid.statistics.residuals.diagnostics import Outlier

CHECK = Assessment((Concern("noise/larger"),))


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


def test_a_probe_without_shown_estimates_states_no_changes():
    probe = SimpleNamespace(
        name="clock_rate",
        kind="assumption",
        sentences=("young_pa",),
        chi_squared=30.0,
        size=0.1,
        size_error=0.01,
        moves={},
    )
    result: Any = SimpleNamespace(
        probes=[probe], estimates={}, parameters={}, budget={}, trust=CHECK
    )
    first = next(_conclusions(result))
    assert first.endswith("χ² decreases by 30; measure it, or estimate it")


def test_memory_of_a_negative_share_is_called_another_effect():
    def probe(name: str, size: float, chi_squared: float) -> SimpleNamespace:
        return SimpleNamespace(
            name=name, kind="assumption", sentences=(name,), chi_squared=chi_squared, size=size,
            size_error=0.03, moves={}, routine=True,
        )  # fmt: skip

    probes = [probe("memory_share τ=0.01s", -0.25, 79.8), probe("clock_rate", 0.1, 30.0)]
    result: Any = SimpleNamespace(
        probes=probes, estimates={}, parameters={}, budget={}, trust=CHECK
    )
    (impossible,) = _conclusions(result)
    assert impossible.startswith("χ² would decrease by 79.8 with memory of a negative share")
    assert impossible.endswith("this is another effect, not memory; by less with clock rate (30)")
    assert is_another_effect(result)
    result.probes = probes[:1]
    (impossible,) = _conclusions(result)
    assert impossible.endswith("this is another effect, not memory")
    result.probes = [probe("memory_share τ=0.01s", -0.25, 20.0), probes[1]]
    (measured,) = _conclusions(result)
    assert measured.startswith("the data determine clock rate")
    result.trust = Assessment()
    assert not [*_conclusions(result)]  # nothing contradicts the description
    assert not is_another_effect(result)


@pytest.mark.parametrize(("chi_squared", "explained"), [(44.0, True), (4.0, False)])
def test_a_decrease_without_a_finding_is_explained(chi_squared, explained):
    probe = SimpleNamespace(
        name="anisotropy z",
        kind="assumption",
        sentences=(),
        chi_squared=chi_squared,
        size=0.1,
        size_error=0.05,
        routine=True,
    )
    result: Any = SimpleNamespace(
        probes=[probe], estimates={}, parameters={}, budget={}, trust=CHECK
    )
    (told,) = _conclusions(result)
    assert told.startswith("tested without a finding: anisotropy z")
    assert ("χ² decreases by 44 with anisotropy z, which is not significant" in told) == explained


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


@pytest.mark.parametrize(
    ("share", "said"), [(0.3, "E +30.00 % and ν +12.00 %"), (-30.21, "E more than half and ν")]
)
def test_a_change_beyond_first_order_has_no_number(share, said):
    moves = {
        "young_pa": EstimateChange(1e4 * (1 + share), 1.0, 1e4 * share, 2.0, 1.0),
        "poisson": EstimateChange(0.28, 0.01, 0.03, 2.0, 1.0),
    }
    probe: Any = SimpleNamespace(
        name="clock_rate",
        kind="assumption",
        sentences=("clock_rate",),
        chi_squared=30.0,
        size=0.1,
        size_error=0.01,
        moves=moves,
    )
    values = {"young_pa": 1e4, "poisson": 0.25}
    estimates = {
        name: SimpleNamespace(value=value, statistical95=(0.9 * value, 1.1 * value))
        for name, value in values.items()
    }
    result: Any = SimpleNamespace(
        probes=[probe], estimates=estimates, parameters=values, budget={}, trust=CHECK
    )
    assert f"the estimates change by {said}" in next(_conclusions(result))
    told = _relaxed_estimate(probe, "young_pa", 1.0)
    assert (told == "E different by more than half") is (abs(share) > 0.5)
    other = Alternative("mass", "with another mass", {"young_pa": 1e4 * (1 + share)})
    law = Alternative("damping_law", "with another law", {"gamma_r_s": 1e-3 * (1 + share)})
    estimates["gamma_r_s"] = SimpleNamespace(value=1e-3)
    result.alternatives = (other, law)
    change, value = alternative_sentences(result)
    if abs(share) > 0.5:
        assert change.startswith("with another mass, E would change by more than half; ")
        assert value == "with another law: γ_r different by more than half"
    else:
        assert change.startswith("with another mass, E would change by about +30%; ")
        assert value == "with another law: γ_r about 0.0013 s"
