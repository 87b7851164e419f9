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
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from ...arrays import Array
from ...errors import InputError
from ...problem import Problem
from ...program.collocation import Collocation
from ...program.marching import march_on
from ...program.newton import NewtonOptions
from ...recording import Experiment, PoseSequence
from ...recording.wrench import Wrench
from ...statistics.linearised import LinearisedFit, least_squares, linearised_fit
from .limits import Bounds, Limits
from .motion import HandMotion

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
