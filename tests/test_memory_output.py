"""What is said of a memory: instantaneous moduli, and branches that were not found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from memories_small import ONE, guesses, recorded, remembering
from problems_small import measured_with, with_markers

from collocation_sysid.experiment import Experiment
from collocation_sysid.fem.constants import symbol_of
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.nlp.collocation import Collocation
from collocation_sysid.statistics.estimates import Estimate
from collocation_sysid.statistics.linearised import linearised_fit
from collocation_sysid.statistics.memory_notes import memory_notes
from collocation_sysid.statistics.uncertainty import Uncertainty, uncertainty_of

NOISE_M = 2e-4


def found(experiment: Experiment) -> Uncertainty:
    """Estimates from noisy markers."""
    tracks = experiment.markers.positions_m
    noise = np.random.default_rng(3).normal(scale=NOISE_M, size=tracks.shape)
    noisy = with_markers(experiment, tracks + noise)
    noisy = replace(noisy, markers=replace(noisy.markers, sigma_m=NOISE_M))
    parameters = guesses(ONE, 1.2)
    collocation = Collocation([noisy], parameters)
    solution = ReducedSpace()(collocation)
    return uncertainty_of(linearised_fit(collocation, solution.z), parameters, solution.q)


def test_the_instantaneous_modulus_has_an_error_bar():
    uncertainty = found(recorded("hung-cube", 40))
    young = uncertainty.derived["young_pa"]
    at_once = uncertainty.derived["instantaneous_young_pa"]
    share = uncertainty.estimates["prony_1.share"]
    assert at_once.value == pytest.approx(young.value * (1 + share.value), rel=1e-12)
    assert at_once.ci95 is not None
    assert at_once.ci95[0] < 720.0 * 1.4 < at_once.ci95[1]
    assert share.ci95 is not None
    assert share.ci95[0] < 0.4 < share.ci95[1]


def test_a_memory_that_is_not_there_is_not_found():
    forgetful = measured_with(remembering("hung-cube", 40), ONE | {"prony_1.share": 0.0})
    uncertainty = found(forgetful)
    assert any("no memory" in note for note in uncertainty.notes)
    share = uncertainty.estimates["prony_1.share"]
    assert share.value < 0.05
    assert share.ci95 is None or share.ci95[0] >= 0


def test_a_branch_slower_than_the_recordings_is_told():
    slow = {"prony_1.share": Estimate(0.3, 0.01, (0.28, 0.32)), "prony_1.tau_s": Estimate(5.0)}
    (note,) = memory_notes(slow, 2.0)
    assert "slower than the longest recording of 2 s" in note
    assert not memory_notes(slow, 8.0)
    (note,) = memory_notes(slow | {"prony_1.share": Estimate(0.0, at_bound=True)}, 8.0)
    assert note.startswith("no memory found: the share of prony_1 ended at 0")


def test_constants_of_a_branch_have_symbols():
    assert symbol_of("prony_1.share") == "g prony_1"
    assert symbol_of("core.prony_1.tau_s") == "τ core.prony_1"
