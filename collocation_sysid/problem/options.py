"""How a problem's answer is checked and its error bars are found; and where it came from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..checked import Options, Positive, Text
from ..statistics.assumptions import CORRELATION_KEY, Assumptions
from ..statistics.shape_error import CORRELATION
from ..statistics.uncertainty import ErrorModel


@dataclass(frozen=True)
class RolloutOptions(Options):
    """The forward simulation that checks the answer.

    Attributes
    ----------
    integrator : {"newmark", "scheme"}
    timestep_s : float, optional
        Newmark's step; a quarter of the sample interval by default.
    """

    integrator: Literal["newmark", "scheme"] = "newmark"
    timestep_s: Positive | None = None


@dataclass(frozen=True)
class UncertaintyOptions(ErrorModel):
    """How the error bars are found.

    Attributes
    ----------
    profile : tuple of str
        List of the parameters whose profile likelihood is wanted.
    numerical : bool
        Solve again with half the step and on a finer mesh: the numerical error.
    assumptions : Assumptions
        How far off what is assumed may be.
    surface_correlation : float
        Correlation length of the error of the surface over the longest extent of the body.
    """

    profile: tuple[Text, ...] = ()
    numerical: bool = False
    assumptions: Assumptions = field(default_factory=Assumptions)
    surface_correlation: Positive = CORRELATION

    @property
    def considered(self) -> dict[str, float | None]:
        """Deviations of what is assumed by name, and the correlation length of the surface."""
        return self.assumptions.deviations | {CORRELATION_KEY: self.surface_correlation}


@dataclass(frozen=True)
class Origin:
    """Where a problem came from.

    Attributes
    ----------
    path : Path of the problem file
    text : str, the problem as run, with what was overridden
    files : tuple of Path, those it names
    """

    path: Path
    text: str = field(repr=False)
    files: tuple[Path, ...] = ()
