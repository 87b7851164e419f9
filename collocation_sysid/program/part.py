"""One experiment at a point of the program: its parameters, its motion, and what is looked at."""

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
    """One experiment at a point of the NLP.

    Attributes
    ----------
    segment : Segment
    q : (nq,) shared parameters
    phi : (k,) its nuisance parameters
    x : (N, 3n) positions [m], or its first rows
    brought : mapping
        Of what is carried, by number, what evaluations bring, where that does not follow from x.
    pressed : mapping
        Of contact as complementarity, by the number of the force, b (1, N, i), see `model.contact`,
        where that does not follow from x.
    given : mapping
        Of readings, by their numbers, what they look at where that does not follow from x.
    bent : bool
        Whether readings are, or taken as linear in second derivatives.
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
        """The physical parameters."""
        return self.segment.setting(self.q, self.phi)

    @cached_property
    def along(self) -> tuple[AnyHistory, ...]:
        """What the evaluations went through, of all that is carried."""
        dynamics = self.setting.dynamics
        pressed = dynamics.pressed(self.x, self.pressed)
        return (*dynamics.histories(self.x, self.brought), *pressed)

    @cached_property
    def sensing(self) -> Sensing:
        """What is looked at."""
        return Sensing(self.segment, self.setting, self.phi)

    @cached_property
    def motion(self) -> Motion:
        """What channels look at."""
        return self.sensing.motion(self.x, self.along)

    @cached_property
    def looked(self) -> list[Array]:
        """Of each reading what it looks at (n, e, 3)."""
        return [
            self.given[k] if k in self.given else reading.channel.values(self.motion, self.phi)
            for k, reading in enumerate(self.segment.readings)
        ]

    @property
    def sights(self) -> list[tuple[DepthReading, Array]]:
        """What depth cameras see, and of each what it looks at."""
        return self.surface_sights[: len(self.segment.depths)]

    @property
    def surface_sights(self) -> list[tuple[DepthReading, Array]]:
        """Readings of depth cameras, those of outlines behind, and of each what it looks at."""
        readings = (*self.segment.depths, *self.segment.outlines)
        return [*zip(readings, self.looked[len(self.looked) - len(readings) :], strict=True)]

    @property
    def outline_distances_px(self) -> list[tuple[OutlineReading, Array]]:
        """Readings of outlines, and distances (n,) of outline points from their edges [pixels]."""
        found = []
        for reading, looked in self.surface_sights[len(self.segment.depths) :]:
            assert isinstance(reading, OutlineReading)
            apart_px = reading.apart_px(looked, self.phi)
            found.append((reading, apart_px[np.isfinite(apart_px)]))
        return found

    @property
    def loss(self) -> float:
        """Of all readings, without priors."""
        pairs = zip(self.segment.readings, self.looked, strict=True)
        return sum(reading.loss(looked, self.phi) for reading, looked in pairs)

    @cached_property
    def loss_slopes(self) -> list[tuple[Array, Array]]:
        """Of each reading ∂loss by what it looks at (n, e, 3), and by its φ (k,)."""
        pairs = zip(self.segment.readings, self.looked, strict=True)
        return [reading.loss_slopes(looked, self.phi) for reading, looked in pairs]

    def gradient(self) -> tuple[Array, Array]:
        """∂loss/∂x (N, 3n) and ∂loss/∂(q, φ) (nq + k,), at what is given."""
        nq, phi = self.segment.nq, self.phi
        by_x, by_p, by_reaction = np.zeros_like(self.x), np.zeros(nq + len(phi)), None
        pairs = zip(self.segment.readings, self.loss_slopes, strict=True)
        for k, (reading, (by_looked, by_phi)) in enumerate(pairs):
            by_p[nq:] += by_phi
            if k not in self.given:
                pulled = reading.channel.pulled(self.motion, phi, by_looked)
                by_x, by_p[nq:] = by_x + pulled.by_x, by_p[nq:] + pulled.by_phi
                if pulled.by_reaction is not None:
                    by_reaction = pulled.by_reaction + (0.0 if by_reaction is None else by_reaction)
        if by_reaction is not None:
            through_x, through_p = self.sensing.pulled(self.x, by_reaction)
            by_x += through_x
            by_p[self.segment.moving] += through_p
        return by_x, by_p

    @cached_property
    def forces(self) -> Linearisation:
        """Those of the evaluations with their slopes, valid until others are formed."""
        rows = self.segment.linearisation_rows
        return self.setting.dynamics.linearise(self.x, rows, self.along)

    @property
    def residual_n(self) -> Array:
        """(N, free dofs) violation of the equations of motion in newtons."""
        return self.segment.residual_n(self.x, self.setting, self.along)
