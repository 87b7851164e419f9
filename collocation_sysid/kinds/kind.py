"""What one kind of body, measurement or force contributes to each stage of an identification."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..recording.deviation import Deviation


class Kind:
    """Contributions of one kind; those of this base class are empty.

    A record imports a module of its room where a stage asks for it, so that every stage can ask.
    """

    @property
    def effects(self) -> tuple[Deviation, ...]:
        """Rows of the uncertainty budget that only this kind has."""
        return ()
