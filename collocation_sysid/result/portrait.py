"""A body as it moved, coloured by what its material feels."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.figure import Figure

from ..arrays import Array
from ..errors import InputError, hint_at
from ..fem.body import Body
from .fields import ElementFields
from .pictures import shapes
from .pictures.shapes import Field
from .replay import Replay

FIELDS = {
    "von_mises_pa": "von Mises stress [Pa]",
    "energy_density_j_m3": "elastic energy [J/m³]",
    "det_f": "volume over undeformed, det F",
}
# More would be too small to tell anything.
MOST_SHAPES = 20


def portrait(
    replay: Replay, body: Body, constants: Mapping[str, float], field: str | None, count: int
) -> Figure:
    """Draw `count` of the replay's shapes, coloured by a field of its elements; see `FIELDS`.

    Without a field the parts of the body have colours of their own.

    Raises
    ------
    InputError
        For an unknown field, or for no shapes or too many.
    """
    if not 1 <= count <= MOST_SHAPES:
        raise InputError(f"count is {count}; expected 1 to {MOST_SHAPES} shapes")
    if field is not None and field not in FIELDS:
        expected = f"expected one of {', '.join(FIELDS)}{hint_at(field, list(FIELDS))}"
        raise InputError(f"no field {field!r}; {expected}")
    assert replay.shapes_m is not None  # it was chosen among those that have some
    return shapes(
        replay.t_s, replay.shapes_m, replay.surface, replay.held, replay.measured_m, replay.up,
        count, replay.surface_nodes, replay.surface_parts,
        None if field is None else _on_surface(body, constants, field),
    )  # fmt: skip


def _on_surface(body: Body, constants: Mapping[str, float], field: str) -> Field:
    elements, cells = ElementFields.of(body, body.theta(constants)), body.mesh.surface_cells

    def at(positions_m: Array) -> Array:
        return elements.at(positions_m)[field][:, cells]

    return Field(FIELDS[field], at)
