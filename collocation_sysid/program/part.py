"""One experiment at given variables of the nonlinear program: its parameters, motion and
observables.

Methods and statistics use a `Part` to evaluate the loss, its gradient and the forces at one
iterate; derived quantities are computed once and cached.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ..arrays import Array
from ..fem.body import Linearisation
from ..model.histories import AnyHistory
from ..model.setting import Setting
from .channel import Motion
from .depth import DepthReading
from .outline_reading import OutlineReading
from .segment import Segment
from .sensing import Sensing


@dataclass(frozen=True, eq=False)
class Part:
    """One experiment at given variables of the nonlinear program.

    Attributes
    ----------
    segment : Segment
        Transcription of the experiment.
    q : (nq,) array
        Shared parameters.
    phi : (k,) array
        Nuisance parameters of the experiment in units of their priors.
    x : (N, 3n) array
        Positions [m], or their first rows.
    brought : mapping of int to array
        History variables by the index of the history, where they are variables of the program;
        others follow from x.
    pressed : mapping of int to array
        Contact variables b (1, N, i) by the index of the force, where contact is a complementarity
        problem (see `model.contact`); others follow from x.
    given : mapping of int to array
        Observables by the index of the measurement, where they are variables of the program; others
        follow from x.
    bent : bool
        If false, neglect the curvature of the observations (Gauss–Newton).
    """

    segment: Segment
    q: Array
    phi: Array
    x: Array
    brought: Mapping[int, Array] = field(default_factory=dict)
    pressed: Mapping[int, Array] = field(default_factory=dict)
    given: Mapping[int, Array] = field(default_factory=dict)
    bent: bool = True

    @cached_property
    def setting(self) -> Setting:
        """Equations of motion at q and φ."""
        return self.segment.setting(self.q, self.phi)

    @cached_property
    def along(self) -> tuple[AnyHistory, ...]:
        """History variables of the body and of forces at all evaluations, followed by
        lifted contact pressures.
        """
        dynamics = self.setting.dynamics
        pressed = dynamics.pressed(self.x, self.pressed)
        return (*dynamics.histories(self.x, self.brought), *pressed)

    @cached_property
    def sensing(self) -> Sensing:
        """Evaluation of the observables of this experiment."""
        return Sensing(self.segment, self.setting, self.phi)

    @cached_property
    def motion(self) -> Motion:
        """Positions and reaction forces for the observables."""
        return self.sensing.motion(self.x, self.along)

    @cached_property
    def looked(self) -> list[Array]:
        """Observables (n, e, 3) of each measurement."""
        return [
            self.given[k] if k in self.given else reading.channel.values(self.motion, self.phi)
            for k, reading in enumerate(self.segment.readings)
        ]

    @property
    def sights(self) -> list[tuple[DepthReading, Array]]:
        """Measurement models of the depth cameras, each with its observables."""
        return self.surface_sights[: len(self.segment.depths)]

    @property
    def surface_sights(self) -> list[tuple[DepthReading, Array]]:
        """Measurement models of the depth cameras, then of the outlines, each with its
        observables.
        """
        readings = (*self.segment.depths, *self.segment.outlines)
        return [*zip(readings, self.looked[len(self.looked) - len(readings) :], strict=True)]

    @property
    def outline_distances_px(self) -> list[tuple[OutlineReading, Array]]:
        """Measurement models of the outlines, each with the distances (n,) of outline
        points from their edges [pixels].
        """
        distances = []
        for reading, looked in self.surface_sights[len(self.segment.depths) :]:
            assert isinstance(reading, OutlineReading)
            distances_px = reading.apart_px(looked, self.phi)
            distances.append((reading, distances_px[np.isfinite(distances_px)]))
        return distances

    @property
    def loss(self) -> float:
        """Loss of all measurements, without priors."""
        pairs = zip(self.segment.readings, self.looked, strict=True)
        return sum(reading.loss(looked, self.phi) for reading, looked in pairs)

    @cached_property
    def loss_slopes(self) -> list[tuple[Array, Array]]:
        """Gradient of the loss of each measurement by its observables (n, e, 3) and by φ (k,)."""
        pairs = zip(self.segment.readings, self.looked, strict=True)
        return [reading.loss_slopes(looked, self.phi) for reading, looked in pairs]

    def gradient(self) -> tuple[Array, Array]:
        """Return the gradient of the loss by x (N, 3n) [1/m] and by (q, φ) (nq + k,).

        Observables that are variables of the program (`given`) are treated as constant.
        """
        nq = self.segment.nq
        phi = self.phi
        by_x = np.zeros_like(self.x)
        by_p = np.zeros(nq + len(phi))
        by_reaction = None
        pairs = zip(self.segment.readings, self.loss_slopes, strict=True)
        for k, (reading, (by_looked, by_phi)) in enumerate(pairs):
            by_p[nq:] += by_phi
            if k not in self.given:
                products = reading.channel.pulled(self.motion, phi, by_looked)
                by_x = by_x + products.by_x
                by_p[nq:] = by_p[nq:] + products.by_phi
                if products.by_reaction is not None:
                    by_reaction = products.by_reaction + (
                        0.0 if by_reaction is None else by_reaction
                    )
        if by_reaction is not None:
            through_x, through_p = self.sensing.pulled(self.x, by_reaction)
            by_x += through_x
            by_p[self.segment.moving] += through_p
        return by_x, by_p

    @cached_property
    def forces(self) -> Linearisation:
        """Forces at the evaluations with their derivatives; valid until the segment
        linearises again.
        """
        rows = self.segment.linearisation_rows
        return self.setting.dynamics.linearise(self.x, rows, self.along)

    @property
    def residual_n(self) -> Array:
        """Violation of the equations of motion (N, free dofs) [N]."""
        return self.segment.residual_n(self.x, self.setting, self.along)
