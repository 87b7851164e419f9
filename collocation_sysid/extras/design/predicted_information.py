"""Predicted information of a future recording about the shared parameters q, for a given motion.

The recording is simulated with the scheme that will be used to fit it. With the slopes S of its
residuals with respect to q and its nuisance parameters φ, and A = SᵀS + the priors of φ, its
information is the Schur complement A_qq − A_qφ A_φφ⁻¹ A_φq. The information of several recordings
adds up.

For small motions, a few simulations predict the information of all motions to first order: a body
hanging at rest responds to small motions of its hand as a linear time-invariant system, and so do
the slopes of the measurements. One pulse of each coordinate gives the response to all: with a pulse
p, a coordinate c_j at the samples and the response g to p,

    c(t) ≈ Σ c_j p(t − t_j),   S(t) ≈ S_0(t) + Σ c_j g(t − t_j).

This is not valid for large rotations and strains; it is used for the start of a search, not for its
result.

The size of the error bars is one number, the logarithm of a relative error bar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...errors import InputError, require_among
from ...model.parameters import Parameters, ThetaMap
from ...problem import Problem
from ...program.collocation import Collocation
from ...program.forward.newton_solver import NewtonOptions
from ...program.forward.scheme_simulation import continue_simulation
from ...recording import Experiment, PoseSequence
from ...recording.measurement_selection import moved_grasp
from ...statistics.estimates import UNDETERMINED, relative_derivatives
from ...statistics.linearised import (
    DerivedModuli,
    LinearisedFit,
    least_squares_of_fit,
    linearise_fit,
)
from .hand_limits import HandBounds, Limits
from .hand_motion import HandMotion

Kind = Literal["worst", "A", "D"]
Over = Literal["mean", "worst"]


@dataclass(frozen=True)
class DesignCriterion:
    """Criterion that a design minimises.

    Raises
    ------
    InputError
        For another kind, or another value of `over`.
    """

    # The largest error bar, their root mean square, or the size of their joint ellipsoid: the
    # geometric mean of its half axes.
    kind: Kind = "worst"
    # Parameters and derived moduli that count; every estimated parameter if empty. For one alone
    # all kinds are the same.
    names: tuple[str, ...] = ()
    over: Over = "mean"  # over draws of θ: the geometric mean, or the largest

    def __post_init__(self) -> None:
        require_among(self.kind, get_args(Kind), where="--criterion")
        require_among(self.over, get_args(Over), where="--over")

    def log_size(self, errors: PredictedErrors) -> float:
        """Return the logarithm of the relative error bar that is minimised, of the parameters named
        by the criterion: the largest, for "A" the root mean square, for "D" the geometric mean over
        the axes of the confidence ellipsoid.

        Parameters
        ----------
        errors : PredictedErrors
            Predicted errors, which must have all names, see `require_known`.
        """
        slopes = errors.slopes_of(self.names)
        covariance = slopes @ errors.covariance @ slopes.T
        if self.kind == "D":
            return float(np.linalg.slogdet(covariance)[1]) / (2 * len(covariance))
        variances = np.diag(covariance)
        return 0.5 * float(np.log(variances.max() if self.kind == "worst" else variances.mean()))

    def combine_draws(self, sizes: Sequence[float]) -> float:
        """Return the mean of the logarithms `sizes` at one or more draws of θ, or the largest if
        `over` is "worst".
        """
        return float(np.max(sizes) if self.over == "worst" else np.mean(sizes))

    def require_known(self, errors: PredictedErrors) -> None:
        """Check that the error bars of all `names` of the criterion are predicted.

        Parameters
        ----------
        errors : PredictedErrors
            Errors at any parameters, with the names of all parameters and moduli.

        Raises
        ------
        InputError
            For a name that is neither an estimated parameter nor a derived modulus that depends on
            one, and for "D" if one of the names follows from the others.
        """
        for name in self.names:
            require_among(name, errors.slopes, where="--for", count="some")
        slopes = errors.slopes_of(self.names)
        if self.kind == "D" and np.linalg.matrix_rank(slopes) < len(slopes):
            raise InputError(
                f"of {', '.join(self.names)} one follows from the others, so that their "
                "confidence ellipsoid has no volume; name fewer, or choose --criterion A or worst",
                None,
                where="--for",
            )


@dataclass(frozen=True, eq=False)
class PredictedErrors:
    """Relative error bars at one θ, to first order."""

    covariance: Array  # (nq, nq): covariance of q
    # dict of str to float: estimated parameters, followed by derived moduli, by name.
    values: dict[str, float]
    # dict of str to (nq,): derivatives of each with respect to q, divided by its value.
    slopes: dict[str, Array]
    estimated_count: int  # number of estimated parameters, the first of the names

    @classmethod
    def from_information(
        cls, information: Array, parameters: Parameters, constants: ThetaMap, q: Array
    ) -> PredictedErrors:
        """Return the errors from the information (nq, nq) of all recordings and the priors of q.

        No error bar of a parameter exceeds `UNDETERMINED` times the parameter, so that motions
        without information can be compared. Coefficients of fields are part of the covariance, but
        not of `values`; neither are derived moduli that do not depend on q.

        Parameters
        ----------
        information : (nq, nq) array
            Information of all recordings.
        parameters : Parameters
            Parameters with their priors.
        constants : ThetaMap
            Map from q to the body's constants, for derived moduli.
        q : (nq,) array
            Parameters in the solver's coordinates.
        """
        sizes = relative_derivatives(parameters, q)
        prior = parameters.prior_residuals(q)[1] ** 2 + (sizes / UNDETERMINED) ** 2
        units = 1 / np.sqrt(np.diag(information) + prior)
        scaled = units[:, None] * (information + np.diag(prior)) * units
        covariance = units[:, None] * np.linalg.inv(scaled) * units
        values = dict[str, float]()
        slopes = dict[str, Array]()
        for k in parameters.scalar_coordinates:
            item = parameters.free[k]
            values[item.name] = item.from_coordinate(float(q[k]))
            slopes[item.name] = np.diag(sizes)[k]
        estimated_count = len(values)
        derived = DerivedModuli.from_bodies([constants], q)
        varying = {name: by_q for name, by_q in derived.derivatives.items() if by_q.any()}
        values |= {name: derived.values[name] for name in varying}
        slopes |= {name: by_q / derived.values[name] for name, by_q in varying.items()}
        return cls(covariance, values, slopes=slopes, estimated_count=estimated_count)

    def slopes_of(self, names: Sequence[str]) -> Array:
        """Return the rows (k, nq) of `slopes` for these names; for all estimated parameters if
        `names` is empty.

        Raises
        ------
        KeyError
            For an unknown name.
        """
        chosen = names or list(self.slopes)[: self.estimated_count]
        return np.array([self.slopes[name] for name in chosen])

    @property
    def relative(self) -> dict[str, float]:
        """Standard errors of parameters and derived moduli relative to their values, by
        name.
        """
        return {
            name: float(np.sqrt(slope @ self.covariance @ slope))
            for name, slope in self.slopes.items()
        }


def prior_draws(parameters: Parameters, spread: float, pairs: int, seed: int) -> list[Array]:
    """Return draws (nq,) of the parameters q, in the solver's coordinates: the middle, followed by
    `pairs` pairs on either side of it, inside the bounds, see `symmetric_draws`.

    A parameter with a prior is drawn from it; the middle is then that of the prior. Others are
    drawn around their guess.

    Parameters
    ----------
    parameters : Parameters
        Parameters, each with a guess, also if it has a prior.
    spread : float
        Above 1. Standard deviations of parameters without a prior are ln `spread` for logarithms,
        and `spread` − 1 times the typical size for linear ones.
    pairs : int
        Number of pairs; 0 gives the middle alone.
    seed : int
        Seed of the random numbers.

    Raises
    ------
    InputError
        If a parameter has no guess.
    """
    middle = parameters.guess_q.copy()
    deviation = np.array(
        [np.log(spread) if item.scale == "log" else spread - 1 for item in parameters.free]
    )
    for k, item in enumerate(parameters.free):
        if item.prior is not None:
            middle[k] = item.to_coordinate(item.prior[0])
            deviation[k] = item.prior[1] / (1.0 if item.scale == "log" else item.unit)
    return symmetric_draws(parameters, middle, root=np.diag(deviation), pairs=pairs, seed=seed)


def symmetric_draws(
    parameters: Parameters, middle: Array, root: Array, pairs: int, seed: int
) -> list[Array]:
    """Return the middle of a normal distribution of q and pairs of draws on either side of it,
    1 + 2 · `pairs` arrays (nq,), all moved inside the bounds by a small margin.

    Parameters
    ----------
    parameters : Parameters
        Parameters with their bounds.
    middle : (nq,) array
        Mean.
    root : (nq, nq) array
        Square root of the covariance.
    pairs : int
        Number of pairs.
    seed : int
        Seed of the random numbers.
    """
    rng = np.random.default_rng(seed)
    deviations = [root @ rng.normal(size=len(middle)) for _ in range(pairs)]
    lower, upper = parameters.bounds_q
    margin = 1e-3 * np.minimum(upper - lower, 1.0)
    draws = [middle, *(middle + sign * way for way in deviations for sign in (1, -1))]
    return [np.clip(q, lower + margin, upper - margin) for q in draws]


# Largest step of Newton's method at convergence, over the body's size. The method converges
# quadratically, so that the remaining error is orders of magnitude smaller.
TOLERANCE = 1e-5
# Number of poses per sample of the markers.
POSES_PER_SAMPLE = 4
# Largest number of samples: each candidate motion is simulated.
MOST_SAMPLES = 100_000


def shared_information(fit: LinearisedFit) -> Array:
    """Return the information (nq, nq) of the measurements of a linearised fit about the shared
    parameters q, in the solver's coordinates.

    Nuisance parameters are eliminated with their priors; priors of the shared parameters are not
    included.
    """
    alone = least_squares_of_fit(fit).marginal(fit.shared_count)
    return alone.information - np.diag(fit.prior_jacobian[: fit.shared_count] ** 2)


@dataclass(frozen=True, eq=False)
class FutureRecording:
    """Recording to be designed: everything except the motion.

    Raises
    ------
    InputError
        If a motion cannot be designed for the experiment: it is static, has not exactly one grasp
        that holds all axes throughout, or would have too few or too many samples.
    """

    problem: Problem  # problem with scheme and parameters
    # Experiment with the same body, grasp, markers, loads and nuisance parameters.
    template: Experiment
    # Stated duration [s]; the recording lasts the nearest whole number of timesteps.
    duration_s: float
    _starts: dict[bytes, Array] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        try:
            self._validate()
        except InputError as error:
            raise error.located(self.problem.path, f"experiment '{self.template.name}'") from error

    def _validate(self) -> None:
        """Raise an `InputError` if a motion cannot be designed for the experiment."""
        template = self.template
        if template.is_static:
            raise InputError(
                "the experiment is static; expected one that moves, to design a motion for"
            )
        if len(template.grasps) != 1:
            raise InputError(
                f"the experiment has {len(template.grasps)} grasps; expected one, whose motion is "
                "designed"
            )
        (grasp,) = template.grasps
        if grasp.axes != "xyz" or not (np.isinf(grasp.from_s) and np.isinf(grasp.until_s)):
            raise InputError(
                "the grasp holds only some axes, or only a part of the time; expected one that holds "
                "all axes throughout"
            )
        if not 3 <= self.sample_count <= MOST_SAMPLES:
            raise InputError(
                f"{self.duration_s:g} s are {self.sample_count - 1:.6g} steps of "
                f"{template.timestep_s:g} s; expected 2 to {MOST_SAMPLES}",
                where="--duration",
            )

    @property
    def sample_count(self) -> int:
        """Number of samples of the designed recording, the first and the last included."""
        return round(self.duration_s / self.template.timestep_s) + 1

    @cached_property
    def since_start_s(self) -> Array:
        """Times (T,) of the samples since the start [s]."""
        return np.asarray(np.arange(self.sample_count) * self.template.timestep_s, dtype=np.float64)

    @cached_property
    def start_pose(self) -> tuple[Array, Array]:
        """Rotation R (3, 3) and translation p (3,) [m] of the rigidly grasped body at the first
        sample of the template: a grasped node at X is at R X + p.
        """
        rotations, translations = self.template.rigid_motion(self.template.t_s[:1])
        return rotations[0], translations[0]

    @cached_property
    def hand_m(self) -> Array:
        """Centre (3,) of the grasped nodes in the undeformed body [m]."""
        (grasp,) = self.template.grasps
        return np.asarray(self.template.body.nodes_m[grasp.nodes].mean(axis=0), dtype=np.float64)

    def bounds(self, limits: Limits) -> HandBounds:
        """Return the limits of the hand relative to its initial position, the middle of the grasped
        nodes at the template's first sample.

        Raises
        ------
        InputError
            If the hand starts outside the workspace or on its boundary.
        """
        rotation, translation = self.start_pose
        return limits.bounds_from(rotation @ self.hand_m + translation)

    def highest_hz(self, limits: Limits) -> float:
        """Return the highest frequency of a wave [Hz]: that of the limits, or a tenth of the
        sampling rate if they state none.

        Raises
        ------
        InputError
            If the stated limit exceeds half the sampling rate.
        """
        rate_hz = 1 / self.template.timestep_s
        if (limits.frequency_hz or 0.0) > rate_hz / 2:
            raise InputError(
                f"found {limits.frequency_hz:g} Hz as the highest frequency of the motion; "
                f"expected at most {rate_hz / 2:g} Hz, half the sampling rate",
                None,
                where="frequency_hz",
            )
        return limits.frequency_hz or rate_hz / 10

    @cached_property
    def pose_times_s(self) -> Array:
        """Times (P,) of the poses since the start [s], several per sample."""
        count = POSES_PER_SAMPLE * (self.sample_count - 1) + 1
        return np.linspace(0.0, self.since_start_s[-1], count)

    def poses(self, motion: HandMotion) -> PoseSequence:
        """Return the poses at `pose_times_s` of a motion of the hand relative to its initial pose,
        as grasps have them: a grasped node at X of the undeformed body is at R X + p.
        """
        return self.poses_from_coordinates(motion.derivatives(self.pose_times_s).value)

    def poses_from_coordinates(self, coordinates: Array) -> PoseSequence:
        """Return the poses at `pose_times_s` from the translation [m] and the rotation vector [rad]
        (P, 6) of the hand, relative to its initial position and orientation, in world axes.
        """
        rotation, translation = self.start_pose
        turned = Rotation.from_rotvec(coordinates[:, 3:]) * Rotation.from_matrix(rotation)
        hand = rotation @ self.hand_m + translation + coordinates[:, :3]
        placed = hand - turned.apply(self.hand_m)
        return PoseSequence(
            self.pose_times_s + self.template.t_s[0], placed, quaternions_xyzw=turned.as_quat()
        )

    def experiment(self, poses: PoseSequence) -> Experiment:
        """Return the future experiment: the template with the given poses of its grasp, and the
        times of the new samples.

        All markers are at the origin, and a sensor of the grasp has zeros, as placeholders for
        measurements. The poses must cover the duration of the recording; times start at the
        template's first sample.
        """
        template = self.template
        (grasp,) = self.template.grasps
        t_s = self.since_start_s + template.t_s[0]
        nowhere = np.zeros((len(t_s), len(template.markers.names), 3))
        return replace(
            template,
            t_s=t_s,
            grasps=(moved_grasp(grasp, poses, t_s=t_s),),
            markers=template.markers.with_samples(t_s, nowhere),
        )

    def simulate_motion(self, experiment: Experiment, q: Array) -> tuple[Array, Array]:
        """Return the information (nq, nq) about the shared parameters and the marker positions
        (T, M, 3) [m] of an experiment simulated at the parameters q (nq,), in the solver's
        coordinates.

        Raises
        ------
        SimulationError
            If the simulation does not reach the end.
        """
        fit, x = self.linearise(experiment, q)
        positions = x[:: self.problem.choose_first_substeps()].reshape(len(experiment.t_s), -1, 3)
        return shared_information(fit), experiment.markers.predict_positions(positions)

    def program(self, experiment: Experiment) -> Collocation:
        """Return the nonlinear program of one experiment with all parameters of the problem, its
        scheme and its first number of substeps. An experiment that is declared as held out is
        fitted, too.
        """
        problem = self.problem
        fitted = replace(experiment, validation=False) if experiment.validation else experiment
        return Collocation(
            [fitted],
            problem.parameters,
            scheme=problem.scheme,
            substeps=problem.choose_first_substeps(),
        )

    def linearise(self, experiment: Experiment, q: Array) -> tuple[LinearisedFit, Array]:
        """Return the linearised fit of a simulated experiment, and its node positions (N, 3n) [m]
        at the N time steps, substeps included.

        The nuisance parameters are at their guesses. The initial equilibrium at q is stored for
        later calls, since every motion starts from it.

        Parameters
        ----------
        experiment : Experiment
            Experiment of `experiment`, or the template; its measurements do not matter for the
            slopes.
        q : (nq,) array
            Parameters in the solver's coordinates.

        Raises
        ------
        SimulationError
            If the simulation does not reach the end.
        """
        alone = self.program(experiment)
        (transcription,) = alone.transcriptions
        known = self._starts.get(q.tobytes())
        x, failure = continue_simulation(
            experiment,
            transcription.dynamics.with_theta(transcription.constants.theta(q)),
            known=known,
            options=NewtonOptions(tolerance=TOLERANCE),
        )
        if failure is not None:
            raise failure
        self._starts[q.tobytes()] = x[:1]
        return linearise_fit(alone, alone.pack(np.append(q, transcription.guess_phi), [x])), x


# Heights of the pulses in translation [m] and rotation vector [rad]: small, for a linear response.
HEIGHTS = np.repeat([1e-4, 1e-3], 3)
# Pulse: the cubic B-spline on uniform knots. A sum of its shifted copies, weighted with the values
# of a coordinate at the samples, approximates that coordinate.
PULSE = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
# Index of the sample at which the simulated pulses are highest.
CENTRE = 2


@dataclass(frozen=True, eq=False)
class LinearRecording:
    """Response of a recording to a pulse of each coordinate, at one q."""

    recording: FutureRecording  # recording to be designed
    rest: LinearisedFit  # linearised fit without any motion
    # (6, frequencies, 3M, p): fourier transforms of the change of the slopes, for a pulse of height
    # one: 3M marker coordinates, p parameters (shared and nuisance).
    responses: Array
    length: int  # length of the transforms, at least twice the number of samples

    @staticmethod
    def gigabytes(recording: FutureRecording) -> float:
        """Return the approximate memory of the responses of a recording [GB], without computing
        them.
        """
        (transcription,) = recording.program(recording.template).transcriptions
        markers = 3 * len(recording.template.markers.names)
        return 6 * 16e-9 * recording.sample_count * markers * len(transcription.parameter_indices)

    @classmethod
    def from_simulations(cls, recording: FutureRecording, q: Array) -> LinearRecording:
        """Return the response of a recording at the parameters q (nq,), in the solver's
        coordinates, from seven simulations: one at rest, and one for each coordinate.

        Raises
        ------
        SimulationError
            If a simulation does not reach the end.
        """
        still = recording.linearise(recording.experiment(_pulse_poses(recording, np.zeros(6))), q)[
            0
        ]
        (at_rest,) = still.blocks
        count = recording.sample_count
        length = 1 << (2 * count - 1).bit_length()
        answers = []
        for k, height in enumerate(HEIGHTS):
            pulsed = recording.experiment(_pulse_poses(recording, height * np.eye(6)[k]))
            (block,) = recording.linearise(pulsed, q)[0].blocks
            change = (block.channels[1] - at_rest.channels[1]) / height
            answers.append(np.fft.rfft(change, length, axis=0))
        return cls(recording, still, responses=np.array(answers), length=length)

    def information(self, motion: HandMotion) -> Array:
        """Return the information (nq, nq) of a motion about the shared parameters, to first order
        in the motion, see `shared_information`.

        The coordinates at the first `CENTRE` samples are neglected: a motion from rest is small
        there.

        Parameters
        ----------
        motion : HandMotion
            Motion with the duration of the recording.
        """
        recording = self.recording
        course = motion.derivatives(recording.since_start_s)[0]
        # The pulses are highest at sample CENTRE; before it a motion from rest is negligible.
        of_course = np.fft.rfft(course[CENTRE:], self.length, axis=0)
        transform = np.einsum("fk,kfcp->fcp", of_course, self.responses)
        (rest,) = self.rest.blocks
        change = np.fft.irfft(transform, self.length, axis=0)[: recording.sample_count]
        slope = rest.jacobian + change.reshape(rest.jacobian.shape)
        return shared_information(replace(self.rest, blocks=(replace(rest, jacobian=slope),)))


def _pulse_poses(recording: FutureRecording, heights: Array) -> PoseSequence:
    """Return one sequence of poses at `pose_times_s`, with a pulse of all coordinates at once."""
    t_s = recording.pose_times_s
    since = t_s / recording.template.timestep_s - CENTRE
    share = np.nan_to_num(np.asarray(PULSE(since), dtype=np.float64))
    return recording.poses_from_coordinates(np.outer(share, heights))
