"""Twins of a recording in which assumptions of the budget are wrong by known amounts.

Each twin is simulated with the body as it is in truth: with another mesh, density, law or air. The
names of the errors are those of `statistics.budget.systematic_effects`, with their components.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from collocation_sysid import (
    Body,
    Experiment,
    Force,
    Grasp,
    Material,
    NodeForce,
    PoseSequence,
    TetMesh,
    simulate,
    with_markers,
)
from collocation_sysid.fem.laws.constants import GAMMA_R
from collocation_sysid.fem.laws.materials import DAMPINGS, DampingLaw, rayleigh
from collocation_sysid.fem.node_force import DRAG_COEFFICIENT, FACING_SHARE
from collocation_sysid.statistics.budget.shape_error import (
    SURFACE_MODES,
    surface_modes,
    thickness_m,
)
from collocation_sysid.statistics.budget.systematic_effects import OBJECTIVE_DAMPINGS

Array = NDArray[np.float64]
SCHEME = "midpoint"
AXES = "xyz"
# Number of time steps between changes of a drifting stiffness.
PIECE_STEPS = 2


def with_wrong_assumptions(
    experiment: Experiment, values: Mapping[str, float], errors: Mapping[str, float]
) -> Experiment:
    """Return the experiment with the marker tracks of a body that deviates from the assumptions.

    `errors` are in the units of the assumptions; those of the air are shares of the forces of the air
    in the model, and an assumption that is absent is correct.
    """
    body = _body(experiment, errors)
    (grasp,) = experiment.grasps
    slower_clock = 1 - errors.get("time_scale", 0.0)
    poses = grasp.poses
    slowed_poses = PoseSequence(slower_clock * poses.t_s, poses.positions_m, poses.quaternions_xyzw)
    # Added mass is that of denser air; buoyancy and drag of this denser air are corrected below.
    denser_air = 1 + errors.get("added_mass", 0.0)
    truth = replace(
        experiment,
        body=body,
        t_s=slower_clock * experiment.t_s,
        grasps=(Grasp(grasp.nodes, slowed_poses),),
        markers=replace(experiment.markers, t_s=slower_clock * experiment.t_s, located=None),
        forces=_buoyancy_errors(experiment, body, errors),
        air_density_kg_m3=denser_air * experiment.air_density_kg_m3,
    )
    values = dict(values, poisson=values["poisson"] + errors.get("poisson", 0.0))
    return with_markers(experiment, _tracks(truth, values, errors.get("stiffness_drift", 0.0)))


def _tracks(truth: Experiment, values: Mapping[str, float], drift: float) -> Array:
    """Return the tracks (T, M, 3) [m] of a body whose stiffness changes by a share `drift` in
    total.
    """
    values = _lame(truth, values)
    if not drift:
        return simulate(truth, values, SCHEME, substeps=1).markers_m
    t_s = truth.t_s
    markers = truth.markers
    moduli = [name for name in values if name.endswith("_pa")]
    tracks = [markers.positions_m[:0]]
    start = {}
    velocity = 0.0
    steps = len(t_s) - 1
    for first in range(0, steps - 1, PIECE_STEPS):  # the last piece has the remaining steps
        samples = slice(
            first, (first + PIECE_STEPS if first + 2 * PIECE_STEPS <= steps else steps) + 1
        )
        elapsed_share = (t_s[samples].mean() - t_s.mean()) / np.ptp(t_s)
        current_values = {
            n: v * (1 + drift * elapsed_share) if n in moduli else v for n, v in values.items()
        }
        piece_markers = replace(
            markers, t_s=t_s[samples], positions_m=markers.positions_m[samples], located=None
        )
        piece = replace(truth, t_s=t_s[samples], markers=piece_markers, **start)
        forward_run = simulate(piece, current_values, SCHEME, substeps=1)
        for displacement_m in np.diff(
            forward_run.positions_m, axis=0
        ):  # velocities of the midpoint rule
            velocity = 2 * displacement_m / truth.timestep_s - velocity
        start = {
            "start": "given",
            "start_positions_m": forward_run.positions_m[-1],
            "start_velocities_m_s": velocity,
        }
        tracks.append(forward_run.markers_m[bool(first) :])
    return np.concatenate(tracks)


def _lame(truth: Experiment, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values with λ and μ in place of E and ν if the material is user-defined."""
    if truth.body.parts[0].material.name == "neo-hookean":
        return dict(values)
    young = values["young_pa"]
    poisson = values["poisson"]
    others = {n: v for n, v in values.items() if n not in ("young_pa", "poisson")}
    mu = young / 2 / (1 + poisson)
    return others | {"mu_pa": mu, "lambda_pa": 2 * mu * poisson / (1 - 2 * poisson)}


def _body(experiment: Experiment, errors: Mapping[str, float]) -> Body:
    old = experiment.body
    (grasp,) = experiment.grasps
    pivot_m = old.nodes_m[grasp.nodes].mean(axis=0)
    scale = 1 + errors.get("body_scale", 0.0)
    points_m = pivot_m + scale * (old.mesh.points_m - pivot_m) + _surface_errors_m(old, errors)
    # Held nodes that end before the body in the model does leave a compliant piece of material.
    points_m[grasp.nodes[grasp.nodes < len(points_m)]] -= _gap_to_grip_m(old, grasp, errors)
    mesh = TetMesh(points_m, old.mesh.tetrahedra)
    extra_stiffness = [errors.get(f"anisotropy {axis}", 0.0) for axis in AXES]
    body_options: dict[str, Any] = {"damping": _damping(old.parts[0].damping, errors)}
    body_options |= {"element": old.element.name}
    if any(extra_stiffness):
        body_options |= {"material": anisotropic_law(extra_stiffness), "evaluator": "casadi"}
    more_drag = errors.get("air_drag", 0.0) - errors.get("added_mass", 0.0)
    if more_drag:
        body_options["forces"] = [_drag(more_drag * experiment.air_density_kg_m3)]
    density = old.mass_kg / old.mesh.volume_m3 * (1 + errors.get("mass", 0.0))
    body = Body(mesh, density_kg_m3=density, **body_options)
    body = body.with_stiffness_factors(_stiffness_factors(body, errors))
    factor = np.ones(len(body.nodes_m))
    for axis, name in enumerate(AXES):
        distance_m = body.nodes_m[:, axis] - np.average(
            body.nodes_m[:, axis], weights=body.node_mass
        )
        factor += (
            errors.get(f"density_gradient {name}", 0.0) * distance_m / np.abs(distance_m).max()
        )
    body._lumped_m3 = [lumped * np.repeat(factor, 3) for lumped in body._lumped_m3]
    body.node_mass = body.node_mass * factor
    return body


def _surface_errors_m(body: Body, errors: Mapping[str, float]) -> Array:
    """Return the displacements (n, 3) of the nodes by errors of the surface [m]."""
    sizes = [errors.get(f"surface {mode + 1}", 0.0) for mode in range(SURFACE_MODES)]
    if not any(sizes):
        return np.zeros_like(body.mesh.points_m)
    modes = surface_modes(body, np.array([], dtype=int))[:, : len(body.mesh.points_m)]
    return thickness_m(body) * np.einsum("m,mni->ni", sizes, modes)


def _gap_to_grip_m(body: Body, grasp: Grasp, errors: Mapping[str, float]) -> Array:
    """Return the vector (3,) from the true place of the gripper to the grasped nodes [m].

    A layer is never negative; the edge may be on either side.
    """
    length_m = abs(errors.get("grip_layer_m", 0.0)) + errors.get("grasp_edge_m", 0.0)
    along = body.nodes_m.mean(axis=0) - body.nodes_m[grasp.nodes].mean(axis=0)
    return length_m * along / np.linalg.norm(along)


def _stiffness_factors(body: Body, errors: Mapping[str, float]) -> Array:
    """Return the factors (E,) of the stiffness of all elements, linear along each axis of the body."""
    factors = np.ones(len(body.cells))
    volumes_m3 = body.mesh.volumes_m3
    for axis, name in enumerate(AXES):
        place_m = body.nodes_m[:, axis]
        centres_m = place_m[body.cells].mean(axis=1)
        middle_m = np.average(centres_m, weights=volumes_m3)
        factors += (
            errors.get(f"stiffness_gradient {name}", 0.0)
            * (centres_m - middle_m)
            / np.abs(place_m - middle_m).max()
        )
    return factors


def anisotropic_law(shares: Sequence[float]) -> Material:
    """Return Neo-Hooke's law, stiffer along each axis (3,) by a share of E."""

    def energy(f, lambda_pa, mu_pa):
        j = ca.det(f)
        young_pa = mu_pa * (3 * lambda_pa + 2 * mu_pa) / (lambda_pa + mu_pa)
        green = 0.5 * (f.T @ f - ca.SX.eye(3))
        isotropic = 0.5 * mu_pa * (2 * ca.trace(green) - 2 * ca.log(j))
        isotropic += 0.5 * lambda_pa * ca.log(j) ** 2
        return isotropic + 0.5 * young_pa * sum(s * green[k, k] ** 2 for k, s in enumerate(shares))

    return Material.from_energy(energy)


def _damping(stated_law: DampingLaw, errors: Mapping[str, float]) -> DampingLaw:
    """Return the stated damping law, plus shares of the differences of other laws from it."""
    shares = {
        law: errors.get(key, 0.0)
        for law, key in (
            *((law, f"damping_law {law}") for law in OBJECTIVE_DAMPINGS),
            ("rayleigh", "rayleigh_damping"),
        )
    }
    if not any(shares.values()):
        return stated_law
    own_share = 1 - sum(shares.values())

    def stress(psi, f, rate, gamma_r_s):
        terms = [
            (own_share, stated_law),
            *((shares[law], DAMPINGS[law]) for law in OBJECTIVE_DAMPINGS),
        ]
        stresses = ca.SX(9, 1)
        slopes = ca.SX(9, 9)
        for share, law in terms:
            stress, slope = law.stress(psi, f, rate, gamma_r_s)
            stresses += share * stress
            slopes += share * slope
        return stresses, slopes

    def potential(psi, f, rate, gamma_r_s):
        return shares["rayleigh"] * rayleigh(psi, f, rate, gamma_r_s)

    return DampingLaw("between", (GAMMA_R,), potential, stress)


def _drag(density_kg_m3: float) -> NodeForce:
    """Return the drag force −½ ρ c_d a |v| v of each node, where a is the area that faces v."""
    per_area = 0.5 * density_kg_m3 * DRAG_COEFFICIENT * FACING_SHARE

    def drag(x, v, node):
        return -per_area * node.area_m2 * ca.sqrt(ca.sumsqr(v) + 1e-8) * v

    return NodeForce.from_law(drag)


def _buoyancy_errors(
    experiment: Experiment, body: Body, errors: Mapping[str, float]
) -> tuple[Force, ...]:
    """Return the forces that correct the buoyancy of air whose density gives the true added mass."""
    more_buoyancy = errors.get("buoyancy", 0.0) - errors.get("added_mass", 0.0)
    air_kg = experiment.air_density_kg_m3 * body.node_mass * body.mesh.volume_m3 / body.mass_kg
    return tuple(
        Force([k], [0, 0, 9.81 * more_buoyancy * m])
        for k, m in enumerate(air_kg)
        if more_buoyancy * m
    )
