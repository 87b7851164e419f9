"""Load cells in live estimation, compared with the batch, also with missing values."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.frames import (
    NO_TIME,
    assert_same_information,
    frames_of,
    normal_equations,
    streamed,
    swing,
)
from kit.problems import GUESS, IDEAL, TRUTH
from kit.sensors import CLAMPED, instrumented
from kit.wrenches import POINT_M, SIGMA_N, SIGMA_NM, sensing

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.extras.live import Frame, FrameReader, LiveEstimator
from collocation_sysid.extras.live.sources import frames_of_recording
from collocation_sysid.extras.live.window_pass import WindowPass
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.program import streaming_model, streaming_sweep
from collocation_sysid.recording import Nuisance, Wrench

# What may be unknown of a load cell that live takes.
UNKNOWN = {"tare": 10.0, "sensor_time_s": 5e-3, "tool_kg": 0.01, "tool_m": 0.02}


@cache
def weighed(scheme: str = "midpoint", frame: str = "grasp", **unknown: float) -> cs.Problem:
    """A cube swung by its top, with a load cell there and a clamp, on clocks of their own."""
    (seen,) = swing(nuisance=Nuisance.none(**unknown)).experiments
    inner = seen.t_s[0] + np.linspace(0.0, 0.355, 83)
    clamp = cs.Gauge("clamp", CLAMPED["expression"], inner[::3], None, 2e-3, grasp=1)
    made = instrumented(sensing(seen, inner, frame=frame), clamp)
    told, rng = (cs.simulate(made, TRUTH, scheme, substeps=1), np.random.default_rng(3))
    (wrench,), (force,) = told.wrenches, told.custom_sensor_values
    wrench = wrench + rng.normal(size=wrench.shape) * np.repeat([SIGMA_N, SIGMA_NM], 3)
    wrench[9], wrench[7, 2] = np.nan, np.nan
    made = cs.with_readings(made, [force + 2e-3 * rng.normal(size=force.shape)])
    (grasp,) = made.grasps
    made = replace(made, grasps=[replace(grasp, wrench=replace(grasp.wrench, values=wrench))])
    return cs.Problem([made], GUESS, scheme=scheme, substeps=1)


def without(experiment: cs.Experiment, waiting: list[tuple[int, float]]) -> cs.Experiment:
    """The same without the samples of instruments that still wait, by number and time."""
    (clamp,), (grasp,) = experiment.readings, experiment.grasps
    late = [[t_s for of, t_s in waiting if of == number] for number in (1, 2)]
    values = np.where(
        np.isin(clamp.sample_times_s, late[0])[:, None], np.nan, clamp.measured_values
    )
    wrench = np.where(np.isin(grasp.wrench.t_s, late[1])[:, None], np.nan, grasp.wrench.values)
    grasp = replace(grasp, wrench=replace(grasp.wrench, values=wrench))
    return cs.with_readings(replace(experiment, grasps=[grasp]), [values])


@pytest.mark.parametrize(
    ("scheme", "frame", "unknown"),
    [
        ("midpoint", "grasp", {}),
        ("midpoint", "world", UNKNOWN | {"gravity_rad": 0.02, "hand_eye_rad": 0.01}),
        ("bdf2", "grasp", UNKNOWN),
    ],
)
def test_load_cells_count_live_as_in_the_batch(scheme, frame, unknown, monkeypatch):
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    problem = weighed(scheme, frame, **unknown)
    live = streamed(problem)
    waiting = [each[:2] for each in live.intake._waiting]
    assert 2 <= len(waiting) < 12
    seen = without(problem.experiments[0], waiting)
    collocation = replace(problem, experiments=[seen]).collocation()
    horizon, p = (
        Horizon(collocation, [len(live.log)], prior=streaming_model.WEAK_PRIOR_DEVIATION),
        collocation.guess_p,
    )
    point = horizon.evaluate(p, horizon.simulate(p)[0])
    point = horizon.evaluate(p, [each.x + each.step for each in point.trajectories])
    flat = live.model.transformed(p)
    rows = np.column_stack([point.fit.jacobian, point.fit.residual - point.fit.jacobian @ flat])
    batch, ours = (rows.T @ rows, normal_equations(live.first_pass.sweep.information.triangle))
    scale = np.sqrt(np.outer(np.diag(batch), np.diag(batch)))
    np.testing.assert_allclose(ours / scale, batch / scale, atol=1e-8)


@pytest.mark.long
def test_a_pass_that_turns_moves_what_a_load_cell_looks_at_along_its_slopes(monkeypatch):
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    live = streamed(weighed(tare=0.1, tool_kg=0.01))
    half, far = len(live.log) // 2, []
    for size in (1e-2, 5e-3):
        p = live.first_pass.sweep.p + size
        whole, turned = (
            WindowPass(live.model, at, live.prior, 99) for at in (p, live.first_pass.sweep.p)
        )
        for number, row in enumerate(live.log):
            if number == half:
                turned.relinearise_at(p)
                moved, there = (track.sweep.read[-1][2] for track in (turned, whole))
                far.append(np.abs(moved - there)[..., 0].max() / np.abs(there[..., 0]).max())
            turned.repeat_rows([row])
            whole.repeat_rows([row])
        assert_same_information(turned.sweep.information, whole.sweep.information, atol=5 * size)
    assert 0 < far[1] < 0.3 * far[0] < 1e-4  # of second order


def unweighed(problem: cs.Problem) -> cs.Problem:
    """The same with a density that is not known, and 40 % off."""
    parameters = GUESS.with_guess({"lambda_pa": 300.0, "mu_pa": 200.0})
    density = cs.Parameter("density_kg_m3", 42.0, 1.0, 1e4)
    return replace(problem, parameters=replace(parameters, items=(*parameters.items, density)))


@pytest.mark.long
def test_a_load_cell_determines_the_scale_that_markers_do_not():
    problem = unweighed(weighed(tare=0.1))
    live = LiveEstimator(problem, replace(NO_TIME, rows=8))
    for frame in frames_of(problem, live):
        update = live.process_frame(frame)
    blind = LiveEstimator(problem, replace(NO_TIME, rows=8))
    for frame in frames_of(problem, live):
        without = blind.process_frame(replace(frame, instrument_samples=()))
    for name, true in (TRUTH | {"density_kg_m3": 30.0}).items():
        estimate = update.estimates[name]
        assert abs(estimate.value - true) < 4 * estimate.statistical_std_error
    for name in ("mu_pa", "density_kg_m3"):
        assert update.estimates[name].statistical_std_error < 0.05 * update.estimates[name].value
        assert (
            without.estimates[name].statistical_std_error is None
        )  # markers alone tell ratios of these
    settled, batch = live.finish(), cs.run(problem, seek_causes=False)
    for name, estimate in settled.estimates.items():
        assert estimate.value == pytest.approx(batch.parameters[name], rel=1e-5)
        # The stream is not corrected for the time step, the answer at its end is.
        away = abs(update.estimates[name].value - batch.solution.parameters[name])
        assert away < estimate.statistical_std_error


def last_estimates(problem: cs.Problem, frames: list[Frame]) -> tuple[LiveEstimator, np.ndarray]:
    live = LiveEstimator(problem, NO_TIME)
    for frame in frames:
        update = live.process_frame(frame)
    return live, np.array([each.value for each in update.estimates.values()])


@pytest.mark.long
def test_samples_of_a_load_cell_may_be_late_or_missing():
    problem = weighed()
    live = LiveEstimator(problem, NO_TIME)
    frames = frames_of(problem, live)
    in_time, expected = last_estimates(problem, frames)
    before = [(), (), (), *(frame.instrument_samples for frame in frames[:-3])]
    late = [
        replace(frame, instrument_samples=told) for frame, told in zip(frames, before, strict=True)
    ]
    late[-1] = replace(
        late[-1],
        instrument_samples=[each for frame in frames[-4:] for each in frame.instrument_samples],
    )
    delayed, found = last_estimates(problem, late)
    assert (
        delayed.first_pass.sweep.information.row_count
        == in_time.first_pass.sweep.information.row_count
    )
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    some = [
        replace(frame, instrument_samples=() if 8 < k < 12 else frame.instrument_samples)
        for k, frame in enumerate(frames)
    ]
    fewer, found = last_estimates(problem, some)
    lost = sum(
        np.isfinite(values).sum() for f in frames[9:12] for _, _, values in f.instrument_samples
    )
    assert (
        fewer.first_pass.sweep.information.row_count
        == in_time.first_pass.sweep.information.row_count - lost
    )
    np.testing.assert_allclose(found, expected, rtol=0.1)
    far = [
        *(replace(frame, instrument_samples=()) for frame in frames[:12]),
        replace(frames[12], instrument_samples=late[5].instrument_samples),
    ]
    assert last_estimates(problem, far)[0].counts["late"] == len(late[5].instrument_samples) > 0


def reader_of(sensors: int = 1) -> FrameReader:
    wrench = Wrench([0.0], np.ones((1, 6)), SIGMA_N, SIGMA_NM, point_m=POINT_M)
    return FrameReader([1], ["a"], wrenches={k + 1: wrench for k in range(sensors)})


SIX = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (SIX, [(1, 1.0, SIX)]),
        ([1, None, 3], [(1, 1.0, [1, np.nan, 3, *[np.nan] * 3])]),
        ({"t_s": 0.9, "values": SIX}, [(1, 0.9, SIX)]),
        (
            [{"t_s": 0.9, "values": SIX}, {"t_s": 0.95, "values": None}, {"t_s": 1, "values": SIX}],
            [(1, 0.9, SIX), (1, 1.0, SIX)],
        ),
        ({"1": SIX}, [(1, 1.0, SIX)]),
        (None, []),
    ],
)
def test_frames_bring_wrenches_with_times_of_their_own(given, expected):
    found = reader_of().read(json.dumps({"t_s": 1.0, "wrench": given})).instrument_samples
    assert [each[:2] for each in found] == [each[:2] for each in expected]
    for (*_, values), (*_, numbers) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(values, numbers)


def test_tables_of_frames_have_wrenches_in_their_columns():
    names = "t_s,x_m,y_m,z_m,qx,qy,qz,qw"
    one, two = reader_of(), reader_of(2)
    assert one.read(f"{names},fz_n,fx_n") is None
    ((number, t_s, values),) = one.read("1,1,2,3,0,0,0,1,0.5,").instrument_samples
    assert (number, t_s) == (1, 1.0)
    np.testing.assert_array_equal(values, [np.nan, np.nan, 0.5, *[np.nan] * 3])
    assert two.read(f"{names},2.tx_nm") is None
    assert two.read("1,1,2,3,0,0,0,1,0.5").instrument_samples[0][0] == 2


@pytest.mark.parametrize(
    ("sensors", "given", "said"),
    [
        (1, [1, 2], "the wrench of grasp 1: found 2 numbers; expected 6 numbers"),
        (1, "much", "the wrench of grasp 1: found 'much'; expected 6 numbers"),
        (
            1,
            {"t_s": 1},
            "a sample of the wrench of grasp 1 has the keys 't_s'; expected t_s and values",
        ),
        (
            1,
            {"2": SIX},
            "found a wrench of grasp '2'; expected the number of a grasp with a sensor, 1",
        ),
        (2, SIX, "found one wrench; expected those of the grasps 1 and 2, by number"),
    ],
)
def test_invalid_wrenches_are_reported_with_their_line(sensors, given, said):
    with pytest.raises(InputError, match=f"input, line 1: {said}"):
        reader_of(sensors).read(json.dumps({"t_s": 1.0, "wrench": given}))


def test_live_estimation_names_unsupported_sensors():
    with pytest.raises(InputError, match=r"a sensor with a low-pass \(sensor_lag\)"):
        LiveEstimator(weighed(sensor_lag_s=3e-3))
    live = LiveEstimator(swing(nuisance=IDEAL), NO_TIME)
    for frame in list(frames_of_recording(live.problem.experiments[0], live.model))[:3]:
        seen = live.update(frame.t_s, (frame.pose[0][0], frame.pose[1][0]), frame.tracks_m, SIX)
        left_out = "wrenches are ignored: no grasp of the problem has a sensor"
        assert (left_out in seen.notes) == (frame.t_s == 0.0)
