"""Verdict on tracks: how many points survive, where the others were lost, and what helps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...common.display import Line, Shown, Table
from .points import Tracks
from .start_time import StartTime

# Fewest points that one camera needs: the pose of a camera follows from four.
FEWEST_POINTS = 4
# Step between two images above which a point that was lost was probably too fast [pixels]; the page
# docs/howto/image_tracks.md has what was measured.
FAST_PX = 35.0
# Losses that are listed.
MOST_LISTED = 8


@dataclass(frozen=True, eq=False)
class TrackVerdict:
    """What was tracked, and what is to be done."""

    tracks: Tracks
    start: StartTime | None = None
    damage: str = ""  # a sentence on errors of the video; empty without any

    @property
    def surviving(self) -> int:
        """Number of points that the last image has."""
        return int(np.isfinite(self.tracks.pixels[-1]).all(axis=-1).sum())

    @property
    def verdict(self) -> str:
        """Return "good", "check" (fewer than half of the points or than four survive, or the video is
        damaged) or "doubtful".
        """
        count = len(self.tracks.names)
        if not self.surviving:
            return "doubtful"
        is_enough = self.surviving >= min(FEWEST_POINTS, count) and 2 * self.surviving >= count
        return "good" if is_enough and not self.damage else "check"

    @property
    def remedies(self) -> list[str]:
        """Sentences on what helps against damage and losses; empty without any."""
        losses = self.tracks.losses
        left = [each for each in losses if each.has_left]
        fast = [each for each in losses if not each.has_left and each.step_px > FAST_PX]
        changed = len(losses) - len(left) - len(fast)
        found = [self.damage] if self.damage else []
        if left:
            found.append(f"{len(left)} left the image: film with more room around the motion")
        if fast:
            most_px = max(each.step_px for each in fast)
            found.append(
                f"{len(fast)} moved by up to {most_px:.0f} pixels per image: move slower, or film more "
                "images per second"
            )
        if changed:
            found.append(
                f"{changed} changed or moved suddenly: film before a plain background, with a shorter "
                "exposure and more light, move slower, or use another tracker"
            )
        return found

    def shown(self) -> Iterator[Shown]:
        """Yield the verdict with its numbers for display."""
        tracks = self.tracks
        seen = np.isfinite(tracks.pixels).all(axis=2).mean()
        yield Line(f"Verdict: {self.verdict}")
        yield (
            f"{self.surviving} of {len(tracks.names)} points survive to the last of {len(tracks.t_s)} "
            f"images ({tracks.t_s[-1]:.4g} s); {seen:.0%} of the samples"
        )
        if tracks.sigma_px:
            yield f"sigma_px = {tracks.sigma_px:.3f}, in the table: deviation from the motion of neighbours"
        if tracks.losses:
            rows = tuple(
                (
                    each.name,
                    f"{each.image}",
                    f"{each.t_s:.3f} s",
                    f"({each.pixel[0]:.0f}, {each.pixel[1]:.0f})",
                    f"{each.step_px:.1f} px",
                )
                for each in tracks.losses[:MOST_LISTED]
            )
            heads = ("lost", "image", "time", "last at", "step")
            yield Table("", heads, rows=rows)
            more = len(tracks.losses) - MOST_LISTED
            if more > 0:
                yield f"and {more} more"
        yield from self.remedies
        if self.start is not None:
            yield (
                f"start_s = {self.start.start_s:.4f}, ± {2 * self.start.sigma_s:.1g} s of noise alone, from "
                f"{', '.join(self.start.names)}; {self.start.unexplained:.1%} of their motion does not "
                "follow the poses"
            )
