"""Start without a guess: a scan of the stiffness from stiff to soft.

At each stiffness the free moduli have values that are typical in relation to each other, and other
parameters without a guess have typical values. The first part of the motion of every recording is
simulated and compared with all measurements, with the nuisance parameters that fit best; if that
part is alike at every stiffness, as in free fall, a longer one is. A stiff body can always be
simulated and moves rigidly with the grasp; a softer one sags more, follows later and needs less
force, until it fits, and finally the simulation fails. So the best start is found by cheap
simulations, and the search begins on the side where simulations succeed.

The same scan is used if a guess cannot be simulated, or fits worse than a rigid body. Use
`start_problem` before a method is called.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from ...common.array_types import Array
from ...common.step_counting import StepUnit, complete_steps, counted_phase
from ...errors import InputError, SimulationError
from ...fem.laws.constants import (
    AXIAL,
    BENDING,
    TORSION,
    YOUNG,
    is_modulus,
    usual_value,
    without_region,
)
from ...model.parameters import Parameter, Parameters, with_widest_bounds
from ...program.collocation import Collocation, ExperimentIterate
from ...program.forward.newton_solver import NewtonOptions
from ...program.least_squares import SquareRootInformation
from ...program.measurement_residual import huber_as_least_squares
from ...recording.specimen_files import initial_modulus_pa
from ..horizon import motion_shares, rows_of_share
from ..options import SHARES
from ..reduced_space import ReducedSpace
from ..solution import Solution
from ..solve_recorder import interrupted_solution, keep
from .initial_trajectories import complete_variables, simulate_trajectories
from .memory import memory_start
from .power_law import power_law_start
from .start import NO_GUESS, Scan, Start, beyond_default

# Young's moduli of the scan, three in a decade [Pa].
SCAN_PA: list[float] = np.geomspace(1e7, 1e2, 15).tolist()
# Typical Young's modulus of a soft body, where nothing is known [Pa].
SOFT_PA = 1e4
# Factors of the usual stiffnesses of a section, which are those of a cable, and of the first modulus
# of the scan, at which a rod of metal collapses.
RAISED = 1.0, 30.0, 900.0, 27e3
# Simulations of a scan: a body that collapses under a small part of its weight is too soft. Solids are
# only compared, but slender bodies do not move on from such errors.
STRICT = NewtonOptions(may_begin_small=False)
LOOSE = replace(STRICT, tolerance=1e-4)
# Number of failures in a row that end the scan.
CONSECUTIVE_FAILURES = 2
# Misfit over the best one that counts as a failure.
WORSE = 3.0
# The scan continues beyond an end as long as the misfit decreases by this share, or by more than in
# the step before: a body that is much too soft, such as a metal, moves alike at every stiffness.
BETTER = 0.01
# Largest number of stiffer bodies in a row that fit worse, but move otherwise than the one before:
# a steel ruler that vibrates over five periods fits worse at two between 3 and 37 GPa.
MOST_WORSE = 4
# Misfit up to which the measurements are explained, so that no other stiffness is sought [sigma].
EXPLAINED = 1.5
# Number of other starts where there are local minima: each costs a solve, and the right one was
# next to the best in all twins.
MORE_STARTS = 2
# Largest misfit of another start over the best one.
EQUIVALENT_LOSS_RATIO = 4.0
# Misfit at a guess over that at the best start of a scan, up to which only the guess is searched: the
# damping, which is usual in a scan, and the distance of its stiffnesses make smaller differences.
CLEARLY_BETTER = 1.2
# Largest error of a pose, clock or place in a scan, in standard deviations of its prior: larger ones
# would fit wrong stiffnesses.
LARGEST_ERROR = 3.0
# Change of an error, in the same unit, for derivatives of distances without correspondences, and the
# smallest step to errors that fit better.
DIFFERENCE = 1e-3
# Most steps to the errors that fit best: a turned camera takes about six.
NUISANCE_STEPS = 10


def start_problem(collocation: Collocation, is_complete: bool = False) -> Start:
    """Return the problem with a guess of every parameter, and the scan if there was one.

    Specimens of laws in powers of the stretches without a guess start from `power_law_start`; the
    note states which constants their measurements do not determine, which are then fixed. Tables of
    moduli over frequency or time start from `memory_start`, unless the guesses are as good, and
    other specimens without a guess of a modulus from the initial slope of their stresses.

    Given guesses are kept, unless the body cannot be simulated with them. If it fits worse than an
    undeformed one, and the scan finds initial values that fit clearly better (`CLEARLY_BETTER`), the
    start has those, and the problem with the guesses is `Start.stated`, to be searched too. The given
    problem is not modified; it is returned itself if nothing changes.

    Parameters
    ----------
    is_complete : bool
        Whether the simulation at the start must reach the end of the recordings.

    Raises
    ------
    InputError
        If a modulus has no guess and the body cannot be simulated at any stiffness, or with
        `is_complete` to the end at none from the best one on.
    """
    usual = typical_parameters(collocation.parameters, SOFT_PA)
    are_specimens = all(each.experiment.specimen for each in collocation.transcriptions)
    if are_specimens and (of_memory := memory_start(collocation, usual)) is not None:
        return of_memory
    unguessed = collocation.parameters.names_without_guess
    start = power_law_start(collocation) if unguessed and are_specimens else None
    if start is not None:
        usual = typical_parameters(start.collocation.parameters, start.young_pa)
        found = collocation.with_parameters(usual)
        return Start(found, start.fitted_variables(found), note=start.note)
    if any(is_modulus(name) for name in unguessed):
        if are_specimens:
            return _start_of_curves(collocation)
        result = scan_stiffness(collocation, is_complete=is_complete)
        return Start(collocation.with_parameters(result.parameters), scan=result)
    if unguessed:
        usual = typical_parameters(collocation.parameters, SCAN_PA[0])
        collocation = _stiff_enough(collocation.with_parameters(usual), unguessed)
    if not _has_free_modulus(collocation):
        return Start(collocation)
    trial = TrialSimulation(collocation)
    misfit, failure = trial.evaluate_guess(is_complete)
    if failure is None and misfit <= trial.rigid_misfit:
        return Start(collocation)
    result = rescue(collocation, "", is_complete=is_complete)
    if result is None:
        return Start(collocation)  # the method reports what it needs
    if result.share != trial.share and failure is None:
        misfit, failure = TrialSimulation(collocation, result.share).evaluate_guess(is_complete)
    found = collocation.with_parameters(result.parameters)
    if failure is not None:
        reason = f"the body cannot be simulated at the guess ({failure})"
        return Start(found, scan=replace(result, reason=reason))
    best = float(result.misfit[result.best])
    if misfit <= CLEARLY_BETTER * best:
        return Start(collocation)
    reason = (
        "the stated guess and the best stiffness of a scan were both searched, because at the guess "
        f"the misfit is {misfit:.3g} standard deviations, larger than that of a rigid body, and "
        f"{best:.3g} there"
    )
    return Start(found, scan=replace(result, reason=reason), stated=collocation)


def _stiff_enough(collocation: Collocation, unguessed: Sequence[str]) -> Collocation:
    """Return the problem with usual stiffnesses of sections, raised until the rod fits no worse than a
    rigid one: a search converges from a thousand times the stiffness, but not from a hundredth.
    """
    stiffnesses = {BENDING.name, TORSION.name, AXIAL.name}
    raised = [name for name in unguessed if without_region(name) in stiffnesses]
    parameters = collocation.parameters
    for factor in RAISED if raised else ():
        guesses = {name: factor * parameters.guesses[name] for name in raised}
        stiffer = collocation.with_parameters(parameters.with_guess(guesses))
        trial = TrialSimulation(stiffer)
        misfit, failure = trial.evaluate_guess(is_complete=False)
        if failure is None and misfit <= trial.rigid_misfit:
            return stiffer
    return collocation


def _start_of_curves(collocation: Collocation) -> Start:
    """Return a start with typical values at Young's modulus of the initial slope of the stresses."""
    slopes = [initial_modulus_pa(each.experiment) for each in collocation.transcriptions]
    known = [slope for slope in slopes if slope > 0]
    young_pa = float(np.median(known)) if known else SOFT_PA
    bounded = collocation.parameters
    if is_beyond := beyond_default(young_pa):
        bounded = bounded.map_components(_with_wider_modulus)
    found = collocation.with_parameters(typical_parameters(bounded, young_pa))
    what = "of the initial slope of the stresses"
    return Start(found, note=f"{NO_GUESS}: started from E = {young_pa:.3g} Pa {what}{is_beyond}")


def rescue(collocation: Collocation, reason: str, is_complete: bool = False) -> Scan | None:
    """Return a scan without the given guesses, see `without_guesses`; None if no modulus is free on
    a logarithmic scale, or `scan_stiffness` finds no start.

    Parameters
    ----------
    collocation : Collocation
        Problem with guesses.
    reason : str
        Reason for the scan.
    is_complete : bool
        Whether the simulation at the start must reach the end of the recordings.
    """
    if not _has_free_modulus(collocation):
        return None
    try:
        return scan_stiffness(without_guesses(collocation), reason, is_complete=is_complete)
    except InputError:
        return None


def scan_stiffness(
    collocation: Collocation, reason: str = NO_GUESS, is_complete: bool = False
) -> Scan:
    """Simulate the problem at stiffnesses from stiff to soft, and return the best as a start.

    Default bounds of moduli are those of foams and rubbers: where a stiffer body fits best, as one
    of metal, the start has the `widest` bounds instead. Stated bounds are kept.

    With `is_complete` it is the best, or else the next stiffer one, at which the complete
    recordings can be simulated; there are then no `others`. The problem is not modified.

    Parameters
    ----------
    collocation : Collocation
        Problem; parameters with a guess keep it.
    reason : str
        Reason for the scan, the beginning of `Scan.sentence`.
    is_complete : bool
        Whether the simulation at the start must reach the end of the recordings.

    Raises
    ------
    InputError
        If the body cannot be simulated at any stiffness, or with `is_complete` to the end at none
        from the best one on.
    """
    began = time.perf_counter()
    widest = collocation.parameters.map_components(_with_wider_modulus)
    sized = collocation.with_parameters(_with_units(widest, 1.0))
    for share in SHARES:
        trial = TrialSimulation(sized, share)
        trials = _tried(trial)
        if trials.depends_on_stiffness:
            break
    young_pa = np.array(sorted(trials.misfits))
    misfit = np.array([trials.misfits[young] for young in young_pa])
    candidates = [
        young
        for young in _ranked_moduli(young_pa, misfit)
        if not is_complete or trial.is_simulable(young)
    ]
    if not candidates:
        raise InputError(
            "no initial values were found: the body cannot be simulated at any of "
            f"{len(young_pa)} stiffnesses from E = {young_pa[-1]:.3g} to {young_pa[0]:.3g} Pa "
            f"({trial.failure}); check grasp, mass and units, or give guesses",
            None,
            where="parameters",
        )
    best = int(np.flatnonzero(young_pa == candidates[0])[0])
    is_beyond = candidates[0] > YOUNG.bounds[1]
    bounded = widest if is_beyond else collocation.parameters
    start = typical_parameters(bounded, candidates[0])
    others = other_starts(misfit, best) if not is_complete else ()
    starts = {k: typical_parameters(bounded, young_pa[k]) for k in (best, *others)}
    return Scan(
        reason,
        young_pa,
        misfit=misfit,
        best=best,
        parameters=start,
        samples=sum(trial.samples),
        time_s=time.perf_counter() - began,
        starts=starts,
        others=others,
        share=trial.share,
    )


def _tried(trial: TrialSimulation) -> ScanState:
    """Return the misfits from stiff to soft, continued beyond an end that fits best. The scan begins
    with a stiffer body if the first one cannot be simulated.
    """
    trials = ScanState(trial)
    step = SCAN_PA[1] / SCAN_PA[0]
    low, high = trial.bounds_pa
    within = [young for young in SCAN_PA if low <= young <= high] or [math.sqrt(abs(low * high))]
    raised = [within[0] * factor for factor in RAISED if within[0] * factor <= max(within[0], high)]
    with counted_phase(StepUnit.STIFFNESS, len(within)):
        for first in raised:
            trials.try_sequence([first])
            if np.isfinite(trials.misfits[first]):
                softer = (first * step**k for k in range(1, 2 * len(SCAN_PA)))
                within = [first, *(young for young in softer if young >= within[-1])]
                break
        trials.try_sequence(within[1:])
    if trials.depends_on_stiffness and trials.is_best_at_end(softest=True):
        trials.extend_range(min(trials.misfits), step)
    if trials.is_best_at_end(softest=False):
        trials.last_trajectories = None
        trials.extend_range(max(trials.misfits), 1 / step)
    return trials


def other_starts(misfit: Array, best: int) -> tuple[int, ...]:
    """Return the indices of moduli other than the best that may lead to a better solution, in
    ascending order of the misfit.

    They are the neighbours of the best and other minima of the misfit, unless their misfit is much
    larger; at most `MORE_STARTS`.

    Parameters
    ----------
    misfit : (k,) array
        Misfit by ascending stiffness, NaN where the body cannot be simulated.
    best : int
        Index of the stiffness that is chosen.
    """
    known = np.where(np.isfinite(misfit), misfit, np.inf)
    padded = np.concatenate([[np.inf], known, [np.inf]])
    is_minimum = (known < padded[:-2]) & (known <= padded[2:])
    candidates = {best - 1, best + 1, *np.flatnonzero(is_minimum).tolist()} - {best}
    possible = [
        k
        for k in candidates
        if 0 <= k < len(known) and known[k] <= EQUIVALENT_LOSS_RATIO * known[best]
    ]
    return tuple(sorted(possible, key=lambda k: known[k])[:MORE_STARTS])


def typical_parameters(parameters: Parameters, young_pa: float) -> Parameters:
    """Return parameters in which missing guesses are replaced by typical values at a Young's
    modulus [Pa], within their bounds, see `Parameter.within_bounds`.

    Parameters with a prior get its mean instead. Fixed parameters and those with a guess are kept;
    units that are missing are added, see `_with_units`. Every free parameter without a guess must
    have a prior or a typical value, which parameters are required to have where they are made.
    """
    usual = _usual_values(parameters, young_pa)
    guesses = {item.name: item.within_bounds(usual[item.name]) for item in parameters.free}
    return _with_units(parameters, young_pa).with_guess(guesses)


def _usual_values(parameters: Parameters, young_pa: float) -> dict[str, float]:
    """Return the guess of each free parameter, its prior mean, or a typical value."""
    guesses = {
        i.name: i.guess for i in parameters.components if i.tied is None and i.guess is not None
    }
    values = {}
    for item in parameters.free:
        region, dot, _ = item.name.rpartition(".")
        poisson = guesses.get(f"{region}{dot}poisson", guesses.get("poisson", 0.3))
        usual = item.prior[0] if item.prior else usual_value(item.name, young_pa, poisson=poisson)
        values[item.name] = guesses.get(item.name, usual)
        assert values[item.name] is not None  # by `parameter`
    return values


def typical_constants(parameters: Parameters) -> dict[str, float]:
    """Return values of all parameters by name, in SI units: guesses, or typical ones of a soft body
    (`SOFT_PA`).
    """
    return typical_parameters(parameters, SOFT_PA).guesses


def _ranked_moduli(young_pa: Array, misfit: Array) -> list[float]:
    """Return the moduli [Pa] that could be simulated: the best, then stiffer ones."""
    if np.isnan(misfit).all():
        return []
    best = int(np.nanargmin(misfit))
    return [float(young_pa[k]) for k in range(best, len(young_pa)) if np.isfinite(misfit[k])]


def _with_units(parameters: Parameters, young_pa: float) -> Parameters:
    """Linear parameters without a unit (NaN) get a tenth of `young_pa` [Pa]."""
    unit = young_pa / 10
    return parameters.map_components(
        lambda item: replace(item, unit=unit) if np.isnan(item.unit) else item
    )


def _with_wider_modulus(item: Parameter) -> Parameter:
    return with_widest_bounds(item) if is_modulus(item.name) else item


def _has_free_modulus(collocation: Collocation) -> bool:
    free = collocation.parameters.free
    return any(is_modulus(item.name) and item.scale == "log" for item in free)


def without_guesses(collocation: Collocation) -> Collocation:
    """Return the problem without the guesses of those free parameters that have a prior or a
    typical value, which can replace the guess; other guesses are kept, and the given problem is not
    modified.
    """

    def without_guess(item: Parameter) -> Parameter:
        """Return the parameter without its guess, if that can be replaced."""
        is_replaceable = item.prior is not None or usual_value(item.name, 1.0) is not None
        return replace(item, guess=None) if is_replaceable and item in free else item

    free = collocation.parameters.free
    return replace(collocation, parameters=collocation.parameters.map_components(without_guess))


def _misfit(collocation: Collocation, p: Array, positions: Sequence[Array]) -> float:
    """Return the root mean square of all residuals on the first rows, in standard deviations, with the
    nuisance parameters that fit best, at most `LARGEST_ERROR`, and their priors.
    """
    # Otherwise an error of the pose of a camera or of a clock would be fitted by the stiffness.
    collocation, p = collocation.place_unknown_markers(p, positions, only_poses=True)
    phi = p[collocation.nq :]
    fit = _nuisance_fit(collocation, p, positions)
    loss, reach = fit.loss(phi), np.inf
    low, high = np.minimum(phi, -LARGEST_ERROR), np.maximum(phi, LARGEST_ERROR)
    # What has no effect at a fixed motion, such as a tilt of gravity, keeps its value.
    is_moved = np.diag(fit.information) > 1
    for _ in range(NUISANCE_STEPS):
        if not (np.isfinite(loss) and is_moved.any()):
            break
        fitted = fit.minimiser(np.maximum(low, phi - reach), np.minimum(high, phi + reach))
        other_phi = np.where(is_moved, fitted, phi)
        step = np.abs(other_phi - phi).max()
        other = _nuisance_fit(
            collocation, np.concatenate([p[: collocation.nq], other_phi]), positions
        )
        gain = loss - other.loss(other_phi)
        if gain > 0:
            fit, phi, loss = other, other_phi, loss - gain
        if step < DIFFERENCE or 0 <= gain < BETTER * loss:
            break
        if not gain > 0:
            reach = step / 4
    return math.sqrt(loss / max(fit.row_count - len(phi), 1)) if np.isfinite(loss) else np.nan


def _nuisance_fit(
    collocation: Collocation, p: Array, positions: Sequence[Array]
) -> SquareRootInformation:
    """Return residuals and priors of φ, linearised at a motion of φ = 0 that changes only with the
    pose of the body in its grasp.
    """
    count = collocation.nphi
    fit = SquareRootInformation.empty(count).with_rows(np.zeros(count), np.eye(count))
    for part in collocation.iterates_at(p, positions):
        own = SquareRootInformation.empty(len(part.phi))
        for residuals, slopes in _residuals(part):
            own = own.with_rows(residuals, slopes, part.phi)
        indices = part.transcription.nuisance_indices.indices - collocation.nq
        fit = fit.with_problem(own, indices)
    return fit


def _residuals(iterate: ExperimentIterate) -> Iterator[tuple[Array, Array]]:
    """Yield the residuals (m,) of each measurement, and their derivatives (m, k) by φ."""
    phi, grasp = iterate.phi, iterate.transcription.nuisance.grasp_indices
    changes = np.eye(len(phi))[grasp]
    moved, *others = _moved_in_grasp(iterate, phi + np.vstack([0 * phi, changes]))
    for k, (residual, slope) in enumerate(moved.linearise_fixed_motion()):
        kind = iterate.transcription.residuals[k]
        # Cameras are compared by `rough_residuals`, which need no correspondences.
        rough = kind.rough_residuals(moved.x, phi)
        if rough is not None:
            slopes = np.zeros((len(rough), len(phi)))
            for place in kind.own_parameters[0]:
                error = DIFFERENCE * np.eye(len(phi))[place]
                other = np.asarray(kind.rough_residuals(moved.x, phi + error))
                slopes[:, place] = (other - rough) / DIFFERENCE
            is_seen = np.isfinite(rough)
            yield rough[is_seen], slopes[is_seen]
            continue
        for place, other in zip(grasp, others, strict=True):
            slope[..., place] += kind.residuals(other.observables[k], phi) - residual
        is_compared = kind.compared_with(len(moved.observables[k]))[: len(residual)]
        residual, slope = huber_as_least_squares(residual, slope, kind.huber)
        yield residual[is_compared], slope[is_compared]


def _moved_in_grasp(iterate: ExperimentIterate, phis: Array) -> list[ExperimentIterate]:
    """Return a motion rigidly moved by the errors in each φ (m, k) of the pose in its grasp."""
    transcription, nuisance = iterate.transcription, iterate.transcription.nuisance
    if not len(nuisance.grasp_indices):
        return [iterate] * len(phis)
    t_s = transcription.dynamics.t_s[: len(iterate.x)]
    rotations, translations = transcription.experiment.rigid_motion(t_s)
    held = (iterate.x.reshape(len(t_s), -1, 3) - translations[:, None]) @ rotations
    errors = nuisance.grasp_motion_matrix(phis)[:, None, :3]
    turns = (rotations @ errors[..., :3]).swapaxes(-1, -2)
    shifts = translations[:, None] + (rotations @ errors[..., 3:]).swapaxes(-1, -2)
    return [replace(iterate, x=each.reshape(len(t_s), -1)) for each in held @ turns + shifts]


def _answer(collocation: Collocation, p: Array, positions: Sequence[Array]) -> Solution:
    """Return a simulation of the first rows as a solution."""
    parameters = collocation.parameters
    values = parameters.values(p[: collocation.nq])
    guesses = {item.name: values[item.name] for item in parameters.free}
    collocation = collocation.with_parameters(parameters.with_estimates(guesses))
    collocation, p = collocation.place_unknown_markers(p, positions)
    z = complete_variables(collocation, p, known_rows=positions)
    return interrupted_solution(ReducedSpace.name, collocation, z)


class TrialSimulation:
    """Simulation of the first part of the motion of every recording, and its misfit.

    Parameters
    ----------
    collocation : Collocation
        Problem with units of all parameters.
    share : float
        Share of the motion that is compared, see `motion_shares`; also an attribute.

    Attributes
    ----------
    samples : list of int
        Number of samples that are compared, by experiment.
    rows : list of int
        Number of grid rows that are compared, by experiment.
    all_rows : list of int
        Number of all grid rows, by experiment.
    failure : SimulationError or None
        Last failure of `evaluate_at` or `is_simulable`; None before the first.
    """

    def __init__(self, collocation: Collocation, share: float = SHARES[0]) -> None:
        self.collocation = collocation
        self.share = share
        is_solid = all(each.body.is_solid for each in collocation.transcriptions)
        self.options = LOOSE if is_solid else STRICT
        usual = collocation.with_parameters(typical_parameters(collocation.parameters, SOFT_PA))
        self.rows = [rows_of_share(motion, share) for motion in motion_shares(usual)]
        self.all_rows = [each.grid_times for each in collocation.transcriptions]
        self.samples = [
            (rows - 1) // each.substeps + 1
            for rows, each in zip(self.rows, collocation.transcriptions, strict=True)
        ]
        self.failure: SimulationError | None = None

    @cached_property
    def rigid_misfit(self) -> float:
        """Misfit of an undeformed body that moves with the grasp in the first part of the
        recordings, in standard deviations; every parameter must have a guess.
        """
        positions = []
        for transcription, rows in zip(self.collocation.transcriptions, self.rows, strict=True):
            rigid_positions = transcription.experiment.rigid_positions(
                transcription.dynamics.t_s[:rows]
            )
            positions.append(rigid_positions.reshape(rows, -1))
        return _misfit(self.collocation, self.collocation.guess_p, positions=positions)

    def evaluate_guess(self, is_complete: bool) -> tuple[float, SimulationError | None]:
        """Return the misfit of the guess and None, or NaN and the failure of its simulation.

        With `is_complete` the complete recordings are simulated; the misfit is always that of their
        first part, in standard deviations, and NaN with None if it is not finite. Nothing is
        stored, neither the trajectories nor `failure`. Every parameter must have a guess.
        """
        p = self.collocation.guess_p
        positions, failure = simulate_trajectories(
            self.collocation,
            p,
            rows=self.all_rows if is_complete else self.rows,
            options=self.options,
        )
        if failure is not None:
            return np.nan, failure
        return self._evaluate(p, positions), None

    def evaluate_at(
        self, young_pa: float, guess: list[Array] | None
    ) -> tuple[float, list[Array] | None]:
        """Return misfit (NaN if it is not finite) and trajectories at a Young's modulus; NaN and
        None if the simulation fails, whose error is then stored in `failure`.

        Parameters
        ----------
        young_pa : float
            Young's modulus [Pa].
        guess : list of (N, 3n) array or None
            Trajectories at another modulus, near which equilibria are searched; None without.
        """
        p = self._p(young_pa)
        positions, failure = simulate_trajectories(
            self.collocation, p, rows=self.rows, options=self.options, guess=guess
        )
        if failure is not None:
            self.failure = failure
            return np.nan, None
        return self._evaluate(p, positions), positions

    def is_simulable(self, young_pa: float) -> bool:
        """Simulate the complete recordings at a Young's modulus [Pa], and return whether that
        succeeds; if not, the error is stored in `failure`.
        """
        _, failure = simulate_trajectories(
            self.collocation, self._p(young_pa), rows=self.all_rows, options=self.options
        )
        self.failure = failure or self.failure
        return failure is None

    def differ(self, positions: list[Array], others: list[Array]) -> bool:
        """Return whether the measurements tell two motions (N, 3n) of each recording apart: their
        residuals differ by more than the noise, as a root mean square.
        """
        p = self._p(SOFT_PA)  # of what is measured only viscous forces depend on it
        first, second = (
            [
                residual.ravel()
                for part in self.collocation.iterates_at(p, motion)
                for residual, _ in part.linearise_fixed_motion()
            ]
            for motion in (positions, others)
        )
        return any(np.mean((a - b) ** 2) > 1 for a, b in zip(first, second, strict=True))

    @cached_property
    def bounds_pa(self) -> tuple[float, float]:
        """Young's moduli [Pa] between which the moduli without a guess are within their bounds."""
        usual = _usual_values(self.collocation.parameters, 1.0)
        scaled = [
            item
            for item in self.collocation.parameters.free
            if is_modulus(item.name) and item.guess is item.prior is None and usual[item.name] > 0
        ]
        low = max((item.lower / usual[item.name] for item in scaled), default=0.0)
        return low, min((item.upper / usual[item.name] for item in scaled), default=math.inf)

    def _p(self, young_pa: float) -> Array:
        """Return p (np,) with typical values for missing guesses, and φ zero."""
        q = typical_parameters(self.collocation.parameters, young_pa).guess_q
        return np.concatenate([q, np.zeros(self.collocation.nphi)])

    def _evaluate(self, p: Array, positions: Sequence[Array]) -> float:
        """Return the misfit of the first part; NaN if it is not finite."""
        first = [x[:rows] for x, rows in zip(positions, self.rows, strict=True)]
        misfit = _misfit(self.collocation, p, positions=first)
        if not np.isfinite(misfit):
            return np.nan
        keep(self, partial(_answer, self.collocation, p, first), misfit, share=0.0)
        return misfit


class ScanState:
    """Moduli that were tried so far, with their misfits.

    Parameters
    ----------
    trial : TrialSimulation
        Simulation that is repeated for every modulus.

    Attributes
    ----------
    misfits : dict of float to float
        Misfit by Young's modulus [Pa]; NaN where the simulation failed.
    last_trajectories : list or None
        Trajectories of the last simulation that succeeded; None before.
    is_ended_early : bool
        Whether the scan ended before the softest modulus.
    """

    def __init__(self, trial: TrialSimulation) -> None:
        self.trial = trial
        self.misfits: dict[float, float] = {}
        self.last_trajectories: list[Array] | None = None
        self.is_ended_early = False

    def try_sequence(self, young_pa: Sequence[float]) -> None:
        """Try Young's moduli in the given order [Pa], at least one, until `CONSECUTIVE_FAILURES` in
        a row fail or fit badly; then `is_ended_early` is set. Their misfits are stored.

        Failures before the first simulation that succeeds do not count.
        """
        failures = 0
        for young in young_pa:
            misfit = self._try(young)
            finite_misfits = [m for m in self.misfits.values() if np.isfinite(m)]
            is_failure = bool(finite_misfits) and not misfit <= WORSE * min(finite_misfits)
            failures = failures + 1 if is_failure else 0
            if failures == CONSECUTIVE_FAILURES:
                self.is_ended_early = True
                return

    def extend_range(self, young_pa: float, factor: float) -> None:
        """Try moduli beyond an end of the range, as long as each decreases the misfit by more than
        the share `BETTER`, or by more than the modulus before; their misfits are stored, also that
        of the last one.

        Towards stiffer ones also `MOST_WORSE` in a row may be worse, as long as each moves otherwise
        than the one before: the misfit of a body that vibrates has local minima over the stiffness.

        It also ends where a simulation fails, where the measurements are `EXPLAINED`, or where moduli
        leave their bounds.

        Parameters
        ----------
        young_pa : float
            Modulus at the end, which was simulated [Pa].
        factor : float
            Ratio of successive moduli, below one towards softer ones.
        """
        last = self.misfits[young_pa]
        inside = min(self.misfits, key=lambda each: abs(np.log(each * factor / young_pa)))
        decrease = self.misfits[inside] - last
        beyond = young_pa * factor
        softest, stiffest = self.trial.bounds_pa
        worse = 0
        while softest < beyond < stiffest and last > EXPLAINED:
            before = self.last_trajectories
            misfit = self._try(beyond)
            gain = last - misfit
            is_better = gain > BETTER * last or gain > max(decrease, 0.0)
            worse = 0 if is_better else worse + 1
            after = self.last_trajectories
            moves = factor > 1 and before and after and self.trial.differ(before, after)
            if np.isnan(misfit) or not (is_better or (moves and worse <= MOST_WORSE)):
                return
            last, decrease = misfit, gain
            beyond = beyond * factor

    @property
    def depends_on_stiffness(self) -> bool:
        """Whether the misfits differ by more than the share `BETTER` of the largest, and of a
        standard deviation; a body that falls freely, for example, moves alike at every stiffness
        until it is touched.
        """
        finite = [misfit for misfit in self.misfits.values() if np.isfinite(misfit)]
        return not finite or max(finite) - min(finite) > BETTER * max(*finite, 1.0)

    def is_best_at_end(self, softest: bool) -> bool:
        """Return whether the best modulus is the softest (or else the stiffest) that was tried.

        False if no modulus could be simulated, and for the softest end if the scan ended before it.
        `softest` selects the end.
        """
        finite_misfits = {young: m for young, m in self.misfits.items() if np.isfinite(m)}
        if not finite_misfits or (softest and self.is_ended_early):
            return False
        best = min(finite_misfits, key=lambda young: finite_misfits[young])
        return best == (min(self.misfits) if softest else max(self.misfits))

    def _try(self, young_pa: float) -> float:
        """Simulate, and return the misfit; NaN if it fails, with the last trajectories kept."""
        misfit, warm = self.trial.evaluate_at(young_pa, self.last_trajectories)
        self.last_trajectories = warm or self.last_trajectories
        self.misfits[young_pa] = misfit
        complete_steps(StepUnit.STIFFNESS)
        return misfit
