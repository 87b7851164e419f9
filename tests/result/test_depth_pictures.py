"""Pictures of depth cameras before and after a fit, and messages about empty images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.depth import (
    MATRIX,
    NOISE_M,
    POSE,
    PROBLEM,
    SHAPE,
    TRUTH,
    bar,
    camera_residuals,
    fitted,
    hanging,
    image_m,
    moved,
    noisy,
)
from kit.problem_files import pictures_drawn, run_command
from kit.results import a_result

import collocation_sysid as cs
from collocation_sysid.kinds.depth.poses import camera_hypotheses
from collocation_sysid.pipeline import run
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording.depth_camera import points_from_image
from collocation_sysid.result.animation import FilmFigure
from collocation_sysid.result.camera_overlays import save_overlays, surface_rows, undeformed_rows
from collocation_sysid.result.pictures.album import all_pictures
from collocation_sysid.result.pictures.cameras import camera_pictures, depth_picture
from collocation_sysid.result.replay import MotionRecord

UPWARD, INVERTED = np.diag([1.0, -1, -1, 1]), np.linalg.inv(POSE)
AWAY = np.eye(4) + 5 * np.outer(np.eye(4)[2], np.eye(4)[3])  # 5 m above, and looks up
IN_MM = POSE * np.array([[1, 1, 1, 1000]] * 3 + [[1, 1, 1, 1]])


def seeing(pose: np.ndarray, factor: float = 1.0) -> cs.Experiment:
    """The bar, seen by a camera that is described by this pose and a factor of its depth."""
    camera = cs.DepthCamera(MATRIX, pose=pose)
    return hanging((cs.Depth.of_images("front", factor * image_m(), camera, NOISE_M),))


@pytest.mark.parametrize(
    ("pose", "factor", "said"),
    [
        (INVERTED, 1.0, ["inverted"]),
        (POSE @ UPWARD, 1.0, ["y up, z backwards"]),
        (np.linalg.inv(POSE @ UPWARD), 1.0, ["inverted", "y up, z backwards"]),
        (POSE, 1000.0, ["points were in mm"]),
        (IN_MM, 1.0, ["pose were in mm"]),
        (IN_MM, 1000.0, ["points were in mm", "pose were in mm"]),
    ],
)
def test_a_camera_that_sees_nothing_is_reported_with_the_reason(pose, factor, said):
    (mistake,) = camera_hypotheses(seeing(pose, factor))
    assert mistake.cause == "camera"
    # Of those that do as well each has as many as are wrong.
    either = mistake.data["mistakes"].split("; or if ")
    assert any(all(word in each for word in said) for each in either)
    assert {each.count("(state") for each in either} == {len(said)}


def test_an_inverted_pose_is_reported_with_what_to_state():
    (mistake,) = camera_hypotheses(seeing(INVERTED))
    assert mistake.message.endswith(
        "hardly any points are near the body; they would be if camera.pose were inverted (state "
        "the transform from the camera's frame to the world)"
    )


@pytest.mark.parametrize("sides", [(1, -1, -1, 1), (-1, 1, -1, 1)])
def test_equivalent_frames_of_a_symmetric_body_are_both_named(sides):
    (mistake,) = camera_hypotheses(seeing(POSE @ np.diag([*map(float, sides)])))
    one, other = mistake.data["mistakes"].split("; or if ")
    assert "x to the right, y up, z backwards" in one + other
    assert "x to the left, y down, z backwards" in one + other


def test_a_frame_of_no_convention_is_not_reported_twice():
    forward = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    (mistake,) = camera_hypotheses(seeing(POSE @ forward.T @ np.diag([-1.0, -1, 1, 1])))
    assert "mistakes" not in mistake.data
    assert "check camera.pose" in mistake.message


def test_a_displaced_camera_is_reported_to_see_nothing():
    elsewhere = moved(np.zeros(3), np.array([0.0, 0.0, 0.7]))
    (mistake,) = camera_hypotheses(seeing(elsewhere))
    assert "only 0 % of the body's visible surface" in mistake.message


def test_a_camera_that_is_20_mm_and_10_degrees_off_is_none_that_sees_nothing():
    off = moved(np.radians(10) * np.array([0, 0.6, 0.8]), np.array([0.02, 0, 0]))
    assert not [*camera_hypotheses(seeing(off))]


def test_outlines_before_a_fit_are_where_the_stated_camera_sees_the_body():
    (rows,) = undeformed_rows(seeing(POSE)).values()
    points, lines = rows[np.isfinite(rows[:, 3])], rows[np.isnan(rows[:, 3])]
    assert np.isnan(points[:, 4]).all()
    # The undeformed bar is drawn by hand.
    skin = VisibleSurface.from_body(bar(), seeing(POSE).depths[0])
    own = (skin.subdivided_triangles(bar().nodes_m[skin.nodes], 1) - POSE[:3, 3]) @ POSE[:3, :3]
    silhouette = np.argwhere(np.isfinite(cs.depth_image(cs.DepthCamera(MATRIX), SHAPE, own)))
    low, high = (np.nanmin(lines[:, 1:3], axis=0), np.nanmax(lines[:, 1:3], axis=0))
    np.testing.assert_allclose(low[::-1], silhouette.min(axis=0), atol=1.5)
    np.testing.assert_allclose(high[::-1], silhouette.max(axis=0), atol=1.5)
    assert len(depth_picture(rows).axes) == 2


def test_the_picture_names_points_out_of_view():
    (rows,) = undeformed_rows(seeing(INVERTED)).values()
    said = [text.get_text() for text in depth_picture(rows).axes[0].texts]
    assert said == ["the body is not in view"]


@pytest.mark.filterwarnings("error")
def test_points_of_a_cloud_at_the_camera_do_not_count():
    camera = cs.DepthCamera(MATRIX, pose=POSE)
    seen = points_from_image(image_m(), cs.DepthCamera(MATRIX))
    cloud = np.vstack([seen, [[0.0, 0.0, 0.0], [0.1, 0.1, 1e-320], [0.1, 0.0, -1e-9]]])
    depths = [cs.Depth("scan", [0.0], [each], 1e-3, camera) for each in (seen, cloud)]
    (expected,), (rows,) = (undeformed_rows(hanging((each,))).values() for each in depths)
    assert np.array_equal(rows, expected, equal_nan=True)
    assert depth_picture(rows).axes


def test_a_cloud_is_drawn_with_the_body_from_its_broad_side():
    cloud = points_from_image(image_m(), cs.DepthCamera(MATRIX)) @ POSE[:3, :3].T + POSE[:3, 3]
    (rows,) = undeformed_rows(hanging((cs.Depth("scan", [0.0], [cloud], 1e-3),))).values()
    points, lines = rows[np.isfinite(rows[:, 3])], rows[np.isnan(rows[:, 3])]
    wide, high = np.nanmax(lines[:, 1:3], axis=0) - np.nanmin(lines[:, 1:3], axis=0)
    assert 100 < wide < 135
    assert 20 < high < 60
    # It hangs below the undeformed one, downwards in the picture.
    assert points[:, 2].max() > np.nanmax(lines[:, 2]) + 20


def stated(folder: Path, pose: np.ndarray) -> Path:
    bar().mesh.write(folder / "bar.vtu")
    np.savez(folder / "front.npz", depth_m=image_m(), camera_matrix=MATRIX, camera_pose=pose)
    (folder / "problem.toml").write_text(PROBLEM)
    return folder / "problem.toml"


@pytest.mark.long
def test_check_draws_image_and_body_and_names_the_mistake(tmp_path):
    file = stated(tmp_path, INVERTED)
    checked = run_command("check", str(file), "--out", str(tmp_path / "seen"))
    assert checked.code == 1
    assert (tmp_path / "seen" / "depth_hanging_front.png").stat().st_size > 5000
    assert "depth_hanging_front.png" in checked.out
    assert "inverted" in " ".join(checked.out.split())
    assert "points of 'front'" in checked.out


@pytest.mark.long
def test_check_draws_and_reports_a_camera_that_looks_away(tmp_path):
    checked = run_command("check", stated(tmp_path, AWAY), "--out", tmp_path / "seen")
    assert checked.code == 1
    assert (tmp_path / "seen" / "depth_hanging_front.png").is_file()
    assert "points of 'front'" in checked.out
    (rows,) = undeformed_rows(seeing(AWAY)).values()
    said = [text.get_text() for text in depth_picture(rows).axes[0].texts]
    assert said == ["the body is not in view"]


@pytest.mark.long
def test_a_solve_in_which_no_point_of_a_camera_counts_is_saved_with_its_pictures(tmp_path):
    tip = np.flatnonzero(bar().nodes_m[:, 0] > 0.12 - 1e-9)[:3]
    still = cs.Markers([0.0], np.zeros((1, 3, 3)), 1e-4, places_m=bar().nodes_m[tip])
    marked = replace(seeing(AWAY), markers=still, nuisance=cs.Nuisance.none())
    marked = with_markers(marked, cs.simulate(marked, TRUTH).markers_m)
    unknown = TRUTH | {"young_pa": cs.Unknown(2e5)}
    solved = run(cs.Problem([marked], cs.Parameters.from_mapping(unknown)), seek_causes=False)
    found_pa = solved.optimum["young_pa"].value
    assert found_pa == pytest.approx(TRUTH["young_pa"], rel=1e-3)
    assert any("0 points of 'front' are compared" in note for note in solved.solution.notes)
    with pictures_drawn():
        solved.save(tmp_path / "run", frames=False)
    assert (tmp_path / "run" / "depth_experiment_front.png").is_file()
    (text,) = depth_picture(np.zeros((0, 8))).axes[0].texts
    assert text.get_text() == "no point is near enough to the body to be compared"


@pytest.mark.parametrize(("matrix", "unit"), [(MATRIX, "pixels"), (None, "mm")])
def test_image_coordinates_have_their_unit(tmp_path, matrix, unit):
    """Those of an image are pixels, those of a cloud without a matrix millimetres."""
    (depth,) = seeing(POSE).depths
    camera = cs.DepthCamera(matrix, pose=POSE)
    images_m = depth.images_m if matrix is not None else ()
    experiment = replace(seeing(POSE), depths=(replace(depth, camera=camera, images_m=images_m),))
    rows = undeformed_rows(experiment)
    shape_m = bar().nodes_m[None], np.zeros((1, 0, 3))
    record = MotionRecord.from_experiment(experiment, shape_m)
    kept = MotionRecord.from_arrays("hanging", replace(record, visible_points=rows).to_arrays())
    ((_, figure),) = camera_pictures(kept)
    assert figure.axes[0].get_xlabel() == f"u [{unit}]"
    assert figure.axes[0].get_ylabel() == f"v [{unit}]"
    with pictures_drawn():
        assert save_overlays([experiment], tmp_path)


def test_cameras_whose_names_meet_in_one_file_name_have_a_picture_each(tmp_path):
    (rows,) = undeformed_rows(seeing(POSE)).values()
    named = [("a_b", "c"), ("a", "b_c")]
    twins = [
        replace(seeing(POSE), name=name, depths=(replace(seeing(POSE).depths[0], name=camera),))
        for name, camera in named
    ]
    drawn = save_overlays(twins, tmp_path)
    assert [file.name for file in drawn] == ["depth_a_b_c.png", "depth_a_b_c_2.png"]
    shape_m = bar().nodes_m[None], np.zeros((1, 0, 3))
    shown = [
        replace(
            MotionRecord.from_experiment(each, shape_m), visible_points={each.depths[0].name: rows}
        )
        for each in twins
    ]
    assert {"depth_a_b_c", "depth_a_b_c_2"} <= all_pictures(shown, a_result()).keys()


def test_models_are_not_compared_by_depth_images_alone(tmp_path):
    file = stated(tmp_path, POSE)
    both = "neo-hookean,st-venant-kirchhoff"
    compared = run_command("compare-models", file, "--materials", both, "--out", tmp_path / "both")
    assert compared.code == 2
    assert "'hanging' has neither markers nor a measured force" in " ".join(compared.err.split())
    assert not (tmp_path / "both").exists()


@pytest.fixture(scope="module")
def found():
    return fitted(noisy(np.random.default_rng(3)), POSE)


@pytest.mark.long
def test_the_fitted_surface_is_drawn_over_the_image_with_distances(found):
    (part,) = found.collocation.iterates(found.z)
    (reading,) = camera_residuals(part.transcription)
    surface = reading.fitted(part.motion_for(reading.observable), part.phi)
    rows = surface_rows(surface, part.transcription.experiment.upward_direction)
    points, lines = rows[np.isfinite(rows[:, 3])], rows[np.isnan(rows[:, 3])]
    used = np.isfinite(points[:, 4])
    assert used.sum() == reading.correspondences.is_compared.sum()
    assert np.sqrt(np.mean(points[used, 4] ** 2)) < 2e-4
    # What is seen lies within what is drawn of the surface, but for a pixel.
    low, high = (np.nanmin(lines[:, 1:3], axis=0), np.nanmax(lines[:, 1:3], axis=0))
    assert (points[used, 1:3] > low - 1).all()
    assert (points[used, 1:3] < high + 1).all()
    # Where points are in the world they are on the surface, to what they are apart.
    skin, x = (reading.correspondences.surface, reading.surface_shapes(part.x, part.phi)[0])
    _, places = skin.nearest_points(x, points[used, 5:], np.arange(len(skin.plane_triangles)))
    faces, _ = skin.nearest_points(x, points[used, 5:], np.arange(len(skin.plane_triangles)))
    _, feet, _ = skin.evaluate(x, faces, places)
    away = np.linalg.norm(points[used, 5:] - feet, axis=1)
    assert np.median(np.abs(away - np.abs(points[used, 4]))) < 1e-6
    titles = [axes.get_title() for axes in depth_picture(rows).axes]
    assert any("mm RMS, " in title for title in titles)


def test_a_film_shows_the_points_that_were_seen_about_each_of_its_samples(found):
    (part,) = found.collocation.iterates(found.z)
    (reading,) = camera_residuals(part.transcription)
    surface = reading.fitted(part.motion_for(reading.observable), part.phi)
    rows = surface_rows(surface, part.transcription.experiment.upward_direction)
    experiment = part.transcription.experiment
    x = np.repeat(part.x.reshape(1, -1, 3), 3, axis=0)
    replay = MotionRecord.from_experiment(experiment, (x[:1], np.zeros((1, 0, 3))))
    # As if the camera had seen it twice, before and after a dropout.
    later = rows + np.eye(8)[0] * 0.2
    replay = replace(
        replay,
        t_s=np.array([0.0, 0.1, 0.2]),
        is_prescribed=np.repeat(replay.is_prescribed, 3, axis=0),
        measured_m=np.zeros((3, 0, 3)),
        positions_m=x,
        markers_m=np.zeros((3, 0, 3)),
        visible_points={"front": np.vstack([rows, later])},
    )
    count = reading.correspondences.is_compared.sum()
    assert [len(replay.camera_points_m(t)) for t in range(3)] == [count, 0, count]
    sparse = replace(replay, visible_points={"front": rows})
    assert [len(sparse.camera_points_m(t)) > 0 for t in range(3)] == [True, False, False]
    film = FilmFigure(sparse)
    ((_, _, _, drawn, _),) = film.drawings
    film.show_sample(0)
    u, _ = drawn.camera_points.get_data()
    assert 0 < len(u) <= reading.correspondences.is_compared.sum()
    shown = drawn.view.to_sheet_mm(sparse.camera_points_m(0))
    assert np.isin(np.round(u, 6), np.round(shown[:, 0], 6)).all()
    film.show_sample(2)
    assert len(drawn.camera_points.get_data()[0]) == 0
