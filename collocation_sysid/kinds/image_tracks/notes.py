"""Image tracks in checks and runs: likely errors of cameras (`stated_cameras`) and of single tracks,
which are compared with their predictions after a fit, and notes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...program.collocation import ExperimentIterate
from .places import SIMILAR_POSES
from .residual import ImageTrackResidual


def notes(part: ExperimentIterate) -> Iterator[str]:
    """Yield a note for each camera: how many pixels are compared, and what is left out."""
    experiment = part.transcription.experiment
    pairs = zip(part.transcription.residuals, part.observables, strict=True)
    for residual, values in pairs:
        if not isinstance(residual, ImageTrackResidual):
            continue
        places, tracks = residual.correspondences, residual.sensor
        off = (residual.predict(values, part.phi) - residual.measured[: len(values)])[..., :2]
        compared = residual.is_compared[: len(off), :, :2]
        known = compared.all(axis=2)
        rms = float(np.sqrt(np.mean(off[compared] ** 2))) if compared.any() else np.nan
        left = []
        if not places.is_placed.all():
            absent = [n for n, on in zip(tracks.names, places.is_placed, strict=True) if not on]
            left.append(f"{', '.join(absent)} (their rays do not meet the body)")
        hidden = tracks.is_seen & places.is_placed & ~places.is_visible
        if hidden.any():
            left.append(f"{hidden.sum()} samples of points that the body or an obstacle hides")
        lost = np.isfinite(residual.measured[..., 0]) & ~tracks.is_followed
        if lost.any():
            names = [name for name, of in zip(tracks.names, lost.T, strict=True) if of.any()]
            left.append(
                f"{lost.sum()} samples of {', '.join(names)} in which the tracker has lost the point "
                "(after a jump, at exactly one place, or in repeated images)"
            )
        yield (
            f"experiment '{experiment.name}': {known.sum()} samples of {known.any(axis=0).sum()} "
            f"points of '{tracks.name}' deviate by {rms:.3g} pixels (RMS of a coordinate); left out: "
            f"{'; '.join(left) or 'none'}"
        )
        if not tracks.has_known_pose:
            rows = [
                "[" + ", ".join(f"{number:.4f}" for number in row) + "]"
                for row in residual.estimated_pose(part.phi).tolist()
            ]
            yield f"pose of '{tracks.name}' as found: pose = [{', '.join(rows)}]"
        if places.mirror_ratio < SIMILAR_POSES:
            yield (
                f"the pose of '{tracks.name}' was found from points that a mirrored pose explains "
                f"nearly as well (error {places.mirror_ratio:.2g} times as large): state the places "
                "of points that are not in a plane, or the pose"
            )
