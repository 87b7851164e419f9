"""Options of the uncertainties and of the check by forward simulation, and the origin of a
problem.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from ..common.validated_classes import validated
from ..common.validated_types import Flag, Positive, Text
from ..statistics.budget.systematic_effects import Assumptions, ExactIfNone
from ..statistics.uncertainty import ErrorModel


@validated
class RolloutOptions:
    """The forward simulation that checks the answer.

    Attributes
    ----------
    integrator : {"newmark", "scheme"}
        Newmark's method, or the scheme of the transcription.
    timestep_s : float, optional
        Time step of Newmark's method; a quarter of the sample interval by default.
    """

    integrator: Literal["newmark", "scheme"] = "newmark"
    timestep_s: Positive | None = None


@validated
class UncertaintyOptions(ErrorModel):
    """Intervals of the estimates.

    Attributes
    ----------
    profile : tuple of str
        List of the parameters whose profile likelihood is computed.
    numerical : bool
        Solve again with half the step and on a finer mesh, to estimate the discretisation error.
    assumptions : Assumptions
        Standard deviations of systematic effects, by name; "none" if all are exact, as for a
        simulated recording.
    """

    profile: tuple[Text, ...] = ()
    numerical: Flag = False
    assumptions: Annotated[Assumptions, ExactIfNone()] = field(default_factory=Assumptions)


@dataclass(frozen=True)
class Origin:
    """Problem file of a problem."""

    path: Path  # path of the problem file
    text: str = field(repr=False)  # text of the problem with the overrides that were applied
    files: tuple[Path, ...] = ()  # data files that the problem names
