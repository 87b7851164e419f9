"""Likely mistakes in the description of image tracks: cameras (`stated_cameras`), and single tracks,
which are compared with their predictions after a fit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...common.array_types import Array
from ...judge.source import Source
from ...methods.solution import Solution
from ...recording.placement import nearest_points_of_triangles
from ...statistics.hypothesis import Hypothesis
from . import stated_cameras
from .residual import ImageTrackResidual

# Standard deviations of residuals from which a track is suspicious, and the factor by which an
# exchange or a step must explain them.
SUSPICIOUS = 5.0
EXPLAINED = 3.0
# Range of a track over that of its prediction below which the tracker is stuck.
STUCK = 0.25
# Samples on each side of a jump.
FEWEST_BESIDE = 3
# Distance of an estimated place from the surface over the diagonal of the body, beyond which it is off
# the body: wrong solutions of twins with unknown places had 0.06 to 0.2.
OFF_BODY = 0.05


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield exchanged, stuck, jumping and lost tracks; of a camera with missing images these alone,
    because they deform the fit.
    """
    for part in solution.parts:
        experiment = part.transcription.experiment
        name = experiment.name
        pairs = zip(part.transcription.residuals, part.observables, strict=True)
        for residual, values in pairs:
            if isinstance(residual, ImageTrackResidual):
                predicted = residual.predict(values, part.phi)[..., :2]
                of = f"'{residual.sensor.name}' of '{name}'"
                missing = [*stated_cameras.missing_image_hypotheses(experiment, residual.sensor)]
                if missing:
                    yield from missing
                    continue
                yield from places_off_body(residual, part.phi, of)
                yield from track_hypotheses(residual, predicted, of)


def places_off_body(residual: ImageTrackResidual, phi: Array, of: str) -> Iterator[Hypothesis]:
    """Yield the point of one camera whose estimated place at φ (k,) is farthest from the body, if it
    is off the body.
    """
    places, body = residual.correspondences, residual.experiment.body
    corners = body.nodes_m[body.mesh.surface]
    size_m = float(np.linalg.norm(np.ptp(body.nodes_m, axis=0)))
    places_m = places.places_m(phi)
    off_m = np.zeros(len(places_m))
    for k in np.flatnonzero(places.is_placed).tolist():
        nearest = nearest_points_of_triangles(places_m[k], corners)
        off_m[k] = np.linalg.norm(nearest - places_m[k], axis=1).min()
    worst = int(off_m.argmax())
    if off_m[worst] > OFF_BODY * size_m:
        data = {"point": residual.sensor.names[worst], "off_mm": 1e3 * float(off_m[worst])}
        strength = float(off_m[worst]) / (OFF_BODY * size_m)
        yield Hypothesis("image-track/off-body", of, data=data, strength=strength)


def track_hypotheses(
    residual: ImageTrackResidual, predicted: Array, of: str
) -> Iterator[Hypothesis]:
    """Yield hypotheses about the tracks of one camera.

    Parameters
    ----------
    predicted : (s, N, 2) array
        Predicted pixels of the first s images.
    of : str
        Camera and experiment, for messages.
    """
    sigma = residual.sensor.sigma_px
    names = residual.sensor.names
    compared = np.asarray(residual.is_compared[: len(predicted), :, :2].all(axis=2))
    measured = np.where(compared[..., None], residual.measured[: len(predicted), :, :2], np.nan)
    used = np.flatnonzero(compared.any(axis=0)).tolist()
    off = (measured - predicted) / sigma
    rms = {k: float(np.sqrt(np.nanmean(off[:, k] ** 2))) for k in used}
    exchanged: set[int] = set()
    for i in used:
        for j in (k for k in used if k > i):
            own = np.hypot(rms[i], rms[j])
            if own < SUSPICIOUS or {i, j} & exchanged:
                continue
            crossed = (measured[:, [j, i]] - predicted[:, [i, j]]) / sigma
            known = np.asarray(np.isfinite(crossed).all(axis=(1, 2)))
            if not known.any():
                continue
            other = float(np.sqrt(2 * np.mean(crossed[known] ** 2)))
            if other * EXPLAINED < own:
                exchanged |= {i, j}
                data = {"first": names[i], "second": names[j]}
                yield Hypothesis("image-track/exchanged", of, data=data, strength=own / other)
    usual = float(np.median([*rms.values()])) if rms else 0.0
    for k in used:
        if k in exchanged or rms[k] < SUSPICIOUS or rms[k] < EXPLAINED * usual:
            continue
        yield _track_hypothesis(residual, k, measured[:, k], predicted[:, k], of, rms[k], usual)


def _track_hypothesis(
    residual: ImageTrackResidual,
    k: int,
    measured: Array,
    predicted: Array,
    of: str,
    rms: float,
    usual: float,
) -> Hypothesis:
    name = residual.sensor.names[k]
    known = np.flatnonzero(np.isfinite(measured).all(axis=1))
    strength = rms / max(usual, 1.0)
    ranges = [float(np.linalg.norm(np.ptp(v[known], axis=0))) for v in (measured, predicted)]
    if ranges[0] < STUCK * ranges[1]:
        data = {"point": name, "predicted_px": ranges[1]}
        return Hypothesis("image-track/stuck", of, data=data, strength=strength)
    off = (measured - predicted)[known]
    best, at, jump = np.inf, 0, np.zeros(2)
    for cut in range(FEWEST_BESIDE, len(off) - FEWEST_BESIDE + 1):
        means = off[:cut].mean(axis=0), off[cut:].mean(axis=0)
        rest = np.sum((off[:cut] - means[0]) ** 2) + np.sum((off[cut:] - means[1]) ** 2)
        if rest < best:
            best, at, jump = rest, cut, means[1] - means[0]
    if best * EXPLAINED**2 < np.sum((off - off.mean(axis=0)) ** 2):
        t_s = float(residual.t_s[known[at]])
        data = {"point": name, "jump_px": float(np.linalg.norm(jump)), "t_s": t_s}
        return Hypothesis("image-track/jumps", of, data=data, strength=strength)
    data = {"point": name, "sigmas": rms, "others": usual}
    return Hypothesis("image-track/drifts", of, data=data, strength=strength)


IMAGE_TRACKS = Source(described=stated_cameras.hypotheses, fitted=fit_hypotheses)
