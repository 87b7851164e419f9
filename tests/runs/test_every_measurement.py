"""Every check for every kind of measurement: the table of docs/howto/trust.md."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from kit.depth import hanging
from kit.filmed import swung, tracks_of
from kit.fits import PARAMETERS, autoregressive, problem
from kit.problems import hung_cube, measured
from kit.silhouettes import hanging as hung_in_photograph
from kit.silhouettes import outlines_of

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.features.measurements import (
    copied,
    instrument_misfits,
    judged_residuals,
    lost_samples,
    reason_against_copy,
)
from collocation_sysid.kinds.specimen.concerns import SPECIMEN_CODES, as_specimen_concerns
from collocation_sysid.program.depth.surface_comparison import DepthError, SurfaceComparison
from collocation_sysid.runs.verdict import _outlier_counts
from collocation_sysid.statistics.assessment import (
    fit_concerns,
    forward_simulation_concerns,
    outlier_share_concerns,
    prediction_concerns,
    validation_concerns,
)
from collocation_sysid.statistics.plausibility import copied_measurements
from collocation_sysid.statistics.uncertainty import uncertainty_from_fit

NUMBERS = (
    "markers",
    "wrench",
    "custom sensor",
    "specimen",
    "harmonic test",
    "image tracks",
    "outlines",
)
SPECIMENS = ("specimen", "harmonic test")


@cache
def only(kind, cube=None):
    """Experiment in which one kind of measurement is measured, with values of one."""
    if kind == "specimen":
        strain = np.linspace(0.1, 0.5, 11)
        return cs.Specimen("uniaxial", strain, 1.0 + 0 * strain, 0.1).experiment(name="pull")
    if kind == "harmonic test":
        ones = np.ones(11)
        test = cs.Specimen.harmonic(np.geomspace(0.1, 10.0, 11), ones, ones, 0.1)
        return test.experiment(name="dma", prony=("a",))
    cube = cube or measured(hung_cube())
    ones = np.ones(len(cube.t_s))
    if kind == "markers":
        return cube
    if kind == "wrench":
        force = cs.Wrench(cube.t_s, ones[:, None] * [[1.0, 1.0, 1.0]], sigma_n=0.1)
        grasps = [replace(cube.grasps[0], wrench=force)]
        return replace(cube, grasps=grasps, markers=None)
    if kind == "image tracks":
        return swung(readings=[tracks_of()], markers=None)
    if kind == "outlines":
        return hung_in_photograph([outlines_of()])
    if kind == "depth camera":
        points_m = np.random.default_rng(0).uniform(0.1, 0.2, size=(20, 3))
        return hanging((cs.Depth("front", [0.0], [points_m], 1e-3),))
    gauge = cs.Gauge("height", lambda at: at.position_m[2, 0], cube.t_s, ones, 0.1, [[0, 0, 0]])
    return replace(cube, readings=[gauge], markers=None)


@pytest.fixture(params=NUMBERS)
def case(request):
    """An experiment, its measured values as predictions, and the index of its measurement."""
    experiment = only(request.param)
    values = [each.measured_values for each in experiment.measurements]
    (k,) = (k for k, each in enumerate(experiment.measurements) if each.has_samples())
    return experiment, values, k


def test_a_wrong_prediction_of_a_validation_recording_is_doubtful(case):
    experiment, values, k = case
    (right,) = instrument_misfits(experiment, values)
    assert not validation_concerns(experiment.name, right, 1.0, {})
    off = experiment.measurements[k].value_sigmas * 20
    wrong = [each + off if j == k else each for j, each in enumerate(values)]
    (misfit,) = instrument_misfits(experiment, wrong)
    assert misfit.sigmas == pytest.approx(20.0)
    (concern,) = validation_concerns(experiment.name, misfit, 1.0, {})
    assert (concern.code, concern.grade) == ("roll-out/predicted", "doubtful")
    assert misfit.what in concern.message


def test_a_prediction_is_judged_by_the_measurement(case):
    experiment, values, k = case
    residuals = judged_residuals(experiment, values)
    assert residuals.unit == experiment.measurements[k].unit
    assert np.nanmax(np.abs(residuals.values)) == 0.0
    assert residuals.is_counted.any()


def test_a_copy_of_the_recording_is_predicted(case):
    experiment, values, k = case
    assert reason_against_copy(experiment, experiment) == ""
    np.testing.assert_array_equal(copied(experiment, experiment)[k], values[k])


def test_a_complete_measurement_has_no_note(case):
    experiment, _, _ = case
    assert lost_samples(experiment) == []


def test_a_measurement_outside_the_recording_is_refused(case):
    experiment, _, k = case
    if experiment.measurements[k] is experiment.markers:
        pytest.skip("markers are measured at the times of the recording")
    late = replace(experiment.measurements[k], t_s=experiment.t_s + 100.0)

    def shifted():
        if experiment.readings:
            return replace(experiment, readings=[late])
        return replace(experiment, grasps=[replace(experiment.grasps[0], wrench=late)])

    with pytest.raises(InputError):
        lost_samples(shifted())


def test_texts_name_the_instrument_and_its_noise(case):
    experiment, _, k = case
    measurement = experiment.measurements[k]
    assert measurement.title
    assert measurement.sigma_text
    assert measurement.noise_key
    assert all(measurement.presence)


# The table ----------------------------------------------------------------------------------------

KINDS = (*NUMBERS, "depth camera")
# Key of sigma and numbers of one sample (entities, numbers of each) in a linearised fit.
BLOCKS = {
    "markers": ("sigma_m", (3, 3)),
    "wrench": ("sigma_n", (2, 3)),
    "custom sensor": ("sigma", (3, 1)),
    "specimen": ("sigma", (3, 1)),
    "depth camera": ("sigma_m of depth", (5, 3)),
    "harmonic test": ("sigma", (3, 1)),
    "image tracks": ("sigma_px", (5, 2)),
    "outlines": ("sigma_px of outlines", (3, 1)),
}
SAMPLES = 80


class Surface(SurfaceComparison):
    """Comparison of an image with a surface that is away from it by multiples of sigma."""

    sigmas: float

    def __init__(self, sigmas: float) -> None:
        vars(self)["sigmas"] = sigmas

    @property
    def error(self) -> DepthError:
        off_m = 1e-3 * self.sigmas
        return DepthError(20, 20, off_m, 1.0, 1.0, 0.0, off_m, self.sigmas, self.sigmas)


def predictions(experiment, sigmas):
    """Predictions that are `sigmas` standard deviations away from all measurements."""
    return [
        each.measured_values + sigmas * each.value_sigmas
        if each.value_sigmas.size
        else Surface(sigmas)
        for each in experiment.measurements
    ]


def codes(kind, errors, second=None):
    """Codes of the concerns about a fit to errors (T, M, 3) of a kind of measurement, in sigma; of
    two recordings if errors of a second one are given.
    """
    key, (entities, numbers) = BLOCKS[kind]
    both = [errors] if second is None else [errors, second]
    made = problem((SAMPLES,) * len(both), entities, offsets=False)
    is_number = np.arange(3) < numbers
    slopes = tuple(each * is_number[:, None] for each in made.slopes)
    made = replace(made, slopes=slopes)
    fit, wrong = made.fit([each * is_number for each in both], np.zeros(len(made.names)))
    blocks = [
        replace(
            each,
            sigma_key=key,
            components=np.broadcast_to(is_number, each.residual.shape),
            is_static=kind in SPECIMENS,
            errs_slowly=kind == "image tracks",
        )
        for each in fit.blocks
    ]
    found = uncertainty_from_fit(replace(fit, blocks=tuple(blocks)), PARAMETERS, wrong[:4])
    concerns = fit_concerns(found)
    if kind in SPECIMENS:
        concerns = as_specimen_concerns(concerns, [only(kind)])
    return {each.code for each in concerns}


def named(kind, code):
    """The code of a concern about a kind of measurement."""
    code = code.replace("marker", "sensor") if kind != "markers" else code
    codes = dict(SPECIMEN_CODES)
    if kind == "harmonic test":
        codes["noise/larger"] = "specimen/branches"
    return codes.get(code, code) if kind in SPECIMENS else code


def white(kind, seed=0):
    return np.random.default_rng(seed).normal(size=(SAMPLES, BLOCKS[kind][1][0], 3))


def size_of_residuals(kind):
    assert codes(kind, white(kind)) == set()
    assert named(kind, "noise/larger") in codes(kind, 5 * white(kind))
    # Trackers may err slowly by more than from image to image.
    is_smaller = named(kind, "noise/smaller") in codes(kind, white(kind) / 5)
    assert is_smaller == (kind != "image tracks")


def small_but_persistent(kind):
    """Residuals of four times less than sigma are too small, also if they are not independent and
    widen the error bars.
    """
    slow = autoregressive(np.random.default_rng(3), SAMPLES, BLOCKS[kind][1][0], 0.99)
    found = codes(kind, slow / 4)
    assert (named(kind, "noise/smaller") in found) == (kind != "image tracks")
    if kind not in (*SPECIMENS, "image tracks"):
        assert "residuals/persist" in found


def test_slow_errors_of_trackers_within_sigma_are_no_reason():
    """Those of other instruments are, and so are larger ones of trackers."""
    slow = autoregressive(np.random.default_rng(3), SAMPLES, 5, 0.95)
    assert codes("image tracks", 0.5 * slow) == set()
    assert "residuals/persist" in codes("image tracks", 2 * slow)
    assert "residuals/persist" in codes("markers", 0.5 * slow[:, :3])


def one_is_noisier(kind):
    assert named(kind, "noise/marker") in codes(
        kind, white(kind) * [[1.0], [30.0], *[[1.0]] * (BLOCKS[kind][1][0] - 2)]
    )


def correlation_in_time(kind):
    slow = autoregressive(np.random.default_rng(3), SAMPLES, BLOCKS[kind][1][0], 0.95)
    assert named(kind, "residuals/persist") in codes(kind, 2 * slow)


def correlation_of_numbers(kind):
    common = np.random.default_rng(8).normal(size=(SAMPLES, 1, 1))
    assert "residuals/shared" in codes(kind, common + 0.1 * white(kind))


def single_samples(kind):
    errors = white(kind)
    errors[40, 1] = [150.0, 50.0, 0.0]
    assert named(kind, "residuals/outlier") in codes(kind, errors)


def recordings_disagree(kind):
    made = problem((SAMPLES,), BLOCKS[kind][1][0], offsets=False)
    off = 0.6 * made.slopes[0][..., 0]
    found = codes(kind, white(kind) + off, white(kind, 1) - off)
    # A law that is too simple, or too few branches, contradicts specimens that disagree, too.
    assert found & {"residuals/recordings", "specimen/law", "specimen/branches"}


def loss_of_samples(kind):
    experiment = only(kind)
    assert lost_samples(experiment) == []
    measurement = experiment.measurements[-1]
    assert all(each.any() for each in measurement.presence.values())


def same_values_twice(kind):
    first = only(kind)
    rng = np.random.default_rng(0)

    def shaken(experiment, name):
        """The experiment with other values, as noise makes them."""
        made = experiment.measurements[-1]
        if kind == "depth camera":
            return replace(experiment, name=name)
        values = made.measured_values + rng.normal(size=made.measured_values.shape)
        return replace(with_values(experiment, values), name=name)

    one = shaken(first, "one")
    twice = replace(one, name="two")
    (found,) = copied_measurements([one, twice])
    assert "of 'one' and" in found.message
    assert "of 'two' are exactly the same" in found.message
    if kind != "depth camera":
        assert copied_measurements([one, shaken(first, "two")]) == []


def with_values(experiment, values):
    """The experiment with other numbers of its last measurement."""
    measurement = experiment.measurements[-1]
    if measurement is experiment.markers:
        tracks_m = values.reshape(measurement.positions_m.shape)
        return replace(experiment, markers=replace(measurement, positions_m=tracks_m))
    if isinstance(measurement, cs.Outlines):
        shift = 1 + int(abs(1e6 * np.nanmax(values))) % 9
        masks = [np.roll(np.asarray(mask), shift, axis=1) for mask in measurement.all_masks]
        return replace(experiment, readings=[replace(measurement, masks=masks)])
    if isinstance(measurement, cs.ImageTracks):
        other = replace(measurement, pixels=values.reshape(len(values), -1, 2))
    else:
        other = replace(measurement, values=values)
    if experiment.readings:
        return replace(experiment, readings=[other])
    return replace(experiment, grasps=[replace(experiment.grasps[0], wrench=other)])


def outlier_share(kind):
    """Of 20 samples of two instruments of this kind, three are beyond the threshold."""
    _, (entities, numbers) = BLOCKS[kind]
    residuals = np.ones((20, entities, numbers))
    residuals[:3, 0] = 50.0
    model = SimpleNamespace(
        residuals=lambda *_: residuals, is_compared=np.ones(residuals.shape, dtype=bool)
    )
    part = SimpleNamespace(
        transcription=SimpleNamespace(residuals=[model]), observables=[None], phi=None
    )
    solution: Any = SimpleNamespace(collocation=SimpleNamespace(huber=3.0 * numbers), parts=[part])
    assert _outlier_counts(solution) == (3, 20 * entities)
    solution.collocation.huber = None
    assert _outlier_counts(solution) == (0, 20 * entities)
    assert [each.code for each in outlier_share_concerns(10, 100)] == ["residuals/wild"]


def forward(kind):
    experiment = only(kind)
    near, far = (instrument_misfits(experiment, predictions(experiment, k)) for k in (1.0, 9.0))
    assert not forward_simulation_concerns("a", near[-1], near[-1])
    (concern,) = forward_simulation_concerns("a", far[-1], near[-1])
    assert (concern.code, concern.grade) == ("roll-out/misses", "doubtful")
    assert far[-1].what in concern.message


def validation(kind):
    experiment = only(kind)
    (misfit,) = instrument_misfits(experiment, predictions(experiment, 20.0))[-1:]
    (concern,) = validation_concerns("a", misfit, 1.0, {})
    assert (concern.code, concern.grade) == ("roll-out/predicted", "doubtful")
    assert misfit.what in concern.message


def prediction(kind):
    experiment = only(kind)
    (misfit,) = instrument_misfits(experiment, predictions(experiment, 20.0))[-1:]
    (concern,) = prediction_concerns("a", **vars(misfit))
    assert (concern.code, concern.grade) == ("prediction/misses", "doubtful")


def copies(kind):
    experiment = only(kind)
    assert reason_against_copy(experiment, experiment) == ""


CHECKS = {
    "loss of samples": loss_of_samples,
    "the same values twice": same_values_twice,
    "size of the residuals": size_of_residuals,
    "small but persistent residuals": small_but_persistent,
    "one instrument is noisier": one_is_noisier,
    "correlation in time": correlation_in_time,
    "correlation between numbers": correlation_of_numbers,
    "single samples": single_samples,
    "share of outliers": outlier_share,
    "disagreement of recordings": recordings_disagree,
    "forward simulation": forward,
    "validation": validation,
    "prediction without a fit": prediction,
    "copy of another recording": copies,
}
TESTS = Path(__file__).parents[1]
PAGE = (TESTS.parent / "docs" / "howto" / "trust.md").read_text()


def table():
    """Reason why a check does not concern a kind of measurement, or "yes", by check and kind in
    the documentation, and its sentences.
    """
    section = PAGE.partition("## Checks by measurement")[2].partition("\n## ")[0]
    _, *lines = re.findall(r"(?m)^\| (.+?) \|(?: (.+))? \|$", section)
    kinds = re.findall(r"(?m)^Kinds of measurement: (.+)\.$", section)[0].split(", ")
    cells = {(title, kind): "yes" for title, _ in lines for kind in kinds}
    for title, exceptions in lines:
        for kind, reason in re.findall(r"([a-z ]+) (\d+)(?:, |$)", exceptions):
            assert (title, kind) in cells
            cells[title, kind] = reason
    return cells, re.findall(r"(?m)^(\d+)\. ", section)


CELLS, REASONS = table()


def test_the_documentation_has_a_row_for_every_check_and_no_empty_field():
    titles = {title for title, _ in CELLS}
    assert {kind for _, kind in CELLS} == set(KINDS)
    assert all(any(title.startswith(each) for title in titles) for each in CHECKS)
    assert {cell for cell in CELLS.values() if cell != "yes"} == set(REASONS)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        (name, kind)
        for (title, kind), cell in CELLS.items()
        for name in CHECKS
        if cell == "yes" and title.startswith(name)
    ],
)
def test_a_check_concerns_the_kinds_of_measurement_of_its_row(name, kind):
    CHECKS[name](kind)
