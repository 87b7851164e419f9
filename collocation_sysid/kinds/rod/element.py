"""Slender bodies: rods, cables and hoses, as elements between cross-sections that stay rigid.

A cross-section has three nodes on an ellipse around its centre r, at 120°:

    p_j = r + h₁ cos φ_j d₁ + h₂ sin φ_j d₂,

so that r and the directors d₁, d₂ are linear in the positions of the nodes. With h₁² = 2 I₂/A and
h₂² = 2 I₁/A three equal masses have the inertia of the section, in translation and in rotation; I₁
and I₂ are the second moments of area about d₁ and d₂.

An element is the part between two sections. Its one point, in the middle, has the gradient
G = (d₁, d₂, r′, d₁′, d₂′) of 3 × 5 numbers: means of the directors, and differences over the length
ℓ. With d₃ the unit vector along d₁ × d₂ the strains are those of Simo and Reissner,

    Γ = (d₁·r′, d₂·r′, d₃·r′ − 1),   κ = (d₃·d₂′, −d₃·d₁′, ½ (d₂·d₁′ − d₁·d₂′)),

less those of the rest shape and of natural curvature. They do not change with a rigid rotation and
do not depend on the path, because they follow from interpolated directors (Betsch & Steinmann 2002;
Romero 2004). The energy per length is ½ (GA (Γ₁² + Γ₂²) + EA Γ₃² + EI₁ κ₁² + EI₂ κ₂² + GJ κ₃²) and
the energy of the strain of both sections, with `SECTION_STIFFNESS`, which keeps them rigid.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, cached_property, lru_cache
from itertools import pairwise
from typing import Any, Literal

import casadi as ca
import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from ...common.array_types import Array, Index
from ...common.checked_arrays import read_only_floats
from ...common.validated_classes import validated
from ...common.validated_types import Positive
from ...errors import InputError
from ...fem.elements import ROD, Element
from ...fem.laws.constants import (
    AXIAL,
    BENDING,
    NATURAL_ENDS,
    NATURAL_STRAINS,
    POISSON,
    TORSION,
    YOUNG,
    Constant,
    NaturalCurvature,
)
from ...fem.laws.materials import StrainMaterial
from ...fem.meshes.mesh import ElementNodes, TetMesh
from . import KIND

# Stiffness of a section against changes of its shape, in units of EA. A moment M stretches directors
# by about EI κ²/(10 EA), 0.01 % where the radius of curvature is 20 times that of the section.
SECTION_STIFFNESS = 10.0
# Part of the length of a rod by which a place may be beyond its end: a curve through measured points
# is no longer known.
KNOWN_LENGTH = 5e-3
# Angle by which a rod that was not stated to be straight may be bent by itself [rad].
ROD_CURVATURE = 0.5
_ANGLES = 2 * np.pi / 3 * np.arange(3)
# Centre and directors of a section from its nodes: rows for r, h₁ d₁ and h₂ d₂.
_DIRECTORS = np.stack([np.full(3, 1 / 3), 2 / 3 * np.cos(_ANGLES), 2 / 3 * np.sin(_ANGLES)])
# Of the rest shape a point has half the length of its element, the share of the length of its region
# that is before it, then the strains.
COLUMNS, STRAINS = ROD.columns, ROD.rest_values - 2
RESULTANTS = ROD.stresses  # with those of both sections


@validated
class CrossSection:
    """Cross-section of a rod, with directors d₁ and d₂ along its principal axes."""

    area_m2: Positive
    # Second moments of area (∫X₂², ∫X₁²) about d₁ and d₂ [m⁴].
    moments_m4: tuple[Positive, Positive]
    torsion_m4: Positive  # J of the torsional stiffness G J
    extent_m: tuple[Positive, Positive]  # half widths along d₁ and d₂

    @classmethod
    @validated
    def round(cls, diameter_m: Positive, inner_m: float = 0.0) -> CrossSection:
        """Return a circle, or a ring with an inner diameter.

        Raises
        ------
        InputError
            If the inner diameter is not smaller than the diameter.
        """
        if not 0 <= inner_m < diameter_m:
            raise InputError(
                f"found {inner_m:g}; expected a number from 0 to below the diameter, {diameter_m:g}",
                where="inner_m",
            )
        moment = np.pi * (diameter_m**4 - inner_m**4) / 64
        area = np.pi * (diameter_m**2 - inner_m**2) / 4
        return cls(area, (moment, moment), 2 * moment, (diameter_m / 2, diameter_m / 2))

    @classmethod
    @validated
    def rectangle(cls, width_m: Positive, height_m: Positive) -> CrossSection:
        """Return a rectangle with its width along d₁ and its height along d₂.

        The torsion constant is the approximation of Young & Budynas (2002), table 10.1, whose error
        is below 4 %.
        """
        b, a = sorted((width_m / 2, height_m / 2))
        torsion = a * b**3 * (16 / 3 - 3.36 * b / a * (1 - b**4 / (12 * a**4)))
        moments = width_m * height_m**3 / 12, height_m * width_m**3 / 12
        return cls(width_m * height_m, moments, torsion, (width_m / 2, height_m / 2))

    def scaled(self, factor: float) -> CrossSection:
        """Return the section with all lengths multiplied by a factor."""
        first, second = self.moments_m4
        return CrossSection(
            self.area_m2 * factor**2,
            (first * factor**4, second * factor**4),
            self.torsion_m4 * factor**4,
            (self.extent_m[0] * factor, self.extent_m[1] * factor),
        )

    @property
    def perimeter_m(self) -> float:
        """Perimeter of the ellipse of `extent_m` (Ramanujan) or of the rectangle."""
        a, b = self.extent_m
        if self.area_m2 > 3.9 * a * b:
            return 4 * (a + b)
        return float(np.pi * (3 * (a + b) - np.sqrt((3 * a + b) * (a + 3 * b))))

    @property
    def node_radii_m(self) -> tuple[float, float]:
        """Half axes h₁ and h₂ of the ellipse with the nodes."""
        about_1, about_2 = self.moments_m4
        return float(np.sqrt(2 * about_2 / self.area_m2)), float(
            np.sqrt(2 * about_1 / self.area_m2)
        )


class RodMesh(TetMesh):
    """Cross-sections along a centreline, with three nodes each.

    The tetrahedra divide the triangular prisms between the sections, three in each; they serve
    selections and pictures. Their volumes are those of the rod.

    Attributes
    ----------
    section : CrossSection
    s_m : (N,)
        Arc length of each section, from zero [m].
    is_straight_at_rest : bool
        Whether the rod is straight without stress, whatever the positions of its nodes.
    """

    kind = KIND
    section: CrossSection
    s_m: Array
    is_straight_at_rest: bool

    def __init__(
        self, nodes_m: Array, s_m: Array, section: CrossSection, is_straight_at_rest: bool = False
    ) -> None:
        first = 3 * np.arange(len(s_m) - 1)[:, None, None]
        prism = np.array([[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]])
        super().__init__(nodes_m, (first + prism).reshape(-1, 4), is_generated=True)
        self._set(section=section, s_m=s_m, is_straight_at_rest=is_straight_at_rest)

    def __repr__(self) -> str:
        return f"RodMesh({len(self.s_m)} sections, {self.s_m[-1]:g} m)"

    @cached_property
    def volumes_m3(self) -> Array:
        """Volume of each tetrahedron (3 (N − 1),): a third of the rod between two sections [m³]."""
        return np.repeat(self.section.area_m2 * self.lengths_m / 3, 3)

    @property
    def extents_m(self) -> tuple[float, float, float]:
        first, second = self.section.extent_m
        return float(self.s_m[-1]), 2 * first, 2 * second

    @property
    def arc_lengths_m(self) -> Array:
        return np.repeat(self.s_m, 3)

    def place_m(self, s_m: float) -> Array:
        """Return the point (3,) [m] of the centreline at an arc length, between sections by linear
        interpolation.

        Raises
        ------
        InputError
            If the arc length is not on the rod, whose end is known to `KNOWN_LENGTH`.
        """
        if not 0 <= s_m <= self.s_m[-1] * (1 + KNOWN_LENGTH):
            raise InputError(
                f"found the arc length {s_m:g} m; expected 0 to {self.s_m[-1]:g} m, the length of the "
                "rod"
            )
        return self.places_m(np.array([s_m]))[0]

    def places_m(self, s_m: Array) -> Array:
        """Return the points (M, 3) [m] of the centreline at arc lengths (M,), see `place_m`."""
        centres = self.centres_of_sections_m
        return np.stack([np.interp(s_m, self.s_m, axis) for axis in centres.T], axis=1)

    def nearest_s_m(self, points_m: Array) -> Array:
        """Return the arc length (M,) [m] of the point of the centreline nearest to each of (M, 3)."""
        centres = self.centres_of_sections_m
        elements, shares = nearest_on_centreline(centres, points_m)
        return self.s_m[elements] + shares * np.diff(self.s_m)[elements]

    def elements_at(self, s_m: Array) -> Index:
        """Return the element (M,) at each arc length (M,) [m]."""
        return np.searchsorted(self.s_m[1:-1], s_m, side="right")

    def smooth_interpolation(
        self, s_m: Array, elements: Index
    ) -> tuple[Index, Array, Array, Array]:
        """Return the sections (M, 4) near elements (M,), and the weights (M, 4) of their positions
        at arc lengths (M,) [m] with their first and second derivatives.

        Weights are cubic, with the slopes of parabolas through three sections; beyond the element
        they are linear.
        """
        size = min(4, len(self.s_m))
        first = np.clip(elements - 1, 0, len(self.s_m) - size)
        sections = first[:, None] + np.arange(size)
        inside = np.clip(s_m, self.s_m[elements], self.s_m[elements + 1])
        value, slope, curvature = (
            np.take_along_axis(self._weights(inside, order), sections, axis=1) for order in range(3)
        )
        beyond = (s_m - inside)[:, None]
        return sections, value + beyond * slope, slope, np.where(beyond == 0, curvature, 0.0)

    @cached_property
    def _weights(self) -> scipy.interpolate.CubicHermiteSpline:
        of_sections = np.eye(len(self.s_m))
        slopes = np.gradient(of_sections, self.s_m, axis=0, edge_order=2)
        return scipy.interpolate.CubicHermiteSpline(self.s_m, of_sections, slopes)

    @property
    def centres_of_sections_m(self) -> Array:
        """Centre of each section (N, 3) [m]."""
        return centres_of_sections(self.points_m)

    @property
    def lengths_m(self) -> Array:
        """Distances of neighbouring sections (N − 1,) [m]."""
        lengths: Array = np.linalg.norm(np.diff(self.centres_of_sections_m, axis=0), axis=1)
        return lengths

    def nodes_of(self, element: Element) -> ElementNodes:
        """Return the nodes (N − 1, 6) of each element: those of two sections."""
        cells = 3 * np.arange(len(self.s_m) - 1)[:, None] + np.arange(6)
        return ElementNodes(self, self.points_m, cells=cells, ends=np.empty((0, 2), dtype=np.int64))

    def geometry(self, nodes: ElementNodes, element: Element, parts: Sequence[Index]) -> Array:
        shares = np.empty(len(nodes.cells))
        for cells in parts:
            first, last = self.s_m[cells.min()], self.s_m[cells.max() + 1]
            middles = (self.s_m[cells] + self.s_m[cells + 1]) / 2
            shares[cells] = (middles - first) / (last - first)
        return self._geometry(nodes.points_m, nodes.cells, shares)

    def gradients(self, points_m: Array, cells: Index) -> tuple[Array, Array]:
        geometry = self._geometry(points_m, cells, np.zeros(len(cells)))[:, 0]
        slopes = geometry[:, : 6 * COLUMNS].reshape(len(cells), 6, COLUMNS)
        return slopes.swapaxes(1, 2), 2 * geometry[:, 6 * COLUMNS]

    def geometry_at(self, positions_m: Array, cells: Index, geometry: Array) -> Array:
        return self._geometry(positions_m, cells, geometry[:, 0, -2 - STRAINS])

    def _geometry(self, positions_m: Array, cells: Index, shares: Array) -> Array:
        """Return the geometry, see `rod_geometry`, with nodes (n, 3) at any positions [m]."""
        straight_m = None
        if self.is_straight_at_rest:
            centres = centres_of_sections(positions_m)
            changed = np.linalg.norm(np.diff(centres, axis=0), axis=1) / self.lengths_m
            straight_m = np.diff(self.s_m) * changed
        return rod_geometry(positions_m, cells, self.section.area_m2, shares, straight_m)

    def partly_straightened(self, cells: Index, geometry: Array, share: float) -> Array:
        if share == 1 or not self.is_straight_at_rest:
            return geometry
        slopes = geometry[..., : 6 * COLUMNS].reshape(len(cells), -1, COLUMNS)
        strains = _strains_of_shape(self.points_m[cells], slopes)[:, None]
        straightened = geometry.copy()
        straightened[..., -1 - STRAINS : -1] += (1 - share) * strains
        return straightened

    def element_and_law(
        self, element: str, material: object, natural_curvature: NaturalCurvature
    ) -> tuple[Element, RodMaterial]:
        """Return the element of rods and the law; that of `Body`'s default is "rod".

        Raises
        ------
        InputError
            For any other material.
        """
        name = "rod" if material == "neo-hookean" else getattr(material, "name", material)
        if name not in ("rod", "cable"):
            raise InputError(
                f"found {material!r}; expected 'rod' (E and ν) or 'cable' (EI, GJ and EA), the laws of "
                "slender bodies",
                where="material",
            )
        return ROD, rod_material(name, self.section, natural_curvature)

    @property
    def places_in_refined(self) -> Index:
        return (6 * np.arange(len(self.s_m))[:, None] + np.arange(3)).ravel()

    def refined_mask(self, is_held: NDArray[np.bool_]) -> NDArray[np.bool_]:
        held = is_held.reshape(-1, 3)
        fine = np.zeros((2 * len(held) - 1, 3), dtype=bool)
        fine[::2] = held
        fine[1::2] = held[1:] & held[:-1]
        return fine.ravel()

    @property
    def surface_factor(self) -> float:
        corners = self.points_m[:3]
        around = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum()
        return self.section.perimeter_m / float(around)

    @property
    def cell_of_tetrahedra(self) -> Index:
        return np.arange(len(self.tetrahedra)) // 3


@validated
def rod_mesh(
    centreline_m: ArrayLike,
    section: CrossSection,
    sections: int = 31,
    stations_m: Sequence[float] = (),
    first_director: ArrayLike | None = None,
    is_straight_at_rest: bool = False,
) -> RodMesh:
    """Return the sections of a rod along a smooth curve, without twist at rest.

    Parameters
    ----------
    centreline_m : (k, 3)
        Two or more points of the centreline; a spline leads through them.
    section : CrossSection
    sections : int
        Desired number of sections.
    stations_m : sequence of float
        Arc lengths that have a section in any case, such as the end of a clamp.
    first_director : (3,), optional
        Direction of d₁ at the beginning, of which the part across the rod is used. By default the
        axis of coordinates that is most nearly perpendicular to the rod.
    is_straight_at_rest : bool
        Whether the centreline is a shape under load of a rod that is straight without stress.

    Raises
    ------
    InputError
        If points are too few or coincide, or a station is outside the rod.
    """
    points = read_only_floats(centreline_m, (None, 3), name="centreline_m")
    if len(points) < 2:
        raise InputError("found one point; expected two or more", where="centreline_m")
    if first_director is not None:
        first_director = read_only_floats(first_director, (3,), name="first_director")
    if sections < 3:
        raise InputError(f"found {sections}; expected at least 3", where="sections")
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if not steps_m.min() > 0:
        raise InputError("found two equal points one after another", where="centreline_m")
    chords = np.diff(points, axis=0) / steps_m[:, None]
    cosines = np.sum(chords[1:] * chords[:-1], axis=1)
    if cosines.min(initial=1.0) < -1e-9:
        raise InputError(
            f"found a turn of {np.degrees(np.arccos(max(cosines.min(), -1.0))):.0f}° at point "
            f"{np.argmin(cosines) + 2}; expected at most 90°: more points where the rod bends",
            where="centreline_m",
        )
    curve, s_known = _by_arc_length(points, steps_m)
    s_m = _stations(float(s_known[-1]), sections, stations_m)
    tangents = curve(s_m, 1)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    directors = _without_twist(tangents, first_director)
    radii = section.node_radii_m
    offsets = np.cos(_ANGLES)[:, None] * radii[0] * directors[:, None]
    second = np.cross(tangents, directors)
    offsets = offsets + np.sin(_ANGLES)[:, None] * radii[1] * second[:, None]
    nodes_m = (curve(s_m)[:, None] + offsets).reshape(-1, 3)
    return RodMesh(nodes_m, s_m, section, is_straight_at_rest=is_straight_at_rest)


def rod_geometry(
    points_m: Array,
    cells: Index,
    area_m2: float,
    shares: Array,
    straight_lengths_m: Array | None = None,
) -> Array:
    """Return the shape gradients of G, half the length, the share of the region before it, the
    strains at rest and the volume of each element (E, 1, 6 · 5 + 2 + 6 + 1).

    Parameters
    ----------
    points_m : (n, 3)
        Positions of the nodes at rest.
    cells : (E, 6)
    area_m2 : float
        Area of the section.
    shares : (E,)
        Share of the length of the region before the middle of each element.
    straight_lengths_m : (E,), optional
        Lengths of the elements of a rod that is straight at rest, if its nodes are not.
    """
    ends = points_m[cells].reshape(-1, 2, 3, 3)
    scaled = np.einsum("kj,esji->eski", _DIRECTORS, ends)
    lengths = np.linalg.norm(scaled[:, 1, 0] - scaled[:, 0, 0], axis=1)
    if straight_lengths_m is not None:
        lengths = straight_lengths_m
    radii = np.linalg.norm(scaled[:, :, 1:], axis=3)
    ones = np.ones((len(cells), 2, 1))
    own = _DIRECTORS / np.concatenate([ones, radii], axis=2)[..., None]
    gradients = np.zeros((len(cells), 6, COLUMNS))
    for end, sign in ((0, -1.0), (1, 1.0)):
        nodes = slice(3 * end, 3 * end + 3)
        gradients[:, nodes, :2] = own[:, end, 1:].swapaxes(1, 2) / 2
        gradients[:, nodes, 2:] = sign * own[:, end].swapaxes(1, 2) / lengths[:, None, None]
    strains = np.zeros((len(cells), STRAINS))
    if straight_lengths_m is None:
        strains = _strains_of_shape(points_m[cells], gradients)
    volumes = (area_m2 * lengths)[:, None]
    places = np.stack([lengths / 2, shares], axis=1)
    return np.hstack([gradients.reshape(len(cells), -1), places, strains, volumes])[:, None]


def _strains_of_shape(ends_m: Array, gradients: Array) -> Array:
    G = np.einsum("eai,eac->eic", ends_m, gradients)
    return np.array([_strain_function()(each).full().ravel() for each in G]).reshape(-1, STRAINS)


def directions_beyond_clamps(mesh: RodMesh, is_held: NDArray[np.bool_]) -> Array:
    """Return unit vectors (n, 3) at the nodes of the last held section beside each free one,
    along the centreline into the clamp, from a mask (n,) of held nodes; zero elsewhere.
    """
    held: NDArray[np.bool_] = np.asarray(is_held.reshape(-1, 3).all(axis=1))
    centres = mesh.centres_of_sections_m
    directions = np.zeros((len(held), 3, 3))
    for k in np.flatnonzero(held[1:] != held[:-1]):
        clamp, free = (k, k + 1) if held[k] else (k + 1, k)
        into = centres[clamp] - centres[free]
        directions[clamp] = into / np.linalg.norm(into)
    return directions.reshape(-1, 3)


def refined(mesh: RodMesh) -> RodMesh:
    """Return the mesh with a section in the middle between each two."""
    between = midpoint_interpolation(mesh.s_m)
    sections = between @ mesh.points_m.reshape(len(mesh.s_m), -1)
    return RodMesh(
        sections.reshape(-1, 3), between @ mesh.s_m, mesh.section, mesh.is_straight_at_rest
    )


def midpoint_interpolation(s_m: Array) -> Array:
    """Return weights (2 N − 1, N) that give values at N sections and in the middle between each two,
    there by polynomials through the four nearest sections, at arc lengths (N,) [m].
    """
    count = len(s_m)
    weights = np.zeros((2 * count - 1, count))
    weights[::2] = np.eye(count)
    size = min(4, count)
    for k in range(count - 1):
        near = min(max(k - 1, 0), count - size) + np.arange(size)
        middle = (s_m[k] + s_m[k + 1]) / 2
        differences = s_m[near][:, None] - s_m[near]
        np.fill_diagonal(differences, 1.0)
        away = np.tile(middle - s_m[near], (size, 1))
        np.fill_diagonal(away, 1.0)
        weights[2 * k + 1, near] = np.prod(away / differences, axis=1)
    return weights


def centres_of_sections(nodes_m: Array) -> Array:
    """Return the centre (…, N, 3) of each section, from positions of the nodes (…, 3 N, 3)."""
    centres: Array = nodes_m.reshape(*nodes_m.shape[:-2], -1, 3, 3).mean(axis=-2)
    return centres


def nearest_on_centreline(centres_m: Array, points_m: Array) -> tuple[Index, Array]:
    """Return the elements (M,) that are nearest to points (M, 3), and the share (M,) of each at the
    nearest point, from the centres (N, 3) of sections.
    """
    steps = np.diff(centres_m, axis=0)
    away = points_m[:, None] - centres_m[:-1]
    shares = np.clip(np.sum(away * steps, axis=2) / np.sum(steps**2, axis=1), 0.0, 1.0)
    nearest = np.linalg.norm(away - shares[..., None] * steps, axis=2).argmin(axis=1)
    return nearest, shares[np.arange(len(points_m)), nearest]


def nearest_place(nodes_m: Array, point: Array) -> tuple[Array, Array]:
    """Return the point (3,) of the centreline nearest to a point (3,), and its tangent (3, 1)."""
    centres = centres_of_sections(nodes_m)
    (k,), (share,) = nearest_on_centreline(centres, point[None])
    step = centres[k + 1] - centres[k]
    return centres[k] + share * step, (step / np.linalg.norm(step))[:, None]


def frames_of_sections(nodes_m: Array) -> tuple[Array, Array]:
    """Return the centre (N, 3) of each section, and its frame (N, 3, 3) with the columns d₃, d₁ and
    d₂, from positions of the nodes (3 N, 3).
    """
    centres, first, second = np.einsum("kj,sji->ksi", _DIRECTORS, nodes_m.reshape(-1, 3, 3))
    d1 = first / np.linalg.norm(first, axis=1)[:, None]
    normal = np.cross(first, second)
    d3 = normal / np.linalg.norm(normal, axis=1)[:, None]
    return centres, np.stack([d3, d1, np.cross(d3, d1)], axis=2)


def strains_of(G: ca.SX) -> ca.SX:
    """Return (Γ, κ) (6,) at a gradient G (3, 5), without those of the rest shape."""
    d1, d2, slope, d1_slope, d2_slope = ca.horzsplit(G)
    normal = ca.cross(d1, d2)
    area = ca.norm_2(normal)
    d3 = normal / area
    return ca.vertcat(
        ca.dot(d1, slope),
        ca.dot(d2, slope),
        ca.dot(d3, slope) - 1,
        ca.dot(d3, d2_slope),
        -ca.dot(d3, d1_slope),
        # Directors in the middle of an element that is twisted by φ have the length cos(φ/2), and
        # sin φ/cos(φ/2)^(4/3) is φ up to fourth order.
        (ca.dot(d2, d1_slope) - ca.dot(d1, d2_slope)) / (2 * area ** (2 / 3)),
    )


def strains_with_sections(G: ca.SX, half_m: ca.SX) -> ca.SX:
    """Return (Γ, κ) at a gradient G (3, 5), then Green's strains of both sections (12,), at half the
    length of the element.
    """
    d1, d2, _, d1_slope, d2_slope = ca.horzsplit(G)
    strain = strains_of(G)
    for offset in (-half_m, half_m):
        first, second = d1 + offset * d1_slope, d2 + offset * d2_slope
        own = ca.vertcat(
            ca.dot(first, first) - 1, ca.dot(second, second) - 1, ca.dot(first, second)
        )
        strain = ca.vertcat(strain, own / 2)
    return strain


@cache
def _strain_function() -> ca.Function:
    G = ca.SX.sym("G", 3, COLUMNS)
    return ca.Function("strains", [G], [strains_of(G)])


RodLaw = Literal["rod", "cable"]
# Constants of each law.
LAWS: dict[str, tuple[Constant, ...]] = {
    "rod": (YOUNG, POISSON),
    "cable": (BENDING, TORSION, AXIAL),
}


class RodMaterial(StrainMaterial):
    """Law of a rod of one section.

    Parameters
    ----------
    law : {"rod", "cable"}
        "rod": Young's modulus and Poisson's ratio of a homogeneous section; "cable": bending,
        torsional and axial stiffness of a composite one, equal about both axes.
    section : CrossSection
    natural_curvature : bool or "affine"
        Whether natural curvature and twist, uniform along the rod or affine in the arc length of a
        region, are constants beside the rest shape.
    """

    section: CrossSection
    natural_curvature: NaturalCurvature

    def __init__(
        self, law: RodLaw, section: CrossSection, natural_curvature: NaturalCurvature = False
    ) -> None:
        constants = LAWS[law] + (NATURAL_STRAINS if natural_curvature else ())
        constants += NATURAL_ENDS if natural_curvature == "affine" else ()
        for name, value in (
            ("name", law),
            ("energy", strains_of),
            ("constants", constants),
            ("section", section),
            ("natural_curvature", natural_curvature),
        ):
            object.__setattr__(self, name, value)

    def psi(self, F: ca.SX, values: ca.SX) -> ca.SX:
        """Return the energy per volume [J/m³] at G (3, 5), from the constants, then half the
        length, the share before it, the strains at rest (6,) and the volume of the element.
        """
        stiffness, strain = self._all_strains(F, values)
        return ca.dot(stiffness, strain**2) / (2 * self.section.area_m2)

    def viscous_stress(
        self, F: ca.SX, rate: ca.SX, values: ca.SX, gamma_r_s: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """Return the stress (15,) of Kelvin–Voigt damping, γ_r times the stiffness and the rates of
        the strains, and its derivative (15, 15) by G stacked (15,).
        """
        slopes = ca.jacobian(self._strain(ca.reshape(F, 3, COLUMNS), values), F)
        viscosity = gamma_r_s * ca.diag(self._stiffness(values)) / self.section.area_m2
        stress = slopes.T @ viscosity @ slopes @ rate
        return stress, ca.jacobian(stress, F)

    def resultants(
        self, F: ca.SX, rate: ca.SX, values: ca.SX, gamma_r_s: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """Return strains at G (3, 5), with those of both sections (12,), and the elastic stresses
        per volume that are conjugate to them, with the viscous ones at the rate (15,).
        """
        G = ca.SX.sym("G", 3, COLUMNS)
        stiffness, strain = self._all_strains(G, values)
        damped = ca.vertcat(ca.jtimes(strain[:STRAINS], ca.vec(G), rate), ca.SX(STRAINS, 1))
        stress = stiffness * (strain + gamma_r_s * damped) / self.section.area_m2
        strain, stress = ca.substitute([strain, stress], [G], [F])
        return strain, stress

    @cached_property
    def lame(self) -> ca.Function:
        values = ca.SX.sym("values", len(self.constants))
        stiffness = self._stiffness(values)
        shear = stiffness[5] / self.section.torsion_m4
        young = stiffness[3] / self.section.moments_m4[0]
        return ca.Function(
            "lame", [values], [ca.vertcat(shear * (young - 2 * shear) / (3 * shear - young), shear)]
        )

    def stiffness(self, values: Sequence[float]) -> Array:
        """Return GA, GA, EA, EI₁, EI₂ and GJ (6,) from the constants (c,)."""
        return self.all_stiffnesses(values)[:STRAINS]

    def all_stiffnesses(self, values: Sequence[float]) -> Array:
        """Return them with those of both sections (12,)."""
        return np.array(ca.evalf(self._all_stiffnesses(ca.SX(ca.DM(list(values)))))).ravel()

    def natural_strains(self, values: Any, share: Any) -> Any:
        """Return the natural curvatures and twist (3,) [1/m] after a share of the length, from the
        constants (c,); numbers, or CasADi expressions.
        """
        own = values[len(LAWS[self.name]) : len(self.constants)]
        return own[:3] + share * (own[-3:] - own[:3])

    def _stiffness(self, values: ca.SX) -> ca.SX:
        """Return (GA, GA, EA, EI₁, EI₂, GJ)."""
        about_1, about_2 = self.section.moments_m4
        if self.name == "cable":
            bending, torsion, axial = ca.vertsplit(values[:3])
            shear = axial / 2.6
            return ca.vertcat(shear, shear, axial, bending, bending, torsion)
        young, poisson = values[0], values[1]
        shear = young / (2 * (1 + poisson))
        area = self.section.area_m2
        return ca.vertcat(
            shear * area,
            shear * area,
            young * area,
            young * about_1,
            young * about_2,
            shear * self.section.torsion_m4,
        )

    def _all_strains(self, G: ca.SX, values: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return the stiffnesses (12,) and strains (12,) whose energy per length is ½ Σ stiffness ·
        strain²: those of the rod, then Green's strains of both sections.
        """
        half = values[len(self.constants)]  # not from the volume, by which stiffness is scaled
        of_sections = strains_with_sections(G, half)[STRAINS:]
        return self._all_stiffnesses(values), ca.vertcat(self._strain(G, values), of_sections)

    def _all_stiffnesses(self, values: ca.SX) -> ca.SX:
        stiffness = self._stiffness(values)
        section = SECTION_STIFFNESS * stiffness[2] / 2 * ca.SX([1, 1, 2])
        return ca.vertcat(stiffness, section, section)

    def _strain(self, G: ca.SX, values: ca.SX) -> ca.SX:
        rest = values[values.numel() - STRAINS - 1 : values.numel() - 1]
        natural = ca.SX(STRAINS, 1)
        if self.natural_curvature:
            natural[3:] = self.natural_strains(values, values[len(self.constants) + 1])
        return strains_of(G) - rest - natural


@lru_cache(64)
def rod_material(
    law: RodLaw, section: CrossSection, natural_curvature: NaturalCurvature = False
) -> RodMaterial:
    """Return the law of a rod; equal arguments give the same object, so that kernels are shared."""
    return RodMaterial(law, section, natural_curvature)


def _by_arc_length(points: Array, steps_m: Array) -> tuple[scipy.interpolate.CubicSpline, Array]:
    """Return a spline through points by arc length, and the arc length of each point."""
    s = np.concatenate([[0.0], np.cumsum(steps_m)])
    if len(points) == 2:
        return scipy.interpolate.CubicSpline(s, points), s
    nodes, weights = np.polynomial.legendre.leggauss(8)
    for _ in range(20):
        curve = scipy.interpolate.CubicSpline(s, points)
        half = np.diff(s)[:, None] / 2
        places = s[:-1, None] + half * (1 + nodes)
        lengths = np.sum(np.linalg.norm(curve(places, 1), axis=2) * weights * half, axis=1)
        s = np.concatenate([[0.0], np.cumsum(lengths)])
    return scipy.interpolate.CubicSpline(s, points), s


def _stations(length_m: float, count: int, stated_m: Sequence[float]) -> Array:
    """Return the arc lengths of the sections: those stated, and others evenly between them."""
    stated = np.asarray(sorted(stated_m), dtype=float)
    tolerance = 1e-9 * length_m
    if stated.size and not (stated[0] >= -tolerance and stated[-1] <= length_m + tolerance):
        raise InputError(
            f"found the arc lengths {stated[0]:g} to {stated[-1]:g} m; expected 0 to {length_m:g} m, "
            "the length of the rod",
            where="s_m",
        )
    knots = np.concatenate([[0.0], stated, [length_m]])
    knots = knots[np.concatenate([[True], np.diff(knots) > 1e-6 * length_m])]  # or one section
    spans = np.diff(knots)
    counts = np.maximum(1, np.round((count - 1) * spans / length_m)).astype(int)
    while counts.sum() < count - 1:  # many short spans
        counts[np.argmax(spans / counts)] += 1
    parts = [
        knots[k] + span * np.arange(number) / number
        for k, (span, number) in enumerate(zip(spans, counts, strict=True))
    ]
    return np.concatenate([*parts, [length_m]])


def _without_twist(tangents: Array, first: ArrayLike | None) -> Array:
    """Return the director d₁ (N, 3) at each section, carried along without twist."""
    start = np.eye(3)[np.argmin(np.abs(tangents[0]))] if first is None else np.asarray(first, float)
    director = start - (start @ tangents[0]) * tangents[0]
    if not np.linalg.norm(director) > 1e-6:
        raise InputError(
            f"found {start.tolist()}, which is along the rod; expected a direction across it",
            where="first_director",
        )
    directors = [director / np.linalg.norm(director)]
    for before, after in pairwise(tangents):
        axis = np.cross(before, after)
        cosine = before @ after
        moved = directors[-1]
        moved = moved * cosine + np.cross(axis, moved) + axis * (axis @ moved) / (1 + cosine)
        moved = moved - (moved @ after) * after
        directors.append(moved / np.linalg.norm(moved))
    return np.array(directors)
