"""Methods that solve a `Collocation` and return a `Solution`, by name."""

from __future__ import annotations

from .continuation import STAGES, Continuation

METHODS: dict[str, type] = STAGES | {Continuation.name: Continuation}
