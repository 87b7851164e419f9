"""A cube released in one of its modes, and the frequency and damping of its simulated oscillation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from collocation_sysid.program.modes.natural import Modes, natural_modes
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment, Grasp, PoseSequence
from kit.forces import forces_alone
from kit.problems import EDGE_M, hung_cube, nodes_where, vertex_markers

# Small enough for the cube to be linear, large enough against the tolerance of Newton's method.
AMPLITUDE_M = 1e-6 * EDGE_M


def released_in_a_mode(theta: np.ndarray, mode: int, timestep_s: float = 0.01, steps: int = 30):
    """A weightless cube held at its top, displaced in one of its modes and let go.

    Returns
    -------
    experiment : Experiment
    modes : Modes
    """
    cube = hung_cube()
    body, t_s = cube.body, timestep_s * np.arange(steps + 1)
    held = nodes_where(body, 2, EDGE_M)
    modes = natural_modes(forces_alone(body, theta), body.nodes_m, cube.free_dofs)
    shape = modes.shapes[mode] / np.abs(modes.shapes[mode]).max()
    released = replace(
        cube,
        t_s=t_s,
        grasps=(Grasp(held, PoseSequence.fixed()),),
        markers=vertex_markers(body, [0], t_s),
        gravity_m_s2=np.zeros(3),
        start="given",
        start_positions_m=body.nodes_m + AMPLITUDE_M * shape,
    )
    return released, modes


def oscillation(
    experiment: Experiment, modes: Modes, mode: int, theta: np.ndarray, integrator: str, **options
) -> tuple[float, float]:
    """Undamped angular frequency and damping ratio of a mode's amplitude in a simulation.

    An oscillation sampled evenly satisfies a_{k+2} = 2 Re(z) a_{k+1} − |z|² a_k.
    """
    body = experiment.body
    steps = {} if "timestep_s" in options else {"substeps": 1}
    motion = simulate(experiment, theta, integrator, **steps, **options).positions_m - body.nodes_m
    weights = body.node_mass[:, None] * modes.shapes[mode]
    a = np.tensordot(motion, weights, axes=2)[
        12:
    ]  # where what the start stirred up besides is gone
    (double_real, minus_square), *_ = np.linalg.lstsq(
        np.column_stack([a[1:-1], a[:-2]]), a[2:], rcond=None
    )
    z = complex(double_real / 2, np.sqrt(-minus_square - double_real**2 / 4))
    exponent = np.log(z)
    return abs(exponent) / experiment.timestep_s, -exponent.real / abs(exponent)
