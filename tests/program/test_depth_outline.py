"""Outlines in depth images, several starts of a scan, and wrong units of depth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.depth import MATRIX, NOISE_M, POSE, PROBLEM, SHAPE, TRUTH, bar, hanging, image_m
from kit.problem_files import run_command
from PIL import Image
from scipy.ndimage import binary_erosion

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.kinds.depth.concerns import camera_pose_concerns, outline_concerns
from collocation_sysid.methods.starts.stiffness_scan import other_starts
from collocation_sysid.model.nuisance_map import NuisanceMap
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.depth.camera_model import DepthCameraModel
from collocation_sysid.program.depth.outline import no_depth_is_empty
from collocation_sysid.program.depth.outline_residual import OutlineResidual
from collocation_sysid.program.depth.surface_correspondences import SurfaceCorrespondences
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.recording.depth_camera import (
    MOST_OUTLINE_IMAGES,
    points_from_image,
    samples_with_outlines,
)
from collocation_sysid.runs.searches import SAME_LOSS, robust_loss

UNKNOWN = cs.Nuisance.none(depth_turn_rad=0.09, depth_shift_m=0.02, depth_edge_px=1.0)
CAMERA = cs.DepthCamera(MATRIX, pose=POSE)


def seen_by(image: np.ndarray, **options) -> cs.Experiment:
    depth = cs.Depth.of_images("front", image, CAMERA, NOISE_M, spacing_m=0.004, **options)
    return hanging((depth,), nuisance=UNKNOWN)


@cache
def surface_m(young_pa: float) -> np.ndarray:
    """Positions of the surface's nodes of the hanging bar."""
    nothing = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    x = cs.simulate(hanging((nothing,)), {**TRUTH, "young_pa": young_pa}).positions_m[0]
    return x[VisibleSurface.from_body(bar(), nothing).nodes]


def sighting(
    image: np.ndarray, young_pa: float = TRUTH["young_pa"], **options
) -> SurfaceCorrespondences:
    """What belongs together where the bar has a stiffness and the camera is as stated."""
    experiment = seen_by(image, **options)
    nuisance = NuisanceMap.from_experiment(experiment)
    view = DepthCameraModel.from_experiment(experiment, 0, nuisance)
    shapes_m = surface_m(young_pa)[None]
    return SurfaceCorrespondences.from_shapes(view, bar(), shapes_m, np.zeros(nuisance.size), 0.01)


def outside_px(found: SurfaceCorrespondences) -> np.ndarray:
    """How many pixels outline points are outside of their edges."""
    outline = found.outline
    shape_m = found.shapes_m[0]
    points_m = np.einsum("ea,eai->ei", outline.weights[0], shape_m[outline.nodes[0]])
    edges_m = outline.points[0] @ POSE[:3, :3].T + POSE[:3, 3]
    way_m = np.sum(outline.normals[0] * (points_m - edges_m), axis=1)
    return (way_m / np.where(outline.is_compared[0], outline.pixel_m[0], np.inf))[
        outline.is_compared[0]
    ]


def test_the_outline_of_the_true_shape_is_at_the_edges_in_the_image():
    apart_px = outside_px(sighting(image_m()))
    assert len(apart_px) > 50
    assert abs(apart_px.mean()) < 0.1
    assert apart_px.std() < 0.4


def test_rounding_of_edges_to_pixels_is_averaged_along_the_outline():
    """A single search line per point leaves 0.28 pixels, the rounding to whole pixels."""
    assert outside_px(sighting(image_m())).std() < 0.2


def test_noise_along_the_rays_does_not_choose_the_points_beside_a_crease():
    noise_m = NOISE_M * np.random.default_rng(3).normal(size=SHAPE)
    found = []
    for sign in (1.0, -1.0):
        cloud_m = points_from_image(image_m(), CAMERA)
        rays = cloud_m / cloud_m[:, 2:]
        moved_m = cloud_m + sign * rays * noise_m.ravel()[: len(rays), None]
        depth = cs.Depth("front", [0.0], [moved_m], NOISE_M, CAMERA, spacing_m=5e-4)
        experiment = hanging((depth,), nuisance=UNKNOWN)
        nuisance = NuisanceMap.from_experiment(experiment)
        view = DepthCameraModel.from_experiment(experiment, 0, nuisance)
        found.append(
            SurfaceCorrespondences.from_shapes(
                view,
                bar(),
                surface_m(TRUTH["young_pa"])[None],
                np.zeros(nuisance.size),
                0.01,
                settled=True,
            )
        )
    nearer, farther = found
    assert nearer.excluded_counts["crease"] > 20
    np.testing.assert_array_equal(nearer.is_compared, farther.is_compared)
    used = nearer.is_compared[0]
    turned = np.abs(nearer.normals - farther.normals)[0, used].max(axis=1) > 0.1
    # With the points beside the crease, noise turns the normal of twelve points.
    assert np.count_nonzero(turned) <= 2


def test_a_body_that_is_too_soft_extends_beyond_the_image():
    apart_px = outside_px(sighting(image_m(), 0.5 * TRUTH["young_pa"]))
    assert apart_px.max() > 5
    stiff_px = outside_px(sighting(image_m(), 2.0 * TRUTH["young_pa"]))
    assert stiff_px.max() > 5  # its upper side shows nothing either


def test_pixels_that_show_something_far_behind_the_body_are_evidence():
    wall = np.where(np.isnan(image_m()), 1.0, image_m())
    np.testing.assert_allclose(
        outside_px(sighting(wall)), outside_px(sighting(image_m())), atol=1e-9
    )


@pytest.mark.parametrize(
    "missing_m",
    [
        pytest.param(0.2, id="something nearer"),
        pytest.param(np.nan, id="missing depths of unknown reasons"),
    ],
)
def test_pixels_that_may_hide_the_body_are_no_evidence(missing_m):
    image = np.where(np.isnan(image_m()), missing_m, image_m())
    found = sighting(image, 0.5 * TRUTH["young_pa"], background="unknown")
    assert not found.outline.is_compared.any()


def test_missing_depths_are_evidence_where_no_background_is_seen():
    found = sighting(image_m())
    view, image = found.camera, found.camera.depth.images_m[0]
    assert no_depth_is_empty(view, image, sample=0, size_m=view.size_m)
    wall = image.copy()
    wall[:30] = 1.5
    assert not no_depth_is_empty(view, wall, sample=0, size_m=view.size_m)


def test_outlines_beyond_the_margin_of_the_image_are_no_evidence():
    cut = image_m().copy()[:, :80]
    camera = replace(CAMERA, matrix=MATRIX)
    depth = cs.Depth.of_images("front", cut, camera, NOISE_M, spacing_m=0.004)
    experiment = hanging((depth,), nuisance=UNKNOWN)
    nuisance = NuisanceMap.from_experiment(experiment)
    view = DepthCameraModel.from_experiment(experiment, 0, nuisance)
    shapes_m = surface_m(TRUTH["young_pa"])[None]
    found = SurfaceCorrespondences.from_shapes(view, bar(), shapes_m, np.zeros(nuisance.size), 0.01)
    apart_px = outside_px(found)
    assert 20 < len(apart_px) < len(outside_px(sighting(image_m())))
    assert np.abs(apart_px).max() < 1.0


def test_slopes_of_outline_residuals_agree_with_differences():
    experiment = seen_by(image_m())
    unknown = {**TRUTH, "young_pa": cs.Unknown(TRUTH["young_pa"])}
    collocation: Collocation = cs.Problem(
        [experiment], cs.Parameters.from_mapping(unknown)
    ).collocation()
    (transcription,) = collocation.transcriptions
    (reading,) = transcription.residuals_of(OutlineResidual)
    rng = np.random.default_rng(0)
    values = transcription.body.nodes_m[reading.correspondences.surface.nodes][None]
    phi = 0.1 * rng.normal(size=transcription.nuisance.size)
    by_values, by_phi = reading.loss_gradient(values, phi)
    way, turn = rng.normal(size=values.shape), rng.normal(size=len(phi))
    step = 1e-7
    for by, here, there in (
        (np.sum(by_values * way), (values + step * way, phi), (values - step * way, phi)),
        (by_phi @ turn, (values, phi + step * turn), (values, phi - step * turn)),
    ):
        difference = (reading.loss(*here) - reading.loss(*there)) / (2 * step)
        assert by == pytest.approx(difference, rel=1e-5)
    assert np.abs(by_phi).min() > 0  # turn, shift and edge all count


@pytest.mark.long
def test_silhouettes_that_are_smaller_all_around_do_not_make_the_body_stiffer(rng):
    """As those of sensors that lose depths at the edges of things."""
    image = image_m() + NOISE_M * rng.normal(size=SHAPE)
    image[~binary_erosion(np.isfinite(image_m()), iterations=2)] = np.nan
    unknown = {**TRUTH, "young_pa": cs.Unknown(1.2 * TRUTH["young_pa"])}
    solution = cs.solve(cs.Problem([seen_by(image)], cs.Parameters.from_mapping(unknown)))
    (part,) = solution.parts
    (edge_px,) = part.phi[
        [e.row.name == "depth_edge_px" for e in part.transcription.nuisance.entries]
    ]
    assert 1.0 < edge_px < 2.5
    assert solution.parameters["young_pa"] == pytest.approx(TRUTH["young_pa"], rel=0.08)


@pytest.mark.long
def test_missing_depths_at_the_free_end_that_count_as_evidence_ask_for_a_check(rng):
    """A dark end gives no depth: taken for the end of the body it is contradicted by the rest."""
    image = image_m() + NOISE_M * rng.normal(size=SHAPE)
    columns = np.flatnonzero(np.isfinite(image).any(axis=0))
    image[:, columns[-20] :] = np.nan
    unknown = {**TRUTH, "young_pa": cs.Unknown(1.2 * TRUTH["young_pa"])}
    problem = cs.Problem([seen_by(image, background="empty")], cs.Parameters.from_mapping(unknown))
    answer = cs.run(problem, seek_causes=False)
    assert answer.trust.verdict != "good"
    assert any("model's outline" in reason for reason in answer.trust.reasons)
    known = cs.Problem([seen_by(image, background="unknown")], cs.Parameters.from_mapping(unknown))
    found = cs.solve(known).parameters["young_pa"]
    assert found == pytest.approx(TRUTH["young_pa"], rel=0.2)


def test_an_outline_off_the_edges_at_many_points_gives_concern():
    assert not outline_concerns("camera", np.full(50, 1.0))
    assert not outline_concerns("camera", np.zeros(0))
    (found,) = outline_concerns("camera", np.r_[np.zeros(40), np.full(10, 4.0)])
    assert (found.code, found.grade) == ("residuals/outline", "check")
    assert "20 %" in found.message


def test_starts_are_the_best_stiffness_its_neighbours_and_other_minima():
    misfit = np.array([9.0, 3.0, 2.0, 2.5, 2.8, 2.6, 5.0, np.nan])
    assert other_starts(misfit, 2) == (3, 5)
    assert other_starts(np.array([1.0, 50.0, 60.0]), 0) == ()
    assert other_starts(np.array([np.nan, 1.0, 1.5]), 1) == (2,)


@pytest.mark.long
def test_a_soft_bar_is_found_without_a_guess_from_a_camera_that_is_off():
    """Its scan is best at 13.9 kPa, from where a search without outlines ends at 16 kPa, not 25."""
    from depth_twins import SOFT_TRUTH, soft_problem  # pyright: ignore[reportMissingImports]

    solution = cs.solve(soft_problem(0))
    known = cs.solve(soft_problem(0, SOFT_TRUTH["young_pa"]))
    assert robust_loss(solution) < robust_loss(known) + SAME_LOSS
    assert solution.parameters["young_pa"] == pytest.approx(SOFT_TRUTH["young_pa"], rel=0.2)
    assert solution.scan is not None


@pytest.mark.long
def test_points_left_out_beside_creases_do_not_end_the_search():
    """From 35 kPa, where they are still compared; their loss once the shape settles is no loss of
    visible points."""
    from depth_twins import soft_problem  # pyright: ignore[reportMissingImports]

    above = cs.solve(soft_problem(1, 3.5e4))
    below = cs.solve(soft_problem(1, 1.8e4))
    assert robust_loss(above) == pytest.approx(robust_loss(below), abs=2.0)
    assert above.parameters["young_pa"] == pytest.approx(below.parameters["young_pa"], rel=0.02)


def test_a_camera_more_than_two_deviations_off_asks_for_a_check():
    assert not camera_pose_concerns(["turn", "shift"], [1.9, -1.9])
    assert not camera_pose_concerns([], [])
    (found,) = camera_pose_concerns(["turn", "shift"], [1.0, -2.5])
    assert (found.code, found.grade) == ("nuisance/camera", "check")
    assert "shift is 2.5 standard deviations" in found.message


def test_the_lens_projects_points_to_the_pixels_of_their_rays():
    camera = cs.DepthCamera(MATRIX, distortion=[0.1, -0.02, 1e-3, 2e-3, 0.01])
    pixels = np.array([[20.0, 100.0], [80.0, 60.0], [150.0, 5.0]])
    np.testing.assert_allclose(
        camera.distorted_pixels(0.4 * camera.points_at_unit_depth(pixels)), pixels, atol=1e-5
    )


def test_only_some_images_of_a_long_recording_are_kept():
    assert samples_with_outlines(3) == {0, 1, 2}
    kept = samples_with_outlines(1000)
    assert len(kept) == MOST_OUTLINE_IMAGES
    assert {0, 999} <= kept


@pytest.mark.parametrize("factor", [1000.0, 0.001, 10.0, 0.1])
def test_depth_in_a_wrong_unit_is_refused_with_the_power_of_ten(factor):
    camera = cs.DepthCamera(MATRIX, pose=POSE)
    depth = cs.Depth.of_images("front", factor * image_m(), camera, NOISE_M, spacing_m=0.004)
    problem = cs.Problem(
        [hanging((depth,))], cs.Parameters.from_mapping({**TRUTH, "young_pa": cs.Unknown()})
    )
    with pytest.raises(InputError, match=f"multiply count_m by {1 / factor:g}"):
        cs.solve(problem)


@pytest.mark.long
def test_a_wrong_count_m_of_a_png_ends_with_one_message(tmp_path):
    bar().mesh.write(tmp_path / "bar.vtu")
    counts = np.nan_to_num(1e4 * image_m()).astype(np.uint16)  # tenths of a millimetre
    Image.fromarray(counts).save(tmp_path / "front.png")
    camera = f"[experiment.depth.camera]\nmatrix = {MATRIX}\npose = {POSE.tolist()}\n"
    file = tmp_path / "problem.toml"
    file.write_text(PROBLEM.replace("front.npz", "front.png") + camera)
    solved = run_command("solve", file, "--out", tmp_path / "out")
    assert solved.code == 2
    assert "multiply count_m by 0.1" in " ".join(solved.err.split())
    checked = run_command("check", file, "--out", tmp_path / "seen")
    assert checked.code == 1
    assert "0.1 times as far away" in " ".join(checked.out.split())
    file.write_text(file.read_text().replace("sigma_m =", "count_m = 1e-4\nsigma_m ="))
    (experiment,) = cs.Problem.read(file).experiments
    assert np.nanmedian(experiment.depths[0].images_m[0]) == pytest.approx(0.34, abs=0.05)
