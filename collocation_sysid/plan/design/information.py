"""What a recording would tell of the shared parameters q, were the hand to make a motion.

The recording is simulated with the scheme that is to fit it. With S the slopes of its residuals,
by q and by its nuisance parameters φ, and A = SᵀS + the priors of φ, its information is what is
left of q when φ is estimated beside it, A_qq − A_qφ A_φφ⁻¹ A_φq. Informations of recordings add.

What small motions tell, to first order, takes a few simulations in place of one for each motion: a
body that hangs at rest answers small motions of its hand as a linear system that does not change
in time, and so do the slopes of what is measured by the parameters. One pulse of each coordinate
tells the answer to all: with p a pulse, c_j a coordinate at the samples and g the answer to p,

    c(t) ≈ Σ c_j p(t − t_j),   S(t) ≈ S_0(t) + Σ c_j g(t − t_j).

Large turns and large strains are beyond it. It tells where a search may begin, not how it ends.

How small the error bars are is one number, the logarithm of a relative error bar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from ...arrays import Array
from ...errors import InputError, require_among
from ...fem.constants import is_mode
from ...model.parameters import Parameters, ThetaMap
from ...problem import Problem
from ...program.collocation import Collocation
from ...program.marching import march_on
from ...program.newton import NewtonOptions
from ...recording import Experiment, PoseSequence
from ...recording.wrench import Wrench
from ...statistics.estimates import UNDETERMINED, relative_slopes
from ...statistics.linearised import Derived, LinearisedFit, least_squares, linearised_fit
from .limits import Bounds, Limits
from .motion import HandMotion

Kind = Literal["worst", "A", "D"]
Over = Literal["mean", "worst"]


@dataclass(frozen=True)
class Criterion:
    """What is to be small.

    Attributes
    ----------
    kind : {"worst", "A", "D"}
        The largest error bar, their root mean square, or the size of their joint ellipsoid: the
        geometric mean of its half axes.
    names : tuple of str
        Parameters and derived moduli that count; every estimated parameter by default. Of one
        alone all kinds are the same.
    over : {"mean", "worst"}
        Over draws of θ: of the geometric mean, or of the largest.

    Raises
    ------
    InputError
        For an unknown kind.
    """

    kind: Kind = "worst"
    names: tuple[str, ...] = ()
    over: Over = "mean"

    def __post_init__(self) -> None:
        require_among(self.kind, get_args(Kind), None, "--criterion")
        require_among(self.over, get_args(Over), None, "--over")

    def log_size(self, errors: Errors) -> float:
        """The logarithm of the error bar that is to be small."""
        slopes = errors.slopes_of(self.names)
        covariance = slopes @ errors.covariance @ slopes.T
        if self.kind == "D":
            return float(np.linalg.slogdet(covariance)[1]) / (2 * len(covariance))
        variances = np.diag(covariance)
        return 0.5 * float(np.log(variances.max() if self.kind == "worst" else variances.mean()))

    def over_draws(self, sizes: Sequence[float]) -> float:
        """One number of those at several θ."""
        return float(np.max(sizes) if self.over == "worst" else np.mean(sizes))

    def require_known(self, errors: Errors) -> None:
        """Refuse names that are not estimated, and for "D" those that follow from one another.

        Raises
        ------
        InputError
        """
        for name in self.names:
            require_among(name, errors.slopes, None, "--for", "some")
        slopes = errors.slopes_of(self.names)
        if self.kind == "D" and np.linalg.matrix_rank(slopes) < len(slopes):
            raise InputError(
                f"of {', '.join(self.names)} one follows from the others, so that their ellipsoid "
                "has no size; name fewer, or choose --criterion A or worst",
                None,
                "--for",
            )


@dataclass(frozen=True, eq=False)
class Errors:
    """Relative error bars at one θ, to first order.

    Attributes
    ----------
    covariance : (nq, nq) of q
    values : by name, parameters that are estimated, and derived moduli
    slopes : by name, (nq,) relative change of each by q
    estimated : number of parameters, the first of the names
    """

    covariance: Array
    values: dict[str, float]
    slopes: dict[str, Array]
    estimated: int

    @classmethod
    def of(
        cls, information: Array, parameters: Parameters, constants: ThetaMap, q: Array
    ) -> Errors:
        """From the information (nq, nq) of all recordings; priors of the parameters join it.

        No error bar becomes larger than `UNDETERMINED` times a parameter: that much is as good as
        nothing, and the sizes of motions that tell nothing can be compared.
        """
        sizes = relative_slopes(parameters, q)
        prior = parameters.prior(q)[1] ** 2 + (sizes / UNDETERMINED) ** 2
        units = 1 / np.sqrt(np.diag(information) + prior)
        scaled = units[:, None] * (information + np.diag(prior)) * units
        covariance = units[:, None] * np.linalg.inv(scaled) * units
        values, slopes = dict[str, float](), dict[str, Array]()
        for item, c, slope in zip(parameters.free, q, np.diag(sizes), strict=True):
            if not is_mode(item.name):
                values[item.name], slopes[item.name] = item.value(float(c)), slope
        told = len(values)
        derived = Derived.of([constants], q)
        moving = {name: by_q for name, by_q in derived.by_q.items() if by_q.any()}
        values |= {name: derived.values[name] for name in moving}
        slopes |= {name: by_q / derived.values[name] for name, by_q in moving.items()}
        return cls(covariance, values, slopes, told)

    def slopes_of(self, names: Sequence[str]) -> Array:
        """(k, nq) of those names, of the estimated parameters where there are none."""
        chosen = names or list(self.slopes)[: self.estimated]
        return np.array([self.slopes[name] for name in chosen])

    @property
    def relative(self) -> dict[str, float]:
        """Standard errors over values, by name."""
        return {
            name: float(np.sqrt(slope @ self.covariance @ slope))
            for name, slope in self.slopes.items()
        }


def draws_about(parameters: Parameters, spread: float, pairs: int, seed: int) -> list[Array]:
    """Draws (nq,) of q: the middle, then pairs on either side of it.

    A parameter with a prior is drawn from that. Others lie about their guess: logarithms within a
    standard deviation of ln `spread`, linear ones of `spread` − 1 times their typical size.
    """
    middle = parameters.guess_q.copy()
    deviation = np.array(
        [np.log(spread) if item.scale == "log" else spread - 1 for item in parameters.free]
    )
    for k, item in enumerate(parameters.free):
        if item.prior is not None:
            middle[k] = item.q(item.prior[0])
            deviation[k] = item.prior[1] / (1.0 if item.scale == "log" else item.unit)
    return both_sides(parameters, middle, np.diag(deviation), pairs, seed)


def both_sides(
    parameters: Parameters, middle: Array, root: Array, pairs: int, seed: int
) -> list[Array]:
    """The middle of a normal distribution of q, and draws on either side, within the bounds."""
    rng = np.random.default_rng(seed)
    ways = [root @ rng.normal(size=len(middle)) for _ in range(pairs)]
    lower, upper = parameters.bounds_q
    inside = 1e-3 * np.minimum(upper - lower, 1.0)
    draws = [middle, *(middle + sign * way for way in ways for sign in (1, -1))]
    return [np.clip(q, lower + inside, upper - inside) for q in draws]


# Newton's last step over the body's size: what is left of it is ten thousand times less.
TOLERANCE = 1e-5
# Logged poses between two samples.
POSES_PER_SAMPLE = 4
# A motion of more is not meant: each candidate is simulated.
MOST_SAMPLES = 100_000


def shared_information(fit: LinearisedFit) -> Array:
    """(nq, nq) of the shared parameters, with the others free but for their priors.

    That of the measurements alone: priors of the shared parameters are left out.
    """
    alone = least_squares(fit).marginal(fit.shared)
    return alone.information - np.diag(fit.prior_slope[: fit.shared] ** 2)


@dataclass(frozen=True, eq=False)
class SimulatedMotion:
    """A motion as it was simulated at one q.

    Attributes
    ----------
    information : (nq, nq)
    markers_m : (T, M, 3)
    """

    information: Array
    markers_m: Array


@dataclass(frozen=True, eq=False)
class FutureRecording:
    """The recording to come: all of it but the motion.

    Attributes
    ----------
    problem : Problem
        With its scheme and parameters.
    template : Experiment
        Body, grasp, markers, loads and nuisance parameters are those of this one.
    duration_s : float
        Rounded to whole samples.
    """

    problem: Problem
    template: Experiment
    duration_s: float
    _starts: dict[bytes, Array] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        try:
            self._check()
        except InputError as error:
            raise error.located(self.problem.path, f"experiment '{self.template.name}'") from error

    def _check(self) -> None:
        template = self.template
        if template.static:
            raise InputError("is static; expected one that moves, to design a motion for")
        if len(template.grasps) != 1:
            raise InputError(
                f"has {len(template.grasps)} grasps; expected one, whose motion is designed"
            )
        (grasp,) = template.grasps
        if grasp.axes != "xyz" or not (np.isinf(grasp.from_s) and np.isinf(grasp.until_s)):
            raise InputError(
                "has a grasp that holds some axes, or for a while; expected one that holds "
                "throughout"
            )
        if not 3 <= self.samples <= MOST_SAMPLES:
            raise InputError(
                f"{self.duration_s:g} s are {self.samples - 1:.6g} steps of "
                f"{template.timestep_s:g} s; expected 2 to {MOST_SAMPLES}",
                where="--duration",
            )

    @property
    def samples(self) -> int:
        """Number of the samples of markers."""
        return round(self.duration_s / self.template.timestep_s) + 1

    @cached_property
    def since_start_s(self) -> Array:
        """(T,) times of the samples."""
        return np.asarray(np.arange(self.samples) * self.template.timestep_s, dtype=np.float64)

    @cached_property
    def start(self) -> tuple[Array, Array]:
        """(3, 3), (3,) rotation and translation of the first pose."""
        rotations, translations = self.template.rigid_motion(self.template.t_s[:1])
        return rotations[0], translations[0]

    @cached_property
    def hand_m(self) -> Array:
        """(3,) the middle of the grasped nodes, undeformed."""
        (grasp,) = self.template.grasps
        return np.asarray(self.template.body.nodes_m[grasp.nodes].mean(axis=0), dtype=np.float64)

    def bounds(self, limits: Limits) -> Bounds:
        """The limits of the hand about where it starts."""
        rotation, translation = self.start
        return limits.about(rotation @ self.hand_m + translation)

    def highest_hz(self, limits: Limits) -> float:
        """No wave is faster.

        Raises
        ------
        InputError
            If the samples could not tell it from a slower one.
        """
        rate_hz = 1 / self.template.timestep_s
        if (limits.frequency_hz or 0.0) > rate_hz / 2:
            raise InputError(
                f"found {limits.frequency_hz:g}; expected at most {rate_hz / 2:g}, half the rate "
                "of the samples",
                None,
                "frequency_hz",
            )
        return limits.frequency_hz or rate_hz / 10

    @cached_property
    def pose_times_s(self) -> Array:
        """(P,) times of the poses since the start, several a sample."""
        count = POSES_PER_SAMPLE * (self.samples - 1) + 1
        return np.linspace(0.0, self.since_start_s[-1], count)

    def poses(self, motion: HandMotion) -> PoseSequence:
        """The poses of a motion."""
        return self.carried(motion.derivatives(self.pose_times_s)[0])

    def carried(self, coordinates: Array) -> PoseSequence:
        """The poses at `pose_times_s` from the hand's shift and rotation vector then, (P, 6)."""
        rotation, translation = self.start
        turned = Rotation.from_rotvec(coordinates[:, 3:]) * Rotation.from_matrix(rotation)
        hand = rotation @ self.hand_m + translation + coordinates[:, :3]
        placed = hand - turned.apply(self.hand_m)
        return PoseSequence(self.pose_times_s + self.template.t_s[0], placed, turned.as_quat())

    def experiment(self, poses: PoseSequence) -> Experiment:
        """What would be recorded, without a measurement yet: all markers at the origin."""
        template, (grasp,) = self.template, self.template.grasps
        t_s = self.since_start_s + template.t_s[0]
        nowhere = np.zeros((len(t_s), len(template.markers.names), 3))
        return replace(
            template,
            t_s=t_s,
            grasps=(replace(grasp, poses=poses, wrench=_anew(grasp.wrench, t_s)),),
            markers=replace(template.markers, t_s=t_s, positions_m=nowhere),
        )

    def told(self, experiment: Experiment, q: Array) -> SimulatedMotion:
        """What the experiment tells at q.

        Raises
        ------
        SimulationError
            Where it cannot be simulated to its end.
        """
        fit, x = self.fit(experiment, q)
        positions = x[:: self.problem.first_substeps].reshape(len(experiment.t_s), -1, 3)
        return SimulatedMotion(shared_information(fit), experiment.markers.observe(positions))

    def program(self, experiment: Experiment) -> Collocation:
        """The equations of motion of one experiment."""
        problem = self.problem
        fitted = replace(experiment, validation=False) if experiment.validation else experiment
        return Collocation([fitted], problem.parameters, problem.scheme, problem.first_substeps)

    def fit(self, experiment: Experiment, q: Array) -> tuple[LinearisedFit, Array]:
        """The experiment simulated at q, with the slopes of all residuals; and x (N, 3n) [m].

        Raises
        ------
        SimulationError
            Where it cannot be simulated to its end.
        """
        alone = self.program(experiment)
        (segment,) = alone.segments
        known = self._starts.get(q.tobytes())  # every motion starts from the same rest
        x, failure = march_on(
            experiment,
            segment.dynamics.with_theta(segment.constants.theta(q)),
            known,
            NewtonOptions(tolerance=TOLERANCE),
        )
        if failure is not None:
            raise failure
        self._starts[q.tobytes()] = x[:1]
        return linearised_fit(alone, alone.pack(np.append(q, segment.guess_phi), [x])), x


def _anew(wrench: Wrench | None, t_s: Array) -> Wrench | None:
    """A sensor that measures at its own rate, over other times, what it did."""
    if wrench is None:
        return None
    rate_hz = (len(wrench.t_s) - 1) / max(np.ptp(wrench.t_s), 1e-300)
    count = max(3, 1 + int(np.ptp(t_s) * rate_hz + 1e-6))
    times = t_s[0] + np.arange(count) / rate_hz
    values = np.tile(np.where(wrench.measured, 0.0, np.nan), (count, 1))
    return replace(wrench, t_s=times, values=values)


# The pulses' heights, as small as the answers are linear, of shifts [m] and of turns [rad].
HEIGHTS = np.repeat([1e-4, 1e-3], 3)
# The cubic B-spline on even knots: of its shifted copies, values at the samples make a course.
PULSE = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
# The sample at which those that are simulated are highest.
CENTRE = 2


@dataclass(frozen=True, eq=False)
class LinearRecording:
    """The answers of a recording to a pulse of each coordinate, at one q.

    Attributes
    ----------
    recording : FutureRecording
    rest : LinearisedFit
        Without any motion.
    answers : (6, frequencies, 3M, p) their transforms, to a pulse of height one
    length : int, of the transforms
    """

    recording: FutureRecording
    rest: LinearisedFit
    answers: Array
    length: int

    @staticmethod
    def gigabytes(recording: FutureRecording) -> float:
        """Memory that the answers take."""
        (segment,) = recording.program(recording.template).segments
        markers = 3 * len(recording.template.markers.names)
        return 6 * 16e-9 * recording.samples * markers * len(segment.places)

    @classmethod
    def of(cls, recording: FutureRecording, q: Array) -> LinearRecording:
        """Seven simulations.

        Raises
        ------
        SimulationError
        """
        still = recording.fit(recording.experiment(_pulse(recording, np.zeros(6))), q)[0]
        (at_rest,) = still.blocks
        count = recording.samples
        length = 1 << (2 * count - 1).bit_length()
        answers = []
        for k, height in enumerate(HEIGHTS):
            pulsed = recording.experiment(_pulse(recording, height * np.eye(6)[k]))
            (block,) = recording.fit(pulsed, q)[0].blocks
            change = (block.channels[1] - at_rest.channels[1]) / height
            answers.append(np.fft.rfft(change, length, axis=0))
        return cls(recording, still, np.array(answers), length)

    def information(self, motion: HandMotion) -> Array:
        """(nq, nq) of the shared parameters, see `shared_information`."""
        recording = self.recording
        course = motion.derivatives(recording.since_start_s)[0]
        # What was simulated is highest at a sample before which a motion from rest is nothing yet.
        of_course = np.fft.rfft(course[CENTRE:], self.length, axis=0)
        whole = np.einsum("fk,kfcp->fcp", of_course, self.answers)
        (rest,) = self.rest.blocks
        change = np.fft.irfft(whole, self.length, axis=0)[: recording.samples]
        slope = rest.slope + change.reshape(rest.slope.shape)
        return shared_information(replace(self.rest, blocks=(replace(rest, slope=slope),)))


def _pulse(recording: FutureRecording, heights: Array) -> PoseSequence:
    """Poses with a pulse of each coordinate, of these heights (6,)."""
    t_s = recording.pose_times_s
    since = t_s / recording.template.timestep_s - CENTRE
    share = np.nan_to_num(np.asarray(PULSE(since), dtype=np.float64))
    return recording.carried(np.outer(share, heights))
