"""Message for a constant of an extension that a problem does not state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..fem.body import Body
from .property_check import PropertyCheck
from .small_problems import DENSITY_KG_M3, uneven_box, usual_constants


def check_missing_constant(check: PropertyCheck, values: Mapping[str, float], **laws: Any) -> None:
    """Require that values without the last constant of an extension are refused by its name.

    All other constants of a small box with the extension are stated.

    Parameters
    ----------
    values : mapping of name to float
        Constants of the extension; nothing is checked if there are none.
    **laws : object
        Arguments of `Body` that contain the extension.

    Raises
    ------
    AssertionError
        If the values are accepted, or the message lacks the name.
    """
    if not values:
        return
    body = Body(uneven_box(1), density_kg_m3=DENSITY_KG_M3, **laws)
    known = usual_constants(tuple(body.constants.values()), values)
    *_, missing = values
    del known[missing]
    check.require_refusal(
        lambda: body.theta_from_values(known),
        naming=missing,
        statement=f"a problem that does not state {missing}",
    )
