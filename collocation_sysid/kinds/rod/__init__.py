"""Slender bodies: rods, cables and hoses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..kind import Kind

if TYPE_CHECKING:
    from ...recording.deviation import Deviation


class Rod(Kind):
    """Rods, cables and hoses."""

    @property
    def effects(self) -> tuple[Deviation, ...]:
        from .effects import ROWS

        return ROWS


KIND = Rod()
