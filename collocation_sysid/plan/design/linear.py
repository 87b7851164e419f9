"""What small motions tell, to first order: a few simulations in place of one for each motion.

A body that hangs at rest answers small motions of its hand as a linear system that does not change
in time, and so do the slopes of what is measured by the parameters. One pulse of each coordinate
tells the answer to all: with p a pulse, c_j a coordinate at the samples and g the answer to p,

    c(t) ≈ Σ c_j p(t − t_j),   S(t) ≈ S_0(t) + Σ c_j g(t − t_j).

Large turns and large strains are beyond it. It tells where a search may begin, not how it ends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline

from ...arrays import Array
from ...recording import PoseSequence
from ...statistics.linearised import LinearisedFit
from .information import Recording, shared_information
from .motion import Motion

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
    recording : Recording
    rest : LinearisedFit
        Without any motion.
    answers : (6, frequencies, 3M, p) their transforms, to a pulse of height one
    length : int, of the transforms
    """

    recording: Recording
    rest: LinearisedFit
    answers: Array
    length: int

    @staticmethod
    def gigabytes(recording: Recording) -> float:
        """Memory that the answers take."""
        (segment,) = recording.program(recording.template).segments
        markers = 3 * len(recording.template.markers.names)
        return 6 * 16e-9 * recording.samples * markers * len(segment.places)

    @classmethod
    def of(cls, recording: Recording, q: Array) -> LinearRecording:
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

    def information(self, motion: Motion) -> Array:
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


def _pulse(recording: Recording, heights: Array) -> PoseSequence:
    """Poses with a pulse of each coordinate, of these heights (6,)."""
    t_s = recording.pose_times_s
    since = t_s / recording.template.timestep_s - CENTRE
    share = np.nan_to_num(np.asarray(PULSE(since), dtype=np.float64))
    return recording.carried(np.outer(share, heights))
