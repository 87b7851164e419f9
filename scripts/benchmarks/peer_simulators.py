"""Simulations of the swung cylinder by MuJoCo's flex and by CalculiX.

`simulate_flex` needs the package `mujoco`, `simulate_with_calculix` the program ``ccx``. The
cylinder and the motion of the hand are those of `peer_case`.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from peer_case import (
    GRAVITY_M_S2,
    NODE_MASS_KG,
    SAMPLE_COUNT,
    SAMPLE_S,
    STEPS_PER_SAMPLE,
    cylinder,
    grasped_nodes,
    grasped_positions,
    hand_motion,
)

import collocation_sysid as cs

Array = NDArray[np.float64]

# MuJoCo -------------------------------------------------------------------------------------------

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
    mesh: cs.TetMesh,
    values: Mapping[str, float],
    *,
    step_s: float = MUJOCO_STEP_S,
    integrator: str = "Euler",
) -> Array:
    """Simulate the cylinder by MuJoCo.

    Parameters
    ----------
    mesh : TetMesh
        The cylinder.
    values : dict of str to float
        Values of the parameters of `peer_case.TRUTH`.
    step_s : float
        Time step [s].
    integrator : {"Euler", "discrete"}
        MuJoCo's integrator after the body has settled: explicit or implicit for the flex.

    Returns
    -------
    positions_m : (T, n, 3) array
        Positions of the nodes at the samples [m].

    Raises
    ------
    UnstableSimulationError
        If MuJoCo warns of bad positions, velocities or accelerations.
    """
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
    if integrator == "Euler":
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
                f"MuJoCo, {integrator}, steps of {step_s:g} s: unstable "
                f"at {step * step_s:.3g} s with {dict(values)}"
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


# CalculiX -----------------------------------------------------------------------------------------

# Name of CalculiX's files in the folder of a simulation.
JOB = "cylinder"
# Density of the elements, which carry no mass but must have some [kg/m³].
NO_DENSITY_KG_M3 = 1e-6


def simulate_with_calculix(
    values: Mapping[str, float], folder: Path, *, is_damped: bool = True
) -> Array:
    """Simulate the cylinder by CalculiX's implicit dynamics, in steps of the trapezoidal rule.

    CalculiX has Rayleigh damping β K instead of the damping stress of `peer_case`; γ_r is its β.

    Parameters
    ----------
    values : dict of str to float
        Values of the parameters of `peer_case.TRUTH`.
    folder : path
        Existing folder for CalculiX's files, which are overwritten.
    is_damped : bool
        False: without damping.

    Returns
    -------
    positions_m : (T, n, 3) array
        Positions of the nodes at the samples [m].

    Raises
    ------
    UnstableSimulationError
        If CalculiX fails, with the end of what it printed.
    """
    mesh = cylinder()
    deck = _calculix_deck(mesh, values, is_damped=is_damped)
    (folder / f"{JOB}.inp").write_text(deck, encoding="ascii")
    process = subprocess.run(
        ["ccx", "-i", JOB], cwd=folder, capture_output=True, text=True, check=False
    )
    blocks = (folder / f"{JOB}.dat").read_text().split("displacements")[1:]
    if process.returncode or len(blocks) != SAMPLE_COUNT:
        raise UnstableSimulationError(f"CalculiX: {process.stdout[-300:]}")
    displacements_m = [_displacements(block) for block in blocks]
    return np.array(displacements_m) + mesh.points_m


def _displacements(block: str) -> Array:
    """Return the displacements (n, 3) [m] of a block of CalculiX's table of nodes."""
    lines = [line.split() for line in block.splitlines()[1:]]
    rows = [line[1:] for line in lines if len(line) == 4 and line[0].isdigit()]
    return np.array(rows, dtype=float)


def _calculix_deck(mesh: cs.TetMesh, values: Mapping[str, float], *, is_damped: bool) -> str:
    """Return CalculiX's input: a static step under gravity, then the motion of the hand."""
    grasped = grasped_nodes(mesh)
    free = np.setdiff1d(np.arange(len(mesh.points_m)), grasped)
    elements = np.asarray(mesh.tetrahedra) + 1
    lumps = [[len(elements) + 1 + k, n + 1] for k, n in enumerate(free)]
    weight_n = NODE_MASS_KG * GRAVITY_M_S2[2]
    loads = "\n".join(f"{n + 1},3,{weight_n:.12e}" for n in free)
    damping = f"*DAMPING,ALPHA=0.,BETA={values['gamma_r_s']:.12e}"
    step_s = SAMPLE_S / STEPS_PER_SAMPLE
    times_s = step_s * np.arange((SAMPLE_COUNT - 1) * STEPS_PER_SAMPLE + 1)
    displacements_m = grasped_positions(mesh, times_s) - mesh.points_m[grasped]
    return f"""*NODE,NSET=ALL
{_rows(enumerate(mesh.points_m, start=1))}
*ELEMENT,TYPE=C3D4,ELSET=BODY
{_rows(enumerate(elements, start=1))}
*ELEMENT,TYPE=MASS,ELSET=LUMPS
{_rows((lump[0], lump[1:]) for lump in lumps)}
*MASS,ELSET=LUMPS
{NODE_MASS_KG:.12e}
*MATERIAL,NAME=FOAM
*ELASTIC
{values["young_pa"]:.12e},{values["poisson"]:.12e}
*DENSITY
{NO_DENSITY_KG_M3}
{damping if is_damped else "**"}
*SOLID SECTION,ELSET=BODY,MATERIAL=FOAM
{_amplitudes(grasped, times_s, displacements_m)}
*STEP,NLGEOM,INC=1000
*STATIC
0.25,1.
*BOUNDARY
{_rows((n + 1, (1, 3, 0.0)) for n in grasped)}
*CLOAD
{loads}
*NODE PRINT,NSET=ALL,FREQUENCY=1000
U
*EL PRINT,ELSET=BODY,TOTALS=ONLY,FREQUENCY=1000
ELSE
*END STEP
*STEP,NLGEOM,INC=100000
*DYNAMIC,DIRECT,ALPHA=0.
{step_s:.12e},{times_s[-1]:.12e}
{_boundary_conditions(grasped)}
*CLOAD
{loads}
*NODE PRINT,NSET=ALL,FREQUENCY={STEPS_PER_SAMPLE}
U
*END STEP
"""


def _amplitudes(
    grasped: NDArray[np.intp], times_s: NDArray[np.floating], displacements_m: Array
) -> str:
    """Return CalculiX's tables of the displacements (k, g, 3) [m] of the grasped nodes."""
    tables = []
    for k, node in enumerate(grasped):
        for axis in range(3):
            rows = np.column_stack([times_s, displacements_m[:, k, axis]])
            lines = "\n".join(f"{t:.12e},{u:.12e}" for t, u in rows)
            tables.append(f"*AMPLITUDE,NAME=A{node}_{axis}\n{lines}")
    return "\n".join(tables)


def _boundary_conditions(grasped: NDArray[np.intp]) -> str:
    """Return CalculiX's conditions that the grasped nodes follow their tables."""
    return "\n".join(
        f"*BOUNDARY,AMPLITUDE=A{n}_{axis}\n{n + 1},{axis + 1},{axis + 1},1."
        for n in grasped
        for axis in range(3)
    )


def _rows(rows: Iterable[tuple[int, Any]]) -> str:
    """Return lines of a number and further numbers, of at most 20 characters each."""
    return "\n".join(
        ",".join([str(number), *(_number(value) for value in values)]) for number, values in rows
    )


def _number(value: float) -> str:
    """Return an integer without decimals, and another number with 13 digits."""
    is_integer = isinstance(value, (int, np.integer))
    return str(value) if is_integer else f"{value:.12e}"
