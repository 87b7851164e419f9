"""Grasps that follow measured displacements, as of image correlation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.judge.contradictions import load_sign_hypotheses
from collocation_sysid.model.nuisance_map import NuisanceMap
from collocation_sysid.problem.options import UncertaintyOptions
from collocation_sysid.program.simulation import with_wrenches
from collocation_sysid.recording.measured_faces import face_columns, face_note, read_face
from collocation_sysid.recording.writers import write_columns_csv
from collocation_sysid.statistics.budget.consider_analysis import changed_residuals
from collocation_sysid.statistics.budget.systematic_effects import ASSUMPTIONS, Assumptions

SIZE_M = 0.02
TIMES = np.array([0.0, 1.0, 2.0])
STRETCH = np.array([[0.02, 0.01, 0.0], [0.0, 0.03, 0.005], [0.004, 0.0, -0.04]])
VALUES = {"young_pa": 1e5, "poisson": 0.42, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
(ROW,) = (row for row in ASSUMPTIONS if row.name == "measured_face")


def cube(divisions: int = 3, **options) -> cs.Body:
    mesh = cs.box_mesh((SIZE_M,) * 3, (divisions,) * 3)
    return cs.Body(mesh, density_kg_m3=1000.0, **options)


def grid(z_m: float, count: int = 5) -> np.ndarray:
    """Places (k, 3) on a face, most of which are no nodes."""
    ticks = np.linspace(0.0, SIZE_M, count)
    x, y = np.meshgrid(ticks, ticks)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z_m)])


def write_face(file: Path, places_m, moved_m, t_s=TIMES) -> Path:
    """Write displacements (T, k, 3) of places (k, 3), in an order of their own."""
    columns = {"t_s": np.repeat(t_s, len(places_m))}
    for k, axis in enumerate("xyz"):
        columns[f"{axis}_m"] = np.tile(places_m[:, k], len(t_s))
        columns[f"u{axis}_m"] = moved_m[..., k].ravel()
    order = np.random.default_rng(2).permutation(len(columns["t_s"]))
    write_columns_csv(file, {name: column[order] for name, column in columns.items()})
    return file


def stretched(places_m: np.ndarray) -> np.ndarray:
    """Displacements (T, k, 3) of an affine map, growing in time, after a rotation by up to 40°."""
    shares = TIMES / TIMES[-1]
    turns = Rotation.from_rotvec(np.outer(0.7 * shares, [0.0, 0.6, 0.8])).as_matrix()
    maps = turns @ (np.eye(3) + shares[:, None, None] * STRETCH)
    return np.einsum("tij,kj->tki", maps, places_m) + 0.01 * shares[:, None, None] - places_m


def static(body: cs.Body, grasps, **options) -> cs.Experiment:
    return cs.Experiment(
        body,
        TIMES,
        grasps,
        kind="static",
        gravity_m_s2=(0.0, 0.0, 0.0),
        nuisance=cs.Nuisance.none(),
        **options,
    )


@pytest.mark.parametrize("interpolation", ["smooth", "linear", "hold"])
def test_affine_displacements_are_exact_between_the_places(tmp_path, interpolation):
    file = write_face(tmp_path / "face.csv", grid(SIZE_M), stretched(grid(SIZE_M)))
    poses = replace(read_face(file, cube().nodes_m), interpolation=interpolation)
    points_m = grid(SIZE_M, 4)
    found = poses.moved_positions(points_m, TIMES)
    np.testing.assert_allclose(found, points_m + stretched(points_m), atol=1e-7)
    assert poses.deformation_at(points_m, [0.5]).shape == (1, 16, 3)
    assert "25 places move rigidly by up to" in face_note(poses)


def test_the_table_of_a_simulation_is_that_which_is_read(tmp_path):
    file = write_face(tmp_path / "face.csv", grid(SIZE_M), stretched(grid(SIZE_M)))
    poses = read_face(file, cube().nodes_m)
    write_columns_csv(tmp_path / "again.csv", face_columns(poses))
    again = read_face(tmp_path / "again.csv", cube().nodes_m)
    np.testing.assert_allclose(again.positions_m, poses.positions_m, atol=1e-9)


def test_the_inside_of_a_body_follows_its_measured_surface(tmp_path):
    body = cube()
    outside = ((body.nodes_m < 1e-9) | (body.nodes_m > SIZE_M - 1e-9)).any(axis=1)
    nodes = np.flatnonzero(outside)
    moved_m = stretched(body.nodes_m)
    columns = {"t_s": np.repeat(TIMES, len(nodes)), "node": np.tile(nodes, len(TIMES))}
    columns |= {f"u{axis}_m": moved_m[:, nodes, k].ravel() for k, axis in enumerate("xyz")}
    write_columns_csv(tmp_path / "face.csv", columns)
    grasp = cs.Grasp(nodes, read_face(tmp_path / "face.csv", body.nodes_m), sigma_m=1e-6)
    wrench = cs.Wrench(TIMES, np.zeros((3, 6)), sigma_n=1.0, sigma_nm=1.0)
    experiment = static(body, [replace(grasp, wrench=wrench)])
    positions_m = cs.simulate(experiment, VALUES).positions_m
    np.testing.assert_allclose(positions_m, body.nodes_m + moved_m, atol=1e-7)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda text: text.replace("uz_m", "w_m"), "expected each of t_s, x_m, y_m, z_m, ux_m"),
        (lambda text: text.rpartition("\n")[0].rpartition("\n")[0], "expected each place once"),
        (lambda text: text + text.splitlines()[-1] + "\n", "expected each place once"),
        (lambda text: text.replace("x_m,", "node,", 1), "expected an index from 0 to 63"),
    ],
)
def test_incomplete_tables_are_refused(tmp_path, change, expected):
    file = write_face(tmp_path / "face.csv", grid(SIZE_M), stretched(grid(SIZE_M)))
    file.write_text(change(file.read_text()))
    with pytest.raises(InputError, match=expected):
        read_face(file, cube().nodes_m)


def test_a_node_far_from_the_places_is_refused(tmp_path):
    file = write_face(tmp_path / "face.csv", grid(SIZE_M), stretched(grid(SIZE_M)))
    body = cube()
    poses = read_face(file, body.nodes_m)
    with pytest.raises(InputError, match="from the nearest place of a measured displacement"):
        static(body, [cs.Grasp(cs.Box((-1, -1, -1), (1, 1, 1e-6)), poses, sigma_m=1e-6)])


@pytest.mark.parametrize(
    "motion", ['displacements = "a.csv"', 'displacements = "a.csv", sigma_m = 1e-6, poses = "b"']
)
def test_measured_displacements_need_their_deviation_and_no_other_motion(tmp_path, motion):
    file = tmp_path / "problem.toml"
    file.write_text(
        "parameters = { young_pa = 1e5, poisson = 0.4 }\n"
        '[object]\nbox_m = [1, 1, 1]\nedge_length_m = 1\n[[experiment]]\nname = "a"\n'
        f'grasp = {{ nodes = {{ face = "top" }}, {motion} }}\n'
    )
    with pytest.raises(InputError, match="expected displacements and sigma_m"):
        cs.Problem.read(file)


# Twin of a block between platens that give way ---------------------------------------------------


def bowed(places_m: np.ndarray) -> np.ndarray:
    """Displacements (T, k, 3) of both faces: by up to 6 % of the height, in the middle 30 % less."""
    across = 2 * places_m[:, :2] / SIZE_M - 1
    way_m = 0.015 * SIZE_M * TIMES[:, None]
    share = 1 - 0.3 * np.prod(1 - across**2, axis=1)
    side = np.where(places_m[:, 2] > SIZE_M / 2, -1, 1)
    moved_m = np.zeros((len(TIMES), len(places_m), 3))
    moved_m[..., 2] = way_m * (side * share - 1)
    moved_m[..., :2] = 0.1 * way_m[..., None] * across
    return moved_m


def pressed(
    folder: Path, divisions: int, upper: cs.PoseSequence | None = None, noise_m: float = 0.0
) -> cs.Experiment:
    """The block as its faces are measured at 81 places each, or with rigid platens."""
    body = cube(divisions, element="tet10-p0")
    rng = np.random.default_rng(1)
    grasps = []
    for z_m in (0.0, SIZE_M):
        nodes = np.flatnonzero(np.abs(body.nodes_m[:, 2] - z_m) < 1e-9)
        poses, sigma_m = cs.PoseSequence.fixed(), None
        if upper is None:
            places_m = grid(z_m, 9)
            moved_m = bowed(places_m)
            moved_m += noise_m * rng.normal(size=moved_m.shape)
            file = write_face(folder / f"{z_m:g}.csv", places_m, moved_m)
            poses, sigma_m = read_face(file, body.nodes_m), 2e-6
        elif z_m:
            poses = upper
        grasps.append(cs.Grasp(nodes, poses, sigma_m=sigma_m))
    wrench = cs.Wrench(TIMES, np.zeros((len(TIMES), 6)), sigma_n=0.02, sigma_nm=1.0)
    grasps[1] = replace(grasps[1], wrench=wrench)
    places_m = np.array([[SIZE_M, y, z] for y in (0.006, 0.014) for z in (0.005, 0.01, 0.015)])
    markers = cs.Markers(
        TIMES, np.zeros((len(TIMES), 6, 3)), sigma_m=1e-5, names=[*"abcdef"], places_m=places_m
    )
    return static(body, grasps, markers=markers)


def test_an_error_of_the_measured_faces_is_an_effect_on_the_load(tmp_path):
    experiment = pressed(tmp_path, 2)
    known = parameters(young_pa=cs.Unknown(VALUES["young_pa"], 1e3, 1e7))
    collocation = cs.Collocation([experiment], known)
    simulated = cs.simulate(experiment, VALUES)
    positions_m = simulated.positions_m.reshape(len(TIMES), -1)
    z = collocation.pack(collocation.guess_p, [positions_m])
    found, blocks = changed_residuals(collocation, z, [(ROW, 1.0)])
    assert sorted(found) == sorted(f"measured_face {axes}" for axes in ROW.axes.split())
    for component, along in ((2, 2), (0, 0), (2, 0)):
        grasps = []
        for grasp in experiment.grasps:
            face = grasp.poses.deformation
            assert face is not None
            moved_m = face.displacements_m.copy()
            share = 2 * face.places_m[:, along] / SIZE_M - 1
            moved_m[..., component] += 2e-6 * np.outer(TIMES / TIMES[-1], share)
            poses = replace(grasp.poses, deformation=replace(face, displacements_m=moved_m))
            grasps.append(replace(grasp, poses=poses))
        off = cs.simulate(replace(experiment, grasps=grasps), VALUES)
        expected_n = off.wrenches[0] - simulated.wrenches[0]
        number = found.index(f"measured_face {'xyz'[component]}{'xyz'[along]}")
        change_n = 0.02 * blocks[-1][:, 0, :3, number]
        np.testing.assert_allclose(change_n[:, 2], expected_n[:, 2], atol=1e-4)


def test_measured_faces_that_advance_against_the_load_have_a_wrong_sign(tmp_path):
    experiment = pressed(tmp_path, 1)
    seen = with_wrenches(experiment, cs.simulate(experiment, VALUES).wrenches)
    # A sensor below, whose platen gives way towards it.
    lower, upper = seen.grasps
    (sensor,) = seen.wrenches
    below = replace(lower, wrench=sensor.with_samples(TIMES, -sensor.values))
    for right in (seen, replace(seen, grasps=[below, replace(upper, wrench=None)])):
        assert not [*load_sign_hypotheses(right)]
        wrong = right.wrenches[0].with_samples(TIMES, -right.wrenches[0].values)
        (found,) = load_sign_hypotheses(right.with_measurements([right.markers, wrong]))
        assert found.data["axis"] == "z"


def test_measured_faces_do_not_turn_by_default(tmp_path):
    experiment = replace(pressed(tmp_path, 1), nuisance=cs.Nuisance())
    entries = NuisanceMap.from_experiment(experiment).entries
    assert "clamp_turn" not in {entry.row.key for entry in entries}


def parameters(**stated) -> cs.Parameters:
    return cs.Parameters.from_mapping(VALUES | {"young_pa": cs.Unknown(6e4, 1e3, 1e7)} | stated)


def solved(experiment: cs.Experiment, truth: cs.Trajectory):
    """Fit E and ν to noisy markers and loads of a simulation; the block itself is as described."""
    rng = np.random.default_rng(2)
    loads_n = truth.wrenches[0].copy()
    loads_n[:, :3] += 0.02 * rng.normal(size=(len(TIMES), 3))
    loads_n[:, 3:] = np.nan
    tracks_m = truth.markers_m + 1e-5 * rng.normal(size=truth.markers_m.shape)
    markers = replace(experiment.markers, positions_m=tracks_m)
    measured = with_wrenches(replace(experiment, markers=markers), [loads_n])
    exact = {**vars(Assumptions.exact()), "measured_face": 1.0}
    problem = cs.Problem(
        [measured],
        parameters(poisson=cs.Unknown(0.35)),
        uncertainty=UncertaintyOptions(assumptions=Assumptions(**exact)),
    )
    return cs.run(problem, seek_causes=False)


@pytest.mark.long
def test_measured_faces_identify_a_block_between_platens_that_give_way(tmp_path):
    truth = cs.simulate(pressed(tmp_path, 3), VALUES)
    measured = solved(pressed(tmp_path, 3, noise_m=2e-6), truth)
    for name in ("young_pa", "poisson"):
        low, high = measured.interval(name)
        assert low < VALUES[name] < high
        assert measured.estimates[name].value == pytest.approx(VALUES[name], rel=0.05)
    assert "measured_face" in str(measured.budget["young_pa"].shares)
    shifts_m = np.outer(-0.03 * SIZE_M * TIMES, [0.0, 0.0, 1.0])
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(TIMES), 1))
    upper = cs.PoseSequence(TIMES, shifts_m, upright)
    rigid = solved(pressed(tmp_path, 3, upper), truth)
    assert rigid.estimates["young_pa"].value < 0.9 * VALUES["young_pa"]
