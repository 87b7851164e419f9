"""Precision that a description promises, without its measured values.

`expected_precision` linearises a program where the equations of motion hold, and evaluates noise of
the stated σ and the uncertainty budget. `check` uses it at the guess, and `with_measurements` for
the precision with one more sensor or test: the equilibria or motions are those of the estimates,
and a new test is simulated.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..common.time_dependence import values_over_time
from ..errors import InputError, SimulationError
from ..fem.laws.constants import symbol_of
from ..program.collocation import Collocation
from ..program.forward.scheme_simulation import continue_simulation
from ..program.measured_motion import fitted_values
from ..program.simulation import simulate
from ..program.transcription import Transcription
from ..recording.custom_sensor import CustomSensor
from ..recording.experiment import Experiment
from ..recording.measured_wrench import Wrench
from ..recording.measurement_selection import with_some_samples
from ..recording.obstacle import Obstacle
from ..recording.poses import PoseSequence
from ..recording.specimen import Specimen, cell_of_other_test
from ..recording.specimen_files import moduli_of, specimen_strains
from ..statistics.budget.combined_intervals import NORMAL_95
from ..statistics.budget.consider_analysis import (
    UNWEIGHTED,
    ResidualChanges,
    changes_of_assumptions,
    unweighted_fit,
)
from ..statistics.combinations import (
    WIDE,
    Combination,
    Fix,
    precision_text,
    undetermined_names,
    vague_constants,
    widest_after,
)
from ..statistics.estimates import relative_derivatives
from ..statistics.linearised import LinearisedFit, linearise_fit
from ..statistics.uncertainty import ErrorModel, uncertainty_from_fit
from .smaller_problem import sample_distance

# Errors of measurements that were not made.
EXACT_NOISE = ErrorModel("given", "independent")
# Noise of an added instrument over its largest value.
NOISE = 0.01
# Tests that are tried beside those that were made. Simple shear determines what a planar test does.
ADDED_TESTS = {
    "equibiaxial": "an equibiaxial test",
    "planar": "a planar test",
    "confined": "a confined test",
    "uniaxial": "a uniaxial test",
}
# Beginning of the name of a recording that is held longer than the fitted one of the other name.
LONGER = "longer "
# Half width of an interval, as a factor, below which no other measurement is tried.
NARROW = 1.25
# Number of recorded motions, the longest ones, of which a repetition or a force sensor is tried:
# with each, all recordings are linearised again.
MOST_TRIED = 4


@dataclass(frozen=True, eq=False)
class ExpectedPrecision:
    """Covariance that is expected of estimates."""

    names: tuple[str, ...]  # the k estimated scalar parameters that are not at a bound
    values: Array  # (k,): their values
    # (k, k): finite covariance of their relative deviations, due to noise alone, and with the
    # budget.
    statistical: Array
    covariance: Array
    # mapping of str to (k,): relative derivatives of derived moduli by their logarithms.
    moduli: Mapping[str, Array]

    def combinations(self) -> tuple[Combination, ...]:
        """Return the combinations that are determined where a constant alone is not, then the
        constants that are not determined and in no combination, each with repetitions and the known
        value that would determine its constants.
        """
        vague = undetermined_names(self.names, self.covariance)
        return vague_constants(
            self.names, self.values, self.covariance, self.statistical, vague, self.moduli
        )


def expected_precision(
    collocation: Collocation, z: Array, deviations: Mapping[str, float | None]
) -> ExpectedPrecision:
    """Return the precision of the estimates if all residuals were zero at the variables z, which
    satisfy the equations of motion.

    Parameters
    ----------
    z : (variables,) array
    deviations : mapping of str to float or None
        Standard deviations of the assumptions of the budget.

    Raises
    ------
    SimulationError
        If the equations of motion are singular.
    """
    return next(_precisions(collocation, z, deviations, [range(len(collocation.experiments))]))


def _precisions(
    collocation: Collocation,
    z: Array,
    deviations: Mapping[str, float | None],
    selections: Iterable[Collection[int]],
) -> Iterator[ExpectedPrecision]:
    """Yield the precision with each selection of the fitted experiments; see `expected_precision`."""
    from ..judge.augmented_fit import is_learnt
    from ..judge.posterior import Effects, Posterior

    complete, of_nuisances = unweighted_fit(collocation, z, deviations)
    complete = _exact(complete)
    parameters = collocation.parameters
    q = z[: collocation.nq]
    changes = changes_of_assumptions(collocation, z, deviations, of_nuisances)
    experiments = [k for k, t in enumerate(collocation.transcriptions) for _ in t.residuals]
    sizes = relative_derivatives(parameters, q)
    kept = [k for k in parameters.scalar_coordinates if not complete.at_bound[k]]
    names = tuple(parameters.free[k].name for k in kept)
    values = parameters.values(q)
    for selection in selections:
        own = [k for k, number in enumerate(experiments) if number in selection]
        fit = replace(complete, blocks=tuple(complete.blocks[k] for k in own))
        seen = ResidualChanges(changes.names, [changes.blocks[k] for k in own])
        posterior = Posterior.from_fit(
            fit,
            Effects.from_changes(seen, deviations, {}, {}),
            parameters,
            q,
            EXACT_NOISE,
            is_learnt=is_learnt(collocation),
        )
        of_noise = posterior.uncertainty.complete_covariance
        covariance = posterior.combine_covariance(of_noise, sizes)
        yield ExpectedPrecision(
            names,
            np.array([values[name] for name in names]),
            of_noise[np.ix_(kept, kept)],
            covariance[np.ix_(kept, kept)],
            {
                name: (posterior.derivatives[name] / sizes)[kept] / value
                for name, value in fit.derived.values.items()
                if value
            },
        )


def _exact(fit: LinearisedFit) -> LinearisedFit:
    """Return the fit as if all residuals were zero."""
    blocks = [replace(b, residual=0 * b.residual, misfit=None) for b in fit.blocks]
    return replace(fit, blocks=tuple(blocks), prior_residual=0 * fit.prior_residual)


def expected_deviations(collocation: Collocation, z: Array) -> dict[str, float]:
    """Return the relative standard deviation of each estimated scalar parameter by noise of the
    stated σ and the errors of the sensors, if all residuals were zero at z.
    """
    fit = _exact(linearise_fit(replace(collocation, huber=UNWEIGHTED), z))
    parameters = collocation.parameters
    known = uncertainty_from_fit(fit, parameters, z[: collocation.nq], EXACT_NOISE)
    kept = [k for k in collocation.parameters.scalar_coordinates if not fit.at_bound[k]]
    deviations = np.sqrt(np.diag(known.complete_covariance))
    return {known.names[k]: float(deviations[k]) for k in kept}


def views_note(collocation: Collocation, z: Array) -> str:
    """Return a note on what is expected of the sensors that could be elsewhere, with each alone and
    with the best of their other places; empty if there is no such sensor.
    """
    experiments = [each.experiment for each in collocation.transcriptions]
    views_of = [
        [(sensor, views) for sensor in each.readings if (views := [*sensor.other_views(each)])]
        for each in experiments
    ]
    number = next((k for k, each in enumerate(views_of) if each), None)
    if number is None:
        return ""
    experiment = experiments[number]
    views = [sensor for sensor, _ in views_of[number]]

    def expected(readings: Sequence[CustomSensor]) -> dict[str, float]:
        changed = replace(experiment, readings=tuple(readings))
        return expected_deviations(
            *_extended(collocation, z, [*experiments[:number], changed, *experiments[number + 1 :]])
        )

    def in_words(what: str, deviations: Mapping[str, float]) -> str:
        known = (
            f"{symbol_of(name)} {precision_text(1 + NORMAL_95 * each).removeprefix('to ')}"
            for name, each in deviations.items()
        )
        return f"{what} {', '.join(known)}"

    stated = [*experiment.readings]
    now = expected(stated)
    lines = [in_words("as stated", now)]
    if len(views) > 1:
        for view in views:
            alone = [each for each in stated if each is view or each not in views]
            lines.append(in_words(f"with '{view.name}' alone", expected(alone)))
    others = views_of[number][0][1]
    tried = [(expected([*stated, other]), what) for what, other in others]
    if now:
        first = next(iter(now))
        best, what = min(tried, key=lambda each: each[0].get(first, np.inf))
        lines.append(in_words(f"with {what}", best))
    return (
        f"expected 95 % intervals by noise and errors of the sensors of '{experiment.name}' (other "
        "systematic effects come in addition): "
        f"{'; '.join(lines)}"
    )


def with_measurements(
    combinations: Sequence[Combination],
    collocation: Collocation,
    z: Array,
    deviations: Mapping[str, float | None],
    noise: float = 1.0,
) -> tuple[Combination, ...]:
    """Return the combinations with the added sensor or test that would determine their constants
    best as the first of their `fixes`; unchanged where none would. Of specimens, the first test
    that determines all of them well (`NARROW`) is taken. Of motions that are sampled much faster
    than they change, every n-th sample serves, with the noise of the mean of n, and one time step
    for each sample.

    Parameters
    ----------
    z : (variables,) array
        Variables that satisfy the equations of motion.
    deviations : mapping of str to float or None
        Standard deviations of the assumptions of the budget.
    noise : float
        Variance of the noise over that of the stated σ.
    """
    if not combinations:
        return ()
    found: list[list[Fix]] = [[] for _ in combinations]
    distance = min(sample_distance(each.experiment) for each in collocation.transcriptions)
    some, z = _with_some_samples(collocation, z, distance)

    def effects(what: str, expected: ExpectedPrecision) -> dict[int, Fix]:
        covariance = expected.covariance + (noise - 1) * expected.statistical
        return {
            k: widest_after(expected.names, members, covariance, what)
            for k, each in enumerate(combinations)
            if {*(members := each.determined.names)} <= {*expected.names}
        }

    added = [*added_measurements(some, z, NOISE / np.sqrt(distance))]
    for what, expected in _with_each(some, z, deviations, added):
        for k, fix in effects(what, expected).items():
            found[k].append(fix)
        if all(fixes and fixes[-1].factor < NARROW for fixes in found):
            break
    best = (min(fixes, key=lambda fix: fix.factor, default=None) for fixes in found)
    return tuple(
        each if fix is None or fix.factor >= WIDE else replace(each, fixes=(fix, *each.fixes))
        for each, fix in zip(combinations, best, strict=True)
    )


def _with_each(
    collocation: Collocation,
    z: Array,
    deviations: Mapping[str, float | None],
    added: Iterable[tuple[str, Sequence[Experiment]]],
) -> Iterator[tuple[str, ExpectedPrecision]]:
    """Yield the precision with each of the `added_measurements`; experiments that are added to the
    same ones are linearised together.
    """
    own = range(count := len(collocation.transcriptions))
    by_base: dict[tuple[int, ...], list[tuple[str, Sequence[Experiment]]]] = {}
    for each in added:
        by_base.setdefault(tuple(map(id, each[1][:count])), []).append(each)
    for alternatives in by_base.values():
        further = [each for _, experiments in alternatives for each in experiments[count:]]
        selections = [[*own, count + k] for k in range(len(further))] or [own]
        try:
            wide, at = _extended(collocation, z, [*alternatives[0][1][:count], *further])
            found = [*_precisions(wide, at, deviations, selections)]
        except (InputError, SimulationError):
            continue  # the law or the body does not allow this
        yield from zip((what for what, _ in alternatives), found, strict=True)


def _with_some_samples(
    collocation: Collocation, z: Array, distance: int
) -> tuple[Collocation, Array]:
    """Keep every n-th sample, n being `distance`, with the noise of their mean, and one time step from
    each to the next.
    """
    if distance == collocation.substeps == 1:
        return collocation, z
    experiments = []
    for transcription in collocation.transcriptions:
        few = transcription.experiment
        if distance > 1:
            few = with_some_samples(few, distance)
            markers = replace(few.markers, sigma_m=few.markers.sigma_m / np.sqrt(distance))
            few = few.with_measurements([markers])
        experiments.append(few)
    some = replace(collocation, experiments=experiments, substeps=1)
    p, positions = collocation.unpack(z)
    motions = []
    for few, each, x in zip(
        some.transcriptions, collocation.transcriptions, positions, strict=True
    ):
        motions.append(x[:: distance * each.substeps][: few.grid_times])
    return some, some.pack(p, motions)


def added_measurements(
    collocation: Collocation, z: Array, noise: float = NOISE
) -> Iterator[tuple[str, Sequence[Experiment]]]:
    """Yield measurements that may be added to a problem, as phrases with all experiments.

    For specimens these are other tests of the same strains with the same relative noise and errors
    of area and zero; beside a table of moduli they say nothing more. A body with a mesh, of which no
    force is measured, gets a force sensor at its grasp, with `noise` over the largest force, and a
    recorded motion a second recording after which it is held as long again; of more than `MOST_TRIED`
    motions, only the longest. A test that the law or the body does not allow is left out.
    """
    experiments = [each.experiment for each in collocation.transcriptions]
    motions = [k for k, each in enumerate(experiments) if each.specimen is None]
    tried = sorted(motions, key=lambda k: -len(experiments[k].t_s))[:MOST_TRIED]
    values = collocation.parameters.values(z[: collocation.nq])
    tests = {each.specimen.test for each in experiments if each.specimen is not None}
    for k, experiment in enumerate(experiments):
        if k in tried:
            if not experiment.wrenches and experiment.grasps:
                which = "" if len(experiments) == 1 else f" of '{experiment.name}'"
                sensed = _with_force_sensor(collocation, z, k, noise)
                if sensed is not None:
                    yield (
                        f"a force sensor at the grasp{which} "
                        f"(noise {NOISE:.0%} of the largest force)",
                        [*experiments[:k], sensed, *experiments[k + 1 :]],
                    )
            if (longer := _held_longer(collocation.transcriptions[k])) is not None:
                yield (
                    f"another recording of '{experiment.name}', held as long again at its end",
                    [*experiments, longer],
                )
        elif experiment.specimen and len(experiment.body.parts) == 1 and not moduli_of(experiment):
            for test, phrase in ADDED_TESTS.items():
                if test not in tests:
                    tests.add(test)
                    try:
                        added = _other_test(experiment, test, values)
                    except (InputError, SimulationError):
                        continue  # equibiaxial tension thins a sheet more than uniaxial tension
                    yield f"{phrase} up to the same strain", [*experiments, added]


def _other_test(experiment: Experiment, test: str, values: Mapping[str, float]) -> Experiment:
    """Return another test of a specimen, up to the same strain, with the same noise over the
    largest stress.
    """
    stress = experiment.readings[0]
    assert stress.values is not None
    relative = stress.sigma / np.nanmax(np.abs(stress.values))
    strain, _ = specimen_strains(experiment)
    body = cell_of_other_test(experiment.body, test)
    blank = Specimen(test, strain, np.zeros_like(strain), 1.0, t_s=experiment.t_s)
    added = blank.experiment(body=body, name=f"added {test}")
    (stresses_pa,) = simulate(added, values).custom_sensor_values
    (gauge,) = added.readings
    sigma_pa = float(relative * np.abs(stresses_pa).max())
    return replace(added, readings=[replace(gauge, sigma=sigma_pa)])


def _held_longer(transcription: Transcription) -> Experiment | None:
    """Return a recorded motion with its grasps held at their last poses for as long again; None
    unless only markers are measured and nothing else acts on the body.
    """
    experiment = transcription.experiment
    more = (experiment.tendons, experiment.pressures, experiment.readings, experiment.depths)
    loads = (experiment.forces, experiment.masses, experiment.wrenches)
    if experiment.is_static or any(map(len, (*more, *loads))) or not experiment.grasps:
        return None
    times_s, markers = experiment.t_s, experiment.markers
    later_s = times_s[-1] + experiment.timestep_s * np.arange(1, len(times_s))
    rows = np.r_[np.arange(len(times_s)), np.full(len(later_s), len(times_s) - 1)]
    grid_s = transcription.dynamics.t_s
    grasps = []
    for grasp in experiment.grasps:
        if isinstance(grasp, Obstacle) or np.isfinite([grasp.from_s, grasp.until_s]).any():
            return None
        rotations, places_m = grasp.poses.at(grid_s)
        quaternions = Rotation.from_matrix(rotations).as_quat()
        poses = PoseSequence(
            np.append(grid_s, later_s[-1]),
            np.append(places_m, places_m[-1:], axis=0),
            np.append(quaternions, quaternions[-1:], axis=0),
            interpolation="linear",
        )
        grasps.append(replace(grasp, poses=poses))
    values = values_over_time(markers)
    longer = {
        name: value[rows] for name, value in values.items() if value is not None and name != "t_s"
    }
    return replace(
        experiment,
        t_s=np.r_[times_s, later_s],
        grasps=grasps,
        markers=replace(markers, t_s=np.r_[times_s, later_s], **longer),
        name=LONGER + experiment.name,
    )


def _with_force_sensor(
    collocation: Collocation, z: Array, number: int, noise: float
) -> Experiment | None:
    """None if no force is predicted, as in a recording of few samples."""
    experiments = [each.experiment for each in collocation.transcriptions]
    experiment = experiments[number]
    blank = Wrench(experiment.t_s, np.zeros((len(experiment.t_s), 3)), 1.0)

    def sensed(wrench: Wrench) -> Experiment:
        first, *others = experiment.grasps
        return replace(experiment, grasps=[replace(first, wrench=wrench), *others])

    experiments[number] = sensed(blank)
    wide, at = _extended(collocation, z, experiments)
    measurements = experiments[number].measurements
    predicted = fitted_values(wide.iterates(at)[number])
    (forces_n,) = (
        each for of, each in zip(measurements, predicted, strict=True) if isinstance(of, Wrench)
    )
    largest_n = float(np.nanmax(np.abs(np.asarray(forces_n)[:, :3]), initial=0.0))
    return None if not largest_n else sensed(replace(blank, sigma_n=noise * largest_n))


def _extended(
    collocation: Collocation, z: Array, experiments: Sequence[Experiment]
) -> tuple[Collocation, Array]:
    """New nuisance parameters are zero; new or longer experiments are simulated."""
    wide = replace(collocation, experiments=[*experiments])
    p, positions = collocation.unpack(z)
    by_name = dict(zip(collocation.parameter_names, p.tolist(), strict=True))
    known = {
        each.experiment.name: x
        for each, x in zip(collocation.transcriptions, positions, strict=True)
    }
    motions = []
    for each in wide.transcriptions:
        if (motion := known.get(each.experiment.name)) is None:
            dynamics = each.dynamics.with_theta(each.constants.theta(z[: each.nq]))
            fitted = known.get(each.experiment.name.removeprefix(LONGER))
            motion, failure = continue_simulation(each.experiment, dynamics, fitted)
            if failure is not None:
                raise failure
        motions.append(motion)
    return wide, wide.pack(wide.with_values(by_name, np.zeros(wide.nq + wide.nphi)), motions)
