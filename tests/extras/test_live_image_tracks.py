"""Live estimates from image tracks, without markers: information and solution of the batch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from kit.filmed import NAMES, TRUTH, filming, swung, tracks_of, unknown_young
from kit.frames import frames_of, normal_equations

import collocation_sysid as cs
from collocation_sysid.extras.live import FrameReader, LiveEstimator, LiveOptions
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.program import streaming_model, streaming_sweep
from collocation_sysid.recording.poses import PoseSequence

# Points on the sides that a camera sees.
SEEN = {
    "front": [name for name in NAMES if not name.endswith("end")],
    "side": [name for name in NAMES if not name.endswith("front")],
}
UNKNOWN = {**TRUTH, "young_pa": cs.Unknown(1e5), "gamma_r_s": cs.Unknown(4e-3)}
EXACT_POSE: dict[str, Any] = {"pose_sigma": cs.PoseSigma(turn_deg=0.0, shift_m=0.0)}


def seen_from(name: str, rng: np.random.Generator | None = None, **changes: Any) -> cs.ImageTracks:
    """Tracks of the points that a camera sees."""
    tracks = tracks_of(name, rng, **changes)
    chosen = [NAMES.index(point) for point in SEEN[name]]
    places = {"places_m": tracks.known_places_m[chosen]}
    return replace(tracks, names=SEEN[name], pixels=tracks.pixels[:, chosen], **places)


def test_image_tracks_count_live_as_in_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    rng = np.random.default_rng(1)
    tracks = [seen_from(name, rng, **EXACT_POSE) for name in SEEN]
    problem = cs.Problem([swung(tracks)], UNKNOWN, substeps=1)
    live = LiveEstimator(problem, LiveOptions(budget_s=1e-9))
    for frame in frames_of(problem, live)[:20]:
        live.process_frame(frame)
    rows = len(live.log)
    seen = [
        replace(each, pixels=np.where(np.arange(41)[:, None, None] < rows - 2, each.pixels, np.nan))
        for each in tracks
    ]
    collocation = cs.Problem([swung(seen)], UNKNOWN).collocation()
    p = collocation.guess_p
    horizon = Horizon(collocation, [rows], prior=streaming_model.WEAK_PRIOR_DEVIATION)
    reached, _ = horizon.simulate(p)
    point = horizon.evaluate(
        p, [each.x + each.step for each in horizon.evaluate(p, reached).trajectories]
    )
    flat = live.model.transformed(p)
    batch = np.column_stack([point.fit.jacobian, point.fit.residual - point.fit.jacobian @ flat])
    batch = batch.T @ batch
    ours = normal_equations(live.first_pass.sweep.information.triangle)
    scale = np.sqrt(np.outer(np.diag(batch), np.diag(batch)))
    np.testing.assert_allclose(ours / scale, batch / scale, atol=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("known", [True, False], ids=["places known", "places unknown"])
def test_live_estimates_of_image_tracks_end_where_the_batch_ends(known: bool) -> None:
    rng = np.random.default_rng(3)
    tracks = [seen_from(name, rng, known=known) for name in SEEN]
    problem = cs.Problem([swung(tracks)], UNKNOWN, substeps=1)
    live = LiveEstimator(problem, LiveOptions(rows=20))
    for frame in frames_of(problem, live):
        update = live.process_frame(frame)
    # The last two images wait for later rows.
    used = [
        replace(t, pixels=np.concatenate([t.pixels[:-2], np.nan * t.pixels[-2:]])) for t in tracks
    ]
    batch = cs.solve(replace(problem, experiments=[swung(used)])).parameters
    for name in ("young_pa", "gamma_r_s"):
        estimate = update.estimates[name]
        assert abs(estimate.value - batch[name]) < 0.1 * estimate.statistical_std_error
    assert update.pixel_rms == pytest.approx(0.5, abs=0.1)
    assert np.isnan(update.marker_rms_m)
    settled, whole = live.finish(), cs.run(problem, seek_causes=False)
    assert settled is not None
    for name, estimate in settled.estimates.items():
        assert estimate.value == pytest.approx(whole.parameters[name], rel=1e-6)


@pytest.mark.long
def test_the_pose_of_a_camera_is_found_from_the_first_frame() -> None:
    anywhere = filming("front", pose=np.eye(4))
    tracks = seen_from("front", camera=anywhere, has_known_pose=False)
    problem = cs.Problem([swung([tracks])], unknown_young(), substeps=1)
    live = LiveEstimator(problem, LiveOptions(rows=6))
    first, *others = frames_of(problem, live)
    # Without an image the frame is no beginning.
    update = live.process_frame(replace(first, t_s=-0.01, instrument_samples=()))
    assert "the first frame has no pixels of 'front'" in update.notes[0]
    for frame in (first, *others):
        update = live.process_frame(frame)
    assert update.estimates["young_pa"].value == pytest.approx(TRUTH["young_pa"], rel=0.01)


def test_a_point_that_is_not_on_the_body_is_left_out_with_a_note() -> None:
    tracks = seen_from("front", known=False)
    problem = cs.Problem([swung([tracks])], unknown_young(), substeps=1)
    live = LiveEstimator(problem, LiveOptions(budget_s=1e-9))
    first = frames_of(problem, live)[0]
    ((number, t_s, values),) = first.instrument_samples
    values = np.concatenate([[5.0, 5.0], values[2:]])
    update = live.process_frame(replace(first, instrument_samples=((number, t_s, values),)))
    assert update.notes == (
        "points left out, because the first frame does not show them on the body: "
        "tip_front in front",
    )


def test_frames_bring_pixels_by_point_or_in_columns() -> None:
    cameras = [seen_from(name) for name in SEEN]
    reader = FrameReader([1], [], gauges=cameras)
    line = '{"t_s": 1, "readings": {"front": {"tip_top": [3, 4], "near_top": null}}}'
    ((number, _, values),) = reader.read(line).instrument_samples
    expected = np.full((len(SEEN["front"]), 2), np.nan)
    expected[SEEN["front"].index("tip_top")] = 3, 4
    assert number == 1
    np.testing.assert_array_equal(values, expected.ravel())
    with pytest.raises(cs.InputError, match="found a point 'nose'; expected one of tip_front"):
        reader.read('{"t_s": 1, "readings": {"front": {"nose": [3, 4]}}}')
    assert (
        reader.read("t_s,x_m,y_m,z_m,qx,qy,qz,qw,side.tip_top_u,side.tip_top_v,tip_end_u") is None
    )
    ((number, _, values),) = reader.read("1,0,0,0,0,0,0,1,5,6,7").instrument_samples
    assert (number, values[np.isfinite(values)].tolist()) == (2, [7, 5, 6])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"drift_sigma_px": 1.0}, "drifts of tracks that are estimated"),
        ({"camera": "moving"}, "a camera that moves"),
    ],
)
def test_tracks_that_frames_do_not_describe_are_refused(changes: Any, said: str) -> None:
    if "camera" in changes:
        changes = {"camera": replace(filming("front"), poses=PoseSequence.fixed())}
    problem = cs.Problem([swung([tracks_of(**changes)])], parameters=unknown_young())
    with pytest.raises(cs.InputError, match=f"live estimates do not support {said}"):
        LiveEstimator(problem)
