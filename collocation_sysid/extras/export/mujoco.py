"""MuJoCo: a flex of tetrahedra whose nodes are bodies on three slides; grasps are mocap bodies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import eigh
from scipy.sparse.linalg import eigsh
from scipy.spatial.transform import Rotation

from ...common.array_types import Array
from ...errors import InputError
from ...kinds.rod.element import centres_of_sections
from ...model.forces import Forces
from ...program.modes.natural import natural_modes
from ...recording import Grasp, Solid
from .identified import IdentifiedBody
from .mujoco_cable import Chain, clamp_in_gripper, hinge_angles
from .obstacle_shapes import Primitive, offset_solid
from .target import (
    ExportedFiles,
    PredictionComparison,
    TargetCapabilities,
    comment_lines,
    linear_tetrahedra,
    require_known_laws,
    values_as_text,
    xml_attribute,
)

MODEL = "body.xml"
# Oldest major version: with 3.3 to 3.8 and 3.17 the first natural frequency is 10 % too high, with
# 3.10 and 3.12 33 %.
OLDEST_VERSION = 4
# Timestep over the largest one at which explicit damping and elasticity are stable.
STEP_SAFETY_FACTOR = 0.5
# Half the thickness of the skin that collides, in mean edges.
RELATIVE_SKIN_RADIUS = 0.02
# Mass of the body that carries grasped nodes over that of the specimen: the nodes do not move it.
CARRIER_MASS_RATIO = 1e3
# Displacement of nodes in the differences for the stiffness, in mean edges.
RELATIVE_DIFFERENCE_STEP = 1e-5
# Steps of a verified motion: some minutes.
MAX_STEPS = 2_000_000
CAPABILITIES = TargetCapabilities(
    stiffness_damping='the damping of a flex is the law "material", γ_r (λ tr(Ė) I + 2 μ Ė); '
    "{damping} agrees with it at small strain",
    mass_damping="mass-proportional damping, γ_m = {gamma_m_1_s:.4g} 1/s, is not supported, and MuJoCo "
    "refuses dampers on the nodes of a flex",
    damping_law="material",
    has_moving_grasps=True,
    has_rounded_edges=False,
    has_face_selection=False,
)


def export(body: IdentifiedBody) -> ExportedFiles:
    """Return the model file, whose key frame "start" is the state at the first sample, and what
    MuJoCo cannot express.

    Raises
    ------
    InputError
        For another law, or for grasps that hold single axes, or not during the whole recording.
    """
    if body.experiment.specimen is not None:
        raise InputError(
            "a test of a specimen has no body that moves; export its constants with --to json or "
            "calculix, also with --samples, or export a recording of a body"
        )
    require_known_laws(body, "mujoco")
    for k, grasp in enumerate(body.experiment.grasps, start=1):
        if grasp.axes != "xyz" or not grasp.is_active(body.experiment.t_s).all():
            raise InputError(
                f"grasp {k} holds only {grasp.axes}, from {grasp.from_s:g} s until "
                f"{grasp.until_s:g} s; a mocap body of MuJoCo holds nodes along all axes, "
                "throughout: export to calculix or json"
            )
    if not body.body.is_solid:
        return _export_cable(body)
    limits = CAPABILITIES.limitations(body)
    if body.experiment.grasps:
        limits.append(
            "the weld of grasped nodes to the mocap bodies lags by two time steps: to apply a "
            "motion, set position and velocity of the free joints at every step, as --verify does"
        )
    step_s = _stable_step_s(body)
    x = comment_lines(body, limits, start="<!-- ", end=" -->")
    x += f"<mujoco model={xml_attribute(body.title or 'body')}>\n"
    gravity = values_as_text(body.experiment.gravity_m_s2)
    x += f'<option timestep="{step_s!r}" gravity="{gravity}" jacobian="sparse"/>\n'
    bodies = f"{_grasp_xml(body)}{_obstacle_xml(body, step_s)}{_node_xml(body)}"
    x += f"<worldbody>\n{bodies}</worldbody>\n"
    x += f"<deformable>\n{_flex_xml(body)}</deformable>\n"
    x += f"<equality>\n{_weld_xml(body, step_s)}</equality>\n"
    x += f"<keyframe>\n{_keyframe_xml(body)}</keyframe>\n"
    return ExportedFiles({MODEL: f"{x}</mujoco>\n"}, tuple(limits))


def _export_cable(body: IdentifiedBody) -> ExportedFiles:
    chain = Chain.from_body(body)
    interval_s = body.experiment.timestep_s
    step_s = interval_s / int(np.ceil(interval_s / chain.stable_step_s))
    limits = [
        "the cable does not stretch; mass-proportional damping is the drag of a viscous medium, which "
        "is the same for links of the same length"
    ]
    x = comment_lines(body, limits, start="<!-- ", end=" -->")
    gravity = values_as_text(body.experiment.gravity_m_s2)
    grasp = _grasp_xml(body).removesuffix("</body>\n")
    (holding,) = body.experiment.grasps
    clamp = clamp_in_gripper(body, int(chain.sections[0]))
    x += f"<mujoco model={xml_attribute(body.title or 'cable')}>\n"
    x += f'<option timestep="{step_s!r}" gravity="{gravity}" integrator="implicitfast" '
    x += f'viscosity="{chain.viscosity!r}"/>\n'
    x += f"<worldbody>\n{grasp}{chain.xml(clamp)}</body>\n</worldbody>\n"
    x += f"<equality>\n{_weld_xml(body, step_s)}</equality>\n"
    shape = body.nodes_m if body.simulated_m is None else body.simulated_m[0]
    start = np.concatenate(
        [*_pose_at(holding, body.start_s), hinge_angles(shape, chain.sections).ravel()]
    )
    x += f'<keyframe>\n<key name="start" qpos="{values_as_text(start)}"/>\n</keyframe>\n'
    return ExportedFiles({MODEL: f"{x}</mujoco>\n"}, tuple(limits))


def _compare_tip(body: IdentifiedBody, mujoco: ModuleType, model: Any) -> PredictionComparison:
    """Compare the RMS motion of the free end against the gripper [m]."""
    e = body.experiment
    assert body.simulated_m is not None
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    steps = round(e.timestep_s / model.opt.timestep)
    tips = []
    for k in range(steps * (len(e.t_s) - 1) + 1):
        at_s = min(body.start_s + k * model.opt.timestep, float(e.t_s[-1]))
        data.mocap_pos[0], data.mocap_quat[0] = _pose_at(e.grasps[0], at_s)
        if k % steps == 0:
            mujoco.mj_forward(model, data)
            tips.append(data.site("tip").xpos.copy())
        mujoco.mj_step(model, data)
    ours = centres_of_sections(body.simulated_m)[:, -1]
    rigid_m = centres_of_sections(e.rigid_positions(e.t_s))[:, -1]
    moved, theirs = ours - rigid_m, np.array(tips) - rigid_m
    moved, theirs = moved - moved[0], theirs - theirs[0]
    difference_m = _rms_length(theirs - moved)
    remark = (
        f"the tips differ by {difference_m:.3g} m (RMS), {difference_m / _rms_length(moved):.2%}"
    )
    return PredictionComparison(
        "RMS motion of the free end against the gripper",
        _rms_length(theirs),
        ours=_rms_length(moved),
        unit="m",
        remark=remark,
    )


def _grasp_xml(body: IdentifiedBody) -> str:
    """The second body is needed: nodes of an elastic flex cannot be attached to a mocap body."""
    lines = ""
    mass = body.node_mass_kg.sum() * CARRIER_MASS_RATIO
    size = np.ptp(body.nodes_m, axis=0).max()
    inertia = float(mass * size**2)
    for k, grasp in enumerate(body.experiment.grasps):
        position, turn = _pose_at(grasp, body.start_s)
        at = f'pos="{values_as_text(position)}" quat="{values_as_text(turn)}"'
        lines += (
            f'<body name="hand{k}" mocap="true" {at}/>\n<body name="grasp{k}" {at} gravcomp="1">'
            f'<freejoint/><inertial pos="0 0 0" mass="{float(mass)!r}" '
            f'diaginertia="{inertia!r} {inertia!r} {inertia!r}"/></body>\n'
        )
    return lines


def _obstacle_xml(body: IdentifiedBody, step_s: float) -> str:
    """Solids are smaller by the skin, so that contact begins at the true surface."""
    lines = ""
    skin = RELATIVE_SKIN_RADIUS * _mean_edge_m(body)
    for k, each in enumerate(body.obstacles):
        position, turn = _pose_at(each, body.start_s)
        friction = float(each.friction)
        geom = _geom_attributes(offset_solid(each.shape, -skin))
        lines += (
            f'<body name="obstacle{k}" mocap="true" pos="{values_as_text(position)}" '
            f'quat="{values_as_text(turn)}"><geom name={xml_attribute(each.name)} {geom} '
            f'priority="1" condim="{3 if friction else 1}" friction="{friction!r} 0 0" '
            f'solref="{2 * step_s!r} 1"/></body>\n'
        )
    return lines


def _geom_attributes(solid: Solid) -> str:
    shape = Primitive.from_solid(solid)
    turn = values_as_text(shape.rotation.as_quat(scalar_first=True))
    size = values_as_text(shape.size_m) if len(shape.size_m) else "0 0 1"
    return f'type="{shape.kind}" size="{size}" pos="{values_as_text(shape.centre_m)}" quat="{turn}"'


def _weld_xml(body: IdentifiedBody, step_s: float) -> str:
    """Welds are as stiff as the timestep `step_s` [s] allows."""
    return "".join(
        f'<weld body1="hand{k}" body2="grasp{k}" relpose="0 0 0 1 0 0 0" '
        f'solref="{2 * step_s!r} 1" solimp="0.9999 0.9999 0.001"/>\n'
        for k in range(len(body.experiment.grasps))
    )


def _pose_at(grasp: Grasp, t_s: float) -> tuple[Array, Array]:
    """Return position (3,) [m] and unit quaternion (w, x, y, z), see `PoseSequence.at`."""
    rotations, positions = grasp.poses.at([t_s])
    return positions[0], np.roll(Rotation.from_matrix(rotations[0]).as_quat(), 1)


def _node_xml(body: IdentifiedBody) -> str:
    lines = ""
    mass = body.total_node_mass_kg
    for n in np.flatnonzero(~body.is_node_prescribed):
        joints = "".join(
            f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1")
        )
        # Nodes do not rotate, but MuJoCo requires a moment of inertia.
        inertia = max(1e-6 * float(mass[n]), 1e-12)
        lines += (
            f'<body name="node{n}" pos="{values_as_text(body.nodes_m[n])}">'
            f'<inertial pos="0 0 0" mass="{float(mass[n])!r}" '
            f'diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>{joints}</body>\n'
        )
    return lines


def _flex_xml(body: IdentifiedBody) -> str:
    """Positions of grasped nodes are those in the undeformed body; the skin follows the mesh."""
    names = np.array([f"node{n}" for n in range(len(body.nodes_m))], dtype=object)
    places = np.zeros_like(body.nodes_m)
    for k, grasp in enumerate(body.experiment.grasps):
        names[grasp.nodes] = f"grasp{k}"
        places[grasp.nodes] = body.body.nodes_m[grasp.nodes]
    skin = RELATIVE_SKIN_RADIUS * _mean_edge_m(body)
    lines = ""
    for region, cells in zip(body.regions, linear_tetrahedra(body), strict=True):
        used, elements = np.unique(cells, return_inverse=True)
        lines += (
            f'<flex name="{region.name}" dim="3" radius="{skin!r}" body="{" ".join(names[used])}" '
            f'vertex="{values_as_text(places[used])}" '
            f'element="{" ".join(map(str, elements.ravel()))}">\n'
            '<contact contype="1" conaffinity="0" selfcollide="none"/>\n'
            f'<elasticity young="{region.young_pa!r}" poisson="{region.poisson!r}" '
            f'damping="{region.gamma_r_s!r}"/>\n</flex>\n'
        )
    return lines


def _mean_edge_m(body: IdentifiedBody) -> float:
    ends = body.body.nodes_m[body.body.mesh.edges]
    return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean())


def _keyframe_xml(body: IdentifiedBody) -> str:
    """Return the key frame "start"."""
    free = ~body.is_node_prescribed
    shape = body.nodes_m if body.simulated_m is None else body.simulated_m[0]
    started = body.experiment.initial_velocities_m_s
    velocity = np.zeros_like(shape) if started is None else started
    grasps = body.experiment.grasps
    carriers = [np.concatenate(_pose_at(grasp, body.start_s)) for grasp in grasps]
    places = values_as_text(np.concatenate([*carriers, (shape - body.nodes_m)[free].ravel()]))
    speeds = values_as_text(np.concatenate([np.zeros(6 * len(grasps)), velocity[free].ravel()]))
    return f'<key name="start" qpos="{places}" qvel="{speeds}"/>\n'


def _stable_step_s(body: IdentifiedBody) -> float:
    """Return a timestep that divides the interval and keeps integration stable."""
    state = body.body.nodes_m.reshape(1, -1)
    at = body.body.linearise(state, np.zeros_like(state), theta=body.theta)
    stiffness = body.body.pattern.matrix(-at.by_position[0])
    root = 1 / np.sqrt(np.repeat(body.node_mass_kg, 3))
    scaled = sp.diags_array(root) @ stiffness @ sp.diags_array(root)
    start = np.random.default_rng(0).normal(size=len(root))
    largest = eigsh(scaled, 1, which="LA", v0=start, return_eigenvectors=False)
    omega = float(np.sqrt(largest[0]))
    ratio = max(region.gamma_r_s for region in body.regions) * omega / 2
    step_s = STEP_SAFETY_FACTOR * 2 / omega * (np.hypot(1, ratio) - ratio)
    interval_s = body.experiment.timestep_s
    return interval_s / int(np.ceil(interval_s / step_s))


def verify(body: IdentifiedBody, folder: Path) -> list[PredictionComparison]:
    """Run MuJoCo on the exported model, and compare the first natural frequency and, if the
    recording is a motion with a forward simulation, the deformation.

    Parameters
    ----------
    body : IdentifiedBody
        Body that was exported.
    folder : Path
        Folder with the model; nothing is written to it.

    Raises
    ------
    InputError
        If MuJoCo is missing, too old, or refuses the model, or if the motion needs more than
        `MAX_STEPS` steps.
    """
    mujoco = _import_mujoco()
    try:
        model = mujoco.MjModel.from_xml_path(str(folder / MODEL))
    except ValueError as error:
        raise InputError(
            f"MuJoCo refuses the exported model ({error}); export to another format, such as "
            "calculix or json",
            folder / MODEL,
        ) from error
    if not body.body.is_solid:
        return [_compare_tip(body, mujoco, model)] if body.simulated_m is not None else []
    compared = [_compare_first_frequency(body, mujoco, model=model)]
    if not body.experiment.is_static and body.simulated_m is not None:
        compared.append(_compare_motion(body, mujoco, model=model))
    return compared


def _import_mujoco() -> ModuleType:
    try:
        import mujoco  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            'mujoco is not installed: pip install "collocation-sysid[mujoco]"'
        ) from error
    version: str = getattr(mujoco, "__version__")  # noqa: B009 (not in its stubs)
    if int(version.partition(".")[0]) < OLDEST_VERSION:
        raise InputError(
            f"found MuJoCo {version}, which makes a flex stiffer than specified; expected "
            f'{OLDEST_VERSION} or newer: pip install --upgrade "collocation-sysid[mujoco]"'
        )
    return mujoco


def _compare_first_frequency(
    body: IdentifiedBody, mujoco: ModuleType, model: Any
) -> PredictionComparison:
    """Compare the first frequency [Hz] in vacuum, without rigid modes."""
    data = mujoco.MjData(model)
    free = ~body.is_node_prescribed
    grasps = len(body.experiment.grasps)
    probe = RELATIVE_DIFFERENCE_STEP * _mean_edge_m(body)
    count = 3 * int(free.sum())
    columns = np.zeros((count, count))
    for column in range(count):
        ends = []
        for way in (probe, -probe):
            mujoco.mj_resetData(model, data)
            data.qpos[7 * grasps + column] = way
            mujoco.mj_forward(model, data)
            ends.append(data.qfrc_passive[6 * grasps :].copy())
        columns[:, column] = (ends[1] - ends[0]) / (2 * probe)
    mass = np.repeat((body.total_node_mass_kg)[free], 3)
    root = 1 / np.sqrt(mass)
    squares = eigh((columns + columns.T) / 2 * np.outer(root, root), eigvals_only=True)
    oscillating = squares[squares > 1e-9 * squares[-1]]
    theirs = float(np.sqrt(oscillating[0])) / (2 * np.pi)
    dofs = np.flatnonzero(np.repeat(free, 3))
    in_vacuum = replace(body.experiment, air_density_kg_m3="none")
    forces = Forces.from_experiment(in_vacuum, body.start_s, theta=body.theta)
    ours = natural_modes(forces, body.nodes_m, free_dofs=dofs, count=1).frequencies_hz
    return PredictionComparison(
        "first natural frequency, undeformed", theirs, ours=float(ours[0]), unit="Hz"
    )


def _compare_motion(body: IdentifiedBody, mujoco: ModuleType, model: Any) -> PredictionComparison:
    """Compare the RMS deformation over the recording [m]."""
    e = body.experiment
    free = ~body.is_node_prescribed
    data = mujoco.MjData(model)
    model.eq_active0[:] = 0
    mujoco.mj_resetDataKeyframe(model, data, 0)
    steps = round(e.timestep_s / model.opt.timestep)
    if steps * len(e.t_s) > MAX_STEPS:
        raise InputError(
            f"the prediction of the motion would need {steps * len(e.t_s)} time steps; expected at "
            f"most {MAX_STEPS}: verify with a shorter recording or a coarser mesh"
        )
    first = 7 * len(e.grasps)
    shapes = [data.qpos[first:].reshape(-1, 3).copy()]
    for k in range(steps * (len(e.t_s) - 1)):
        _set_grasp_state(
            body,
            mujoco,
            data=data,
            time_and_step_s=(body.start_s + k * model.opt.timestep, model.opt.timestep),
        )
        mujoco.mj_step(model, data)
        if (k + 1) % steps == 0:
            shapes.append(data.qpos[first:].reshape(-1, 3).copy())
    theirs = np.array(shapes) + body.nodes_m[free]
    assert body.simulated_m is not None
    ours = body.simulated_m[:, free]
    rigid_m = e.rigid_positions(e.t_s)[:, free]
    size_m = _rms_length(ours - rigid_m)
    difference_m = _rms_length(theirs - ours)
    share = f", {difference_m / size_m:.2%} of it" if size_m else ""
    remark = f"both simulations differ by {difference_m:.3g} m (RMS){share}"
    what = "RMS deformation over the recording"
    return PredictionComparison(
        what, _rms_length(theirs - rigid_m), ours=size_m, unit="m", remark=remark
    )


def _set_grasp_state(
    body: IdentifiedBody, mujoco: ModuleType, data: Any, time_and_step_s: tuple[float, float]
) -> None:
    """Grasp k has 7 k … of `qpos`, 6 k … of `qvel`; obstacles follow in `mocap_pos`."""
    t_s, step_s = time_and_step_s
    last_s = float(body.experiment.t_s[-1])
    turning = np.zeros(3)
    for k, grasp in enumerate(body.experiment.grasps):
        here, there = (_pose_at(grasp, min(at_s, last_s)) for at_s in (t_s, t_s + step_s))
        mujoco.mju_subQuat(turning, there[1], here[1])
        data.qpos[7 * k : 7 * k + 7] = np.concatenate(here)
        data.qvel[6 * k : 6 * k + 6] = np.concatenate([there[0] - here[0], turning]) / step_s
    for k, each in enumerate(body.obstacles, len(body.experiment.grasps)):
        data.mocap_pos[k], data.mocap_quat[k] = _pose_at(each, min(t_s, last_s))


def _rms_length(vectors: Array) -> float:
    """Vectors are (…, 3)."""
    return float(np.sqrt((vectors**2).sum(axis=-1).mean()))
