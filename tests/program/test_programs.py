"""Matrices of every kind of program, in one table: derivatives, convexity and sensitivities.

A new kind of force, sensor, nuisance parameter or memory needs a line in the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import chain

import casadi as ca
import numpy as np
import pytest
from kit.checks import assert_derivative
from kit.collocation_kinds import ALL_FIXED, ENGINEERING, LAYOUTS, POISSON_FIXED, WITH_PRIOR, swung
from kit.densities import MADE as DENSE
from kit.densities import REMEMBERED, remembering_core
from kit.densities import parameters as free_densities
from kit.lasers import lit_cube
from kit.lifted import REGIONS, of_regions
from kit.lifted_wrenches import ALL_UNKNOWN, felt_memory, free_density, several, weighed
from kit.memories import TWO, guesses, remembering
from kit.own_nuisances import ROWS
from kit.problems import (
    GUESS,
    bar_in_two_hands,
    bar_let_go,
    bar_loaded,
    bar_with_nuisance,
    cube_with_gaps,
    cube_with_nuisance,
    driven_bar,
    hung_cube,
    measured,
    measured_with,
    pressed_cube,
    some_point,
    times,
    with_papers_damping,
)
from kit.rods import bent as bent_rod
from kit.rods import cable, ends
from kit.sensors import accelerometer, instrumented, noisy, strain_gauge
from kit.sharing import sharing, swung_again
from kit.static import HANGING, block
from kit.terms import MODELS, waved_bar
from kit.terms import parameters as stated
from kit.wrench_kinds import pressed
from kit.wrenches import EVERYTHING, felt, sensing, wristed_cube
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.fem.meshes.selection import Indices
from collocation_sysid.fem.node_force import On
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.methods.comparison.shooting import adjoint_gradient, simulate_variables
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.lifted.collocation import LiftedCollocation, with_lifted_variables
from collocation_sysid.program.sweep import Sweep
from collocation_sysid.recording import (
    Experiment,
    Force,
    Grasp,
    Markers,
    Nuisance,
    PointMass,
    PoseSequence,
)

Make = Callable[[], Collocation]


def program(*experiments: Experiment, scheme: str = "midpoint", **options) -> Collocation:
    return Collocation([*experiments], options.pop("parameters", GUESS), scheme, **options)


def several_kinds() -> list[Experiment]:
    return [swung(), swung("undeformed", steps=7), bar_in_two_hands(3), cube_with_gaps(2)]


def cleared_clock(samples: int) -> Collocation:
    """Read whole samples away from where its recording says."""
    nuisance = Nuisance.none(marker_offset_m=2e-3, time_shift_s=0.01)
    collocation = program(replace(swung(steps=8), nuisance=nuisance))
    (transcription,) = collocation.transcriptions
    phi = np.zeros(transcription.nuisance.size)
    phi[transcription.nuisance.clock_indices] = float(samples)
    read, _ = collocation.follow_estimates(np.concatenate([GUESS.guess_q, phi]))
    assert read.transcriptions[0].association.clock_samples == samples
    return read


def with_gaps(experiment: Experiment) -> Experiment:
    tracks = measured(experiment).markers.positions_m.copy()
    tracks[np.random.default_rng(3).random(tracks.shape[:2]) < 0.3] = np.nan
    return cs.with_markers(experiment, tracks)


def without_places() -> Experiment:
    """A cube with everything unknown, of whose markers nobody knows where they sit."""
    experiment = cube_with_nuisance(4)
    marked = measured(experiment).markers
    tracks = marked.positions_m + 5e-3 * np.random.default_rng(3).normal(
        size=marked.positions_m.shape
    )
    return replace(experiment, markers=Markers(marked.t_s, tracks, marked.sigma_m, marked.names))


def smooth_drag(x, v, at, drag_coefficient):
    return -5.0 * drag_coefficient * at.area_m2 * ca.sqrt(ca.sumsqr(v) + 1.0) * v


def in_air(experiment: Experiment) -> Experiment:
    """In a gas of two thirds of the density of the body, so that all that it does is large."""
    return replace(experiment, air_density_kg_m3=20.0)


def whirled(x, v, at, whirl_n_m3):
    """It has no potential."""
    return whirl_n_m3 * at.volume_m3 * ca.vertcat(at.rest_m[1] - x[1], x[0] - at.rest_m[0], 0)


def magnus(x, v, at, spin_n_s_m4):
    """Across where it goes, as on what spins; it does no work."""
    spin = ca.vertcat(0.3, 1 + ca.sumsqr(x), -0.5)
    return 10 * spin_n_s_m4 * at.volume_m3 * ca.cross(v, spin)


def breathing(x, v, at, breath_pa):
    return -breath_pa * (1 + 10 * at.t_s + ca.dot(v, at.normal)) * at.area_m2 * at.normal


def creeping(x, v, before, at, creep_n_m):
    """It bends by all that it takes, as friction does; what creeps slows down as it goes."""
    moved, rate = x - at.rest_m + 0.02 * v, creep_n_m * at.volume_m3 * 1e4
    share = 20 * at.interval_s / (1 + 20 * at.interval_s + ca.sumsqr(before) / 1e-3)
    after = before + (1 - at.is_start) * share * (1 + ca.sin(rate)) * (moved - before)
    return -rate * (moved - after) * (1 + ca.sumsqr(before) / 1e-3), after


def in_field(
    law: Callable,
    scheme: str = "midpoint",
    on: On = "nodes",
    carries: int = 0,
    moved: Experiment | None = None,
    **memory,
) -> Collocation:
    """With a force of a user."""
    force, cube = (
        cs.NodeForce.from_law(law, on=on, carries=carries),
        moved or hung_cube(5, (1, 1, 2)),
    )
    body = cs.Body(
        cube.body.mesh, density_kg_m3=30.0, forces=[force], prony=["prony_1"] if memory else []
    )
    own = Parameters.from_mapping({force.constants[0].name: cs.Unknown(40.0), **memory})
    known = Parameters((*GUESS.items, *own.items))
    return program(replace(cube, body=body), parameters=known, scheme=scheme)


def differing(moved: Experiment, scheme: str = "midpoint", values=GUESS, **body) -> Collocation:
    """Stiffness from place to place, of a body that is uneven already."""
    field = cs.Field(0.1, modes=3)
    made = cs.Body(moved.body.mesh, density_kg_m3=30.0, **({"field": field} | body))
    made = made.with_free_densities(made.parts_with_free_density(values.names))
    known = values.with_fields([made])
    uneven = {name: 0.4 * (-1) ** k for k, name in enumerate(made.field_coefficient_names)}
    return program(replace(moved, body=made), parameters=known.with_guess(uneven), scheme=scheme)


IN_MASS, OF_DENSITY = (
    cs.Field(0.1, "density_kg_m3", 3),
    Parameters.from_mapping({"density_kg_m3": cs.Unknown(25.0)}),
)


def hung_when_scanned(moved: Experiment, values=GUESS, scheme: str = "midpoint", **body):
    """A mesh that was made while the body stood on its lowest nodes, leaning."""
    mesh = moved.body.mesh
    low = np.flatnonzero(mesh.points_m[:, 2] < mesh.points_m[:, 2].min() + 1e-9)
    scan = cs.UnderGravity(Indices(low.tolist()), (2.0, 1.0, -5.0))
    settings = {"density_kg_m3": 30.0, "rest_shape": scan} | body
    made = cs.Body(mesh, **settings)
    made = made.with_free_densities(made.parts_with_free_density(values.names))
    return program(replace(moved, body=made), parameters=values, scheme=scheme)


def differing_core() -> Collocation:
    """A region beside what differs, which differs by itself, in its damping."""
    field = cs.Field((0.05, 0.1), "gamma_r_s", 2)
    core = cs.Region("core", np.arange(12), field=field)
    return differing(measured(hung_cube(4)), regions=[core])


OF_OBSTACLES = Nuisance.none(obstacle_offset_m=1e-3, obstacle_tilt_rad=0.02, obstacle_time_s=2e-3)


def touched(
    friction: float | str = 0.0,
    scheme: str = "midpoint",
    felt: bool = False,
    relaxed: float | None = None,
    **changes,
) -> Collocation:
    """Pressed by a ball and a plate, which may measure the force, or be of hard contact."""
    pressed = pressed_cube(4, friction, **changes)
    if felt:
        held, ball, plate = pressed.grasps
        forces = cs.Wrench(pressed.t_s, np.full((5, 3), 0.05), 0.3)
        pressed = replace(pressed, grasps=[held, replace(ball, wrench=forces), plate])
    pressed = pressed.with_obstacles([replace(o, relaxed=relaxed) for o in pressed.obstacles])
    own = {friction: cs.Unknown(0.5)} if isinstance(friction, str) else {}
    known = Parameters((*GUESS.items, *Parameters.from_mapping(own).items))
    return program(measured(pressed) if not own else pressed, parameters=known, scheme=scheme)


def instruments(scheme: str = "midpoint", huber: float | None = None) -> Collocation:
    """Of a user's own, so blunt that what is known of the markers is not drowned."""
    cube = hung_cube(7, (1, 1, 2))
    made = cs.with_markers(cube, cube.markers.positions_m)
    made = noisy(instrumented(made, accelerometer(made.t_s[2:]), strain_gauge(made.t_s)))
    blunt = [replace(gauge, sigma=100 * gauge.sigma) for gauge in made.readings]
    return program(replace(made, readings=blunt), scheme=scheme, huber=huber)


def watched(**changes) -> Collocation:
    """Seen by a camera between its samples, of which nothing is known exactly, beside markers."""
    cube = hung_cube(6, (1, 1, 2))
    cube = cs.with_markers(cube, cube.markers.positions_m)
    pose = np.array([[1, 0, 0, 0.05], [0, 0, 1, -0.4], [0, -1, 0, 0.05], [0, 0, 0, 1.0]])
    camera = cs.DepthCamera([[100, 0, 0], [0, 100, 0], [0, 0, 1]], pose=pose)
    places = np.random.default_rng(0).uniform([-0.04, -0.04, 0.395], [0.04, 0.04, 0.405], (9, 3))
    seen = cs.Depth("front", cube.t_s[1:5] + 0.003, [places] * 4, 0.05, camera, gate_m=0.1)
    unknown = Nuisance.none(
        depth_turn_rad=0.1,
        depth_shift_m=0.02,
        depth_bias_m=0.01,
        depth_scale=0.01,
        depth_time_s=0.01,
    )
    return program(replace(cube, depths=[seen], nuisance=unknown), **changes)


def clamp(**changes) -> Collocation:
    """A user's load cell in the hand, beside a sensor and markers."""
    cube = wristed_cube(6, ALL_UNKNOWN, frame="grasp")
    cell = cs.Gauge("cell", bent, cube.t_s, np.ones((7, 2)), 0.3, unknowns={"gain": 0.1}, grasp=1)
    return program(replace(cube, readings=[cell]), **changes)


def bent(at: cs.GraspQuantities, gain):
    """Curved in all that it looks at."""
    return ca.vertcat(gain + at.force_n[2] ** 2, (1 + gain) * at.torque_nm[0] * at.force_n[1])


def users_nuisances() -> Collocation:
    """Beside all others, and shared by two recordings."""
    bar = bar_with_nuisance(5)
    own = replace(bar.nuisance, time_shift_s=0.003, own=tuple(ROWS.values()))
    shared = replace(own, scope={"sag": "shared", "camera_scale": "shared"})
    pair = (replace(bar, nuisance=shared), replace(bar, name="second", nuisance=shared))
    return program(*pair, huber=2.0)


def shared_by_four() -> Collocation:
    """What is shared stands among each one's own, in another order, and moves the bodies too."""
    cube = cube_with_nuisance(4)
    shared = ("marker_offset_m", "camera_offset_m", "time_shift_s", "pose_turn_rad", "gravity_rad")
    second, third = (swung_again(cube, name) for name in ("second", "third"))
    fourth = replace(bar_with_nuisance(4), nuisance=Nuisance.none(marker_offset_m=0.003))
    return program(
        sharing(cube, "hand_eye_m"),
        sharing(second, *shared),
        fourth,
        sharing(third, *shared, "hand_eye_m"),
    )


def shared_sensors() -> Collocation:
    nuisance = Nuisance(tare=10.0, sensor_lag_s=0.003, tool_kg=0.01, tool_m=0.02, gravity_rad=0.03)
    one = wristed_cube(4, nuisance)
    names = ("tare", "sensor_time_s", "sensor_lag_s", "tool_kg", "tool_m", "gravity_rad")
    return program(*(sharing(each, *names) for each in (one, swung_again(one, "second"))))


def regions_and_several() -> Collocation:
    one = replace(hung_cube(3, (1, 1, 2)), body=of_regions())
    forgetful = replace(hung_cube(3, (1, 1, 2)), name="forgetful")
    tilted = replace(one, name="tilted", nuisance=Nuisance.none(gravity_rad=0.1))
    return program(one, forgetful, tilted, parameters=guesses(REGIONS, 1.1))


def memory(name: str, scheme: str = "midpoint", **changes) -> Collocation:
    experiment = remembering(name, 4, 2, **changes)
    return program(experiment, parameters=guesses(TWO, 1.1), scheme=scheme)


OWN_TIMES_S = times(22, 0.0031) + 0.0017


def loaded_cube(steps: int = 8) -> Experiment:
    """A cube that a mass joins and leaves, in the hand and below, and a force pulls there."""
    cube = hung_cube(steps)
    dt, held = cube.timestep_s, cube.grasps[0].nodes
    free = np.setdiff1d(np.arange(len(cube.body.nodes_m)), held)
    both = np.concatenate([held[:2], free[:2]])
    return replace(
        cube,
        masses=[PointMass(both, 0.01, 1.6 * dt, until_s=5.2 * dt)],
        forces=[Force(both[1:3], [[0.02, 0.01, 0.03]], from_s=2.3 * dt)],
        nuisance=replace(EVERYTHING, joining_s=0.004),
    )


def gripped_rod(scheme: str = "midpoint", **options) -> Collocation:
    """A bent cable with natural curvature, whose first section a hand with a sensor turns."""
    body = cable(bent_rod(4), natural_curvature=True, damping="kelvin-voigt")
    t_s = np.arange(6) * 0.01
    turns = Rotation.from_rotvec(np.outer(10 * t_s, [0.2, 0.3, 0.1])).as_quat()
    hand = PoseSequence(t_s, np.outer(t_s, [0.5, -0.2, 1.0]), turns)
    tips = Markers(t_s, np.zeros((6, 1, 3)), 1e-3, places_m=[body.mesh.place_m(0.1)])
    rod = Experiment(body, t_s, [Grasp(ends(body)[0], hand)], tips, nuisance=Nuisance.none())
    known = {"torsion_n_m2": 0.01, "curvature_1_1_m": cs.Unknown(0.5), "curvature_2_1_m": -0.3}
    known |= {"twist_1_m": 0.2, "gamma_r_s": cs.Unknown(2e-3), "gamma_m_1_s": 0.1}
    stiff = {"bending_n_m2": cs.Unknown(0.02), "axial_n": cs.Unknown(5.0)}
    parameters = Parameters.from_mapping(known | stiff)
    return program(felt(sensing(rod)), scheme=scheme, parameters=parameters, **options)


STARTS = Nuisance.none(start_acceleration_m_s2=3.0, start_velocity_m_s=0.2)
PROGRAMS: dict[str, Make] = {
    "rod": gripped_rod,
    "rod, bdf2": lambda: gripped_rod("bdf2"),
    **{
        f"{start}, {scheme}": lambda layout=(start, scheme, rows, steps): program(
            swung(layout[0]),
            parameters=WITH_PRIOR,
            scheme=layout[1],
            has_grasp_constraints=layout[2],
            substeps=layout[3],
        )
        for scheme, start, rows, steps in LAYOUTS
    },
    "depth camera": watched,
    "laser beams": lambda: program(lit_cube(measured=True)),
    "engineering moduli": lambda: program(swung(), parameters=ENGINEERING),
    "some fixed": lambda: program(swung(), parameters=POISSON_FIXED),
    "all fixed": lambda: program(swung(), parameters=ALL_FIXED),
    "several": lambda: program(*several_kinds(), scheme="bdf2"),
    "nobody holds": lambda: program(replace(swung("given"), grasps=()), has_grasp_constraints=True),
    "paper's start": lambda: program(
        swung("undeformed", start_rule="paper"), scheme="backward-euler"
    ),
    "shorter than its reach": lambda: program(swung(steps=2), scheme="bdf2"),
    "static": lambda: program(
        measured(block("z", gravity_m_s2=HANGING)), has_grasp_constraints=True
    ),
    "static, a displacement's zero": lambda: program(
        measured(block("xyz", nuisance=Nuisance.none(displacement_zero_m=1e-3)))
    ),
    **{
        f"driven, {scheme}": lambda scheme=scheme: program(
            measured(driven_bar(4)), swung(), scheme=scheme
        )
        for scheme in ("midpoint", "bdf2")
    },
    **{
        f"let go, {scheme}": lambda scheme=scheme: program(measured(bar_let_go(6)), scheme=scheme)
        for scheme in SCHEMES
    },
    "let go, rows": lambda: program(measured(bar_let_go(6)), has_grasp_constraints=True),
    **{
        f"loads, {scheme}": lambda scheme=scheme: program(
            bar_loaded(6),
            replace(bar_let_go(5), nuisance=Nuisance.none(joining_s=0.003)),
            scheme=scheme,
        )
        for scheme in SCHEMES
    },
    **{
        f"moving start, {scheme}": lambda scheme=scheme: program(
            replace(swung(), start="moving", nuisance=STARTS), scheme=scheme
        )
        for scheme in ("midpoint", "bdf2")
    },
    "loads, all fixed": lambda: program(bar_loaded(6), parameters=ALL_FIXED),
    **{
        f"nuisance, {steps}": lambda steps=steps: program(
            with_gaps(cube_with_nuisance(6)), swung(), cube_with_nuisance(3), substeps=steps
        )
        for steps in (1, 2)
    },
    "turn, all fixed": lambda: program(
        replace(swung(), nuisance=Nuisance.none(pose_turn_rad=0.02)), parameters=ALL_FIXED
    ),
    "clock before": lambda: cleared_clock(-4),
    "clock behind": lambda: cleared_clock(4),
    **{
        f"huber, {huber:g}": lambda huber=huber: program(
            swung(), cube_with_nuisance(3), huber=huber
        )
        for huber in (1e-3, 4.0, 1e3)
    },
    "places unknown": lambda: program(without_places()),
    "places unknown, huber": lambda: program(without_places(), huber=2.0),
    **{
        f"density, {name}": lambda make=make: program(make(), parameters=free_densities())
        for name, make in DENSE.items()
    },
    "density, let go, bdf2": lambda: program(
        DENSE["let go"](), parameters=free_densities(), scheme="bdf2"
    ),
    "density, memory": lambda: program(remembering_core(), parameters=free_densities(REMEMBERED)),
    **{
        f"constants, {name}": lambda body=body, truth=truth, off=off: program(
            measured_with(waved_bar(4, evaluator="casadi", **body), truth),
            parameters=stated(truth, off),
        )
        for name, (body, truth, off) in MODELS.items()
    },
    "shared": shared_by_four,
    "shared sensors": shared_sensors,
    "a user's nuisances": users_nuisances,
    "a user's drag": lambda: in_field(smooth_drag),
    "a user's drag, bdf2": lambda: in_field(smooth_drag, "bdf2"),
    "a user's whirl": lambda: in_field(whirled),
    "a user's spin": lambda: in_field(magnus),
    "a user's spin, bdf2": lambda: in_field(magnus, "bdf2"),
    "a user's spin, let go": lambda: in_field(magnus, moved=bar_let_go(6)),
    "a user's spin, wrench": lambda: in_field(
        magnus, moved=sensing(hung_cube(5, (1, 1, 2)), frame="grasp")
    ),
    "a user's pressure": lambda: in_field(breathing, on="faces"),
    "a user's pressure, bdf2": lambda: in_field(breathing, "bdf2", on="faces"),
    "a user's drag, memory": lambda: in_field(
        smooth_drag, **{"prony_1.share": 0.4, "prony_1.tau_s": cs.Unknown(0.05)}
    ),
    "air": lambda: program(in_air(bar_loaded(6))),
    "air, wrench, bdf2": lambda: program(in_air(sensing(loaded_cube())), scheme="bdf2"),
    "air, density": lambda: program(in_air(DENSE["let go"]()), parameters=free_densities()),
    "air, static": lambda: program(measured(in_air(block("z", gravity_m_s2=HANGING)))),
    **{f"contact, {scheme}": lambda scheme=scheme: touched(scheme=scheme) for scheme in SCHEMES},
    "contact, friction": lambda: touched("friction"),
    "contact, friction, bdf2": lambda: touched("friction", scheme="bdf2"),
    "contact, unknown place": lambda: touched("friction", nuisance=OF_OBSTACLES),
    "contact, wrench": lambda: touched("friction", felt=True, nuisance=OF_OBSTACLES),
    "contact, static": lambda: touched(kind="static", felt=True),
    "contact, static, friction": lambda: touched(
        "friction", kind="static", felt=True, nuisance=OF_OBSTACLES
    ),
    **{
        f"hard contact, {scheme}": lambda scheme=scheme: touched(scheme=scheme, relaxed=0.3)
        for scheme in ("midpoint", "bdf2")
    },
    "hard contact, wrench": lambda: touched(relaxed=0.3, felt=True, nuisance=OF_OBSTACLES),
    "hard contact, static": lambda: touched(
        relaxed=0.3, kind="static", felt=True, nuisance=OF_OBSTACLES
    ),
    "under gravity": lambda: hung_when_scanned(swung()),
    "under gravity, bdf2": lambda: hung_when_scanned(swung(), scheme="bdf2"),
    "under gravity, paper's damping": lambda: hung_when_scanned(swung(), damping="rayleigh"),
    "under gravity, static": lambda: hung_when_scanned(
        measured(block("xyz", gravity_m_s2=HANGING))
    ),
    "under gravity, free density": lambda: hung_when_scanned(
        swung(), Parameters((*GUESS.items, *OF_DENSITY.items))
    ),
    "field": lambda: differing(swung()),
    "field, bdf2": lambda: differing(swung(), "bdf2"),
    "field, damping in material form": lambda: differing(swung(), damping="material"),
    "field, paper's damping": lambda: differing(swung(), damping="rayleigh"),
    "field, shear": lambda: differing(swung(), field=cs.Field(0.1, "mu_pa", 2)),
    "field, density": lambda: differing(swung(), field=IN_MASS),
    "field, density, free, bdf2": lambda: differing(
        swung(), "bdf2", Parameters((*GUESS.items, *OF_DENSITY.items)), field=IN_MASS
    ),
    "field, density, static": lambda: differing(
        measured(block("z", gravity_m_s2=HANGING)), field=IN_MASS
    ),
    "field, regions": differing_core,
    "field, memory": lambda: differing(
        measured(hung_cube(3, (1, 1, 2))), values=guesses(TWO, 1.1), prony=["prony_1", "prony_2"]
    ),
    "field, density, memory": lambda: differing(
        measured(hung_cube(3, (1, 1, 2))),
        values=guesses(TWO, 1.1),
        prony=["prony_1", "prony_2"],
        field=IN_MASS,
    ),
    "field, wrench": lambda: differing(sensing(hung_cube(4, (1, 1, 2)), frame="grasp")),
    "field, contact": lambda: differing(measured(pressed_cube(4, 0.0))),
    "field, static": lambda: differing(measured(block("z", gravity_m_s2=HANGING))),
    "carried by a force": lambda: in_field(creeping, carries=3),
    "carried by a force, bdf2": lambda: in_field(creeping, "bdf2", carries=3),
    "carried by a force, memory": lambda: in_field(
        creeping, carries=3, **{"prony_1.share": 0.4, "prony_1.tau_s": cs.Unknown(0.05)}
    ),
    "carried by a force, faces": lambda: in_field(creeping, on="faces", carries=3),
    "carried by a force, let go": lambda: in_field(creeping, carries=3, moved=bar_let_go(6)),
    "carried by a force, wrench": lambda: in_field(
        creeping, carries=3, moved=sensing(hung_cube(5, (1, 1, 2)), frame="grasp")
    ),
    "carried by a force, static": lambda: in_field(
        creeping, carries=3, moved=block("z", gravity_m_s2=HANGING)
    ),
    "instruments": instruments,
    "instruments, bdf2": lambda: instruments("bdf2"),
    "instruments, huber": lambda: instruments(huber=1e3),
    "load cell": clamp,
    "load cell, bdf2, huber": lambda: clamp(scheme="bdf2", huber=2.0),
    "memory, relaxed": lambda: memory("hung-cube"),
    "memory, loaded": lambda: memory("hung-cube", loaded_since_s=0.04),
    "memory, loaded, bdf2": lambda: memory("hung-cube", "bdf2", loaded_since_s=0.04),
    "memory, undeformed": lambda: memory("released-cube"),
    "memory, undeformed, backward-euler": lambda: memory("released-cube", "backward-euler"),
    "memory, let go": lambda: memory("bar-let-go"),
    "memory, nuisance": lambda: memory("bar-with-nuisance"),
    "memory, regions": regions_and_several,
    "wrench": lambda: program(wristed_cube(5)),
    "wrench, unknown": lambda: program(wristed_cube(6, ALL_UNKNOWN, frame="grasp")),
    "wrench, huber": lambda: program(wristed_cube(6, ALL_UNKNOWN), huber=1.5),
    "wrench, bdf2": lambda: program(wristed_cube(6, ALL_UNKNOWN), scheme="bdf2"),
    "wrench, substeps": lambda: program(wristed_cube(3), scheme="backward-euler", substeps=2),
    "wrench, rows": lambda: program(wristed_cube(5), has_grasp_constraints=True),
    "wrench, density": lambda: program(
        weighed(wristed_cube(5, ALL_UNKNOWN)), parameters=free_density()
    ),
    "wrench, loads": lambda: program(sensing(bar_loaded(6))),
    **{
        f"wrench, everything, {scheme}": lambda scheme=scheme: program(
            felt(sensing(loaded_cube(), OWN_TIMES_S, frame="grasp")), scheme=scheme
        )
        for scheme in SCHEMES
    },
    "wrench, everything, in the world": lambda: program(felt(sensing(loaded_cube(), OWN_TIMES_S))),
    "wrench, paper's damping": lambda: program(felt(sensing(with_papers_damping(hung_cube(8))))),
    "wrench, let go": lambda: program(sensing(bar_let_go(8))),
    "wrench, driven": lambda: program(sensing(driven_bar(5))),
    "wrench, static": lambda: program(sensing(block("xyz", gravity_m_s2=HANGING))),
    "wrench, static, uneven": lambda: program(felt(pressed(nuisance=Nuisance()))),
    "wrench, driven, memory": lambda: program(
        felt_memory("driven-bar", 4), parameters=guesses(TWO, 1.1)
    ),
    "wrench, memory": lambda: program(
        felt_memory("cube-with-nuisance"), parameters=guesses(TWO, 1.1)
    ),
    "wrench, memory, let go": lambda: program(
        felt_memory("bar-let-go", 8), parameters=guesses(TWO, 1.1)
    ),
    "wrench, several": lambda: program(*several(), parameters=guesses(TWO, 1.1)),
}


# By name, so that nothing is built before its tests run; these check what is said here.
REMEMBERING = [n for n in PROGRAMS if "memory" in n or "carried" in n or n == "wrench, several"]
# Where nothing but the last rows is left out: what moves the body moves it along its equations.
# Rounding errors of a rod, times the rigidity of its sections, are larger than the tolerance.
ALONG = [
    *(n for n in PROGRAMS if n not in REMEMBERING and "fixed" not in n and not n.startswith("rod"))
]
WITH_ROWS = [
    *("undeformed, backward-euler", "equilibrium, midpoint", "given, midpoint", "undeformed, bdf2"),
    *("nobody holds", "static", "let go, rows", "wrench, rows"),
]
SIMULATED = [name for name in PROGRAMS if name not in (*WITH_ROWS, "all fixed")]
# What these have is in another program too, beside other things.
LONG = [
    *("let go, backward-euler", "loads, backward-euler", "driven, bdf2", "nuisance, 2"),
    *("turn, all fixed", "clock before", "huber, 0.001", "huber, 1000", "density, hung cube"),
    *("density, let go", "density, loaded", "constants, an exponent"),
    *("constants, three constants", "constants, two stiffnesses", "a user's drag, bdf2"),
    *("a user's spin, bdf2", "a user's spin, let go", "a user's pressure, bdf2", "air, density"),
    *("contact, midpoint", "contact, backward-euler", "contact, friction, bdf2"),
    *("contact, unknown place", "contact, static", "hard contact, midpoint"),
    *("hard contact, static", "under gravity", "under gravity, paper's damping"),
    *("under gravity, free density", "field, bdf2", "field, damping in material form"),
    *("field, paper's damping", "field, shear", "field, density", "field, density, static"),
    *("field, density, memory", "field, contact", "field, static", "carried by a force, bdf2"),
    *("carried by a force, faces", "carried by a force, let go", "carried by a force, static"),
    *("instruments", "instruments, huber", "load cell", "memory, loaded", "memory, undeformed"),
    *("memory, nuisance", "wrench", "wrench, bdf2", "wrench, loads"),
    *("wrench, everything, backward-euler", "wrench, everything, bdf2"),
    *("wrench, everything, in the world", "wrench, paper's damping", "wrench, let go"),
    *("wrench, driven", "wrench, static, uneven", "wrench, memory", "wrench, memory, let go"),
    "rod, bdf2",
]


def cases(names: Iterable[str]) -> list:
    return [pytest.param(n, marks=pytest.mark.long) if n in LONG else n for n in names]


@pytest.fixture(scope="module", params=cases(PROGRAMS))
def made(request: pytest.FixtureRequest) -> Collocation:
    """The tests of a program follow each other."""
    found = PROGRAMS[request.param]()
    assert found.has_eliminated_histories == (request.param in REMEMBERING)
    assert found.has_grasp_constraints == (request.param in WITH_ROWS)
    return found


def test_matrices_are_those_of_differences_and_laid_out_in_order(made: Collocation, rng):
    made = with_lifted_variables(made)
    z, y = some_point(made, rng), rng.normal(size=made.constraint_count)

    def slope(at: np.ndarray) -> np.ndarray:
        return 1.3 * made.gradient(at) + made.jacobian(at).T @ y

    jacobian, hessian, gradient = (made.jacobian(z), made.hessian(z, 1.3, y), made.gradient(z))
    assert_derivative(made.objective, lambda d: gradient @ d, z, rng, 1e-7, 0.1, 1)
    for own in (slice(None), slice(made.nq), made.phi_columns, slice(made.phi_columns.stop, None)):
        scale = np.zeros(len(z))  # some columns would drown among the others
        scale[own] = 0.05
        if scale.any():
            values = made.constraint_values
            if np.abs(jacobian @ scale).max() > 0:
                assert_derivative(values, lambda d: jacobian @ d, z, rng, 1e-7, scale, 1)
            assert_derivative(slope, lambda d: hessian @ d, z, rng, 1e-7, scale, 1)
    for indptr, rows in (made.jacobian_structure, made.hessian_structure):
        columns = np.repeat(np.arange(made.variable_count), np.diff(indptr))
        entries = columns * max(made.variable_count, made.constraint_count) + rows
        assert (np.diff(entries) > 0).all(), "an entry twice, or out of order"
        assert columns.shape == rows.shape
    assert (rows <= columns).all(), "an entry below the diagonal"


FAR_OFF = ["places unknown", "places unknown, huber", "wrench, huber"]


@pytest.mark.parametrize("made", FAR_OFF, indirect=True)
def test_gauss_newtons_hessian_is_convex_however_far_readings_are_off(made: Collocation, rng):
    made = with_lifted_variables(made)
    z = some_point(made, rng)
    convex = np.linalg.eigvalsh(made.hessian(z, 1.0, None).toarray())
    assert convex[0] > -1e-12 * convex[-1]
    if not isinstance(made, LiftedCollocation):
        exact = made.hessian(z, 1.0, np.zeros(made.constraint_count)).toarray()
        assert np.linalg.eigvalsh(exact)[0] < -1e-6 * convex[-1]


@pytest.mark.parametrize("made", cases(ALONG), indirect=True)
def test_sensitivities_keep_the_linearised_constraints(made: Collocation, rng):
    z = some_point(made, rng)
    jacobian, found = made.jacobian(z), []
    for part in made.iterates(z):
        found.append(Sweep(part.transcription).forward(part.x, part.equations).by_p)
    moving = [
        transcription.parameter_indices[transcription.dynamic_parameters].tolist()
        for transcription in made.transcriptions
    ]
    for place in sorted(set(chain(*moving))):
        p = np.eye(made.nq + made.nphi)[place]
        still = [np.zeros(by_p.shape[:2]) for by_p in found]
        moved = [
            by_p[..., own.index(place)] if place in own else none
            for by_p, own, none in zip(found, moving, still, strict=True)
        ]
        change = jacobian @ made.pack(p, moved)
        forced = jacobian @ made.pack(p, still)
        assert np.abs(change).max() <= 1e-9 * np.abs(forced).max()


@pytest.mark.parametrize("made", cases(SIMULATED), indirect=True)
def test_the_loss_of_simulated_motions_has_one_gradient_forward_and_backward(
    made: Collocation, rng
):
    q, phi = (made.parameters.guess_q, 0.1 + 0.3 * np.abs(rng.normal(size=made.nphi)))
    p = np.clip(np.concatenate([q, phi]), *made.parameter_bounds)
    z = simulate_variables(made, p)
    rows = [transcription.grid_times for transcription in made.transcriptions]
    point = Horizon(made, rows).evaluate(p, made.unpack(z)[1])
    forward, backward = (2 * made.loss_scale * point.fit.score, adjoint_gradient(made, z))
    assert point.loss == pytest.approx(made.objective(z) / made.loss_scale, rel=1e-7)
    np.testing.assert_allclose(backward, forward, atol=1e-6 * np.abs(forward).max())

    def loss(at: np.ndarray) -> float:
        return made.objective(simulate_variables(made, at))

    assert_derivative(loss, lambda d: forward @ d, p, rng, 1e-5, 0.1, 1)


def test_a_gauge_of_zeros_is_a_residual_and_with_a_small_sigma_an_equation():
    """The strain of a hanging bar is stated instead of measured."""
    t_s = np.linspace(0.0, 0.1, 6)
    bar = cs.Body(cs.box_mesh((0.04, 0.04, 0.12), (1, 1, 3)), density_kg_m3=1000.0)
    held = cs.Grasp(np.flatnonzero(bar.nodes_m[:, 2] > 0.119), cs.PoseSequence.fixed())
    ends_m = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.08)]
    surroundings = {"nuisance": cs.Nuisance.none(), "air_density_kg_m3": "none"}
    markers = cs.Markers(t_s, np.zeros((6, 2, 3)), 1e-4, places_m=ends_m)
    truth = {"young_pa": 20e3, "poisson": 0.4, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.0}
    known = cs.Experiment(bar, t_s, [held], markers, start="equilibrium", **surroundings)
    low_m, high_m = cs.simulate(known, truth, "midpoint", substeps=1).markers_m[0, :, 2]

    def equality(at):
        return at.position_m[2, 1] - at.position_m[2, 0] - float(high_m - low_m)

    equal = cs.Gauge("length", equality, t_s, np.zeros((6, 1)), 1e-7, ends_m, unit="m")
    blind = cs.Experiment(bar, t_s, [held], readings=[equal], start="equilibrium", **surroundings)
    problem = cs.Problem([blind], truth | {"young_pa": cs.Unknown(30e3)}, substeps=1)
    assert cs.solve(problem).parameters["young_pa"] == pytest.approx(20e3, rel=1e-4)
