"""What follows a solve, and what is refused, for slender bodies."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from kit.problem_files import run_command
from kit.problems import smooth_poses
from kit.rods import CABLE, cable, straight

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.extras.export import write_export
from collocation_sysid.extras.export.identified import IdentifiedBody
from collocation_sysid.extras.export.target import LAWS
from collocation_sysid.extras.planning.hand_limits import Limits
from collocation_sysid.extras.planning.motion_plan import plan_motion
from collocation_sysid.extras.planning.task import Task
from collocation_sysid.problem.new import create_problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.result.replay import MotionRecord
from collocation_sysid.runs.check.body import check_body
from collocation_sysid.statistics.plausibility import material_hypothesis

SECTION = cs.CrossSection.round(0.008)
VALUES = CABLE | {"gamma_r_s": 0.01, "gamma_m_1_s": 0.3}
IDEAL = cs.Nuisance.none()
LIMITS = Limits.model_validate(
    {
        "workspace_m": ((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)),
        "speed_m_s": 1.5,
        "acceleration_m_s2": 15.0,
        "rotation_deg": 90.0,
        "angular_speed_deg_s": 360.0,
        "angular_acceleration_deg_s2": 3000.0,
    }
)


def swung(section: cs.CrossSection = SECTION, **changes) -> cs.Experiment:
    """A cable whose first two sections a gripper moves; its tip is tracked."""
    body = cable(straight(0.3, section, 7))
    t_s = 0.02 * np.arange(11)
    hand = smooth_poses(t_s, sway_m=(0.01, 0.02, 0.005))
    tip = cs.Markers(t_s, np.zeros((11, 1, 3)), 1e-3, ["tip"], places_m=[[0.3, 0.0, 0.0]])
    usual = {"nuisance": IDEAL, "air_density_kg_m3": "none"}
    grasps = [cs.Grasp(range(6), hand), *changes.pop("obstacles", ())]
    return cs.Experiment(body, t_s, grasps, tip, **usual | changes)


@cache
def identified(section: cs.CrossSection = SECTION, moves: bool = False) -> IdentifiedBody:
    experiment = swung(section)
    theta = experiment.body.theta_from_values(VALUES)
    shapes = simulate(experiment, theta).positions_m if moves else None
    return IdentifiedBody("a cable", "good", (), {}, experiment.body, theta, experiment, shapes)


# Export -----------------------------------------------------------------------------------------


@pytest.fixture
def stage_of(tmp_path):
    usd = pytest.importorskip("pxr.Usd")

    def stage_of(body: IdentifiedBody):
        write_export(body, "usd", tmp_path)
        return usd.Stage.Open(str(tmp_path / "body.usda"))

    return stage_of


def told(prim, name: str, *time):
    return np.array(prim.GetAttribute(name).Get(*time))


def test_usd_plays_the_centreline_with_its_normals(stage_of):
    body = identified(moves=True)
    stage = stage_of(body)
    curve = stage.GetPrimAtPath("/World/Body/Mesh")
    assert curve.GetTypeName() == "BasisCurves"
    assert curve.GetAttribute("type").Get() == "linear"
    assert told(curve, "curveVertexCounts").tolist() == [7]
    assert told(curve, "widths") == pytest.approx(0.008)
    codes = curve.GetAttribute("points").GetTimeSamples()
    assert body.simulated_m is not None
    for code, shape_m in zip(codes, body.simulated_m, strict=True):
        centres = shape_m.reshape(-1, 3, 3).mean(axis=1)
        np.testing.assert_allclose(told(curve, "points", code), centres, atol=1e-7)
        first = shape_m[::3] - centres
        first /= np.linalg.norm(first, axis=1)[:, None]
        np.testing.assert_allclose(told(curve, "normals", code), first, atol=1e-5)
    assert np.ptp(body.simulated_m[:, -1], axis=0).max() > 1e-3
    rest_m = np.outer(np.linspace(0, 0.3, 7), [1, 0, 0])
    np.testing.assert_allclose(told(curve, "physics:restShapePoints"), rest_m, atol=1e-7)
    assert told(curve, "physics:masses").sum() == pytest.approx(body.node_mass_kg.sum(), rel=1e-6)


@pytest.mark.parametrize(
    "section",
    [SECTION, cs.CrossSection.round(0.008, 0.005), cs.CrossSection.rectangle(0.008, 0.004)],
)
def test_usd_gets_the_stiffness_of_a_cable_over_that_of_a_circle(section, stage_of):
    stage = stage_of(identified(section))
    prim = stage.GetPrimAtPath("/World/Materials/body")
    d = float(told(prim, "physics:thickness"))
    moment, area = np.pi * d**4 / 64, np.pi * d**2 / 4
    assert told(prim, "physics:bendStiffness") * moment == pytest.approx(CABLE["bending_n_m2"])
    assert told(prim, "physics:twistStiffness") * 2 * moment == pytest.approx(CABLE["torsion_n_m2"])
    assert told(prim, "physics:stretchStiffness") * area == pytest.approx(CABLE["axial_n"])
    mass_kg = told(prim, "physics:density") * area * 0.3
    assert mass_kg == pytest.approx(1200.0 * section.area_m2 * 0.3, rel=1e-6)
    for name, value in CABLE.items():
        assert told(prim, f"collocationSysid:{name}") == pytest.approx(value)
    assert told(prim, "collocationSysid:gammaR_s") == pytest.approx(0.01)


def test_usd_attaches_the_held_sections_to_the_gripper(stage_of):
    stage = stage_of(identified())
    grasp = stage.GetPrimAtPath("/World/Gripper_1/Grasp")
    assert told(grasp, "physics:indices0").tolist() == [0, 1]
    np.testing.assert_allclose(told(grasp, "physics:coords1"), [[0, 0, 0], [0.05, 0, 0]], atol=1e-7)


@pytest.mark.parametrize("target", [name for name, laws in LAWS.items() if "cable" not in laws])
def test_a_simulator_without_cables_refuses_one(target, tmp_path):
    with pytest.raises(InputError, match="no law cable"):
        write_export(identified(), target, tmp_path / target)
    assert not (tmp_path / target).exists()


def test_a_cable_has_no_modulus_in_an_export():
    (region,) = identified().regions
    assert np.isnan([region.young_pa, region.poisson]).all()


# Checks and pictures ----------------------------------------------------------------------------


def test_a_check_of_a_rod_speaks_of_no_tetrahedra_and_no_moduli():
    body = swung().body
    checked = check_body(body, body.theta_from_values(VALUES), ("swing",))
    assert not checked.worst_elements
    assert checked.open_question is None
    assert not checked.warnings
    assert set(checked.guess) == set(VALUES)


def test_a_heavy_cable_of_wires_is_no_impossible_material():
    body = cs.Body(straight(0.3, SECTION, 7), "cable", density_kg_m3=7000.0)
    assert (
        material_hypothesis(body, body.theta_from_values(VALUES | {"bending_n_m2": 1e-4})) is None
    )


def test_tetrahedra_of_a_rod_are_no_elements_in_pictures():
    record = MotionRecord.from_experiment(swung())
    assert MotionRecord.from_arrays(record.name, record.to_arrays()).slender


# Refusals ---------------------------------------------------------------------------------------


TABLES = {
    "obstacle": 'shape = { plane = { normal = [0, 0, 1] } }\nposes = "poses.csv"',
    "pressure": "faces = { box_m = [[-1, -1, -1], [1, 1, 1]] }\npressure_pa = 100.0",
    "tendon": "points_m = [[0, 0, 0], [0.6, 0, 0]]\ntension_n = 1.0",
    "depth": 'file = "depth.npz"\nsigma_m = 0.001',
    "outlines": 'file = "masks.json"\ncamera = { matrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]], '
    "pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]] }",
}


@pytest.mark.parametrize("key", TABLES)
def test_a_table_that_needs_a_surface_is_refused_with_exit_code_2(key, tmp_path):
    create_problem(tmp_path / "hose", "cable")
    problem = tmp_path / "hose" / "problem.toml"
    text = problem.read_text(encoding="utf-8")
    table = f'[[experiment.{key}]]\nname = "other"\n{TABLES[key]}\n\n[experiment.markers]'
    problem.write_text(text.replace("[experiment.markers]", table), encoding="utf-8")
    finished = run_command("solve", problem, "--out", tmp_path / "run")
    assert finished.code == 2
    message = f"problem.toml: experiment 'swing': found {key} of a rod; expected a solid body"
    assert finished.err.count("error: ") == 1, finished.err
    assert message in " ".join(finished.err.split())
    assert not (tmp_path / "run").exists()


def test_points_of_a_rod_in_images_need_places():
    t_s = 0.02 * np.arange(11)
    camera = cs.Camera(np.diag([800.0, 800.0, 1.0]) + 0.0, pose=np.eye(4), size_px=(640, 480))
    tracks = cs.ImageTracks("front", camera, t_s, np.full((11, 1, 2), 100.0), ["middle"])
    with pytest.raises(InputError, match="no place is stated of middle in 'front'"):
        cs.Problem(
            [swung(readings=[tracks])], VALUES | {"bending_n_m2": cs.Unknown(1e-3)}
        ).collocation()


def floor() -> cs.Obstacle:
    return cs.Obstacle(shape=cs.Plane((0, 0, 1), (0, 0, -1)), name="floor")


@pytest.mark.parametrize("what", ["obstacle", "tendon", "pressure", "depth", "outlines"])
def test_what_needs_a_surface_is_refused(what):
    camera = cs.Camera(np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))
    t_s = [0.0, 0.02]
    changes = {
        "obstacle": lambda: {"obstacles": [floor()]},
        "tendon": lambda: {"tendons": [cs.Tendon([[0, 0, 0], [0.3, 0, 0]], 1.0)]},
        "pressure": lambda: {"pressures": [cs.Pressure([[0, 1, 3]], 1.0)]},
        "depth": lambda: {"depths": [cs.Depth("cam", t_s, [np.zeros((1, 3))] * 2, 1e-3)]},
        "outlines": lambda: {"readings": [cs.Outlines("cam", camera, t_s, [None, None])]},
    }
    with pytest.raises(InputError, match="of a rod; expected a solid body"):
        swung(**changes[what]())


# Plans ------------------------------------------------------------------------------------------


HUNG = VALUES | {"bending_n_m2": 1e-3, "torsion_n_m2": 8e-4}


def hung_experiment(hand: cs.PoseSequence, t_s: np.ndarray, sections: int) -> cs.Experiment:
    """A cable of 0.3 m, a quarter of which a hand holds, and the rest hangs."""
    mesh = cs.rod_mesh([[0, 0, 0], [0, 0, -0.3]], SECTION, sections, stations_m=[0.075])
    tracks_m = np.zeros((len(t_s), 1, 3))
    return cs.Experiment(
        cable(mesh),
        t_s,
        [cs.Grasp(np.flatnonzero(mesh.arc_lengths_m < 0.0751), hand)],
        cs.Markers(t_s, tracks_m, 1e-3, ["tip"], places_m=[[0.0, 0.0, -0.3]]),
        nuisance=IDEAL,
        air_density_kg_m3="none",
    )


def hung() -> cs.Problem:
    experiment = hung_experiment(cs.PoseSequence.fixed(), 0.02 * np.arange(11), 5)
    return cs.Problem([experiment], {n: cs.Unknown(v) for n, v in HUNG.items()}, substeps=1)


def circle_m(t_s: np.ndarray) -> np.ndarray:
    """Displacement (T, 3) of a point on a circle of 30 mm, from 0.3 to 1.1 s."""
    share = np.clip((t_s - 0.3) / 0.8, 0, 1)
    angle = 2 * np.pi * (10 * share**3 - 15 * share**4 + 6 * share**5)
    return 0.03 * np.stack([1 - np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def task(**changes) -> Task:
    t_s = np.linspace(0.0, 1.4, 71)
    reference = {
        "point": "tip",
        "t_s": t_s.tolist(),
        "position_m": [tuple(each) for each in circle_m(t_s).tolist()],
        "relative": True,
    }
    usual = {"duration_s": 1.4, "sample_s": 0.04, "reference": [reference]}
    return Task.model_validate(usual | {"hand": {"intervals": 14}} | changes)


def test_a_limit_of_the_stretch_of_a_rod_is_refused():
    with pytest.raises(InputError, match="largest_stretch"):
        plan_motion(hung(), task(avoid={"largest_stretch": 1.2}), LIMITS)


def test_a_planned_cable_draws_a_circle_also_with_four_times_as_many_sections():
    """A hand that draws the circle itself is off by more than the circle's diameter."""
    t_s = np.linspace(0.0, 1.4, 141)
    plan = plan_motion(hung(), task(), LIMITS)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    rigid = cs.PoseSequence(t_s, circle_m(t_s), quaternions_xyzw=still)
    errors_m = []
    for hand in (plan.poses(t_s), rigid):
        tip_m = simulate(hung_experiment(hand, t_s, 17), HUNG).markers_m[:, 0]
        away_m = np.linalg.norm(tip_m - tip_m[0] - circle_m(t_s), axis=1)
        errors_m.append(np.sqrt(np.mean(away_m**2)))
    assert errors_m[1] > 0.06
    assert errors_m[0] < 0.1 * errors_m[1]
