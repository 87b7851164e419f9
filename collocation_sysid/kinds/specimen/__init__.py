"""Homogeneous specimens: likely mistakes in their description (`doubts`), concerns in their terms
(`concerns`), notes on tests of one kind and on the zero of the load cell (`notes`).
"""

from __future__ import annotations

from ..kind import Kind, lazy


class Specimens(Kind):
    """Material tests of homogeneous specimens, without a mesh."""

    name = "specimen"
    declares = "HomogeneousDeformation"
    candidates = lazy(".doubts", "specimen_candidates")
    consistent = lazy(".doubts", "likelier_kinds")


KIND = Specimens()
