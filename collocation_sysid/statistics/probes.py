"""Where to look harder: what parts of the data say alone, and what a freed assumption changes.

Windows of time and recordings are fitted alone by one Gauss–Newton step from the answer, as for
`scatter`: parts that agree are near it, and of parts that do not the first order tells which way.
An assumption that is freed joins the linearised fit as one more nuisance parameter, its prior the
deviation that it is considered with and its slope what that changes of the residuals, see
`considered`. Where the data tell it, its effect is found again where that step leads, simulated
without it, and a step is taken from there, until parameters settle: what is left out is of second
order in its own size. Error bars are those of any fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..methods.start import marched
from .assumptions import CORRELATION_KEY
from .distributions import normal_isf
from .linearised import FitBlock, LinearisedFit, best_step, least_squares, linearised_fit
from .relaxation import (
    Answered,
    Kind,
    Probe,
    assumption_of,
    probed_changes,
    relaxed_probe,
    with_freedom,
)
from .routine_probes import ROUTINE, WIDENING, is_alarming, routine_probes, significance
from .scatter import part_fit, recordings_of, single_fits

# Into so many windows of time the data are cut.
WINDOWS = ("first third", "middle third", "last third")
# Probability that a faultless run has any significant probe, beside those of every solve.
CHANCE = 0.01
# Most linear steps of a significant assumption: each is a simulation.
STEPS = 4
# Change of a parameter's logarithm in a step that is the last.
SETTLED = 0.02


def probes_of_every_solve(at: Answered) -> tuple[Probe, ...]:
    """Relax the routine assumptions by one linear step, and follow the one that gives concern.

    A linear step suffices to find that an assumption is wrong, but not for estimates that change by
    much of their value. So the most significant assumption that gives concern, if there is one,
    takes a few steps more, each a simulation.
    """
    found = routine_probes(at)
    alarming = [probe for probe in found if is_alarming(probe)]
    if not alarming:
        return found
    worst = max(alarming, key=lambda probe: probe.chi_squared)
    followed = replace(_released(at, worst, significance(at.changes)), routine=True)
    return tuple(followed if probe is worst else probe for probe in found)


def probes(at: Answered) -> tuple[Probe, ...]:
    """Refit windows of time, recordings where there are several, and with assumptions relaxed.

    Assumptions that every solve probes have the same prior and level of significance as there.
    """
    parts = [*_windows(at), *_recordings(at)]
    freed = [*_freed(at)]
    tests = sum(len(probe.moves) for probe in parts) + len(freed)
    limit = float(normal_isf(CHANCE / 2 / max(1, tests)))
    limits = dict.fromkeys(ROUTINE, significance(at.changes))
    return (
        *(_elsewhere(each, limit) for each in parts),
        *(_released(at, probe, limits.get(probe.name, limit)) for probe in freed),
    )


def _windows(at: Answered) -> Iterator[Probe]:
    """A third of every recording's time at a time."""
    for k, name in enumerate(WINDOWS):
        cuts = [_third(block, k) for block in at.fit.blocks]
        blocks = [_cut(block, cut) for block, cut in zip(at.fit.blocks, cuts, strict=True)]
        alone = part_fit(at.fit, blocks, np.arange(len(at.fit.names)))
        yield from _part(at, "window", name, *alone)


def _third(block: FitBlock, k: int) -> slice:
    ends = np.round(np.linspace(0, len(block.t_s), len(WINDOWS) + 1)).astype(int)
    return slice(int(ends[k]), int(ends[k + 1]))


def _cut(block: FitBlock, cut: slice) -> FitBlock:
    """The same of some samples."""
    own = ("t_s", "present", "residual", "slope", "misfit", "components")
    there = {name: each[cut] for name in own if (each := getattr(block, name)) is not None}
    shaken = block.disturbances
    return replace(block, **there, disturbances=None if shaken is None else shaken[:, cut])


def _recordings(at: Answered) -> Iterator[Probe]:
    if len(recordings_of(at.fit)) < 2:
        return
    for alone, step in single_fits(at.fit):
        yield from _part(at, "recording", alone.blocks[0].name, alone, step)


def _part(
    at: Answered, kind: Kind, name: str, alone: LinearisedFit, step: Array
) -> Iterator[Probe]:
    """What a part of the data says alone, of what it tells at all."""
    if alone.measurements <= len(alone.names):
        return
    found = at.found(alone, at.p[: alone.shared] + step[: alone.shared])
    left = least_squares(alone)
    falls = left.loss(-step) - left.loss(np.zeros(len(step)))
    yield Probe(kind, name, falls, at.moves(found))


def _elsewhere(probe: Probe, limit: float) -> Probe:
    """Told are estimates that are farther away than by chance.

    A part scatters about the whole by less than its own error bar (Hausman 1978).
    """
    far = (n for n, move in probe.moves.items() if abs(move.change) > limit * move.std_error)
    return replace(probe, told=tuple(far))


# Freed assumptions --------------------------------------------------------------------------------


def _freed(at: Answered) -> Iterator[Probe]:
    """Relax each assumption that changes anything, by one linear step."""
    for name in dict.fromkeys(at.changes.names):
        wide = with_freedom(at.fit, at.changes, name, _widening(name))
        if any(block.slope[..., len(at.fit.names) :].any() for block in wide.blocks):
            yield relaxed_probe(at, name, wide, at.p)


def _released(at: Answered, probe: Probe, limit: float) -> Probe:
    """Return a probe that is significant after further steps, from where its first step leads.

    Parameters
    ----------
    at : Answered
    probe : Probe
        Of an assumption, after one linear step; one that is not significant is returned as it is.
    limit : float
        The least significant size, in its standard errors.
    """
    if not probe.is_beyond(limit):
        return probe
    first = len(at.fit.names)
    collocation = at.collocation
    kept = assumption_of(probe.name), CORRELATION_KEY
    alone = {name: size if name in kept else None for name, size in at.deviations.items()}
    wide = with_freedom(at.fit, at.changes, probe.name, _widening(probe.name))
    p = at.p
    _, near = collocation.unpack(at.z)
    for _ in range(STEPS):
        step = best_step(wide)[:first]
        p = p + step
        near, failure = marched(collocation, p, near=near)
        if failure is not None:
            break
        z = collocation.pack(p, near)
        changes = probed_changes(collocation, z, alone)
        there = linearised_fit(collocation, z).disturbed(b.disturbances for b in at.fit.blocks)
        wide = with_freedom(there, changes, probe.name, _widening(probe.name))
        probe = relaxed_probe(at, probe.name, wide, p)
        if np.abs(step[: wide.shared]).max(initial=0.0) < SETTLED:
            break
    return replace(probe, told=(probe.name,) if probe.is_beyond(limit) else ())


def _widening(name: str) -> float:
    """Return the deviation of an assumption's prior, in deviations of the budget."""
    return WIDENING if name in ROUTINE else 1.0
