"""Slender bodies: rods, cables and hoses."""

from __future__ import annotations

from ..kind import Kind, lazy

MESSAGES = {
    "description/several/mirror": "a mirror image of the rod fits as well, with {found} instead of "
    "{stated}, so that the data do not determine which: state one of these natural curvatures, or "
    "measure a marker across the plane of the others"
}


class Rod(Kind):
    """Rods, cables and hoses."""

    name = "rod"
    is_solid = False
    given_stresses = lazy(".stresses", "GivenStresses")
    buckles = (
        "the body loses its stability: it buckles between its grasps or under its weight. State "
        "object.centreline in the shape at the beginning of the recording, or a stiffer guess"
    )
    place_dimension = 1
    places_in_images = ("along the rod",)
    association = lazy(".association", "CentrelineAssociation")
    nearest_place = lazy(".element", "nearest_place")
    refined = lazy(".element", "refined")
    directions_beyond = lazy(".element", "directions_beyond_clamps")
    effects = lazy(".effects", "ROWS")
    other_effects = lazy(".effects", "OTHERS")
    doubts = lazy(".doubts", "ROWS")
    consistent = lazy(".doubts", "mirror_images")
    messages = MESSAGES


KIND = Rod()
