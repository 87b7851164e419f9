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

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..arrays import Array
from ..methods.start import marched
from ..program.collocation import Collocation
from .budget import BudgetLine
from .considered import Changes, assumed
from .distributions import normal_isf
from .estimates import Estimate
from .linearised import Derived, FitBlock, LinearisedFit, best_step, least_squares, linearised_fit
from .scatter import TELLING, part_fit, recordings_of, single_fits
from .uncertainty import ErrorModel, Uncertainty, uncertainty_of

# Into so many windows of time the data are cut.
WINDOWS = ("first third", "middle third", "last third")
# Probability that a faultless run has anything told by one of its probes.
CHANCE = 0.01
# Steps of a freed assumption that is told; and one of a parameter's logarithm that is the last.
STEPS, SETTLED = 4, 0.02
Kind = Literal["window", "recording", "assumption"]


@dataclass(frozen=True)
class Move:
    """How far an estimate goes in a refit.

    Attributes
    ----------
    value, std_error : float
        Of the refit.
    change : float
    of_statistical95, of_combined95 : float or None
        The same over the half widths of its intervals.
    """

    value: float
    std_error: float
    change: float
    of_statistical95: float | None
    of_combined95: float | None


@dataclass(frozen=True)
class Probe:
    """One refit.

    Attributes
    ----------
    kind : {"window", "recording", "assumption"}
    name : str
        The window, the recording, or the assumption with its component.
    chi_squared : float
        By how much χ² falls, of σ as stated and with priors.
    moves : mapping of estimate to Move
        Of those that the refit tells.
    size, size_error : float or None
        Of a freed assumption, in its unit.
    told : tuple of str
        Of a part of the data the estimates that are elsewhere not by chance; an assumption that is
        not zero by chance.
    """

    kind: Kind
    name: str
    chi_squared: float
    moves: Mapping[str, Move]
    size: float | None = None
    size_error: float | None = None
    told: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Answered:
    """A fit at its answer, as probes take it.

    Attributes
    ----------
    collocation : Collocation
    z : (variables,)
    fit : LinearisedFit
    errors : ErrorModel
    estimates : mapping of name to Estimate
    budget : mapping of name to BudgetLine
    deviations : mapping of all assumptions and nuisance parameters to their deviations
    """

    collocation: Collocation
    z: Array
    fit: LinearisedFit
    errors: ErrorModel
    estimates: Mapping[str, Estimate]
    budget: Mapping[str, BudgetLine]
    deviations: Mapping[str, float | None]

    def found(self, fit: LinearisedFit, p: Array) -> Uncertainty:
        """Estimates and error bars of another fit at p."""
        q = p[: fit.shared]
        constants = (segment.constants for segment in self.collocation.segments)
        fit = replace(fit, derived=Derived.of(constants, q))
        return uncertainty_of(fit, self.collocation.parameters, q, self.errors)

    def moves(self, found: Uncertainty) -> dict[str, Move]:
        """How far estimates went that a refit tells."""
        went = {}
        for name, each in {**found.estimates, **found.derived}.items():
            error, joint = each.statistical_std_error, self.estimates[name]
            if error and error < TELLING * abs(each.value):
                change = each.value - joint.value
                combined95 = self.budget[name].combined95 if name in self.budget else None
                of = _share(change, joint.statistical95), _share(change, combined95)
                went[name] = Move(each.value, error, change, *of)
        return went

    @property
    def p(self) -> Array:
        """All parameters at the answer."""
        return self.collocation.parameters_of(self.z)


def probes(at: Answered) -> tuple[Probe, ...]:
    """All refits: windows, recordings where there are several, and freed assumptions."""
    parts, freed = [*_windows(at), *_recordings(at)], [*_freed(at)]
    tests = sum(len(probe.moves) for probe in parts) + len(freed)
    limit = float(normal_isf(CHANCE / 2 / max(1, tests)))
    return (
        *(_elsewhere(each, limit) for each in parts),
        *(_released(at, probe, limit) for probe in freed),
    )


def _share(change: float, interval: tuple[float, float] | None) -> float | None:
    """A change in half widths of an interval."""
    return None if interval is None else 2 * change / max(interval[1] - interval[0], 1e-300)


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
    """Each assumption freed that changes anything."""
    changes = assumed(at.collocation, at.z, at.deviations)
    for name in dict.fromkeys(changes.names):
        wide = with_freedom(at.fit, changes, name)
        if any(block.slope[..., len(at.fit.names) :].any() for block in wide.blocks):
            yield _of_freedom(at, name, wide, at.p)


def with_freedom(fit: LinearisedFit, changes: Changes, name: str) -> LinearisedFit:
    """A fit in which an assumption is one more nuisance parameter, or several of its name.

    Parameters
    ----------
    fit : LinearisedFit
    changes : Changes
        Each off by its deviation, which is that of the prior.
    name : str
    """
    columns = [k for k, other in enumerate(changes.names) if other == name]
    blocks = []
    for block, change in zip(fit.blocks, changes.blocks, strict=True):
        more = change[..., columns] * (block.weight * block.seen)[..., None]
        blocks.append(replace(block, slope=np.concatenate([block.slope, more], axis=3)))
    count = len(columns)
    return replace(
        fit,
        blocks=tuple(blocks),
        names=(*fit.names, *(f"{name} {k}" for k in range(count))),
        prior_residual=np.append(fit.prior_residual, np.zeros(count)),
        prior_slope=np.append(fit.prior_slope, np.ones(count)),
        at_bound=np.append(fit.at_bound, np.zeros(count, dtype=bool)),
    )


def _of_freedom(at: Answered, name: str, wide: LinearisedFit, p: Array) -> Probe:
    """The best of a fit with one more freedom, linearised at p."""
    first, step = len(at.fit.names), best_step(wide)
    after, own = wide.after(step), step[first:]
    found = at.found(after, p + step[:first])
    before, left = least_squares(at.fit), least_squares(after)
    falls = before.loss(np.zeros(first)) - left.loss(np.zeros(len(step)))
    worst, unit = int(np.argmax(np.abs(own))), at.deviations[_row(name)] or 1.0
    error = [*found.nuisance.values()][first - wide.shared + worst]
    size = float(unit * own[worst]), float(unit * error)
    return Probe("assumption", name, falls, at.moves(found), *size)


def _released(at: Answered, probe: Probe, limit: float) -> Probe:
    """One that the data tell once more, from where its first step leads."""
    if not _is_told(probe, limit):
        return probe
    first, collocation = len(at.fit.names), at.collocation
    alone = {name: s if name == _row(probe.name) else None for name, s in at.deviations.items()}
    wide = with_freedom(at.fit, assumed(collocation, at.z, alone), probe.name)
    p, (_, near) = at.p, collocation.unpack(at.z)
    for _ in range(STEPS):
        step = best_step(wide)[:first]
        p = p + step
        near, failure = marched(collocation, p, near=near)
        if failure is not None:
            break
        z = collocation.pack(p, near)
        changes = assumed(collocation, z, alone)
        there = linearised_fit(collocation, z).disturbed(b.disturbances for b in at.fit.blocks)
        wide = with_freedom(there, changes, probe.name)
        probe = _of_freedom(at, probe.name, wide, p)
        if np.abs(step[: wide.shared]).max(initial=0.0) < SETTLED:
            break
    return replace(probe, told=(probe.name,) if _is_told(probe, limit) else ())


def _is_told(probe: Probe, limit: float) -> bool:
    assert probe.size is not None
    return probe.size_error is not None and abs(probe.size) > limit * probe.size_error


def _row(name: str) -> str:
    """The row of an assumption with its component."""
    return name.partition(" ")[0]
