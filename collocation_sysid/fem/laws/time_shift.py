"""Time–temperature superposition: relaxation times at another temperature.

At a temperature T all relaxation times are a_T times those of the parameters. The factor is free, or
that of Williams, Landel & Ferry (1955), log₁₀ a_T = −C₁ ΔT / (C₂ + ΔT) with the difference ΔT from
the temperature of the parameters. The stiffness is the same (no vertical shift).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from ...errors import InputError
from .constants import LOG_SHIFT, WLF_C1, WLF_C2, Constant


@dataclass(frozen=True)
class TimeShift:
    """Factor a_T on the relaxation times of a part of a body."""

    # Prefix of the parameter with the logarithm of a free factor, such as ``warm.log10_shift``; ""
    # for the factor of Williams, Landel & Ferry.
    name: str = ""
    difference_k: float = 0.0  # temperature, less that of the parameters [K], if there is no name

    @property
    def constants(self) -> dict[str, Constant]:
        """Parameters on which the factor depends, by name."""
        if self.name:
            return {f"{self.name}.{LOG_SHIFT.name}": LOG_SHIFT}
        return {WLF_C1.name: WLF_C1, WLF_C2.name: WLF_C2}

    def require_names(self, names: Collection[str]) -> None:
        """Raise an `InputError` unless its parameters are among the names."""
        if missing := [name for name in self.constants if name not in names]:
            raise InputError(
                f"{missing[0]} is missing, by which the relaxation times of a specimen are shifted; "
                f"write {missing[0]} = {{}} to estimate it (in Python cs.Unknown()), or a number",
                None,
                where=missing[0],
            )

    def factor(self, values: Mapping[str, Any]) -> Any:
        """Return a_T, a number or an expression, from parameters by name."""
        own = [values[name] for name in self.constants]
        if self.name:
            return 10 ** own[0]
        return 10 ** (-own[0] * self.difference_k / (own[1] + self.difference_k))
