"""Identification of models with several regions and with user-defined materials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.checks import relative_error
from kit.problems import measured_with
from kit.terms import DAMPING, LEFT_HALF, MODELS, parameters, waved_bar

from collocation_sysid.fem.regions import Region
from collocation_sysid.methods import METHODS
from collocation_sysid.model.parameters import Parameters, Tied, Unknown
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.sweep import Sweep
from collocation_sysid.statistics.pose_noise import uncertainty_at


def collocation_of(name: str) -> Collocation:
    body, truth, guesses = MODELS[name]
    experiment = measured_with(waved_bar(**body), truth)
    return Collocation([experiment], parameters(truth, guesses))


@pytest.mark.long
@pytest.mark.parametrize("name", MODELS)
def test_both_methods_recover_the_truth(name):
    truth, guesses = MODELS[name][1:]
    collocation = collocation_of(name)
    reduced, interior = (METHODS[m]()(collocation) for m in ("reduced-space", "interior-point"))
    for solution in (reduced, interior):
        assert solution.status.converged, solution.message
        for parameter in guesses:
            assert solution.parameters[parameter] == pytest.approx(truth[parameter], rel=1e-3)
    values = [[*solution.parameters.values()] for solution in (reduced, interior)]
    np.testing.assert_allclose(*values, rtol=1e-5)
    assert reduced.kkt_residual < 1e-8


def test_error_bars_of_regions_follow_the_noise(rng):
    body, truth, guesses = MODELS["two stiffnesses"]
    clean = measured_with(waved_bar(**body), truth)
    tracks = clean.markers.positions_m + 1e-4 * rng.standard_normal(clean.markers.positions_m.shape)
    markers = replace(clean.markers, positions_m=tracks, sigma_m=np.full(tracks.shape[1], 1e-4))
    collocation = Collocation([replace(clean, markers=markers)], parameters(truth, guesses))
    solution = METHODS["reduced-space"]()(collocation)
    found = uncertainty_at(collocation, solution.z)
    assert set(found.derived) >= {"young_pa", "stiff.young_pa"}
    for name in guesses:
        error = solution.parameters[name] - truth[name]
        deviation = found.estimates[name].statistical_std_error
        assert deviation is not None
        assert abs(error) < 4 * deviation


def test_a_tied_parameter_is_no_unknown_of_its_own():
    body, truth, _ = MODELS["two stiffnesses"]
    experiment = measured_with(waved_bar(**body), truth)
    stated = {**truth, "mu_pa": Unknown(450.0), "stiff.mu_pa": Tied("mu_pa", ratio=3.0)}
    collocation = Collocation([experiment], Parameters.from_mapping(stated))
    assert collocation.nq == 1
    solution = METHODS["reduced-space"]()(collocation)
    assert solution.parameters["mu_pa"] == pytest.approx(300.0, rel=1e-5)
    assert solution.parameters["stiff.mu_pa"] == pytest.approx(900.0, rel=1e-5)


def test_a_further_parameter_costs_a_right_hand_side_and_no_factorisation(monkeypatch):
    """A sweep factorises every timestep once, whatever the number of parameters."""
    body, truth, guesses = MODELS["two stiffnesses"]
    experiment = measured_with(waved_bar(**body), truth)
    counts = []
    for names in (["mu_pa"], [*guesses, "lambda_pa", "gamma_m_1_s"]):
        stated = {n: Unknown(v) if n in names else v for n, v in truth.items()}
        collocation = Collocation([experiment], Parameters.from_mapping(stated))
        (transcription,) = collocation.transcriptions
        z = METHODS["reduced-space"](max_iterations=1)(collocation).z
        solver = Sweep(transcription)
        factorised = []
        factorise_each = solver.factoriser.factorise_each

        def counted(matrix, count, *rest, kept=factorised, do=factorise_each, **more):
            kept.append(count)
            return do(matrix, count, *rest, **more)

        object.__setattr__(solver.factoriser, "factorise_each", counted)
        (part,) = collocation.iterates(z)
        tangent = solver.forward(part.x, part.equations)
        assert tangent.by_p.shape[2] == len(names)
        counts.append(sum(factorised))
    assert counts[0] == counts[1] == transcription.constraint_times


def test_regions_of_one_stiffness_are_the_body_without_regions():
    truth = {"lambda_pa": 200.0, "mu_pa": 300.0, **DAMPING}
    plain, divided = (
        measured_with(waved_bar(**body), truth)
        for body in ({}, {"regions": [Region("half", LEFT_HALF)]})
    )
    assert relative_error(divided.markers.positions_m, plain.markers.positions_m) < 1e-12
