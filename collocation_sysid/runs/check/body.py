"""Check of a body: size, mesh, suitability of its elements, and grasps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...common.array_types import Array
from ...errors import listed
from ...fem.body import Body
from ...fem.laws.moduli import engineering_constants
from ...fem.meshes.checks import edge_lengths, mean_ratios
from ...fem.meshes.mesh import TetMesh
from ...fem.spatial_field import FieldResolution
from ...recording import Experiment, Grasp
from ...statistics.concerns import Concern, concern_if
from ...statistics.plausibility import density_concerns
from ...statistics.stability_concerns import rest_stability_concerns

# Mean-ratio quality below which an element's shape functions are poor.
POOR_QUALITY = 0.1
# Too stiff from this Poisson's ratio on: linear tetrahedra cannot keep their volume and bend;
# with quadratic ones a beam's stiffness is found 6 % too low at 0.45, and 12 % at 0.49.
LOCKING_POISSON = {"tet4": 0.4, "tet10": 0.45}
# Rounding of Poisson's ratio, which is converted to λ and μ and back, and of the elements across.
ROUNDING = 1e-9
# Ratio of length to thickness above which a body bends like a beam.
LEAST_SLENDERNESS = 2.5
# Elements needed across the thickness of a bending body: with averaged dilatation one element
# sags by half too much, two by 4 to 8 %.
CELLS_ACROSS = {"tet4": 4.0, "tet10-p0": 2.0}
# Elements across the thickness below which no coarser mesh is proposed, whatever the elements are.
FEWEST_CELLS = 2.0
# Name of the linear element.
LINEAR = "tet4"
# Remedies in messages.
FOR_BENDING = 'set object.element = "tet10" (for ν ≥ 0.45 "tet10-p0", with 2 or more across)'
FOR_VOLUME = 'set object.element = "tet10-p0", with 2 or more across a body that bends'

# Corners of the faces of a tetrahedron; face k is opposite to corner k.
_FACES = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))


@dataclass(frozen=True)
class ElementShape:
    """Shape of an element, compared with the regular tetrahedron."""

    element: int  # its index
    quality: float  # mean ratio: 1 for the regular tetrahedron, towards 0 the flatter it is
    aspect_ratio: float  # longest edge over smallest height: 1.22 for the regular tetrahedron


def worst_elements(mesh: TetMesh) -> tuple[ElementShape, ...]:
    """Return the shapes of the three elements of lowest quality, worst first, with indices from
    0; all of them if there are fewer. The mesh is undeformed, and of quadratic elements the corners
    count alone.
    """
    corners = mesh.points_m[mesh.tetrahedra]
    areas = [_areas(corners[:, face]) for face in _FACES]
    heights = 3 * mesh.volumes_m3 / np.max(areas, axis=0)
    quality = mean_ratios(mesh.points_m, mesh.tetrahedra)
    longest = edge_lengths(mesh.points_m, mesh.tetrahedra).max(axis=1)
    return tuple(
        ElementShape(int(e), float(quality[e]), aspect_ratio=float(longest[e] / heights[e]))
        for e in np.argsort(quality, kind="stable")[:3]
    )


def slenderness(mesh: TetMesh) -> tuple[float, float, float]:
    """Return the longest extent [m] of an undeformed body, its thickness where it bends [m], and the
    number of cells of six tetrahedra across the thickness.
    """
    # Edges of the box with the same second moments, however it is turned.
    edges = np.sqrt(12 * np.linalg.eigvalsh(_covariance(mesh)))
    # A bent or hollow body is thinner than its extents: six times volume over surface is a cube's
    # edge, and more than the thickness of beams and plates.
    area = float(_areas(mesh.points_m[mesh.surface]).sum())
    thickness = min(float(edges[0]), 6 * mesh.volume_m3 / area)
    cell = float(np.cbrt(6 * np.median(mesh.volumes_m3)))
    return float(edges[-1]), thickness, thickness / cell


def element_concerns(
    body: Body, theta: Array, shape: tuple[float, float, float], worst: ElementShape
) -> list[Concern]:
    """Return concerns about flat elements, locking, and too few elements across the thickness.

    Parameters
    ----------
    body : Body
        Body with its mesh and elements.
    theta : array
        Constants θ at the guess.
    worst : ElementShape
        Element of the lowest quality.
    """
    name = body.element.name
    poisson = max(engineering_constants(*lame)[1] for lame in body.lame(theta).values())
    limit = LOCKING_POISSON.get(name, np.inf)
    return [
        *concern_if(
            worst.quality < POOR_QUALITY,
            False,
            code="mesh/flat",
            number=worst.element,
            quality=worst.quality,
            aspect_ratio=worst.aspect_ratio,
        ),
        *concern_if(
            poisson >= limit - ROUNDING,
            False,
            code="mesh/locks",
            poisson=poisson,
            element=name,
            limit=limit,
            remedy=FOR_VOLUME,
        ),
        *bending_concerns(body, *shape),
    ]


def bending_concerns(
    body: Body, length_m: float, thickness_m: float, cells_across: float
) -> list[Concern]:
    """Return the concern "mesh/few", as a list, if a slender body has too few elements across its
    thickness; else empty. The numbers are those of `slenderness`.
    """
    name = body.element.name
    off, level = ("stiff", "low") if name == LINEAR else ("soft", "high")
    bends = name in CELLS_ACROSS and length_m > LEAST_SLENDERNESS * thickness_m
    return concern_if(
        bends and longest_edges(body, cells_across) < 1 - ROUNDING,
        False,
        code="mesh/few",
        # Rounded down, so that it is below the number that is needed.
        cells=np.floor(10 * cells_across) / 10,
        element=name,
        thickness_mm=1e3 * thickness_m,
        off=off,
        level=level,
        remedy=f"{FOR_BENDING}, or refine" if name == LINEAR else "refine",
        needed=CELLS_ACROSS.get(name),
    )


def longest_edges(body: Body, cells_across: float) -> float:
    """Return the length of the longest edges with which a body has enough elements across its
    thickness over that of its mesh.
    """
    return cells_across / CELLS_ACROSS.get(body.element.name, FEWEST_CELLS)


def _covariance(mesh: TetMesh) -> Array:
    """Return the mean of (x − x̄)(x − x̄)ᵀ over the undeformed volume (3, 3) [m²], and x̄."""
    shares = mesh.volumes_m3 / mesh.volume_m3
    corners = mesh.points_m[mesh.tetrahedra]
    corners = corners - shares @ corners.mean(axis=1)
    # Over a tetrahedron the mean of x xᵀ is (Σ xᵢ xᵢᵀ + Σ xᵢ Σ xᵢᵀ) / 20.
    sums = corners.sum(axis=1)
    squares = np.einsum("e,eci,ecj->ij", shares, corners, corners)
    return (squares + np.einsum("e,ei,ej->ij", shares, sums, sums)) / 20


def _area_vectors(triangles: Array) -> Array:
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2


def _areas(triangles: Array) -> Array:
    return np.linalg.norm(_area_vectors(triangles), axis=1)


# Shapes that hold less of a field's variance leave most of it to the interval.
LEAST_FIELD_VARIANCE = 0.5


@dataclass(frozen=True)
class BodyCheck:
    """Size, mesh and guess of a body."""

    SERIALISED_PROPERTIES: ClassVar = ("warnings", "open_question")

    experiments: tuple[str, ...]
    # Numbers of nodes and elements.
    nodes: int
    elements: int
    element: str  # name of the element, such as "tet10"
    # Volume of the mesh, and mass at the guess, without point masses.
    volume_m3: float
    mass_kg: float
    # mapping of str to float: sum of the point masses of each experiment that has any, by its name.
    point_masses_kg: Mapping[str, float]
    # Extents (x, y, z) of the mesh along the axes; length and two widths of a rod.
    size_m: tuple[float, float, float]
    edges_m: tuple[float, float, float]
    # Mean ratio, see `ElementShape`.
    smallest_element_quality: float
    median_element_quality: float
    worst_elements: tuple[ElementShape, ...]
    cells_across: float  # number of elements across the body's thickness
    # mapping of name to float: values of the constants, and of E and ν at small strain, at the
    # guess.
    guess: dict[str, float]
    concerns: tuple[Concern, ...]  # concerns about the elements; `warnings` are their sentences
    # mapping of the name of a constant to FieldResolution: constants that vary in space.
    fields: dict[str, FieldResolution]
    # "stress_free" or "under_gravity" where that is stated or follows from how the mesh was made.
    rest_shape: str | None = None
    # Largest distance of the mesh from the stress-free shape at the guess; NaN where there is no
    # such shape.
    rest_shape_change_m: float = 0.0
    # How the body was made, and where its mesh comes from, as stated.
    made: str | None = None
    mesh_from: str | None = None
    # Whether it is the cell of specimens without a mesh, whose deformation is homogeneous.
    is_homogeneous: bool = False

    @property
    def open_question(self) -> str | None:
        """What should be stated about the origin of the body, in one sentence; None if nothing is
        missing, and for a rod, which has no mesh of its own.
        """
        if self.element == "rod":
            return None
        questions = []
        if self.made is None:
            questions.append("made (cast, foam, printed, tissue)")
        if self.rest_shape is None and self.mesh_from is None and not self.is_homogeneous:
            questions.append("mesh_from (cad, scan)")
        if not questions:
            return None
        return f"object.{listed(questions)} not stated"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the concerns about this body."""
        return tuple(concern.message for concern in self.concerns)


def check_body(
    body: Body,
    theta: Array,
    experiments: tuple[str, ...],
    *,
    is_homogeneous: bool = False,
    point_masses_kg: Mapping[str, float] | None = None,
) -> BodyCheck:
    """Return a summary of size, mesh and guess of a body, with concerns.

    Parameters
    ----------
    theta : array
        Constants θ at the guess.
    is_homogeneous : bool
        Whether it is the cell of specimens, which has no discretisation error.
    point_masses_kg : mapping of str to float, optional
        Sum of the point masses by experiment [kg]; none by default.
    """
    mesh = body.mesh
    fields = {
        part.field_name: part.field.describe_resolution() for part in body.parts if part.field
    }
    quality = mesh.quality()
    worst = worst_elements(mesh) if body.is_solid else ()
    shape = slenderness(mesh)
    x, y, z = mesh.extents_m
    return BodyCheck(
        experiments,
        nodes=len(body.nodes.points_m),
        elements=len(body.cells),
        element=body.element.name,
        volume_m3=mesh.volume_m3,
        mass_kg=float(body.mass_of_dofs(theta).sum()) / 3,
        point_masses_kg=dict(point_masses_kg or {}),
        size_m=(x, y, z),
        edges_m=(quality.edge_min_m, quality.edge_mean_m, quality.edge_max_m),
        smallest_element_quality=quality.quality_min,
        median_element_quality=quality.quality_median,
        worst_elements=worst,
        cells_across=shape[2],
        guess=_constants_at_guess(body, theta),
        concerns=(
            *(
                element_concerns(body, theta, shape=shape, worst=worst[0])
                if worst and not is_homogeneous
                else ()
            ),
            *rest_stability_concerns(body, theta),
            *(() if is_homogeneous else density_concerns(body)),
            *(() if is_homogeneous else _field_concerns(fields)),
        ),
        fields=fields,
        rest_shape=_rest_shape(body),
        rest_shape_change_m=_rest_shape_change_m(body, theta),
        made=body.made,
        mesh_from=body.mesh_from,
        is_homogeneous=is_homogeneous,
    )


def _rest_shape(body: Body) -> str | None:
    if body.rest_shape is None:
        return None
    return "stress_free" if body.scan_conditions is None else "under_gravity"


def _rest_shape_change_m(body: Body, theta: Array) -> float:
    """Return the largest distance [m], NaN if no stress-free shape can be computed."""
    if body.inverse_equilibrium is None:
        return 0.0
    if body.rest_shape_failure(theta) is not None:
        return float("nan")
    change_m = body.inverse_equilibrium.solve(theta).positions_m - body.nodes.points_m
    return float(np.linalg.norm(change_m, axis=1).max())


def _field_concerns(fields: Mapping[str, FieldResolution]) -> Iterator[Concern]:
    """Shapes represent less than `LEAST_FIELD_VARIANCE` of the prior variance."""
    for name, field in fields.items():
        if field.share < LEAST_FIELD_VARIANCE:
            yield Concern("field/shapes", data={"name": name, **vars(field)})


def _constants_at_guess(body: Body, theta: Array) -> dict[str, float]:
    """Return E [Pa] and ν of each part, then the constants; stated moduli replace computed ones."""
    moduli = {}
    moduli_of_parts = body.lame(theta)
    for part in body.parts if body.is_solid else ():
        young, poisson = engineering_constants(*moduli_of_parts[part.name])
        moduli |= {part.full_name("young_pa"): young, part.full_name("poisson"): poisson}
    constants = zip(body.constants, theta.tolist(), strict=True)
    coefficients = body.field_coefficient_names
    return moduli | {name: value for name, value in constants if name not in coefficients}


# Distance from the box of the held nodes, in mean edges, below which it is by chance whether a node
# is held.
NEARLY_GRASPED_EDGES = 0.1
# Distance from that box, in mean edges, that is rounding.
ROUND_OFF_EDGES = 1e-6
# Largest distance from that box, in mean edges, of the neighbours of the held nodes.
NEIGHBOUR_EDGES = 1.5


@dataclass(frozen=True)
class GraspCheck:
    """The nodes of one grasp."""

    experiment: str
    nodes: int  # number of nodes
    # (3,) corners of the box around them, on the undeformed body: .
    low_m: tuple[float, ...]
    high_m: tuple[float, ...]
    share: float  # share of all nodes
    # Number of free nodes beside the box, less than a tenth of an edge beyond one of its faces.
    nearly_grasped: int
    # Number of held nodes less than a tenth of an edge inside a face beyond which the body
    # continues, and not in that face.
    nearly_free: int
    axes: str = "xyz"  # axes along which the grasp holds


def check_grasps(experiment: Experiment, mean_edge_m: float) -> tuple[GraspCheck, ...]:
    """Return a summary of the grasped nodes for each grasp of the body in an experiment, without
    obstacles, see `GraspCheck`.

    Parameters
    ----------
    mean_edge_m : float
        Mean edge length of the mesh [m].
    """
    points_m = experiment.body.nodes.points_m
    if not experiment.body.is_solid:
        mean_edge_m = 0.0  # arc lengths, which no rounding changes, select the sections
    return tuple(
        _check_grasp(experiment.name, points_m, grasp=g, mean_edge_m=mean_edge_m)
        for g in experiment.body_grasps
    )


def _check_grasp(name: str, points_m: Array, grasp: Grasp, mean_edge_m: float) -> GraspCheck:
    """Count also nodes so close to a face of the box that rounding may decide."""
    nodes = grasp.nodes
    grasped_m = points_m[nodes]
    free_m = np.delete(points_m, nodes, axis=0)
    low = grasped_m.min(axis=0)
    high = grasped_m.max(axis=0)
    outside_m = np.concatenate([low - free_m, free_m - high], axis=1)
    is_neighbour = outside_m.max(axis=1, initial=-np.inf) < NEIGHBOUR_EDGES * mean_edge_m
    # Behind faces of the box that the body goes on beyond, as far as the nearest held node.
    inner = (outside_m > 0).any(axis=0)
    inside_m = np.concatenate([grasped_m - low, high - grasped_m], axis=1)[:, inner]
    least_m = ROUND_OFF_EDGES * mean_edge_m
    reach_m = NEARLY_GRASPED_EDGES * mean_edge_m
    slightly_outside = (outside_m > least_m) & (outside_m < reach_m) & is_neighbour[:, None]
    slightly_inside = (inside_m > least_m) & (inside_m < reach_m)
    return GraspCheck(
        name,
        len(nodes),
        low_m=tuple(low.tolist()),
        high_m=tuple(high.tolist()),
        share=len(nodes) / len(points_m),
        nearly_grasped=int(slightly_outside.any(axis=1).sum()),
        nearly_free=int(slightly_inside.any(axis=1).sum()),
        axes=grasp.axes,
    )


def grasp_sentence(grasp_check: GraspCheck) -> str:
    """Return number and share of the grasped nodes, size and lower corner of their bounding box
    [mm], and the axes along which they are held unless these are all, as text.
    """
    size = " × ".join(
        f"{1e3 * (b - a):.4g}" for a, b in zip(grasp_check.low_m, grasp_check.high_m, strict=True)
    )
    low = ", ".join(f"{1e3 * x:.4g}" for x in grasp_check.low_m)
    axes = (
        "" if grasp_check.axes == "xyz" else f", held along {' and '.join(grasp_check.axes)} only"
    )
    nodes = f"{grasp_check.nodes} nodes, {grasp_check.share:.0%} of all"
    return f"{nodes}, in a box of {size} mm at ({low}) mm{axes}"


def grasp_concerns(grasp_check: GraspCheck) -> list[Concern]:
    """Return a list with one concern if some nodes are so near to a face of the box that rounding
    decides whether they are held; otherwise an empty list.
    """
    by_chance = bool(grasp_check.nearly_grasped or grasp_check.nearly_free)
    counts = {
        "nodes": grasp_check.nodes,
        "nearly_grasped": grasp_check.nearly_grasped,
        "nearly_free": grasp_check.nearly_free,
    }
    return concern_if(
        by_chance, False, code="description/grasp", experiment=grasp_check.experiment, **counts
    )
