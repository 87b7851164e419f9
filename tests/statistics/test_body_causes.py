"""Copies of tracks and filtered tracks are named, and which corrections are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_twins import TRUTH, twin
from kit.problems import GUESS, hung_cube, measured
from scipy.signal import butter, sosfiltfilt

from collocation_sysid import Problem, Unknown
from collocation_sysid.fem.laws.materials import MATERIALS
from collocation_sysid.judge.bodies import (
    body_rows,
    mirrored_meshes,
    with_body,
    with_material,
    with_shape,
)
from collocation_sysid.judge.engine import _named_alone_or_together, _Refits, find_misspecifications
from collocation_sysid.judge.tracks import _amplitudes, _cutoff, same_tracks
from collocation_sysid.pipeline import solve
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.statistics.hypothesis import Hypothesis

STEP_S = 0.01


def recorded(copied: bool):
    """A cube with noisy tracks of its markers at their places; the second may copy the first."""
    hung = hung_cube(20)
    places_m = hung.markers.predict_positions(hung.body.nodes_m)
    sigma_m = hung.markers.sigma_m[0]
    noise = np.random.default_rng(0).normal(scale=sigma_m, size=(21, *places_m.shape))
    tracks_m = places_m + noise
    if copied:
        tracks_m[:, 1] = tracks_m[:, 0]
    return with_markers(hung, tracks_m)


def test_two_markers_with_one_track_are_named():
    assert not [*same_tracks(recorded(copied=False))]
    (cause,) = same_tracks(recorded(copied=True))
    first, second, *_ = recorded(copied=True).markers.names
    assert f"markers {first} and {second}" in cause.message


def residuals(rng: np.random.Generator, noise: float) -> np.ndarray:
    """White noise, and the slow error of a wrong model."""
    t_s = STEP_S * np.arange(120)
    error = 3 * np.sin(2 * np.pi * 2 * t_s)[:, None] * rng.normal(size=12)
    return noise * rng.normal(size=(120, 12)) + error


@pytest.mark.parametrize("cutoff_hz", [6.0, 10.0, 15.0])
def test_the_cutoff_of_filtered_tracks_is_found(cutoff_hz: float):
    rng = np.random.default_rng(1)
    sections = butter(2, cutoff_hz, output="sos", fs=1 / STEP_S)
    smooth = sosfiltfilt(sections, residuals(rng, 1.0), axis=0)
    frequency_hz, amplitude = _amplitudes(smooth, STEP_S)
    cutoff = _cutoff(amplitude)
    assert cutoff is not None
    assert abs(frequency_hz[cutoff] / cutoff_hz - 1) < 0.25


@pytest.mark.parametrize("noise", [1.0, 0.2, 0.01])
def test_white_noise_with_a_wrong_model_is_not_filtered(noise: float):
    assert _cutoff(_amplitudes(residuals(np.random.default_rng(2), noise), STEP_S)[1]) is None


def test_a_cause_is_named_alone_only_if_no_other_suffices():
    lag = Hypothesis("gripper-frame", "'a'", corrected=1, strength=1.8, remaining=1.4)
    law = Hypothesis("poses-inverted", "'a'", corrected=2, strength=3.0, remaining=0.9)
    other = Hypothesis("camera-frame", "'a'", corrected=3, strength=2.9, remaining=0.95)
    losses = {1: 500.0, 2: 100.0, 3: 105.0}
    assert _named_alone_or_together([lag, law], losses.__getitem__) == [law]
    (either,) = _named_alone_or_together([lag, law, other], losses.__getitem__)
    assert either.code == "several"
    assert "inverted" in either.message
    assert "world frames" in either.message
    (partial,) = _named_alone_or_together([lag], losses.__getitem__)
    assert partial.code == "insufficient"
    assert _named_alone_or_together([law, other], {2: 100.0, 3: 150.0}.__getitem__) == [law]


def test_a_cube_has_no_other_mirror_image_and_keeps_its_grasp_when_scaled():
    hung = hung_cube(5)
    assert not [row for row in mirrored_meshes(hung) if row.hypothesis(hung)]
    wider = with_shape(hung, np.array([1.1, 1.0, 1.0]))
    assert wider is not None
    assert np.isclose(np.ptp(wider.body.nodes_m[:, 0]), 1.1 * np.ptp(hung.body.nodes_m[:, 0]))
    assert len(wider.grasps[0].nodes) == len(hung.grasps[0].nodes)
    assert np.isclose(wider.body.mass_kg, hung.body.mass_kg)


def test_a_refit_begins_at_an_answer_that_rounding_puts_beyond_a_bound():
    described = measured(hung_cube(8))
    solution = solve(Problem([described], GUESS, substeps=1), "reduced-space")
    (experiment,) = (each.experiment for each in solution.collocation.transcriptions)
    changed = with_body(
        experiment, with_material(experiment.body, MATERIALS["st-venant-kirchhoff"])
    )
    assert changed is not None
    refits = _Refits(solution, [experiment], {})
    refits.answer["gamma_m_1_s"] = solution.collocation.parameters.free[-1].lower * (1 - 1e-14)
    assert refits.fit(changed) is not None


def test_no_other_material_is_suggested_for_small_strains():
    solution = solve(Problem([measured(hung_cube(8))], GUESS, substeps=1), "reduced-space")
    (part,) = solution.parts
    rest_m = np.tile(part.transcription.body.nodes_m.ravel(), (len(part.x), 1))
    for stretch, is_suggested in ((1.04, False), (1.06, True)):
        rows = body_rows(replace(part, x=stretch * rest_m))
        assert any(row.name == "law" for row in rows) == is_suggested


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "cause"),
    [
        ("mirrored", "mesh-mirrored"),
        ("hanging", "rest-shape"),
        ("filtered", "tracks-filtered"),
        ("twice", "markers-same"),
        ("law", "law"),
    ],
)
def test_hidden_errors_of_a_bent_bar_are_named(error: str, cause: str):
    """Refits of mirror images had left no sweeps for those of the law and of a hanging scan."""
    near = {name: Unknown(1.3 * value) for name, value in TRUTH.items()}
    problem = replace(twin(error, 0, near), substeps=2)
    assert find_misspecifications(solve(problem))[0].cause == cause


@pytest.mark.slow
def test_a_mirrored_mesh_is_named_although_the_fit_turned_the_body_far():
    """The refits of other corrections had used up the sweeps: gravity along +z was mentioned."""
    (cause, *_) = find_misspecifications(solve(twin("mirrored", 0)))
    assert cause.cause == "mesh-mirrored"
    assert cause.strength > 10
