"""Where a search starts without a guess: a scan of the stiffness, from stiff to soft.

At each stiffness the free moduli take the values that they usually have beside each other, the
other parameters without a guess theirs, and the first part of every recording is simulated and
compared with all that was measured. A stiff body can always be simulated and moves as the grasp
does; the softer it is, the more it sags and lags and the less force it gives, until it fits, and
then falls apart. So the best start is found by simulations that are cheap, and the search begins on
the right side of what can be simulated.

The same scan is the rescue where a guess cannot be simulated, or fits worse than a rigid body.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby

import numpy as np

from ..arrays import Array, root_mean
from ..errors import InputError, SimulationError
from ..fem.constants import is_modulus, usual_value
from ..model.parameters import Parameter, Parameters
from ..program.collocation import Collocation, Part
from ..program.newton import NewtonOptions
from ..program.segment import Segment
from .options import SHARES, part_of
from .start import marched

# Young's moduli that are tried, those beyond where the best is at an end, and the most of these.
STIFFEST_PA, SOFTEST_PA, STEPS = 1e7, 1e2, 15
LIMITS_PA = 1e10, 1.0
# Of a body that nothing is known of.
SOFT_PA = 1e4
# What is simulated for a comparison need not be exact.
LOOSE = NewtonOptions(tolerance=1e-4)
# The scan ends after this many stiffnesses in a row that fail or fit this much worse than the best.
LOST, WORSE = 2, 3.0
# Beyond an end a stiffness is tried as long as the last one fitted better by this share.
BETTER = 0.01
# Other starts that are followed where there are local minima, and by which factor their misfit may
# be larger than the best: each costs a solve, and the right one was next to the best in all twins.
MORE_STARTS = 2
ALIKE = 4.0
NO_GUESS = "no guess"


@dataclass(frozen=True, eq=False)
class Scan:
    """What a scan of the stiffness found.

    Attributes
    ----------
    reason : str
        Why there was one.
    young_pa : (k,) ndarray
        Young's moduli that were tried, ascending; moduli with a guess, and those fixed, kept it.
    misfit : (k,) ndarray
        Root mean square of the residuals, of markers and wrenches, in standard deviations; NaN
        where the body could not be simulated.
    best : int
        Position of the one that was chosen.
    parameters : Parameters
        With the guesses to start from.
    samples : int
        How many first samples were compared, over all experiments.
    time_s : float
    starts : mapping of int to Parameters
        By the position of a stiffness the guesses to start from, of the best and the others.
    others : tuple of int
        Positions of other stiffnesses that may lead to a better answer where there are local
        minima: those next to the best, and other minima of the misfit, the least misfit first.
    """

    reason: str
    young_pa: Array
    misfit: Array
    best: int
    parameters: Parameters
    samples: int
    time_s: float
    starts: Mapping[int, Parameters] = field(default_factory=dict)
    others: tuple[int, ...] = ()

    @property
    def sentence(self) -> str:
        """What was done, for people."""
        return (
            f"{self.reason}: started from E = {self.young_pa[self.best]:.3g} Pa after a scan of "
            f"{len(self.young_pa)} stiffnesses in {self.time_s:.2g} s"
        )


def started(collocation: Collocation, whole: bool = False) -> tuple[Collocation, Scan | None]:
    """The problem with a guess of every parameter, and the scan that found it, if there was one.

    Guesses that are given stay, unless the body cannot be simulated with them or misses what was
    measured by more than an undeformed one, and the scan finds better ones.

    Parameters
    ----------
    collocation : Collocation
    whole : bool
        Whether the start must be simulable to the end of the recordings.

    Raises
    ------
    InputError
        Where parameters have no guess and the body cannot be simulated at any stiffness.
    """
    unguessed = collocation.parameters.unguessed
    if any(is_modulus(name) for name in unguessed):
        found = scan(collocation, whole=whole)
        return replace(collocation, parameters=found.parameters), found
    if unguessed:
        usual = usual_parameters(collocation.parameters, STIFFEST_PA)
        collocation = replace(collocation, parameters=usual)
    if not _scannable(collocation):
        return collocation, None
    trial = _Trial(collocation)
    misfit, failure = trial.guess(whole)
    if failure is None and misfit <= trial.rigid_misfit:
        return collocation, None
    reason = f"the body cannot be simulated at the guess ({failure})"
    if failure is None:
        reason = "at the guess the measurements are missed by more than an undeformed body would"
    found = rescue(collocation, reason, whole)
    if found is None:
        return collocation, None  # the method will tell what it needs
    if failure is None and misfit <= found.misfit[found.best]:
        return collocation, None
    return replace(collocation, parameters=found.parameters), found


def rescue(collocation: Collocation, reason: str, whole: bool = False) -> Scan | None:
    """The scan without the guesses that are given; None where it finds nothing."""
    if not _scannable(collocation):
        return None
    try:
        return scan(without_guesses(collocation), reason, whole)
    except InputError:
        return None


def scan(collocation: Collocation, reason: str = NO_GUESS, whole: bool = False) -> Scan:
    """Try stiffnesses from stiff to soft with the parameters that have no guess.

    Parameters
    ----------
    collocation : Collocation
    reason : str
        Why; the sentence begins with it.
    whole : bool
        Whether the start must be simulable to the end of the recordings.

    Raises
    ------
    InputError
        Where the body cannot be simulated at any stiffness.
    """
    began = time.perf_counter()
    trial = _Trial(replace(collocation, parameters=_sized(collocation.parameters, 1.0)))
    tried = _Tried(trial)
    step = (SOFTEST_PA / STIFFEST_PA) ** (1 / (STEPS - 1))
    tried.walk([STIFFEST_PA * step**k for k in range(STEPS)])
    if tried.at_end(softest=True):
        tried.walk_on(min(tried.misfits), step)
    if tried.at_end(softest=False):
        tried.warm = None
        tried.walk_on(max(tried.misfits), 1 / step)
    young_pa = np.array(sorted(tried.misfits))
    misfit = np.array([tried.misfits[young] for young in young_pa])
    chosen = [young for young in _ranked(young_pa, misfit) if not whole or trial.runs(young)]
    if not chosen:
        raise InputError(
            f"no start was found: the body cannot be simulated at any of {len(young_pa)} "
            f"stiffnesses from E = {young_pa[-1]:.3g} to {young_pa[0]:.3g} Pa "
            f"({trial.failure}); check grasp, mass and units, or give guesses",
            None,
            "parameters",
        )
    best = int(np.flatnonzero(young_pa == chosen[0])[0])
    start = usual_parameters(collocation.parameters, chosen[0])
    others = _other_starts(misfit, best) if not whole else ()
    starts = {k: usual_parameters(collocation.parameters, young_pa[k]) for k in (best, *others)}
    return Scan(
        reason,
        young_pa,
        misfit,
        best,
        start,
        samples=sum(trial.samples),
        time_s=time.perf_counter() - began,
        starts=starts,
        others=others,
    )


def _other_starts(misfit: Array, best: int) -> tuple[int, ...]:
    """Return positions of the next best starts, see `Scan.others`.

    Parameters
    ----------
    misfit : (k,) array
        By ascending stiffness, NaN where the body cannot be simulated.
    best : int
        Position of the stiffness that is chosen.
    """
    known = np.where(np.isfinite(misfit), misfit, np.inf)
    beside = np.concatenate([[np.inf], known, [np.inf]])
    is_minimum = (known < beside[:-2]) & (known <= beside[2:])
    candidates = {best - 1, best + 1, *np.flatnonzero(is_minimum).tolist()} - {best}
    possible = [k for k in candidates if 0 <= k < len(known) and known[k] <= ALIKE * known[best]]
    return tuple(sorted(possible, key=lambda k: known[k])[:MORE_STARTS])


def usual_parameters(parameters: Parameters, young_pa: float) -> Parameters:
    """Parameters whose missing guesses are what is usual at a stiffness, or their priors' means.

    What is fixed or has a guess keeps it.
    """
    known = {i.name: i.guess for i in parameters.items if i.tied is None and i.guess is not None}

    def value(item: Parameter) -> float:
        if item.guess is not None:
            return item.guess
        region, dot, _ = item.name.rpartition(".")
        poisson = known.get(f"{region}{dot}poisson", known.get("poisson", 0.3))
        usual = usual_value(item.name, young_pa, poisson)
        if item.prior is not None:
            usual = item.prior[0]
        assert usual is not None  # by `parameter`
        return float(np.clip(usual, item.lower, item.upper))

    sized = _sized(parameters, young_pa)
    return sized.with_guess({item.name: value(item) for item in parameters.free})


def usual_constants(parameters: Parameters) -> dict[str, float]:
    """Values by name: guesses, or what is usual of a soft body."""
    return usual_parameters(parameters, SOFT_PA).guesses


def _ranked(young_pa: Array, misfit: Array) -> list[float]:
    """Stiffnesses that could be simulated: the best, then those stiffer."""
    if np.isnan(misfit).all():
        return []
    best = int(np.nanargmin(misfit))
    return [float(young_pa[k]) for k in range(best, len(young_pa)) if np.isfinite(misfit[k])]


def _sized(parameters: Parameters, young_pa: float) -> Parameters:
    """The same parameters; linear ones of no known size change by what is usual of a modulus."""
    unit = young_pa / 10
    return Parameters(
        tuple(replace(i, unit=unit) if np.isnan(i.unit) else i for i in parameters.items)
    )


def _scannable(collocation: Collocation) -> bool:
    free = collocation.parameters.free
    return any(is_modulus(item.name) and item.scale == "log" for item in free)


def without_guesses(collocation: Collocation) -> Collocation:
    """The problem without the guesses that the scan can do without."""

    def forgotten(item: Parameter) -> Parameter:
        known = item.prior is not None or usual_value(item.name, 1.0) is not None
        return replace(item, guess=None) if known and item in free else item

    free = collocation.parameters.free
    items = tuple(map(forgotten, collocation.parameters.items))
    return replace(collocation, parameters=Parameters(items))


def _misfit(collocation: Collocation, p: Array, positions: Sequence[Array]) -> float:
    """Root mean square of all residuals, in standard deviations, on the first rows.

    Unknown places are where the first samples lie on the body.
    """
    collocation, p = collocation.placed(p, positions)
    parts = collocation.parts_at(p, positions)
    return root_mean(np.concatenate([_residuals(part) for part in parts]) ** 2)


def _residuals(part: Part) -> Array:
    """Those of all readings; of instruments with the tares, clocks and tools that suit best.

    Nothing else tells these beforehand, and the residuals are nearly linear in them; what they are
    in their deviations counts too.
    """
    found, slopes = [], []
    still = part.sensing.still(part.x)
    for reading, (residual, slope) in zip(part.segment.readings, still, strict=True):
        rough = reading.roughly(part.x, part.phi)
        if rough is not None:
            found.append(rough)
            slopes.append(np.zeros((len(rough), slope.shape[-1])))
            continue
        there = reading.there(len(part.looked[len(found)]))[: len(residual)]
        found.append(residual[there])
        slopes.append(slope[there] * reading.has_offsets)
    residual, slope = np.concatenate(found), np.concatenate(slopes)
    own = slope[:, slope.any(axis=0)]
    priors = np.eye(own.shape[1])
    residual, own = np.append(residual, np.zeros(len(priors))), np.concatenate([own, priors])
    return residual - own @ np.linalg.lstsq(own, residual, rcond=None)[0] if own.size else residual


def _samples(segment: Segment) -> int:
    """How many first samples are compared: a part of all, and one of each kind of reading."""
    t_s, seen = segment.experiment.t_s, [segment.experiment.markers.first_seen]
    for reading in segment.readings[1:]:
        seen.append(int(np.searchsorted(t_s, reading.begins_s)) + reading.channel.late)
    return min(len(t_s), max(part_of(len(t_s), SHARES[0]), max(seen) + 1))


class _Trial:
    """Simulates the first part of every recording."""

    def __init__(self, collocation: Collocation) -> None:
        self.collocation = collocation
        self.samples, self.rows, self.whole = [], [], []
        for segment in collocation.segments:
            self.samples.append(_samples(segment))
            self.rows.append((self.samples[-1] - 1) * segment.substeps + 1)
            self.whole.append(segment.grid_rows)
        self.failure: SimulationError | None = None

    @cached_property
    def rigid_misfit(self) -> float:
        """Of the undeformed body, carried by the grasp."""
        positions = []
        for segment, rows in zip(self.collocation.segments, self.rows, strict=True):
            at = segment.experiment.rigid_positions(segment.dynamics.t_s[:rows])
            positions.append(at.reshape(rows, -1))
        return _misfit(self.collocation, self.collocation.guess_p, positions)

    def guess(self, whole: bool) -> tuple[float, SimulationError | None]:
        """The misfit of the guess, or why it cannot be simulated."""
        p = self.collocation.guess_p
        positions, failure = self._simulated(p, None, self.whole if whole else self.rows)
        if failure is not None:
            return np.nan, failure
        return self._compared(p, positions), None

    def at(self, young_pa: float, warm: list[Array] | None) -> tuple[float, list[Array] | None]:
        """The misfit at a stiffness, NaN where it cannot be simulated, and trajectories."""
        p = self._p(young_pa)
        positions, failure = self._simulated(p, warm, self.rows)
        if failure is not None:
            self.failure = failure
            return np.nan, None
        return self._compared(p, positions), positions

    def runs(self, young_pa: float) -> bool:
        """Whether the whole recordings can be simulated at a stiffness."""
        _, failure = self._simulated(self._p(young_pa), None, self.whole)
        self.failure = failure or self.failure
        return failure is None

    def key(self, young_pa: float) -> tuple[float, ...]:
        """What tells stiffnesses apart: beyond all bounds they are the same."""
        return tuple(self._p(young_pa).tolist())

    def _p(self, young_pa: float) -> Array:
        q = usual_parameters(self.collocation.parameters, young_pa).guess_q
        return np.concatenate([q, np.zeros(self.collocation.nphi)])

    def _compared(self, p: Array, positions: Sequence[Array]) -> float:
        first = [x[:rows] for x, rows in zip(positions, self.rows, strict=True)]
        misfit = _misfit(self.collocation, p, first)
        return misfit if np.isfinite(misfit) else np.nan

    def _simulated(
        self, p: Array, warm: list[Array] | None, rows: Sequence[int]
    ) -> tuple[list[Array], SimulationError | None]:
        return marched(self.collocation, p, None, rows, LOOSE, near=warm)


class _Tried:
    """The stiffnesses tried so far, by Young's modulus."""

    def __init__(self, trial: _Trial) -> None:
        self.trial = trial
        self.misfits: dict[float, float] = {}
        self.warm: list[Array] | None = None
        self.lost = False

    def walk(self, young_pa: Sequence[float]) -> None:
        """Try from stiff to soft until the body is lost; those beyond all bounds are one."""
        lost = 0
        first, *others = ([*same] for _, same in groupby(young_pa, self.trial.key))
        for young in (first[-1], *(same[0] for same in others)):
            misfit = self._try(young)
            found = [m for m in self.misfits.values() if np.isfinite(m)]
            is_lost = bool(found) and not misfit <= WORSE * min(found)
            lost = lost + 1 if is_lost else 0
            if lost == LOST:
                self.lost = True
                return

    def walk_on(self, young_pa: float, factor: float) -> None:
        """Go on beyond an end as long as it gets better."""
        best, beyond = self.misfits[young_pa], young_pa * factor
        while LIMITS_PA[1] < beyond < LIMITS_PA[0]:
            if self.trial.key(beyond) == self.trial.key(beyond / factor):
                return
            misfit = self._try(beyond)
            if not misfit < (1 - BETTER) * best:
                return
            best, beyond = misfit, beyond * factor

    def at_end(self, softest: bool) -> bool:
        """Whether the best is at an end that was reached."""
        known = {young: m for young, m in self.misfits.items() if np.isfinite(m)}
        if not known or (softest and self.lost):
            return False
        best = min(known, key=lambda young: known[young])
        return best == (min(self.misfits) if softest else max(self.misfits))

    def _try(self, young_pa: float) -> float:
        misfit, warm = self.trial.at(young_pa, self.warm)
        self.warm = warm or self.warm
        self.misfits[young_pa] = misfit
        return misfit
