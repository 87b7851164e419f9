"""Newton: a Python module that builds the soft mesh from a JSON file beside it, and the comparison
of a body that Newton has read with this package.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from ...common.serialisation import content
from ...errors import InputError, listed
from ...recording import Obstacle
from .identified import IdentifiedBody
from .obstacle_shapes import FacetedObstacle, Primitive, faceted_obstacles
from .target import (
    ExportedFiles,
    PredictionComparison,
    TargetCapabilities,
    comment_lines,
    equilibria,
    linear_tetrahedra,
    longest_displacement_m,
    require_known_laws,
)

MODULE_FILE = "body.py"
DATA_FILE = "body.json"
CAPABILITIES = TargetCapabilities(
    stiffness_damping="damping γ_r becomes a viscosity k = γ_r μ / 2 [Pa s] with the stress 4 k Ė, the law "
    '"material" without its part λ tr(Ė): changes of volume are damped less; the identified law '
    "is {damping}",
    has_rounded_edges=False,
    has_face_selection=False,
)
# Factor on velocities after each step, so that a body comes to rest.
VELOCITY_FACTOR = 0.95
# Iterations of the solver in each step.
SOLVER_ITERATIONS = 20
# Steps until a body is at rest.
REST_STEPS = 400
# Timestep until a body is at rest.
REST_STEP_S = 2e-3
# Size arguments of each shape in Newton; zeros mean an infinite plane.
SIZE_ARGUMENTS = {
    "plane": ("width", "length"),
    "sphere": ("radius",),
    "box": ("hx", "hy", "hz"),
    "cylinder": ("radius", "half_height"),
    "capsule": ("radius", "half_height"),
}
_MODULE_SOURCE = '''
import json
from pathlib import Path

import newton
import numpy as np
import warp as wp

body = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))


def add_to(builder):
    """Add the body to a newton.ModelBuilder; particles that are grasped have no mass."""
    first = len(builder.particle_mass)
    builder.add_soft_mesh(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(),
        vertices=body["nodes_m"],
        indices=np.ravel(body["cells"]).tolist(),
        density=1.0,
        k_mu=np.array(body["k_mu"]),
        k_lambda=np.array(body["k_lambda"]),
        k_damp=np.array(body["k_damp"]),
        particle_radius=body["contact_m"],
    )
    for k, (mass, held) in enumerate(zip(body["node_mass_kg"], body["held"])):
        builder.particle_mass[first + k] = 0.0 if held else mass


def add_obstacles_to(builder):
    """Add what it may touch to a newton.ModelBuilder."""
    for each in body["obstacles"]:
        config = newton.ModelBuilder.ShapeConfig(
            ke=body["contact_n_m"], kd=0.0, mu=each["friction"]
        )
        add = getattr(builder, "add_shape_" + each["kind"])
        place = wp.transform(each["place_m"], each["quaternion_xyzw"])
        still = {} if each["kind"] == "plane" else {"body": -1}
        add(xform=place, cfg=config, label=each["name"], **each["size"], **still)


def model(device=None):
    """A model of the body and what it may touch, for newton.solvers.SolverVBD."""
    builder = newton.ModelBuilder(gravity=tuple(body["gravity_m_s2"]))
    add_to(builder)
    add_obstacles_to(builder)
    builder.color()
    made = builder.finalize(device=device)
    if body["obstacles"]:
        # Newton averages the body's and the obstacle's: SolverVBD geometrically.
        made.soft_contact_ke, made.soft_contact_kd = body["contact_n_m"], 0.0
        made.soft_contact_mu = body["contact_mu"]
    return made
'''


def _shared_contact(
    obstacles: Sequence[FacetedObstacle],
) -> tuple[float, float, float, tuple[str, ...]]:
    """Return friction, stiffness [N/m], radius ½ δ [m], and a sentence if obstacles differ."""
    constants = {
        "friction": [float(wall.obstacle.friction) for wall in obstacles],
        "stiffness": [wall.node_stiffness_n_m for wall in obstacles],
        "width": [wall.width_m for wall in obstacles],
    }
    friction, stiffness, width = (values or [0.0] for values in constants.values())
    unlike = [
        name for name, values in constants.items() if not np.allclose(values, values[:1], atol=0)
    ]
    sentence = (
        f"obstacles differ in {listed(unlike)}, but a soft body in Newton has only one value: "
        f"exported are the friction {friction[0]:.4g} of the first one, with which Newton "
        f"averages that of each obstacle, and the largest stiffness {max(stiffness):.4g} N/m "
        f"of a node and width {max(width):.4g} m"
    )
    differing = (sentence,) * bool(unlike)
    return friction[0], max(stiffness), max(width) / 2, differing


def export(body: IdentifiedBody) -> ExportedFiles:
    """Return the module ``body.py`` and its numbers ``body.json``, as text, with what Newton cannot
    express.

    The module reads the JSON file with its own name, so that both can be renamed together. Grasped
    nodes have no mass and are fixed at their positions of the first sample.

    The elastic constants are those of Newton's `SolverVBD`, whose energy is the stable neo-Hookean
    one of λ and μ (Smith, de Goes & Kim 2018).

    Raises
    ------
    InputError
        For another law.
    """
    require_known_laws(body, "newton")
    cells = []
    constants = []
    for region, own in zip(body.regions, linear_tetrahedra(body), strict=True):
        cells.append(own)
        # Damping stress of Newton: 4 k Ė; of this package: γ_r (2 μ Ė + λ tr(Ė) I).
        damping = region.gamma_r_s * region.mu_pa / 2
        constants.append(np.tile([region.mu_pa, region.lambda_pa, damping], (len(own), 1)))
    friction, stiffness_n_m, radius_m, differing = _shared_contact(faceted_obstacles(body))
    limits = [
        *CAPABILITIES.limitations(body),
        *differing,
        "SolverSemiImplicit needs other constants for the same material, k_mu = 4/3 μ and "
        "k_lambda = λ + 5/6 μ, and another damping",
        "positions are single precision",
    ]
    k_mu, k_lambda, k_damp = np.concatenate(constants).T
    data = {
        "nodes_m": np.where(body.is_prescribed, body.prescribed_m, body.nodes_m),
        "cells": np.concatenate(cells),
        "k_mu": k_mu,
        "k_lambda": k_lambda,
        "k_damp": k_damp,
        "node_mass_kg": body.total_node_mass_kg,
        "held": body.is_node_prescribed,
        "gravity_m_s2": body.experiment.gravity_m_s2,
        "contact_m": radius_m,
        "contact_n_m": stiffness_n_m,
        "contact_mu": friction,
        "obstacles": [_obstacle_data(each, body.start_s) for each in body.obstacles],
    }
    files = {
        MODULE_FILE: comment_lines(body, limits, start="# ") + _MODULE_SOURCE,
        DATA_FILE: json.dumps(content(data)) + "\n",
    }
    return ExportedFiles(files, tuple(limits))


def _obstacle_data(obstacle: Obstacle, t_s: float) -> dict[str, Any]:
    shape = Primitive.from_solid(obstacle.shape)
    place_m, turn = shape.pose_at(obstacle, t_s)
    sizes = shape.size_m if len(shape.size_m) else np.zeros(2)
    return {
        "name": obstacle.name,
        "kind": shape.kind,
        "size": dict(zip(SIZE_ARGUMENTS[shape.kind], sizes.tolist(), strict=True)),
        "place_m": place_m,
        "quaternion_xyzw": turn.as_quat(),
        "friction": float(obstacle.friction),
    }


def compare_at_rest(
    body: IdentifiedBody, add_to: Callable[[Any], None]
) -> list[PredictionComparison]:
    """Run Newton until a body is at rest, and compare the largest displacement.

    Grasped nodes and obstacles stay at their positions of the first sample; the number of steps is
    fixed, and convergence is not checked.

    Parameters
    ----------
    body : IdentifiedBody
        Body that was exported.
    add_to : callable
        Adds the body and its obstacles, as exported, to a `newton.ModelBuilder`. The particles of
        the body come first, in the order of its nodes.

    Raises
    ------
    InputError
        If Newton is not installed.
    SimulationError
        If the equilibrium of this package cannot be computed.
    """
    try:
        newton: Any = import_module("newton")
    except ImportError as error:
        raise InputError("install Newton to verify the export: pip install newton") from error

    builder = newton.ModelBuilder()
    friction, stiffness_n_m, radius_m, differing = _shared_contact(faceted_obstacles(body))
    if body.obstacles:
        builder.default_particle_radius = radius_m
    add_to(builder)
    # Particles without mass stay where they are.
    grasped = np.flatnonzero(body.is_node_prescribed)
    for k in grasped:
        builder.particle_mass[k] = 0.0
    builder.color()
    model = builder.finalize(device="cpu")
    if body.obstacles:
        model.soft_contact_ke = stiffness_n_m
        model.soft_contact_mu = friction
        model.shape_material_ke.fill_(stiffness_n_m)
    pipeline = newton.CollisionPipeline(model)
    # Obstacles do not move, so that rigid bodies need not be solved for.
    solver = newton.solvers.SolverVBD(
        model, iterations=SOLVER_ITERATIONS, integrate_with_external_rigid_solver=True
    )
    before: Any = model.state()
    after = model.state()
    control = model.control()
    contacts = pipeline.contacts()
    for _ in range(REST_STEPS):
        pipeline.collide(before, contacts)
        solver.step(before, after, control, contacts, REST_STEP_S)
        before, after = after, before
        before.particle_qd.assign(VELOCITY_FACTOR * before.particle_qd.numpy())
    theirs = before.particle_q.numpy().astype(float) - body.nodes_m
    sag_m = longest_displacement_m(equilibria(body)[0][0])
    remark = "".join(differing)
    return [
        PredictionComparison(
            "largest displacement at rest",
            longest_displacement_m(theirs),
            ours=sag_m,
            unit="m",
            remark=remark,
        )
    ]
