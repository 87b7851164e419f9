"""Samples in which a tracker has lost its point, from the tracks alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array

# Fewest samples at exactly one place that fill a gap, and share of the others that may be exactly
# those before, as coordinates with few digits are.
FEWEST_HELD = 5
REPEATED = 0.1
# Motion over σ up to which a point is still.
STILL_SIGMAS = 6.0
# Size over σ from which on a step may be a jump, and over the other steps that it exceeds: those of
# the same track before and after it, and that of most other tracks in the same interval.
LARGE_SIGMAS = 15.0
SUDDEN = 4.0
# Neighbouring steps on each side of a jump, and the fewest that are known; fewest tracks of which
# one can jump alone.
BESIDE = 2
FEWEST_BESIDE = 2
FEWEST_TRACKS = 3
# Distance from the track before all jumps over the largest jump, up to which the point is found again.
FOUND_AGAIN = 0.5


def held_tracks(tracks: Array, sigma: float) -> Iterator[tuple[int, list[tuple[int, int]]]]:
    """Yield the tracks (S, M, d) that are exactly at one place for some samples while others move,
    as gaps that were filled with the last position or with zeros are; with first and last samples.
    """
    repeats = (np.diff(tracks, axis=0) == 0).all(axis=2)
    for m in range(tracks.shape[1]):
        edges = np.flatnonzero(np.diff(np.r_[False, repeats[:, m], False]))
        runs = [(k, end) for k, end in edges.reshape(-1, 2).tolist() if end - k >= FEWEST_HELD - 1]
        count = sum(end - k for k, end in runs)
        rest = np.isfinite(tracks[:, m, 0]).sum() - 1 - count
        if not runs or repeats[:, m].sum() - count > REPEATED * rest:
            continue
        first, last = max(runs, key=lambda run: run[1] - run[0])
        others = np.delete(tracks[first : last + 1], m, axis=1)
        extents = np.linalg.norm(np.ptp(others, axis=0), axis=1)
        moved = float(np.max(extents, initial=0.0, where=np.isfinite(extents))) / sigma
        if moved > STILL_SIGMAS:
            yield m, runs


def jumps(tracks: Array, sigma: float) -> Iterator[tuple[int, int, Array]]:
    """Yield track, first sample after it, and vector (d,) of each jump that one of the tracks
    (S, M, d) makes alone, between two samples: an error of a single sample is no jump.
    """
    if tracks.shape[1] < FEWEST_TRACKS:
        return
    steps = np.diff(tracks, axis=0)
    known = np.asarray(np.isfinite(steps).all(axis=2))
    steps = np.where(known[..., None], steps, np.nan)
    common = np.zeros((len(steps), 1, tracks.shape[2]))
    several = known.sum(axis=1) >= FEWEST_TRACKS
    common[several, 0] = np.nanmedian(steps[several], axis=1)
    sizes = np.linalg.norm(steps - common, axis=2)
    usual = np.full(len(steps), np.inf)
    usual[several] = np.nanmedian(sizes[several], axis=1)
    large = known & (sizes > LARGE_SIGMAS * sigma) & (sizes > SUDDEN * usual[:, None])
    for at, m in np.argwhere(large).tolist():
        beside = np.r_[sizes[max(0, at - BESIDE) : at, m], sizes[at + 1 : at + 1 + BESIDE, m]]
        beside = beside[np.isfinite(beside)]
        if len(beside) >= FEWEST_BESIDE and sizes[at, m] > SUDDEN * beside.max():
            yield m, at + 1, steps[at, m] - common[at, 0]


def followed_samples(tracks: Array, sigma: float) -> NDArray[np.bool_]:
    """Return the mask (S, M) of the samples in which the tracks (S, M, d) follow their points:
    neither those that are held, nor those from a jump on until the track jumps back, nor those in
    which all tracks are exactly where they were before, as in an image that is repeated. The longer
    part of a track that jumps once near its beginning is assumed right.
    """
    followed = np.ones(tracks.shape[:2], dtype=bool)
    off = np.zeros_like(tracks)
    largest = np.zeros(tracks.shape[1])
    for m, at, jump in jumps(tracks, sigma):
        off[at:, m] += jump
        largest[m] = max(largest[m], float(np.linalg.norm(jump)))
    followed &= np.linalg.norm(off, axis=2) <= FOUND_AGAIN * largest
    early = 2 * followed.sum(axis=0) < (~followed).sum(axis=0)
    followed[:, early] = ~followed[:, early]
    for track, runs in held_tracks(tracks, sigma):
        for first, last in runs:
            followed[first : last + 1, track] = False
    if tracks.shape[1] >= FEWEST_TRACKS:
        repeated = (np.diff(tracks, axis=0) == 0).all(axis=(1, 2))
        if repeated.sum() <= REPEATED * len(repeated):
            followed[1:][repeated] = False
    return followed
