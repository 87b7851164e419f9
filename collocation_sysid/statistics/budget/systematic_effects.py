"""Systematic effects (type B): assumptions that are not estimated, and what changes if they are
wrong.

An assumption is a `Deviation` of the table `ASSUMPTIONS` with an `Effect`; those of one kind of body,
measurement or force are in its room of `kinds/`. Deviations that change only the measurements
(cameras, clocks) are in `recording.nuisance`.
`Assumptions` is the table of the problem file in which users state standard deviations.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from ...common.array_types import Array
from ...common.field_descriptions import FieldOfRow, sentence, with_fields
from ...common.schema_tables import ByForm, Section
from ...common.validated_classes import validated
from ...common.validated_types import Positive
from ...fem.body import Body
from ...fem.laws.constants import GAMMA_M, GAMMA_R
from ...fem.laws.materials import DAMPINGS, MATERIALS
from ...fem.laws.moduli import engineering_constants
from ...kinds.registry import KINDS
from ...model.parameters import Parameters
from ...recording import nuisance
from ...recording.deviation import Deviation
from ...recording.homogeneous_deformation import (
    CELL_SIZE_M,
    STRESS_PER_FORCE,
    HomogeneousDeformation,
)
from ...recording.placement import place_markers
from ...recording.specimen import RELAXED_STRAIN
from ...recording.specimen_files import specimen_strains
from .effect import (
    AXES,
    SMALL,
    Effect,
    ExperimentAtAnswer,
    effect_of_constants,
    shape_effect,
    stated_names,
)
from .memory_effect import RELAXATION_TIME, RELAXATION_TIMES_S
from .obstacle_effects import (
    contact_changes_by_size_n,
    obstacle_shifts_m,
    rigid_contact_change_n,
    scaled_start_m,
)
from .platen_slip import slip_displacements_m, sticking_change_n
from .shape_error import SURFACE_MODES, other_section, sag_m

# Relative standard deviation of the density of the air: weather and room temperature, at the stated
# altitude. At 2000 m the density is 18 % lower, and has to be stated.
AIR_DENSITY_DEVIATION = 0.03
# Relative standard deviation of the added mass and of the drag coefficient of a given body: they
# depend on its shape, on edges, on amplitude and on frequency.
AIR_COEFFICIENT_DEVIATION = 0.4
# Shape factor of a pressed specimen of unknown size: four times as wide as high.
FLAT_SHAPE_FACTOR = 1.0
# Strains within which the slope of a toe approaches that of the law, two of which describe those
# between too, and the largest strain of a curve below which they are as much less: what is no small
# part of a curve is not its beginning.
TOE_STRAINS = np.array([0.003, 0.01])
TOE_RANGE = 0.04
# Poisson's ratio of an incompressible material.
INCOMPRESSIBLE_POISSON = 0.5
# Deviation of each component of a vector of length one with an unknown direction.
UNKNOWN_ORIENTATION = 0.58
# Laws of damping that a real material may obey: Rayleigh's resists rotation, as no material does.
OBJECTIVE_DAMPINGS = ("kelvin-voigt", "material")
_MODES = " ".join(str(number) for number in range(1, SURFACE_MODES + 1))


def _size(at: ExperimentAtAnswer, _: int) -> Effect:
    """Return the effect of a body that is larger by a share, per unit of that share: f = s² f(x/s,
    v/s).

    From Ψ(x; s) = s³ Ψ(x/s): what is strained is the ratio of lengths. Goals of grasped nodes scale
    about the middle of the grasps; obstacles keep their size and are moved so that they first touch
    the body as before, and given start positions scale with the body, see `obstacle_effects`.

    Buoyancy and the mass of moved air grow by s³, and drag by s². The own mass grows by s³ unless
    the mass of the body is declared, when it stays. For a mesh made under gravity, the weight
    during the scan relative to the stiffness grows by s, or falls by s² if the mass is declared.
    """
    larger = 1 + SMALL
    smaller = 1 - SMALL
    force = larger**2 * at.internal_n(larger) - smaller**2 * at.internal_n(smaller)
    force = force / (2 * SMALL)
    # Of a body made under gravity the deflection over the size grows with the weight over s².
    heavier = at.force_change_by_scan_weight() * (-2.0 if at.body.has_declared_mass else 1.0)
    mass = (0.0 if at.body.has_declared_mass else 3.0) * at.own_mass_kg
    transcription = at.iterate.transcription
    obstacles = transcription.experiment.obstacles
    if obstacles:
        for change_n in contact_changes_by_size_n(at.dynamics, at.iterate.x):
            force += at.pad_rows(change_n)
    rotations: Array = np.nan_to_num(transcription.prescribed_motion.pose_rows[0])
    arms_m = (
        transcription.prescribed_motion.displaced_nodes(at.iterate.phi)[0]
        - transcription.nuisance.grasp_pivot_m
    )
    displacement_m = np.einsum("tgj,gj->tg", rotations, arms_m)
    for obstacle, shift_m in obstacle_shifts_m(at.iterate) if obstacles else ():
        obstacle_dofs = np.searchsorted(
            transcription.prescribed_motion.dofs, obstacle.prescribed_dofs
        )
        displacement_m[:, obstacle_dofs] = np.tile(shift_m, len(obstacle.nodes))
    air = 3.0 * at.buoyancy_n + 2.0 * at.air_drag_n
    return Effect(
        force + heavier + at.weight_and_drag(mass) + air,
        mass + 3.0 * at.dynamics.mass.added_kg,
        displacement_m=displacement_m,
        start_m=scaled_start_m(at.iterate) if at.dynamics.first_row else None,
    )


def _mass(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect with the weight during a scan; None if a density is estimated."""
    if any(part.has_free_density for part in at.body.parts):
        return None
    return Effect(
        at.weight_and_drag(at.own_mass_kg) + at.force_change_by_scan_weight(), at.own_mass_kg
    )


def _density_gradient(at: ExperimentAtAnswer, axis: int) -> Effect:
    """Return the effect of a share that grows linearly from zero at the centre of mass."""
    place_m = at.body.nodes_m[:, axis]
    shares = _linear_shares(place_m, at.own_mass_kg[::3], extent_m=place_m)
    mass = at.own_mass_kg * np.repeat(shares, 3)
    return Effect(at.weight_and_drag(mass), mass)


def _stiffness_gradient(at: ExperimentAtAnswer, axis: int) -> Effect:
    """Return the effect of a share that grows linearly from the middle, with damping and memory."""
    body = at.stress_free_body
    place_m = at.stress_free_m[:, axis]
    shares = _linear_shares(
        place_m[body.cells].mean(axis=1), body.geometry[..., -1].sum(axis=1), extent_m=place_m
    )
    stiffer = body.with_stiffness_factors(1.0 + shares)
    return Effect(at.internal_n(body=stiffer) - at.internal_force_n)


def _linear_shares(place_m: Array, weights: Array, extent_m: Array) -> Array:
    """Return numbers (k,) with mean zero and magnitude one at the farther end of the body."""
    middle_m = np.average(place_m, weights=weights)
    return (place_m - middle_m) / np.abs(extent_m - middle_m).max()


def _anisotropy(at: ExperimentAtAnswer, axis: int) -> Effect:
    """Return the effect of a stiffness that is higher along one axis (index) by a share of E, the
    Young's modulus of the softest part: the energy ½ E e² of the strain e along it.

    Rayleigh damping K(x) v follows by its time derivative.
    """
    body = at.body
    xi, nu = at.states
    count, points = body.geometry.shape[:2]
    geometry = body.stress_free_geometry(at.theta)
    slopes = geometry[..., :-1].reshape(count, points, -1, 3)[..., axis]
    weight = at.young_pa * geometry[..., -1]
    force = np.zeros_like(xi)
    gamma = at.proportional_s[:, None, None]
    for x, v, own in zip(xi, nu, force, strict=True):
        stretch, rate = (
            np.einsum("eqa,eaj->eqj", slopes, each.reshape(-1, 3)[body.cells]) for each in (x, v)
        )
        squared = np.sum(stretch**2, axis=2, keepdims=True)
        strain = 0.5 * (squared - 1)
        pull = (strain + gamma * np.sum(stretch * rate, axis=2, keepdims=True)) * stretch
        pull = weight[..., None] * (pull + gamma * strain * rate)
        np.subtract.at(own.reshape(-1, 3), body.cells, np.einsum("eqa,eqj->eaj", slopes, pull))
    force[: at.dynamics.first_row] = 0.0
    return Effect(force)


def _drift(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of a share that grows linearly in time, zero at the mean time; None for
    equilibria without memory, whose load grows in time too.
    """
    if at.iterate.transcription.experiment.is_static and not _is_paced(at):
        return None
    t_s = at.dynamics.evaluated_s
    since = (t_s - t_s.mean()) / max(np.ptp(t_s), 1e-300)
    return Effect(at.internal_n() * since[:, None])


def _load_drift(at: ExperimentAtAnswer, index: int) -> Effect | None:
    is_specimen = at.iterate.transcription.experiment.specimen is not None
    return _drift(at, index) if is_specimen else None


def _is_paced(at: ExperimentAtAnswer) -> bool:
    """Return whether equilibria depend on the pace: several with memory, but for tables of moduli."""
    experiment = at.iterate.transcription.experiment
    has_pace = at.body.has_memory and len(at.dynamics.t_s) > 1
    if experiment.specimen is None or not has_pace:
        return has_pace
    return bool(np.abs(specimen_strains(experiment)[0]).max() > 2 * RELAXED_STRAIN)


def _memory(at: ExperimentAtAnswer, index: int) -> Effect | None:
    """Return the effect per share; None where the model has memory, or it cannot be seen."""
    force_n = at.forces_of_memory_n.get(RELAXATION_TIMES_S[index])
    return None if force_n is None else Effect(force_n)


def _time_scale(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of clocks that are fast by a share: less time passes than they show."""
    if at.iterate.transcription.experiment.is_static:
        return None
    slower = at.internal_n(time_factor=1 + SMALL)
    faster = at.internal_n(time_factor=1 - SMALL)
    drag = at.body.tied_damping_rate(at.theta) * at.dynamics.mass.damped_kg * at.states[1]
    air = 2.0 * at.air_drag_n
    return Effect((faster - slower) / (2 * SMALL) - drag + air, time_stretch=-1.0)


def limited_poisson_deviation(deviation: float, parameters: Parameters) -> float:
    """Return the standard deviation of stated Poisson's ratios on the scale ln(1 − 2ν), which ends
    at the incompressible body, per unit of ν: a value that is lower by `deviation` is one standard
    deviation away on this scale. It is that of the largest stated ratio below ½.
    """
    items = {item.name: item for item in parameters.components}
    tied = {name: items[name].tied for name in stated_names(parameters, "poisson")}
    stated = [items[name if to is None else to.to].guess for name, to in tied.items()]
    below = [nu for nu in stated if nu is not None and nu < INCOMPRESSIBLE_POISSON]
    if not below:
        return deviation
    distance = INCOMPRESSIBLE_POISSON - max(below)
    return distance * float(np.log1p(deviation / distance))


def _poisson(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of all ratios together that are fixed or tied to a fixed one."""
    constants = stated_names(at.parameters, "poisson")
    if not constants:
        return None
    # Both differences stay below ½, where the bulk modulus would be infinite.
    values = at.parameters.values(at.iterate.q)
    largest = max(values[name] for name in constants)
    step = min(SMALL, (INCOMPRESSIBLE_POISSON - largest) / 2)
    return effect_of_constants(at, dict.fromkeys(constants, 1.0), step)


def _marker_mass(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of a mass of each marker, per kilogram, which is part of neither the mass
    of the body nor a point mass of the problem; None without markers.

    It is distributed to nodes by the weights of the marker's place; estimated places are those of
    the association at the answer.
    """
    transcription = at.iterate.transcription
    placement = transcription.experiment.markers.placement
    if not len(placement.nodes):
        return None
    association = transcription.association.markers
    if association.sigma_m.any():
        places_m, nodes_m = association.centre_places_m, at.body.nodes_m
        placement = place_markers(places_m, nodes_m, at.body, max_distance_m=np.inf)
    node_mass_kg = np.bincount(
        placement.nodes.ravel(), weights=placement.weights.ravel(), minlength=len(at.body.nodes_m)
    )
    mass_kg: Array = np.repeat(node_mass_kg, 3).astype(float)
    return Effect(at.weight_and_drag(mass_kg), mass_kg)


def _grip_turn(at: ExperimentAtAnswer, axis: int) -> Effect | None:
    """Return the effect of a gripper that gives way about an axis of the world in proportion to the
    torque of the body on it, by one radian at the largest torque; None for a bench.
    """
    experiment = at.iterate.transcription.experiment
    if experiment.is_static:
        return None
    prescribed = at.iterate.equations.prescribed
    displacement_m = np.zeros_like(prescribed.positions_m)
    for grasp in experiment.body_grasps:
        if len(grasp.axes) < len(AXES):
            continue
        columns = np.searchsorted(prescribed.dofs, 3 * grasp.nodes[:, None] + np.arange(3))
        places_m = np.nan_to_num(prescribed.positions_m[:, columns])
        arms_m = places_m - places_m.mean(axis=1, keepdims=True)
        torque_n_m = -np.cross(arms_m, at.grasp_force_n[:, columns]).sum(axis=1)[:, axis]
        share = torque_n_m / (np.abs(torque_n_m).max() or 1.0)
        displacement_m[:, columns] = np.cross(np.outer(share, np.eye(3)[axis])[:, None], arms_m)
    return Effect(displacement_m=displacement_m) if displacement_m.any() else None


def _grip(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect per metre of a massless layer of the body's material under grippers."""
    return at.effect_of_grips


def _grasp_edge(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect per metre; None on a test bench, where platens end at the faces."""
    if at.iterate.transcription.experiment.is_static and _is_driven(at).any():
        return None
    return at.effect_of_grips


def _is_driven(at: ExperimentAtAnswer) -> NDArray[np.bool_]:
    """Return the mask (g,) of grasped dofs whose prescribed position changes."""
    goals = at.iterate.equations.prescribed.positions_m
    return np.asarray(np.nanmax(goals, axis=0) > np.nanmin(goals, axis=0))


def _machine(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of the compliance of a test bench, per m/N: displacements are measured
    behind its frame.

    Each grasp that is moved along an axis lags behind by the force of the specimen along it, which
    is `Experiment.symmetry` times that of the modelled part; the part takes the share
    `Grasp.displacement_scale` of it. Specimens are treated by
    `_machine_of_specimen`.
    """
    experiment = at.iterate.transcription.experiment
    prescribed = at.iterate.equations.prescribed
    if experiment.specimen is not None:
        return _machine_of_specimen(at, experiment.specimen)
    if not experiment.is_static or not (driven := _is_driven(at)).any():
        return None
    displacement_m = np.zeros_like(at.grasp_force_n)
    for grasp in experiment.grasps:
        if grasp.poses.deformation is not None:
            continue  # measured on the body
        for axis in range(3):
            here = np.flatnonzero(
                np.isin(prescribed.dofs, grasp.prescribed_dofs) & (prescribed.dofs % 3 == axis)
            )
            if driven[here].any():
                force_n = at.grasp_force_n[:, here].sum(axis=1, keepdims=True)
                displacement_m[:, here] = -grasp.displacement_scale * force_n
    return Effect(displacement_m=experiment.symmetry * displacement_m)


def _machine_of_specimen(
    at: ExperimentAtAnswer, deformation: HomogeneousDeformation
) -> Effect | None:
    """Return the effect per unit of the compliance C."""
    if not deformation.area_over_length_m:
        return None
    dofs = at.iterate.equations.prescribed.dofs
    direction, normal = (AXES.index(axis) for axis in deformation.first_stress)
    loaded = np.searchsorted(dofs, 3 * (1 + normal) + direction)
    stress_pa = STRESS_PER_FORCE * at.grasp_force_n[:, loaded]
    strain_m_n = -deformation.area_over_length_m * stress_pa
    displacement_m = np.zeros_like(at.grasp_force_n)
    for node, (by_strain_m, _) in deformation.displaced_nodes().items():
        columns = np.searchsorted(dofs, 3 * node + np.arange(3))
        displacement_m[:, columns] = strain_m_n[:, None] * by_strain_m
    return Effect(displacement_m=displacement_m)


def _measured_face(at: ExperimentAtAnswer, index: int) -> Effect | None:
    """Return the effect of measured displacements of grasped nodes that are off by `Grasp.sigma_m`
    at the ends of the body and at the largest displacement.

    The error of one component is linear in one coordinate of the place, zero in the middle of the
    body, and proportional to the RMS displacement of the face over time.
    """
    component, along = divmod(index, 3)
    prescribed = at.iterate.equations.prescribed
    displacement_m = np.zeros_like(prescribed.positions_m)
    nodes_m = at.body.nodes_m
    low_m, high_m = nodes_m[:, along].min(), nodes_m[:, along].max()
    for grasp in at.iterate.transcription.experiment.body_grasps:
        if grasp.poses.deformation is None or component not in grasp.axis_indices:
            continue
        rows = np.flatnonzero(grasp.is_active(at.dynamics.t_s))
        moved_m = grasp.positions_at(nodes_m, at.dynamics.t_s[rows]) - nodes_m[grasp.nodes]
        size_m = np.linalg.norm(moved_m, axis=(1, 2))
        share = (2 * nodes_m[grasp.nodes, along] - low_m - high_m) / (high_m - low_m)
        columns = np.searchsorted(prescribed.dofs, 3 * grasp.nodes + component)
        error_m = (grasp.sigma_m or 0.0) * np.outer(size_m / (size_m.max() or 1.0), share)
        displacement_m[np.ix_(rows, columns)] = error_m
    return Effect(displacement_m=displacement_m) if displacement_m.any() else None


def _gauge_length(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect per share by which all strains are smaller; None for a body."""
    deformation = at.iterate.transcription.experiment.specimen
    if deformation is None:
        return None
    prescribed = at.iterate.equations.prescribed
    displacement_m = np.zeros_like(prescribed.positions_m)
    for node in deformation.displaced_nodes():
        columns = np.searchsorted(prescribed.dofs, 3 * node + np.arange(3))
        displacement_m[:, columns] = at.body.nodes_m[node] - prescribed.positions_m[:, columns]
    return Effect(displacement_m=displacement_m)


def _specimen_delay(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect per second by which loads are late."""
    if at.iterate.transcription.experiment.specimen is None or not _is_paced(at):
        return None
    positions_m = at.iterate.equations.prescribed.positions_m
    return Effect(displacement_m=-np.gradient(positions_m, at.dynamics.t_s, axis=0))


def _effective_length(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return `_gauge_length` for grips: shoulders of a dogbone stretch less than the middle."""
    experiment = at.iterate.transcription.experiment
    deformation = experiment.specimen
    if deformation is None or not deformation.is_displacement or deformation.lateral == "":
        return None
    is_pulled = specimen_strains(experiment)[0].max() > 0
    return _gauge_length(at, 0) if is_pulled else None


def _specimen_sticking(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of platens to which a pressed specimen without a mesh sticks, by the
    logarithm of the ratio of its stiffness to that between lubricated platens.

    Of a disc with the shape factor S this ratio is 1 + 2 S² if it is incompressible (Gent & Lindley,
    Proc. Inst. Mech. Eng. 173, 1959). The addition grows with ν², and ends at the ratio of the
    modulus of confined compression to E.
    """
    deformation = at.iterate.transcription.experiment.specimen
    if deformation is None or deformation.test != "uniaxial":
        return None
    direction, normal = (AXES.index(axis) for axis in deformation.first_stress)
    is_pressed = at.iterate.x[:, 3 * (1 + normal) + direction] < CELL_SIZE_M
    ((lame_pa, shear_pa),) = at.body.lame(at.theta).values()
    young_pa, poisson = engineering_constants(lame_pa, shear_pa)
    flat = 8 * (poisson * (deformation.shape_factor or FLAT_SHAPE_FACTOR)) ** 2
    confined = (lame_pa + 2 * shear_pa) / young_pa - 1
    if not is_pressed.any() or not flat:
        return None
    stiffer = np.log1p(flat * confined / (flat + confined))
    return Effect(stiffer * at.internal_n() * is_pressed[:, None])


def _initial_slope(at: ExperimentAtAnswer, index: int) -> Effect | None:
    """Return the effect of another slope at no load, per share of the slope of the measured curve.

    Stresses are too large by this share of the slope times w (1 − exp(−|ε| / w)), less that of the
    smallest strain, an offset of the strain that `strain_zero` contains: by the mean of those of both
    strains w of `TOE_STRAINS`, less for curves that end below `TOE_RANGE`, or by half their
    difference. None if the strains are exact.
    """
    experiment = at.iterate.transcription.experiment
    deformation = experiment.specimen
    if deformation is None or deformation.second or not experiment.nuisance.strain_zero:
        return None
    strain, _ = specimen_strains(experiment)
    stress_pa = experiment.readings[0].measured_values[:, 0]
    size = np.abs(strain)
    largest = float(size.max())
    if not largest:
        return None
    widths = TOE_STRAINS * min(1.0, largest / TOE_RANGE)
    excess = widths * (np.exp(-size[:, None] / widths) - np.exp(-size.min() / widths))
    slope_pa = float(np.nanmax(np.abs(stress_pa))) / largest
    direction, normal = (AXES.index(axis) for axis in deformation.first_stress)
    force_n = np.zeros_like(at.iterate.x)
    strain_of_force = np.sign(strain) * (excess @ [0.5 - index, 0.5])
    force_n[:, 3 * (1 + normal) + direction] = slope_pa * strain_of_force / STRESS_PER_FORCE
    return Effect(force_n)


def _platen_friction(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of friction on nodes that slide along platens, perpendicular to the loading
    axis, per unit of the coefficient; None for a dynamic experiment and without platens.

    Friction has the size of the normal force and is opposite to the displacement. Planes of
    symmetry have no normal force in the loading direction, and no friction.
    """
    experiment = at.iterate.transcription.experiment
    prescribed = at.iterate.equations.prescribed
    if not experiment.is_static:
        return None
    pressed = {AXES[k] for k in np.unique(prescribed.dofs[_is_driven(at)] % 3)}
    platens = [g for g in experiment.grasps if len(g.axes) < 3 and pressed & set(g.axes)]
    force = np.zeros_like(at.iterate.x)
    x = at.iterate.x
    start = at.body.nodes_m.ravel()
    for grasp in platens:
        across = [k for k, name in enumerate(AXES) if name not in grasp.axes]
        for node in grasp.nodes:
            normal = np.isin(prescribed.dofs, [3 * node + AXES.index(a) for a in grasp.axes])
            press = np.linalg.norm(at.grasp_force_n[:, normal], axis=1)
            dofs = [3 * node + k for k in across]
            way = x[:, dofs] - start[dofs]
            length = np.linalg.norm(way, axis=1, keepdims=True)
            force[:, dofs] -= press[:, None] * way / np.maximum(length, 1e-9)
    return Effect(force) if platens else None


def _platen_slip(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return None if other measurements than loads show the grip, see `slip_displacements_m`."""
    if not at.iterate.transcription.experiment.is_static:
        return None
    displacement_m = slip_displacements_m(at.iterate, at.theta, reactions_n=at.grasp_force_n)
    if displacement_m is None:
        return None
    return Effect(displacement_m=displacement_m)


def _platen_stick(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return None where `_platen_slip` has no counterpart, see `sticking_change_n`."""
    if not at.iterate.transcription.experiment.is_static:
        return None
    force_n = sticking_change_n(at.iterate, at.theta)
    # On dofs that are prescribed: nothing moves, and the reactions change.
    return None if force_n is None else Effect(force_n)


def _contact_stiffness(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect to first order; None where contact is rigid already."""
    if not at.iterate.transcription.experiment.obstacles:
        return None
    change_n = rigid_contact_change_n(
        at.iterate.transcription.experiment, at.dynamics, x=at.iterate.x
    )
    return None if change_n is None else Effect(at.pad_rows(change_n))


def _buoyancy(at: ExperimentAtAnswer, _: int) -> Effect | None:
    return Effect(at.buoyancy_n) if at.dynamics.mass.added_kg.any() else None


def _added_mass(at: ExperimentAtAnswer, _: int) -> Effect | None:
    if at.iterate.transcription.experiment.is_static or not at.dynamics.mass.added_kg.any():
        return None
    return Effect(mass_kg=at.dynamics.mass.added_kg)


def _air_drag(at: ExperimentAtAnswer, _: int) -> Effect | None:
    return Effect(at.air_drag_n) if at.iterate.transcription.experiment.has_air_drag else None


def _other_damping(at: ExperimentAtAnswer, law: str) -> Effect | None:
    """Return the effect of replacing the stated damping law by another with the same γ_r: the
    difference of the forces along the answer.

    Parts with a custom law keep it, and so do parts of linear material, for which all laws agree.
    """
    body = at.body
    names = body.constants.items()
    is_damped = any(
        constant is GAMMA_R and value for (_, constant), value in zip(names, at.theta, strict=False)
    )
    is_same = not body.is_solid and law == "material"  # "kelvin-voigt" of strains of its own
    if at.iterate.transcription.experiment.is_static or not is_damped or is_same:
        return None
    parts = tuple(
        replace(part, damping=DAMPINGS[law])
        if part.damping in DAMPINGS.values() and part.material is not MATERIALS["linear"]
        else part
        for part in body.parts
    )
    if all(own.damping is other.damping for own, other in zip(body.parts, parts, strict=True)):
        return None
    xi, nu = at.dynamics.evaluation_states(at.iterate.x)
    histories = at.dynamics.forces_with_histories(at.dynamics.histories(at.iterate.x)).memory_state
    forces_n = (
        each.force(xi, nu, theta=at.theta, memory_input=histories)
        for each in (body.with_parts(parts), body)
    )
    return Effect(at.pad_rows(next(forces_n) - next(forces_n)))


def _objective_damping(at: ExperimentAtAnswer, index: int) -> Effect | None:
    """Return None if it is the stated law in all parts, see `_other_damping`."""
    return _other_damping(at, OBJECTIVE_DAMPINGS[index])


def _rayleigh_damping(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of the damping that is not objective, see `_other_damping`."""
    return _other_damping(at, "rayleigh")


def _rest_shape(at: ExperimentAtAnswer, axis: int) -> Effect | None:
    """Return None if the problem states the rest shape."""
    if at.body.rest_shape is not None:
        return None
    return Effect(
        at.force_change_by_reference(
            sag_m(at.body, at.theta, support_dofs=at.likely_support_dofs, axis=axis)
        )
    )


def _surface(at: ExperimentAtAnswer, mode: int) -> Effect:
    """Return the effect per thickness; grasped nodes move with the surface."""
    return shape_effect(at, at.surface_modes_m[mode])


# Sections of a body, in the order of the components, and the relative width of a section of the other
# kind with the same stiffness: by the area π/4 it is 0.886, by the second moment 3π/16 0.876.
SECTIONS = {"round": 0.881, "square": 1 / 0.881}


def section_effect(at: ExperimentAtAnswer) -> Effect | None:
    """Return the effect of a round section in place of a square one of the same width, or the
    reverse; None for other meshes, see `other_section`.
    """
    body = at.body
    points_m = body.nodes.points_m
    other = other_section(body.mesh, points_m)
    if other is None:
        return None
    off_axis_m = np.where(other.is_across, points_m - other.middle_m, 0.0)
    of_shape = shape_effect(at, np.log(SECTIONS[other.name]) * off_axis_m)
    if body.has_declared_mass:
        return of_shape
    mass = at.own_mass_kg * (other.volume_ratio - 1)
    assert of_shape.force_n is not None
    return replace(of_shape, force_n=of_shape.force_n + at.weight_and_drag(mass), mass_kg=mass)


def _section(at: ExperimentAtAnswer, index: int) -> Effect | None:
    """Return None for a mesh from a file or of known origin, or in contact with obstacles."""
    body = at.body
    is_stated = body.mesh_from is not None or body.inverse_equilibrium is not None
    if is_stated or not body.mesh.is_generated or at.iterate.transcription.experiment.obstacles:
        return None
    other = other_section(body.mesh, body.nodes.points_m)
    return section_effect(at) if other and other.name == [*SECTIONS][index] else None


ASSUMPTIONS = (
    Deviation(
        "body_scale",
        "1",
        considered=0.01,
        description="relative error of the size of the mesh",
        remedy="measure two lengths of the real body and scale the mesh to them",
        largest=0.3,
        effect=_size,
        by_origin={"cast": 0.005, "printed": 0.005, "tissue": 0.02},
    ),
    Deviation(
        "rest_shape",
        "1",
        wide=1.0,
        description="share of the weight of the body under which the mesh was deformed when "
        "it was made, along each axis, if object.rest_shape is not stated",
        remedy="state object.rest_shape: whether the mesh is free of stress, or the shape in "
        "which the body hung or stood during its scan; omit it for a rod whose natural curvature is "
        "to be estimated",
        effect=_rest_shape,
        axes="x y z",
        by_origin={"scan": UNKNOWN_ORIENTATION},
    ),
    Deviation(
        "surface",
        "1",
        considered=0.005,
        description="displacement of the surface of the body from that of the mesh along its "
        "normal, relative to the thickness",
        remedy="measure the thickness of the real body at several places",
        largest=0.5,
        effect=_surface,
        axes=_MODES,
        by_origin={"scan": 0.01},
    ),
    Deviation(
        "section",
        "1",
        description="difference of the section of a straight body from that of the mesh, as a fraction "
        "of the difference between a square and a round one of the same width",
        remedy="mesh the section of the body",
        effect=_section,
        axes=" ".join(SECTIONS),
    ),
    Deviation(
        "mass",
        "1",
        considered=0.01,
        description="relative error of the mass of the body, if the mass is not estimated",
        remedy="weigh the body",
        largest=1.0,
        effect=_mass,
    ),
    Deviation(
        "marker_mass_kg",
        "kg",
        is_one_sided=True,
        description="mass of each marker, which is not part of the mass of the body",
        remedy="weigh the markers and state "
        "marker_mass_kg = { mean = …, deviation = … } in [uncertainty.assumptions], "
        "or add them as point masses",
        effect=_marker_mass,
    ),
    Deviation(
        "density_gradient",
        "1",
        considered=0.05,
        description="relative difference of the density at one end of the body from that in "
        "its middle",
        remedy="weigh two halves of a specimen",
        largest=1.0,
        effect=_density_gradient,
        axes="x y z",
        by_origin={"cast": 0.01, "printed": 0.02, "tissue": 0.02},
    ),
    Deviation(
        "stiffness_gradient",
        "1",
        considered=0.05,
        description="relative difference of the stiffness at one end of the body from that in "
        "its middle",
        remedy="press specimens from both ends of the body, or estimate a field of the stiffness",
        largest=1.0,
        effect=_stiffness_gradient,
        axes="x y z",
        by_origin={"cast": 0.015, "foam": 0.1, "printed": 0.03, "tissue": 0.15},
    ),
    Deviation(
        "anisotropy",
        "1",
        considered=0.05,
        description="relative difference of the stiffness along one axis from that across it",
        remedy='state how the body was made, such as made = "cast" in [object]; or repeat the recording '
        "with the body loaded along another axis, or test specimens cut along each axis",
        effect=_anisotropy,
        axes="x y z",
        by_origin={"cast": 0.015, "foam": 0.2, "printed": 0.15, "tissue": 0.3},
    ),
    Deviation(
        "stiffness_drift",
        "1",
        considered=0.02,
        description="relative change of the stiffness from the beginning to the end of a recording",
        remedy="repeat the first recording at the end",
        largest=1.0,
        effect=_drift,
        by_origin={"tissue": 0.05},
    ),
    Deviation(
        "load_drift",
        "1",
        considered=0.04,
        description="relative drift of the load cell and of the specimen from the beginning to the end "
        "of a test with memory: 0.2 % of the range of a cell of which the test uses a twentieth",
        remedy="return to no load at the end of the test, and state what the load has drifted over its "
        "largest value",
        largest=1.0,
        effect=_load_drift,
        of_specimens=True,
    ),
    Deviation(
        "memory_share",
        "1",
        is_one_sided=True,  # no material has a memory with a negative share
        wide=1.0,
        description="share of a branch of viscoelastic memory (Prony term) that the material lacks, for "
        "each relaxation time that the recording can show",
        remedy="add a branch of memory to the material, and estimate its share",
        effect=_memory,
        axes=" ".join(f"{RELAXATION_TIME}{tau_s:g}s" for tau_s in RELAXATION_TIMES_S),
        redefines=(GAMMA_R.name, GAMMA_M.name),
    ),
    Deviation(
        "time_scale",
        "1",
        considered=1e-4,
        description="relative error of the rate of all clocks",
        remedy="compare all clocks with a reference clock",
        largest=0.01,
        effect=_time_scale,
    ),
    Deviation(
        "poisson",
        "",
        considered=0.02,
        description="error of a stated Poisson's ratio",
        remedy="measure Poisson's ratio in a tension test, or estimate it; if it is known "
        "better, state its deviation, poisson = …, in [uncertainty.assumptions]: the bulk modulus of "
        "solid rubber, 1.5 to 2 GPa, determines it to about 0.0001",
        effect=_poisson,
        of_specimens=True,
    ),
    Deviation(
        "damping_law",
        "1",
        considered=1.0,
        description="effect of another objective damping law, as a fraction of the complete "
        "difference of its damping force from that of the stated law",
        remedy="compare the laws with compare-models --damping on faster and slower motions, "
        'or state damping_law = "none" where the law is known',
        effect=_objective_damping,
        axes=" ".join(OBJECTIVE_DAMPINGS),
        redefines=(GAMMA_R.name, GAMMA_M.name),
    ),
    Deviation(
        "rayleigh_damping",
        "1",
        description="effect of Rayleigh damping, as a fraction of the complete difference of "
        "its damping force from that of the stated law",
        remedy="compare the laws with compare-models --damping on motions that rotate the body",
        effect=_rayleigh_damping,
        redefines=(GAMMA_R.name, GAMMA_M.name),
    ),
    Deviation(
        "grip_turn_rad",
        "rad",
        wide=0.02,
        description="turn by which a gripper gives way at the largest torque of the body, about each "
        "axis of the world",
        remedy="attach markers to the gripper beside the body and take the poses from them, or hold the "
        "body by a stiffer gripper",
        effect=_grip_turn,
        axes="x y z",
    ),
    Deviation(
        "grip_layer_m",
        "m",
        is_one_sided=True,  # what gives way does not push
        considered=2e-4,
        description="compliance of grip and skin, as the thickness of a layer of the body's material",
        remedy="hold the body more stiffly, or attach markers to it beside the grip",
        largest=0.005,
        effect=_grip,
    ),
    Deviation(
        "grasp_edge_m",
        "m",
        considered=5e-4,
        description="distance by which the gripper holds more or less of the body than the "
        "grasped nodes",
        remedy="measure where the gripper ends on the body, and place the edge of the grasped nodes "
        "there",
        largest=0.02,
        effect=_grasp_edge,
    ),
    Deviation(
        "machine_compliance_m_n",
        "m/N",
        is_one_sided=True,  # what gives way does not push
        considered=1e-6,
        description="compliance of the test bench",
        remedy="press the platens against each other without a specimen and state "
        "the slope of displacement over force as machine_compliance_m_n = { mean = …, deviation = … } "
        "in [uncertainty.assumptions]",
        effect=_machine,
        of_specimens=True,
    ),
    Deviation(
        "measured_face",
        "σ",
        considered=1.0,
        description="error of measured displacements of grasped nodes, over their sigma_m, linear in "
        "place and proportional to the displacement",
        remedy="measure a known rigid motion and a known stretch with the same camera, and state "
        "the deviation as sigma_m of the grasp",
        effect=_measured_face,
        axes="xx xy xz yx yy yz zx zy zz",
    ),
    Deviation(
        "gauge_length",
        "1",
        considered=0.01,
        description="relative error of the length to which the strains of a specimen refer",
        remedy="measure the length between the marks or grips of the unloaded specimen, or the strain "
        "with a calibrated extensometer",
        effect=_gauge_length,
        of_specimens=True,
    ),
    Deviation(
        "specimen_delay_s",
        "s",
        considered=5e-3,
        description="delay of the load of a specimen with memory after its strain",
        remedy="record load and strain by one clock and with the same filter",
        effect=_specimen_delay,
        of_specimens=True,
    ),
    Deviation(
        "effective_length",
        "1",
        considered=0.15,
        description="relative error of length_m as the effective length of a specimen that is pulled "
        "by its grips, because the shoulders of a dogbone stretch less than its narrow part",
        remedy="measure the strain of the narrow part with marks or an extensometer, or state the "
        "effective length, the integral of its smallest area over the area along the specimen",
        effect=_effective_length,
        of_specimens=True,
    ),
    Deviation(
        "specimen_sticking",
        "1",
        is_one_sided=True,  # friction does not make a specimen softer
        considered=1.0,
        description="sticking to the platens of a specimen without a mesh that is pressed, as a fraction "
        "of that without any slip",
        remedy='if the platens are lubricated, state specimen_sticking = "none" in '
        "[uncertainty.assumptions]; if the faces stick, use a test bench with a mesh; beside a column "
        "of strains, state length_m and area_m2",
        effect=_specimen_sticking,
        of_specimens=True,
    ),
    Deviation(
        "initial_slope",
        "",
        considered=0.85,
        typical={"initial_slope excess": 0.1},
        description="relative excess of the slope of a specimen's curve at no load over that of its law: "
        "negative in a toe, where grips or faces do not hold the whole section yet",
        remedy="leave out the rows of small strains, in which grips or faces may not hold the whole section "
        "(a toe) or fillers may stiffen rubber, with window_s, and let strain_zero be unknown",
        effect=_initial_slope,
        axes="excess shape",
        of_specimens=True,
    ),
    Deviation(
        "platen_friction",
        "",
        considered=0.1,
        description="coefficient of friction of platens between which nodes slide",
        remedy="lubricate the platens, or glue the specimen to them",
        effect=_platen_friction,
    ),
    Deviation(
        "platen_slip",
        "1",
        considered=1.0,
        description="slip of faces that are pressed by platens and held along all axes, as a fraction of "
        "that without friction, if only loads are measured",
        remedy="measure the bulge, by markers on the side or depth images; or state "
        'platen_slip = "none" in [uncertainty.assumptions] if the faces are glued, or axes = "z" if '
        "they slide",
        effect=_platen_slip,
    ),
    Deviation(
        "platen_stick",
        "1",
        wide=1.0,
        description="sticking of faces that slide on platens, as a fraction of that without any "
        "slip, if only loads are measured",
        remedy="measure the bulge, by markers on the side or depth images, or compare both "
        "assumptions with compare-models --with",
        effect=_platen_stick,
    ),
    Deviation(
        "contact_stiffness",
        "1",
        considered=1.0,
        description="compliance of the contact with obstacles, as a fraction of that of the pressure law",
        remedy="refine the mesh at the contact, or state a larger stiffness_pa_m and a "
        "smaller width_m of the obstacle",
        effect=_contact_stiffness,
    ),
    Deviation(
        "buoyancy",
        "1",
        considered=AIR_DENSITY_DEVIATION,
        description="relative error of the buoyancy, because of the density of the air",
        remedy="state the density of the air",
        largest=1.0,
        effect=_buoyancy,
    ),
    Deviation(
        "added_mass",
        "1",
        considered=AIR_COEFFICIENT_DEVIATION,
        description="relative error of the added mass of the air",
        remedy="repeat the motion more slowly, or with a heavier specimen",
        largest=3.0,
        effect=_added_mass,
    ),
    Deviation(
        "air_drag",
        "1",
        considered=AIR_COEFFICIENT_DEVIATION,
        description="relative error of the drag of the air",
        remedy="repeat the motion more slowly, or with a heavier specimen",
        largest=10.0,
        effect=_air_drag,
    ),
    *(row for kind in KINDS for row in kind.effects),
)

# Errors of the discretisation, whose mean is the estimated change; the order of convergence, and with
# it this change, is known to about half.
DISCRETISATION = (
    Deviation(
        "mesh",
        "1",
        considered=0.5,
        description="error of the mesh, as a share of its estimate by elements of half the size",
        remedy="solve with smaller elements (of a rod: more sections), or run refine",
    ),
    Deviation(
        "time_step",
        "1",
        considered=0.5,
        description="error of the time step, as a share of its estimate by steps of half the length",
        remedy="raise transcription.substeps, or run refine",
    ),
)
# Every deviation, by its name.
DEVIATIONS = {row.name: row for row in (*ASSUMPTIONS, *nuisance.KINDS, *DISCRETISATION)}
# Those of the budget; other nuisance parameters are estimated or exact.
CONSIDERED = (*ASSUMPTIONS, *(row for row in nuisance.KINDS if row.considered is not None))


def usual_deviations(bodies: Iterable[Body]) -> dict[str, float | None]:
    """Return the default standard deviation of each assumption for bodies, by name; None for an
    assumption that does not count by default. Of several bodies the largest deviation counts.
    """
    origins = {(body.made, body.mesh_from) for body in bodies} or {(None, None)}

    def usual(row: Deviation) -> float | None:
        known = [row.usual_considered(*origin) for origin in origins]
        return max((each for each in known if each is not None), default=None)

    return {row.name: usual(row) for row in ASSUMPTIONS}


class KnownEffect(Section):
    """Systematic effect of known sign and size, for which estimates are corrected to first order.

    Attributes
    ----------
    mean : float
        Size of the effect, positive.
    deviation : float
        Standard deviation of the size.
    """

    mean: Positive
    deviation: Positive


Deviated = Annotated[Literal["none"] | Positive, ByForm(str)]
KnownDeviation = Annotated[KnownEffect | Deviated, ByForm((dict, KnownEffect))]


def _field_of(row: Deviation) -> FieldOfRow:
    """Return the field of `Assumptions` for a row; None is the default of bodies that were made
    like those of the problem, see `Deviation.by_origin`.
    """
    default = "none" if row.considered is None else row.considered
    annotation: Any = KnownDeviation if row.is_one_sided else Deviated
    form = 'float, "none" or table' if row.is_one_sided else 'float or "none"'
    text = sentence(f"{row.description} [{row.unit or 1}]")
    if row.by_origin:
        return FieldOfRow(annotation | None, None, f"{form}, optional", text)
    return FieldOfRow(annotation, default, form, text)


@validated(kw_only=True)
@with_fields({row.name: _field_of(row) for row in CONSIDERED})
class Assumptions:
    """Standard deviations of systematic effects; "none" for an effect that is exactly zero.

    An effect that is known to exist, such as the compliance of a machine, has a table of mean and
    deviation. Nuisance parameters of recordings, by their names, count if they are not estimated.
    There is a field for each of `CONSIDERED`. Fields that are None have the default of bodies that
    were made like those of the problem, see `usual_deviations`.
    """

    if TYPE_CHECKING:

        def __init__(self, **deviations: float | Literal["none"] | KnownEffect | None) -> None: ...
        def __getattr__(self, name: str) -> Any: ...

    @classmethod
    def exact(cls) -> Assumptions:
        """Return a new table with all assumptions exactly true ("none"), as for a simulated
        recording.
        """
        exact: dict[str, Literal["none"]] = dict.fromkeys(vars(Assumptions()), "none")
        return Assumptions(**exact)

    def collect_deviations(
        self, bodies: Iterable[Body] = (), parameters: Parameters | None = None
    ) -> dict[str, float | None]:
        """Return the standard deviations by name, of all fields; None for what is exact, the
        deviation about the mean for a known effect. Fields that are None have the defaults for
        `bodies`.

        With `parameters`, that of Poisson's ratio ends before the incompressible body, see
        `limited_poisson_deviation`.
        """
        defaults = usual_deviations(bodies)
        by_name: dict[str, float | None] = {}
        for name, deviation in vars(self).items():
            known = deviation.deviation if isinstance(deviation, KnownEffect) else deviation
            by_name[name] = defaults[name] if known is None else None if known == "none" else known
        stated = by_name["poisson"]
        if parameters is not None and stated is not None:
            by_name["poisson"] = limited_poisson_deviation(stated, parameters)
        return by_name

    @property
    def means(self) -> dict[str, float]:
        """Known effects by name, the mean of each over its standard deviation; other
        assumptions are omitted.
        """
        return {
            name: deviation.mean / deviation.deviation
            for name, deviation in vars(self).items()
            if isinstance(deviation, KnownEffect)
        }


class ExactIfNone:
    """Annotation of a table of assumptions that may be "none": all of them exactly true."""

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema of the table with "none" replaced by `Assumptions.exact`."""
        return core_schema.no_info_before_validator_function(self._exact_if_none, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON schema: the table, or "none"."""
        return {"anyOf": [handler(schema), {"const": "none", "type": "string"}]}

    @staticmethod
    def _exact_if_none(value: Any) -> Any:
        """Return the values of all assumptions in place of "none"."""
        if isinstance(value, str) and value != "none":
            raise ValueError(
                f'found "{value}"; expected a table, or "none" if all assumptions are exact'
            )
        return vars(Assumptions.exact()) if value == "none" else value


def source_label(source: str) -> str:
    """Return the name of an effect, or of another source of variance, as text for messages: without
    a unit suffix such as "_rad", with spaces for underscores, and with a relaxation time in
    parentheses.
    """
    head, blank, component = source.partition(" ")
    unit = next(
        (u for u in ("_m_n", "_1_m2", "_rad", "_px", "_m", "_s", "_kg") if head.endswith(u)), ""
    )
    label = f"{head.removesuffix(unit)}{blank}{component}".replace("_", " ")
    name, _, time = label.partition(f" {RELAXATION_TIME}")
    return f"{name} (τ = {time.removesuffix('s')} s)" if time else label
