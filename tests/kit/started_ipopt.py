"""Interior point that starts IPOPT also where its conditions hold at the initial point.

Use it where a test is about the program that IPOPT gets: its lifted variables, matrices and options.
"""

from __future__ import annotations

from typing import Any

from collocation_sysid.methods.interior_point import InteriorPoint


def started_ipopt(**options: Any) -> InteriorPoint:
    """Interior point with these options, and one of IPOPT's own that changes nothing."""
    return InteriorPoint(**options, ipopt={"print_level": 0})
