"""Twins of a recording of which something that is assumed is wrong, by sizes that are known.

Each is simulated anew with the body as it would be: another mesh, density, law or air. `OFF` are
the names of `statistics.budget.systematic_effects`, with their components.
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
from collocation_sysid.fem.air import DRAG_COEFFICIENT, FACING_SHARE
from collocation_sysid.fem.laws.constants import GAMMA_R
from collocation_sysid.fem.laws.materials import DAMPINGS, DampingLaw, rayleigh
from collocation_sysid.statistics.budget.systematic_effects import (
    OBJECTIVE_DAMPINGS,
)

Array = NDArray[np.float64]
SCHEME = "midpoint"
AXES = "xyz"
# Steps between changes of what drifts.
PIECE = 2


def wrong(
    experiment: Experiment,
    values: Mapping[str, float],
    off: Mapping[str, float],
) -> Experiment:
    """The recording of a body held by one grasp, with its markers as they would be seen.

    Parameters
    ----------
    experiment : Experiment
        With markers at nodes.
    values : mapping of parameter to its truth, by E and ν
    off : mapping of assumption to how far it is off, in its unit; those of the air are shares of
        what the air around the experiment does in the model
    """
    body = _body(experiment, values, off)
    (grasp,) = experiment.grasps
    slower = 1 - off.get("time_scale", 0.0)
    poses = grasp.poses
    slowed = PoseSequence(
        slower * poses.t_s, poses.positions_m, poses.quaternions_xyzw
    )
    # Added mass is that of denser air, and what else this air does is taken back.
    denser = 1 + off.get("added_mass", 0.0)
    truth = replace(
        experiment,
        body=body,
        t_s=slower * experiment.t_s,
        grasps=(Grasp(grasp.nodes, slowed),),
        markers=replace(
            experiment.markers, t_s=slower * experiment.t_s, located=None
        ),
        forces=_lift(experiment, body, off),
        air_density_kg_m3=denser * experiment.air_density_kg_m3,
    )
    values = dict(values, poisson=values["poisson"] + off.get("poisson", 0.0))
    return with_markers(
        experiment, _tracks(truth, values, off.get("stiffness_drift", 0.0))
    )


def _tracks(
    truth: Experiment, values: Mapping[str, float], drift: float
) -> Array:
    """(T, M, 3) of a body whose stiffness drifts, one piece of the recording after another."""
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
    for first in range(0, steps - 1, PIECE):  # the last piece has what is left
        here = slice(
            first, (first + PIECE if first + 2 * PIECE <= steps else steps) + 1
        )
        since = (t_s[here].mean() - t_s.mean()) / np.ptp(t_s)
        now = {
            n: v * (1 + drift * since) if n in moduli else v
            for n, v in values.items()
        }
        seen = replace(
            markers,
            t_s=t_s[here],
            positions_m=markers.positions_m[here],
            located=None,
        )
        piece = replace(truth, t_s=t_s[here], markers=seen, **start)
        moved = simulate(piece, now, SCHEME, substeps=1)
        for way in np.diff(
            moved.positions_m, axis=0
        ):  # as the midpoint rule has it
            velocity = 2 * way / truth.timestep_s - velocity
        start = {
            "start": "given",
            "start_positions_m": moved.positions_m[-1],
            "start_velocities_m_s": velocity,
        }
        tracks.append(moved.markers_m[bool(first) :])
    return np.concatenate(tracks)


def _lame(truth: Experiment, values: Mapping[str, float]) -> dict[str, float]:
    """The values by λ and μ, where the body has a law of its own."""
    if truth.body.parts[0].material.name == "neo-hookean":
        return dict(values)
    young = values["young_pa"]
    poisson = values["poisson"]
    kept = {n: v for n, v in values.items() if n not in ("young_pa", "poisson")}
    mu = young / 2 / (1 + poisson)
    return kept | {
        "mu_pa": mu,
        "lambda_pa": 2 * mu * poisson / (1 - 2 * poisson),
    }


def _body(
    experiment: Experiment,
    values: Mapping[str, float],
    off: Mapping[str, float],
) -> Body:
    old = experiment.body
    (grasp,) = experiment.grasps
    pivot_m = old.nodes_m[grasp.nodes].mean(axis=0)
    larger = 1 + off.get("body_scale", 0.0)
    mesh = TetMesh(
        pivot_m + larger * (old.mesh.points_m - pivot_m), old.mesh.tetrahedra
    )
    stiffer = [off.get(f"anisotropy {axis}", 0.0) for axis in AXES]
    own: dict[str, Any] = {"damping": _damping(old.parts[0].damping, off)}
    if any(stiffer):
        own |= {"material": _stiffer_along(stiffer), "evaluator": "casadi"}
    more_drag = off.get("air_drag", 0.0) - off.get("added_mass", 0.0)
    if more_drag:
        own["forces"] = [_drag(more_drag * experiment.air_density_kg_m3)]
    density = old.mass_kg / old.mesh.volume_m3 * (1 + off.get("mass", 0.0))
    body = Body(mesh, density_kg_m3=density, **own)
    factor = np.ones(len(body.nodes_m))
    for axis, name in enumerate(AXES):
        place = body.nodes_m[:, axis] - np.average(
            body.nodes_m[:, axis], weights=body.node_mass
        )
        factor += (
            off.get(f"density_gradient {name}", 0.0)
            * place
            / np.abs(place).max()
        )
    body._lumped_m3 = [
        lumped * np.repeat(factor, 3) for lumped in body._lumped_m3
    ]
    body.node_mass = body.node_mass * factor
    return body


def _stiffer_along(shares: Sequence[float]) -> Material:
    def energy(f, lambda_pa, mu_pa):
        j = ca.det(f)
        young_pa = mu_pa * (3 * lambda_pa + 2 * mu_pa) / (lambda_pa + mu_pa)
        green = 0.5 * (f.T @ f - ca.SX.eye(3))
        isotropic = 0.5 * mu_pa * (2 * ca.trace(green) - 2 * ca.log(j))
        isotropic += 0.5 * lambda_pa * ca.log(j) ** 2
        return isotropic + 0.5 * young_pa * sum(
            s * green[k, k] ** 2 for k, s in enumerate(shares)
        )

    return Material.from_energy(energy)


def _damping(stated: DampingLaw, off: Mapping[str, float]) -> DampingLaw:
    """The stated law, which is a stress, with a share of the differences of others from it."""
    shares = {
        law: off.get(key, 0.0)
        for law, key in (
            *((law, f"damping_law {law}") for law in OBJECTIVE_DAMPINGS),
            ("rayleigh", "rayleigh_damping"),
        )
    }
    if not any(shares.values()):
        return stated
    own = 1 - sum(shares.values())

    def stress(psi, f, rate, gamma_r_s):
        terms = [
            (own, stated),
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
    """Return −½ ρ c_d a |v| v of each node, where a is the share of its surface that faces v."""
    per_area = 0.5 * density_kg_m3 * DRAG_COEFFICIENT * FACING_SHARE

    def drag(x, v, at):
        return -per_area * at.area_m2 * ca.sqrt(ca.sumsqr(v) + 1e-8) * v

    return NodeForce.from_law(drag)


def _lift(
    experiment: Experiment, body: Body, off: Mapping[str, float]
) -> tuple[Force, ...]:
    """Return the forces by which buoyancy differs from that of air with the true added mass."""
    more = off.get("buoyancy", 0.0) - off.get("added_mass", 0.0)
    air_kg = (
        experiment.air_density_kg_m3
        * body.node_mass
        * body.mesh.volume_m3
        / body.mass_kg
    )
    return tuple(
        Force([k], [0, 0, 9.81 * more * m])
        for k, m in enumerate(air_kg)
        if more * m
    )
