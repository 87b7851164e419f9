"""Where a search begins: the result of each module of this folder, and of starts from smaller
problems and earlier solutions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from ...common.array_types import Array
from ...fem.laws.constants import YOUNG
from ...model.parameters import Parameters
from ...program.collocation import Collocation
from ..options import SHARES

NO_GUESS = "no guess"


@dataclass(frozen=True, eq=False)
class ScanSummary:
    """Stiffnesses of a scan and their misfits, as in ``result.json``."""

    SERIALISED_PROPERTIES: ClassVar = ("sentence",)

    reason: str  # reason for the scan, the beginning of `sentence`
    # (k,): Young's moduli that were tried, ascending [Pa]. Moduli with a guess, and fixed ones,
    # kept their values.
    young_pa: Array
    # (k,): root mean square of the residuals of all measurements, in standard deviations; NaN where
    # the body could not be simulated.
    misfit: Array
    best: int  # index of the modulus that was chosen
    samples: int  # number of first samples that were compared, over all experiments
    time_s: float  # computing time [s]

    @property
    def sentence(self) -> str:
        """Summary of the scan for the user: its reason, the best modulus, the number of moduli and
        the time.
        """
        return (
            f"{self.reason}: started from E = {self.young_pa[self.best]:.3g} Pa after a scan of "
            f"{len(self.young_pa)} stiffnesses in {self.time_s:.2g} s"
            f"{beyond_default(self.young_pa[self.best])}"
        )


def beyond_default(young_pa: float) -> str:
    """Return an addition to a note if Young's modulus [Pa] is beyond its default bound, else ""."""
    if young_pa <= YOUNG.bounds[1]:
        return ""
    return f", beyond the default bound of {YOUNG.bounds[1]:.3g} Pa of soft bodies"


@dataclass(frozen=True, eq=False)
class Scan(ScanSummary):
    """Result of a scan of the stiffness, with parameters to start from."""

    parameters: Parameters  # parameters with the guesses to start from
    # mapping of int to Parameters: parameters with guesses by the index of a modulus, for `best`
    # and `others`.
    starts: Mapping[int, Parameters] = field(default_factory=dict)
    # Indices of other moduli that may lead to a better solution where there are local minima: those
    # next to the best, and other minima of the misfit, in ascending order of the misfit.
    others: tuple[int, ...] = ()
    share: float = SHARES[0]  # share of the motion that was compared


@dataclass(frozen=True, eq=False)
class Start:
    """Where a search begins."""

    collocation: Collocation  # program with guesses of all parameters
    # (variables,): z where the search begins; None where the method simulates the guesses.
    variables: Array | None = None
    # (constraints,): multipliers there, for a method that begins with them; None without.
    multipliers: Array | None = None
    note: str = ""  # what a person should know of the start; may be empty
    scan: Scan | None = None  # the scan that found the guesses
    # Program with the stated guesses, where the scan fits better; both are searched.
    stated: Collocation | None = None
