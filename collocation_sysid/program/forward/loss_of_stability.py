"""Why a path of static equilibria ends: the mode in which the body loses its stability.

At the end of a stable path the tangent stiffness K loses definiteness: of K φ = λ M φ the lowest λ
tends to zero, and the body moves along φ without a load. A long slender body buckles so. A body
whose surface is compressed also wrinkles there: a half-space of an incompressible neo-Hookean
material is unstable in waves along a principal stretch λ_1 of its surface where

    λ_1/λ_3 = λ_1² λ_2 ≤ ξ,   ξ³ + ξ² + 3 ξ = 1,

λ_2 being the other stretch in the surface and λ_3 that across (Biot, Appl. Sci. Res. A 12, 1963):
at 0.544 in plane strain, 0.666 in equal compression along both, 0.444 along one. The waves have no
length of their own, so that on a mesh they are about as long as elements, and a finer mesh only
makes them shorter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import ArpackError, eigsh

from ...common.array_types import Array, Index
from ...errors import SimulationError
from ...model.forces import Forces
from ...recording.experiment import Experiment
from ...recording.specimen_files import specimen_strains

# λ_1/λ_3 at which the surface of a half-space is unstable: the root of ξ³ + ξ² + 3 ξ − 1.
BIOT_RATIO = 0.29559774
# Stretch over the critical one below which a surface instability is reported: a mesh is stiffer or
# softer than a half-space by this factor.
NEAREST_FACTOR = 1.15
# Lowest eigenvalue over that of the undeformed body below which a failure is a loss of stability.
LEAST_REDUCTION = 0.5
# Displacement over the largest one from which on a face belongs to the mode.
MOVING = 0.5
# Shift of the eigenvalues away from zero, over the lowest of the undeformed body.
SHIFT = 0.01
# Message for slender bodies, whose surface is not modelled.


@dataclass(frozen=True, eq=False)
class StabilityLoss:
    """Mode in which a body loses its stability, and the stretches where the mode is largest."""

    positions_m: Array  # (n, 3): nodes of the body at the end of the stable path [m]
    mode: Array  # (n, 3): displacements of the nodes; the longest has length one
    faces: Index  # (F, 3): corners of the surface's triangles
    place_m: Array  # (3,): undeformed place of the decisive face [m]
    # Principal stretches of the surface there, the smaller first.
    smaller_stretch: float
    larger_stretch: float
    # Smaller stretch at which a neo-Hookean surface is unstable, for the same relation of both
    # stretches.
    critical_stretch: float
    # Wavelength of the mode on the undeformed surface, 2π √(∫|φ|² / ∫|∇φ|²) [m].
    wavelength_m: float

    @property
    def is_surface_instability(self) -> bool:
        """Whether the surface is compressed to near the stretch at which it wrinkles: by at most
        the factor `NEAREST_FACTOR` above `critical_stretch`.
        """
        return (
            self.smaller_stretch < 1
            and self.smaller_stretch <= NEAREST_FACTOR * self.critical_stretch
        )

    def describe(self) -> str:
        """Return the message for the user: the mode, where it is largest, and what to change."""
        x, y, z = (1e3 * self.place_m).tolist()
        where = (
            f"the largest motion is at ({x:.4g}, {y:.4g}, {z:.4g}) mm, where the stretches of the "
            f"surface are {self.smaller_stretch:.3g} and {self.larger_stretch:.3g}, with a "
            f"wavelength of {1e3 * self.wavelength_m:.3g} mm"
        )
        if self.is_surface_instability:
            return (
                f"the body loses its stability: {where}. Rubber wrinkles at a surface stretch of "
                f"{self.critical_stretch:.3g} there (Biot): a physical instability of the "
                "surface, which a finer mesh does not remove. End the recording before that, or "
                "use a strain-stiffening material"
            )
        return (
            f"the body loses its stability: {where}. It buckles, since its surface would wrinkle "
            f"only at a stretch of {self.critical_stretch:.3g} (Biot). End the recording before "
            "that, or support the body there"
        )


def explain_failure(
    experiment: Experiment, theta: Array, error: SimulationError
) -> SimulationError:
    """Return the error of a static simulation with the mode in which the body loses its stability.

    It is a new error, with the mode as `stability_loss`. For a homogeneous specimen, which has no
    mode, the message names the test and the strain. The same error is returned if it has no state,
    there is no such mode, or the mode cannot be computed.
    """
    if error.state_m is None:
        return error
    if experiment.specimen is not None:
        return SimulationError(specimen_message(experiment, error.time_s), error.time_s)
    try:
        instability = find_stability_loss(experiment, theta, x=error.state_m, time_s=error.time_s)
    except (ArpackError, RuntimeError, np.linalg.LinAlgError):
        return error
    if instability is None:
        return error
    message = experiment.body.kind.buckles or instability.describe()
    explained_error = SimulationError(message, error.time_s, element=error.element)
    explained_error.stability_loss = instability
    return explained_error


def specimen_message(experiment: Experiment, time_s: float) -> str:
    """Return the message for a specimen that has no stable equilibrium at a time [s].

    It states the test and the strain at that time, interpolated linearly between samples. The
    experiment must be that of a specimen.
    """
    assert experiment.specimen is not None
    strain, _ = specimen_strains(experiment)
    value = float(np.interp(time_s, experiment.t_s, strain))
    return (
        f"specimen '{experiment.name}': the material has no stable equilibrium in the "
        f"{experiment.specimen.test} test at a strain of {value:.4g} with these constants. They "
        "are probably not determined by the fitted tests: fit this kind of test too, bound the "
        "constants, or use a law with fewer constants"
    )


def find_stability_loss(
    experiment: Experiment, theta: Array, x: Array, time_s: float
) -> StabilityLoss | None:
    """Return the mode in which a body is about to lose its stability, or None.

    None where the lowest eigenvalue is at least the share `LEAST_REDUCTION` of that of the
    undeformed body in its grasps, and where no grasp prevents rigid motions.

    Parameters
    ----------
    theta : (k,) array
        Constants of the body.
    x : (3n,) array
        Positions at the end of the stable path [m].
    time_s : float
        Time of loads and poses [s].

    Raises
    ------
    ArpackError, RuntimeError, numpy.linalg.LinAlgError
        If the eigenvalues cannot be computed.
    """
    forces = Forces.from_experiment(experiment, time_s, theta=theta)
    is_prescribed = experiment.is_prescribed([time_s])[0].ravel()
    free = np.flatnonzero(~is_prescribed)
    reference, _ = _lowest(
        forces, experiment.rigid_positions([time_s])[0].ravel(), free=free, distance_1_s2=0.0
    )
    if not reference > 0:
        return None
    value, shape = _lowest(forces, x, free=free, distance_1_s2=SHIFT * reference)
    if not value < LEAST_REDUCTION * reference:
        return None
    nodes = experiment.body.nodes
    own = len(nodes.points_m)
    mode = np.zeros(len(x))
    mode[free] = shape
    mode = mode.reshape(-1, 3)[:own]
    mode = mode / np.linalg.norm(mode, axis=1).max()
    positions_m = x.reshape(-1, 3)[:own]
    return is_on_surface(
        nodes.points_m, positions_m, mode=mode, surface=experiment.body.mesh.surface
    )


def _lowest(forces: Forces, x: Array, free: Index, distance_1_s2: float) -> tuple[float, Array]:
    """Return λ [1/s²] of K φ = λ M φ nearest to a shift at or below zero, and φ (free,)."""
    state = x.reshape(1, -1)
    stiffness = -forces.linearise(state, np.zeros_like(state)).by_position[0]
    root = sp.diags_array(1 / np.sqrt(forces.mass.inertia_kg[0, free]))
    matrix = sp.csc_array(root @ forces.pattern.matrix(stiffness)[:, free][free] @ root)
    start = np.random.default_rng(0).normal(size=len(free))
    values, vectors = eigsh(matrix, 1, sigma=-distance_1_s2, which="LM", v0=start)
    return float(values[0]), np.asarray(root @ vectors[:, 0])


def is_on_surface(
    points_m: Array, positions_m: Array, mode: Array, surface: Index
) -> StabilityLoss:
    """Return the mode with stretches and wavelength on the surface's triangles.

    Of the faces that move with the mode, the decisive one has the smallest λ_1² λ_2.

    Parameters
    ----------
    points_m, positions_m : (n, 3) arrays
        Undeformed and deformed nodes [m].
    mode : (n, 3) array
        Displacements of the nodes.
    surface : (F, 3) array
        Corners of the surface's triangles.
    """
    edges_m, moved_m, differences = (
        np.stack([each[surface[:, k]] - each[surface[:, 0]] for k in (1, 2)], axis=1)
        for each in (points_m, positions_m, mode)
    )
    first = edges_m @ edges_m.swapaxes(1, 2)
    second = moved_m @ moved_m.swapaxes(1, 2)
    inverse = np.linalg.inv(first)
    areas_m2 = np.sqrt(np.linalg.det(first)) / 2
    squares = np.sort(np.linalg.eigvals(inverse @ second).real, axis=1)
    stretches = np.sqrt(np.maximum(squares, 0.0))
    amplitude2 = (mode[surface] ** 2).sum(axis=2).mean(axis=1)
    moving = amplitude2 >= MOVING**2 * amplitude2.max()
    # Of the faces that move, the one that is nearest to wrinkling.
    criterion = np.where(moving, stretches[:, 0] ** 2 * stretches[:, 1], np.inf)
    face = int(criterion.argmin())
    small, large = stretches[face].tolist()
    # Along λ_2 = λ_1^m the criterion is λ_1^(2 + m) = ξ.
    power = 2 + np.log(large) / np.log(small) if small < 1 else np.inf
    critical = float(BIOT_RATIO ** (1 / power)) if 0 < power < np.inf else 0.0
    slopes2 = np.einsum("fij,fik,fjk->f", inverse, differences, differences)
    share = (areas_m2 * amplitude2).sum() / max((areas_m2 * slopes2).sum(), np.finfo(float).tiny)
    return StabilityLoss(
        positions_m=positions_m,
        mode=mode,
        faces=surface,
        place_m=points_m[surface[face]].mean(axis=0),
        smaller_stretch=small,
        larger_stretch=large,
        critical_stretch=critical,
        wavelength_m=float(2 * np.pi * np.sqrt(share)),
    )
