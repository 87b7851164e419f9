"""Live estimates: the answers of ordinary solves of the frames so far."""

from __future__ import annotations

import io
import itertools
import json
import socket
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from kit.frames import swing
from kit.problem_files import Outcome, run_command
from kit.problems import GUESS, TRUTH
from kit.sensors import CLAMPED, accelerometer, instrumented, strain_gauge
from kit.wrenches import SIGMA_N, SIGMA_NM, sensing

import collocation_sysid as cs
from collocation_sysid.cli import stream_commands
from collocation_sysid.errors import InputError
from collocation_sysid.extras.live import Frame, FrameReader, LiveEstimator, LiveUpdate, estimator
from collocation_sysid.extras.live.sources import arrived, frames_of_recording, receive_lines
from collocation_sysid.methods.solution import Status
from collocation_sysid.problem.gripper_transforms import gripper_transforms
from collocation_sysid.recording import Nuisance, PoseSequence, read_poses

TWENTY = 20 * "9"


def frames_of(problem: cs.Problem) -> list[Frame]:
    return [*frames_of_recording(problem.experiments[0])]


def streamed(problem: cs.Problem, frames: list[Frame] | None = None) -> LiveEstimator:
    live = LiveEstimator(problem)
    for frame in frames_of(problem) if frames is None else frames:
        live.add_frame(frame)
    return live


def assert_same_values(update: LiveUpdate, parameters, rel: float) -> None:
    for name, estimate in update.estimates.items():
        assert estimate.value == pytest.approx(parameters[name], rel=rel)


@cache
def sensed() -> cs.Problem:
    """A swung cube with a load cell, an accelerometer and a strain gauge on clocks of their own."""
    (seen,) = swing(nuisance=Nuisance.none(tare=10.0)).experiments
    inner = seen.t_s[0] + np.linspace(0.0, 0.355, 83)
    clamp = cs.Gauge("clamp", CLAMPED["expression"], inner[::3], None, 2e-3, grasp=1)
    gauges = (clamp, accelerometer(inner), strain_gauge(inner[::2]))
    made = instrumented(sensing(seen, inner), *gauges)
    told = cs.simulate(made, TRUTH, "midpoint", substeps=1)
    rng = np.random.default_rng(3)
    (wrench,) = told.wrenches
    wrench = wrench + rng.normal(size=wrench.shape) * np.repeat([SIGMA_N, SIGMA_NM], 3)
    wrench[9], wrench[7, 2] = np.nan, np.nan
    readings = [
        values + gauge.sigma * rng.normal(size=values.shape)
        for gauge, values in zip(made.readings, told.custom_sensor_values, strict=True)
    ]
    made = cs.with_readings(cs.with_wrenches(made, [wrench]), readings)
    return cs.Problem([made], GUESS, substeps=1)


def test_answers_converge_to_the_batch_and_intervals_contain_the_truth():
    problem = swing()
    live, frames = LiveEstimator(problem), frames_of(problem)
    widths = []
    for number, frame in enumerate(frames, 1):
        live.add_frame(frame)
        if number % 12 == 0:
            update = live.solve()
            low, high = update.estimates["mu_pa"].statistical95
            widths.append(high / low)
    assert widths == sorted(widths, reverse=True)
    for name, (low, high) in ((n, e.statistical95) for n, e in update.estimates.items()):
        assert low < TRUTH[name] < high
    assert update.t_s == problem.experiments[0].t_s[-2]
    assert update.misfit == pytest.approx(1.0, abs=0.15)
    live.add_frame(frames[-1])
    assert_same_values(live.solve(), cs.solve(problem).parameters, rel=1e-4)


def test_the_final_result_is_the_run_of_the_recording():
    problem = swing(24)
    found, expected = streamed(problem).finish(), cs.run(problem, seek_causes=False)
    assert found.trust.verdict == expected.trust.verdict
    for name, estimate in expected.estimates.items():
        assert found.estimates[name].value == pytest.approx(estimate.value, rel=1e-9)


def test_sensors_count_as_in_the_batch():
    problem = sensed()
    update, batch = streamed(problem).solve(), cs.solve(problem)
    assert_same_values(update, batch.parameters, rel=1e-4)
    error = update.estimates["mu_pa"].statistical_std_error
    blind = [replace(frame, samples=()) for frame in frames_of(problem)]
    assert error < streamed(problem, blind).solve().estimates["mu_pa"].statistical_std_error


def test_late_doubled_and_lost_frames_change_little():
    problem = swing()
    complete = streamed(problem).solve()
    frames = frames_of(problem)
    frames[5], frames[9] = frames[9], frames[5]
    frames[12] = replace(frames[12], poses={})
    shifted = [replace(frame, t_s=frame.t_s + 1.7e9) for frame in frames]
    lossy = streamed(problem, [*shifted[:20], shifted[3], *shifted[21:]]).solve()
    assert lossy.t_s == pytest.approx(1.7e9 + complete.t_s, abs=1e-6)
    for name, estimate in complete.estimates.items():
        change = abs(lossy.estimates[name].value - estimate.value)
        assert change < estimate.statistical_std_error


def test_damping_that_rest_does_not_determine_is_found_later():
    (hung,) = swing().experiments
    poses = hung.grasps[0].poses
    t_s = np.concatenate([hung.t_s[:1] - 0.1 + hung.timestep_s * np.arange(10), hung.t_s])
    still = [
        np.repeat(each[:1], 10, axis=0) for each in (poses.positions_m, poses.quaternions_xyzw)
    ]
    moved = PoseSequence(
        t_s,
        np.concatenate([still[0], poses.positions_m]),
        np.concatenate([still[1], poses.quaternions_xyzw]),
    )
    rested = replace(
        hung,
        t_s=t_s,
        grasps=[replace(hung.grasps[0], poses=moved)],
        markers=hung.markers.with_samples(t_s, np.zeros((len(t_s), len(hung.markers.names), 3))),
    )
    tracks_m = cs.simulate(rested, TRUTH, "midpoint", substeps=1).markers_m
    problem = cs.Problem([cs.with_markers(rested, tracks_m)], GUESS)
    live = LiveEstimator(problem)
    for number, frame in enumerate(frames_of(problem), 1):
        live.add_frame(frame)
        if number == 8:
            assert live.solve().estimates["gamma_r_s"].statistical_std_error is None
    assert_same_values(live.solve(), TRUTH, rel=1e-2)


def test_too_few_frames_are_refused():
    with pytest.raises(InputError, match="found 0 poses of grasp 1; expected at least 3"):
        LiveEstimator(swing()).solve()


def test_problems_that_frames_cannot_describe_are_refused():
    hung = swing().experiments[0]
    still = replace(hung, grasps=[replace(hung.grasps[0], poses=PoseSequence.fixed())])
    for experiments, message in (
        ([still], "never move"),
        ([hung, replace(hung, name="again")], "2 experiments"),
    ):
        with pytest.raises(InputError, match=message):
            LiveEstimator(cs.Problem(experiments, GUESS))


# Frames -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((float("nan"), None), "finite"),
        ((0.0, np.eye(3)), "4 × 4"),
        ((0.0, ([0, 0, 0], [0, 0, 0, 2])), "norm"),
        ((0.0, None, {"nobody": [0, 0, 0]}), "nobody"),
        ((0.0, None, np.zeros((1, 3))), "expected 9 × 3 numbers"),
        ((0.0, {"2": np.eye(4)}), "grasp '2'; expected one of 1"),
        ((0.0, None, None, [1, 2]), "expected 6 numbers"),
        ((0.0, None, None, None, {"chip": 1}), "reading 'chip'; expected one of clamp, acc"),
        ((0.0, None, None, None, {"foil": [1, 2]}), "expected 1 numbers"),
        ((0.0, None, None, None, {"foil": {"t_s": 1}}), "keys 't_s'; expected t_s and values"),
        ((0.0, None, None, None, [1]), "expected samples by name"),
    ],
)
def test_an_invalid_frame_is_refused(values, message):
    with pytest.raises(InputError, match=message):
        LiveEstimator(sensed()).add(*values)


def reader(problem: cs.Problem) -> FrameReader:
    return FrameReader(problem.experiments[0], problem)


def test_frames_are_read_from_json():
    line = {"t_s": 1, "pose": {"position_m": [1, 2, 3], "quaternion_xyzw": [0, 0, 0, 1]}}
    (name, *_) = sensed().experiments[0].markers.names
    samples = [{"t_s": 0.9, "values": 0.2}, {"t_s": 1, "values": 0.3}]
    readings = {"foil": samples, "accelerometer": [1, None, 3], "clamp": None}
    line |= {"markers": {name: [4, 5, 6]}, "wrench": [1, 2, 3], "readings": readings}
    frame = reader(sensed()).read(json.dumps(line))
    np.testing.assert_array_equal(frame.poses[1][:3, 3], [1, 2, 3])
    np.testing.assert_array_equal(frame.tracks_m[:2], [[4, 5, 6], [np.nan] * 3])
    values = {(key, t_s): each.tolist() for key, t_s, each in frame.samples}
    assert values["foil", 0.9] == [0.2]
    assert values["foil", 1.0] == [0.3]
    np.testing.assert_array_equal(values["accelerometer", 1.0], [1, np.nan, 3])
    np.testing.assert_array_equal(values[1, 1.0], [1, 2, 3, np.nan, np.nan, np.nan])
    assert len(values) == 4


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{nonsense", "line 2: this line is not valid JSON"),
        ('{"markers": {}}', "line 2: there is no t_s"),
        ('{"t_s": 1, "marker": {}}', "line 2: found the key 'marker'"),
        ('{"t_s": true}', "line 2: t_s is True"),
        ('{"t_s": 1, "pose": {"position_m": [0, 0, 0]}}', "no quaternion_xyzw"),
        ('{"t_s": 1, "markers": {"m1": [1, 2]}}', "expected 3 numbers"),
        (f'{{"t_s": {TWENTY}}}', f"t_s is {TWENTY}; expected a finite number of seconds"),
        (f'{{"t_s": 1, "markers": {{"m1": [0, {15 * TWENTY}, 0]}}}}', "numbers up to 1e.10"),
        (f'{{"t_s": 1, "markers": {{"m1": [0, {20 * TWENTY}, 0]}}}}', "expected 3 numbers"),
        (f'{{"t_s": {250 * TWENTY}}}', "a number is too long"),
        (f'{{"t_s": {"[" * 100_000}', "brackets are nested too deeply"),
        (f'{{"t_s": 1, "markers": {{"m1": {"[" * 300}{"]" * 300}}}}}', "expected 3 numbers"),
        ("[1, 2]", "expected one JSON object per line"),
    ],
)
def test_bad_lines_are_named(line, message):
    lines = reader(swing())
    assert lines.read("") is None
    with pytest.raises(InputError, match=f"input, .*{message}"):
        lines.read(line)


def test_datagrams_are_read_until_an_empty_one():
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for each in (b"one\ntwo", b"", b"three"):
            sender.sendto(each, receiver.getsockname())
    assert [line for batch in arrived(receive_lines(receiver)) for line in batch] == [
        b"one",
        b"two",
    ]


def test_poses_of_lines_are_of_the_gripper_if_stated(tiny: Path):
    """As the poses of a file: both lead to the poses of the body in the recording."""
    file = tiny / "problem.toml"
    transform = "position_m = [0.01, 0.0, 0.02], quaternion_xyzw = [0, 0.6, 0, 0.8]"
    keys = 'poses = "swing_motion.csv"'
    text = file.read_text().replace(keys, f"{keys}, gripper_to_body = {{ {transform} }}")
    file.write_text(text)
    problem = cs.Problem.read(file)
    recorded = read_poses(tiny / "swing_motion.csv")
    rotations, positions_m = problem.experiments[0].grasps[0].poses.at(recorded.t_s)
    for k, t_s in enumerate(recorded.t_s):
        stated = (recorded.positions_m[k].tolist(), recorded.quaternions_xyzw[k].tolist())
        pose = dict(zip(("position_m", "quaternion_xyzw"), stated, strict=True))
        frame = reader(problem).read(json.dumps({"t_s": float(t_s), "pose": pose}))
        np.testing.assert_allclose(frame.poses[1][:3, 3], positions_m[k], atol=1e-12)
        np.testing.assert_allclose(frame.poses[1][:3, :3], rotations[k], atol=1e-12)


def test_a_problem_without_a_gripper_frame_has_no_transforms(tiny: Path):
    problem = cs.Problem.read(tiny / "problem.toml")
    assert gripper_transforms(problem, "swing", [0]) == [None]
    from_python = replace(problem, origin=None)
    assert gripper_transforms(from_python, "swing", [0]) == [None]


# Commands ---------------------------------------------------------------------------------------


def lines_of(problem: cs.Problem) -> list[bytes]:
    lines = []
    names = problem.experiments[0].markers.names
    poses = problem.experiments[0].grasps[0].poses
    for frame in frames_of(problem):
        k = int(np.abs(poses.t_s - frame.t_s).argmin())
        pose = {
            "position_m": poses.positions_m[k].tolist(),
            "quaternion_xyzw": poses.quaternions_xyzw[k].tolist(),
        }
        markers = dict(zip(names, frame.tracks_m.tolist(), strict=True))
        line = json.dumps({"t_s": frame.t_s, "pose": pose, "markers": markers})
        lines.append(line.encode())
    return lines


def live_command(monkeypatch, *lines: bytes) -> Outcome:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"\n".join(lines))))
    return run_command("live", "problem.toml", "--every-s", "0.01")


@pytest.mark.long
def test_malformed_lines_are_ignored_and_reported_in_one_line_with_exit_code_2(tiny, monkeypatch):
    with (tiny / "problem.toml").open("a") as file:
        file.write('\n[uncertainty]\nassumptions = "none"\n')  # which no solve of a part has
    lines = lines_of(cs.Problem.read("problem.toml"))
    ended = live_command(monkeypatch, *lines)
    assert ended.code == 0
    *_, last, final = [json.loads(line) for line in ended.out.splitlines()]
    assert last["t_s"] == pytest.approx(0.08)
    assert last["latency_s"] > 0
    assert final["trust"]["verdict"] in ("good", "check", "doubtful")
    for name, each in last["parameters"].items():
        assert each["value"] == pytest.approx(final["parameters"][name]["value"], rel=1e-3)
    bad = (b"{", lines[0].replace(b"0", b"\xff"), b"\xff\xfe", b'{"t_s":' + 10_000 * b"[")
    again = live_command(monkeypatch, *lines[:2], *bad, *lines[2:])
    assert again.code == 2
    (line,) = again.err.splitlines()
    assert line.startswith("error: standard input, line 3: this line is not valid JSON")
    assert line.endswith("; this line and 3 others are ignored")
    assert json.loads(again.out.splitlines()[-1]) == final


def test_a_recording_without_enough_frames_has_one_line_about_the_damaged_ones(tiny, monkeypatch):
    lines = lines_of(cs.Problem.read("problem.toml"))
    ended = live_command(monkeypatch, lines[0], b"{", b"", b"[]", b"\xff")
    assert (ended.code, ended.out) == (2, "")
    assert ended.err == (
        "error: standard input, line 2: this line is not valid JSON (Expecting property name "
        "enclosed in double quotes); expected one JSON object per line; this line and 2 others are "
        "ignored; without them: found 1 poses of grasp 1; expected at least 3\n"
    )


def test_a_damaged_line_of_a_stream_is_reported_while_it_goes_on(tiny, monkeypatch):
    monkeypatch.setattr(stream_commands, "arrived", lambda lines: ([line] for line in lines))
    clock = itertools.count()
    monkeypatch.setattr(stream_commands, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    first, last = live_command(monkeypatch, b"{", b"{", b"[]").err.splitlines()
    assert first.startswith("error: standard input, line 1: ")
    assert last == "error: found 0 poses of grasp 1; expected at least 3"


def test_ctrl_c_keeps_the_last_answer(tiny, monkeypatch):
    solved = []

    def solve(*arguments, **keys):
        solved.append(estimator_solve(*arguments, **keys))
        if len(solved) == 1:
            return solved[0]
        return replace(solved[-1], status=Status.INTERRUPTED)  # as after Ctrl-C

    estimator_solve = estimator.solve
    monkeypatch.setattr(estimator, "solve", solve)
    ended = run_command("replay", "problem.toml", "--rate", 0, "--every-s", "0.03", "--json")
    assert ended.code == 130
    (line,) = ended.out.splitlines()
    assert json.loads(line)["t_s"] == pytest.approx(0.03)
    assert "interrupted: the last answer is that at t = 0.03 s: " in ended.err


def test_a_recording_is_replayed_at_its_pace(tiny):
    ended = run_command("replay", "problem.toml", "--rate", 1000, "--every-s", 0.02)
    assert ended.code == 0
    assert ended.out.splitlines()[0].startswith("t = 0.")
    assert "Verdict: " in ended.out
