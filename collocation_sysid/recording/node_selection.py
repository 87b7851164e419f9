"""Selections of mesh nodes: node indices, geometric selections, or tables in a problem file."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import model_validator

from ..common.array_types import Index
from ..common.checked_arrays import read_only_nodes
from ..common.schema_tables import ByForm, Corner, Section, Vector, require_one
from ..common.validated_types import NotNegative, Positive, StrictInteger, Text
from ..errors import InputError
from ..fem.meshes.selection import Along, Ball, Box, Face, FaceName, Indices, Named, Selection

if TYPE_CHECKING:
    from ..fem.body import Body


class NodesSection(Section):
    """A selection of mesh nodes, by exactly one of these keys.

    Attributes
    ----------
    s_m : list, optional
        First and last arc length [first, last] along a rod: the cross-sections between them.
    box_m : list, optional
        Lowest and highest corner [[x, y, z], [x, y, z]].
    ball_m : list, optional
        Centre and radius [[x, y, z], radius].
    indices : list of int, optional
        List of node indices as in the mesh file, counted from 0.
    face : str, optional
        "top", "bottom": nodes with the highest or lowest z of the body. "side_x", "side_y": nodes
        with the lowest x or y of the body, without those at the top and at the bottom.
    name : str, optional
        Name of a point array of the mesh that is 1 at the selected nodes, or of a physical group of
        elements of any dimension.
    """

    s_m: tuple[NotNegative, NotNegative] | None = None
    box_m: tuple[Corner, Corner] | None = None
    ball_m: tuple[Vector, Positive] | None = None
    face: FaceName | None = None
    indices: list[StrictInteger] | None = None
    name: Text | None = None

    @model_validator(mode="after")
    def _one(self) -> NodesSection:
        """Require exactly one key; a validation error for none or several."""
        require_one(self, *type(self).model_fields)
        return self


Nodes = Annotated[Text | NodesSection, ByForm(str)]


KINDS: dict[str, Any] = {
    "s_m": Along,
    "box_m": Box,
    "ball_m": Ball,
    "face": Face,
    "indices": Indices,
    "name": Named,
}


def selection_from_section(section: NodesSection | str) -> Selection:
    """Return the selection that a table in the problem file states; a text names a point array or
    physical group.
    """
    if isinstance(section, str):
        return Named(section)
    ((kind, value),) = ((KINDS[key], value) for key, value in section if value is not None)
    return kind(*value) if kind in (Along, Box, Ball) else kind(value)


def node_converter(what: str) -> Callable[[ArrayLike | Selection], Index]:
    """Return a converter to sorted distinct node indices; a `Selection` is returned unchanged.

    Parameters
    ----------
    what : str
        Owner of the nodes, for messages.

    Raises
    ------
    InputError
        By the converter: if there are no nodes, or as `read_only_nodes` does.
    """

    def chosen(selection: ArrayLike | Selection) -> Any:
        if isinstance(selection, Selection):
            return selection
        nodes = np.unique(read_only_nodes(selection, (None,), name=f"nodes of {what}"))
        if nodes.size == 0:
            raise InputError(f"{what} has an empty list of nodes; expected at least one node index")
        nodes.setflags(write=False)
        return nodes

    return chosen


def select_on_body(nodes: Index | Selection, body: Body) -> Index:
    """Return the nodes of a body that a selection selects, sorted; node indices are returned
    unchanged, without a check.

    Raises
    ------
    InputError
        If the selection has no nodes on this body.
    """
    return body.select(nodes) if isinstance(nodes, Selection) else nodes
