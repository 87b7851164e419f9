"""Simulation of the swung cylinder of `peer_case` by MuJoCo's flex."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from peer_case import NODE_MASS_KG, SAMPLE_COUNT, SAMPLE_S, grasped_nodes, hand_motion

import collocation_sysid as cs

Array = NDArray[np.float64]

# The body settles at the implicit integrator's large steps, which damp it strongly.
SETTLING_STEP_S = 5e-3
SETTLING_STEPS = 100
# Explicit steps: stable at the truth and the guess; 0.1 ms is not.
MUJOCO_STEP_S = 5e-5
# Explicit steps of the recording.
RECORDING_STEP_S = 1e-5
# Arbitrary inertia of the hand, whose motion is prescribed [kg].
HAND_MASS_KG = 50.0


class UnstableSimulationError(RuntimeError):
    """A simulation did not reach the end of the recording."""


def simulate_flex(
    mesh: cs.TetMesh, values: Mapping[str, float], *, step_s: float = MUJOCO_STEP_S
) -> Array:
    """Simulate the cylinder by MuJoCo's explicit integrator."""
    mujoco: Any = import_module("mujoco")
    # Without this, MuJoCo writes its warnings to a file in the current folder.
    mujoco.set_mju_user_warning(lambda _: None)
    model = mujoco.MjModel.from_xml_string(_flex_description(mesh, values))
    data = mujoco.MjData(model)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    model.opt.timestep = SETTLING_STEP_S
    for _ in range(SETTLING_STEPS):
        mujoco.mj_step(model, data)
    # The iterative solver of large steps warns of its last digits.
    for warning in data.warning:
        warning.number = 0
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    model.opt.timestep = step_s
    positions_m = np.empty((SAMPLE_COUNT, len(mesh.points_m), 3))
    steps = round(SAMPLE_S / step_s)
    count = (SAMPLE_COUNT - 1) * steps + 1
    for step in range(count):
        hand = hand_motion(step * step_s)
        data.qpos[:2] = hand.coordinates
        data.qvel[:2] = hand.rates
        if step % steps == 0:
            mujoco.mj_kinematics(model, data)
            mujoco.mj_flex(model, data)
            positions_m[step // steps] = data.flexvert_xpos
        mujoco.mj_step(model, data)
        if step % steps == 0 and _has_failed(mujoco, data):
            raise UnstableSimulationError(
                f"MuJoCo: unstable at {step * step_s:.3g} s with {dict(values)}"
            )
    return positions_m


def _has_failed(mujoco: Any, data: Any) -> bool:
    """Return whether MuJoCo has warned of positions, velocities or accelerations."""
    kinds = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")
    return any(data.warning[getattr(mujoco.mjtWarning, kind)].number for kind in kinds)


def _flex_description(mesh: cs.TetMesh, values: Mapping[str, float]) -> str:
    """Return MuJoCo's description of the hand and the cylinder.

    Each free node is a separate body in the world, so that the mass matrix is diagonal; the grasped
    nodes belong to the hand, whose two joints come first.
    """
    grasped = set(grasped_nodes(mesh).tolist())
    nodes = range(len(mesh.points_m))
    axes = ("1 0 0", "0 1 0", "0 0 1")
    joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in axes)
    bodies = "".join(
        f'<body name="node{n}" pos="{_words(mesh.points_m[n])}">'
        f'<inertial pos="0 0 0" mass="{NODE_MASS_KG}" '
        f'diaginertia="1e-9 1e-9 1e-9"/>{joints}</body>'
        for n in nodes
        if n not in grasped
    )
    names = " ".join("hand" if n in grasped else f"node{n}" for n in nodes)
    is_grasped = np.isin(np.arange(len(mesh.points_m)), list(grasped))
    local_m = np.where(is_grasped[:, None], mesh.points_m, 0.0)
    top_m = mesh.points_m[:, 2].max()
    return f"""
<mujoco>
  <option>
    <flag contact="disable" constraint="disable" autoreset="disable"/>
  </option>
  <worldbody>
    <body name="hand">
      <joint type="slide" axis="1 0 0"/>
      <joint type="hinge" axis="0 1 0" pos="0 0 {top_m}"/>
      <geom type="box" size=".03 .03 .01" pos="0 0 {top_m}"
            mass="{HAND_MASS_KG}" contype="0" conaffinity="0"/>
    </body>
    {bodies}
  </worldbody>
  <deformable>
    <flex name="foam" dim="3" radius="0.0005" body="{names}"
          vertex="{_words(local_m)}" element="{_words(mesh.tetrahedra)}">
      <contact contype="0" conaffinity="0" selfcollide="none"/>
      <elasticity young="{values["young_pa"]}" poisson="{values["poisson"]}"
                  damping="{values["gamma_r_s"]}"/>
    </flex>
  </deformable>
</mujoco>"""


def _words(array: Any) -> str:
    """Return numbers separated by spaces."""
    return " ".join(map(str, np.ravel(array).tolist()))
