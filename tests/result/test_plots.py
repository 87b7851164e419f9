"""Pictures of runs: content, axes and labels."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from kit.filmed import NAMES, swung, tracks_of
from kit.problems import (
    GUESS,
    TRUTH,
    bar_in_two_hands,
    hung_cube,
    measured,
    quadratic_bar,
    released_cube,
)
from kit.results import a_result, uncertainty, value
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.image import imread
from matplotlib.text import Text

from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.solution import Iteration, Solution, Status, Timing
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import PoseSequence
from collocation_sysid.result.figure_style import (
    COLOUR_CYCLE,
    COLUMN_MM,
    RESOLUTION_DPI,
    SMALL_PT,
    framed_figure,
)
from collocation_sysid.result.pictures import (
    Confidence,
    all_pictures,
    confidence_ellipses,
    convergence,
    correlation_matrix,
    elements_picture,
    jacobian_sparsity,
    marker_errors,
    marker_tracks,
    mesh_picture,
    save_pictures,
    shapes_picture,
    spectrum_picture,
)
from collocation_sysid.result.pictures.album import experiment_pictures, with_unique_names
from collocation_sysid.result.pictures.confidence import GREY, budget_picture, ellipse_outline
from collocation_sysid.result.pictures.meshes import spread_levels
from collocation_sysid.result.pictures.over_time import sensor_picture, spectral_density
from collocation_sysid.result.pictures.scene import BodyDrawing, ParallelCamera, SheetView, sheet
from collocation_sysid.result.pictures.search import RASTER_SIZE, SHOWN_STEPS
from collocation_sysid.result.pictures.shapes import FIELD_COLOURS, SurfaceField
from collocation_sysid.result.pictures.stress_strain import is_unloading
from collocation_sysid.result.replay import MotionRecord
from collocation_sysid.runs.result_content import Result

THETA = np.array([*TRUTH.values()])
TIMES = 0.01 * np.arange(20.0)


def history(count=5):
    return [
        Iteration(
            number=k,
            loss=10.0 ** (3 - k),
            misfit=10.0 ** (1 - k),
            violation_n=0.0 if k == 0 else 10.0**-k,
            parameters={**TRUTH, "lambda_pa": 200.0 * 2 ** (count - 1 - k)},
            time_s=float(k),
            trust=2.0**k,
            noise=1e-3 * k,
        )
        for k in range(count)
    ]


def noisy_tracks(markers=2):
    rng = np.random.default_rng(3)
    fitted = rng.normal(size=(len(TIMES), markers, 3)).cumsum(axis=0) * 1e-2
    return fitted + 1e-3 * rng.normal(size=fitted.shape), fitted


@cache
def solved(make=hung_cube, scheme="midpoint") -> Solution:
    """A solution found by knowing it."""
    experiment = measured(make(), scheme)
    collocation = Collocation([experiment], GUESS.with_guess(TRUTH), scheme)
    x = simulate_scheme(experiment, Dynamics.from_experiment(experiment, scheme).with_theta(THETA))
    z = collocation.pack(collocation.parameters.guess_q, [x])
    multipliers = np.zeros(collocation.constraint_count)
    return Solution(
        Status.CONVERGED, "", "known", collocation, z, multipliers, 5, history(), Timing()
    )


def rasters(figure):
    """Parameter columns, block band and single block, masked where there is no entry."""
    return [np.ma.asarray(image.get_array()) for a in figure.axes[:3] for image in a.get_images()]


# Convergence


@pytest.mark.parametrize("option", ["figure.constrained_layout.use", "figure.autolayout"])
def test_margins_do_not_depend_on_the_layout_that_matplotlib_is_configured_with(option: str):
    with mpl.rc_context({option: True}):
        framed = framed_figure(80, 60, left_mm=10, right_mm=5, foot_mm=10, top_mm=5)
        bare, _ = sheet(80, 60)
    assert framed.get_layout_engine() is None
    assert bare.get_layout_engine() is None
    assert framed.subplotpars.left == pytest.approx(10 / 80)


def test_convergence_draws_the_quantities_of_the_search_on_logarithmic_axes():
    lines = history()
    *panels, parameters = convergence(lines).axes
    assert {axes.get_xlim() for axes in panels} == {parameters.get_xlim()}
    assert {axes.get_yscale() for axes in panels} == {"log"}
    labels = ["loss", "violation [N]", "trust region", "noise of loss"]
    assert [axes.get_ylabel() for axes in panels] == labels
    for axes, name in zip(panels, ("loss", "violation_n", "trust", "noise"), strict=True):
        values = np.array([getattr(line, name) for line in lines])
        (curve,) = axes.lines
        np.testing.assert_array_equal(curve.get_xdata(), [line.number for line in lines])
        np.testing.assert_array_equal(curve.get_ydata(), np.where(values > 0, values, np.nan))


def test_zeros_leave_gaps_on_a_logarithmic_axis():
    violation = convergence(history()).axes[1].lines[0].get_ydata()
    np.testing.assert_allclose(violation, [np.nan, 0.1, 0.01, 1e-3, 1e-4])


def test_parameters_are_drawn_relative_to_their_final_values():
    _, first, *others = convergence(history()).axes[-1].lines
    np.testing.assert_allclose(first.get_ydata(), [16, 8, 4, 2, 1])
    assert len(others) == 3
    assert "200 Pa" in str(first.get_label())


@pytest.mark.long
def test_parameters_to_draw_can_be_chosen_and_are_labelled_with_their_values():
    named = [
        replace(line, parameters={"young_pa": 720.0, "poisson": 0.2, "core.mu_pa": 450.0})
        for line in history()
    ]
    lines = convergence(named, ("poisson", "core.mu_pa")).axes[-1].lines
    assert len(lines) == 3
    assert "0.2" in str(lines[1].get_label())
    assert "450" in str(lines[2].get_label())
    assert "core" in str(lines[2].get_label())


@pytest.mark.parametrize("names", [(), ("mu_pa",)])
def test_nothing_to_draw_is_no_error(names, tmp_path):
    figures = {"none": convergence([], names), "some": convergence(history(), names)}
    save_pictures(tmp_path, figures)


# Markers


def test_tracks_show_each_coordinate_with_its_error_below():
    measured_m, fitted = noisy_tracks()
    figure = marker_tracks(TIMES, ["tip", "side"], measured_m, fitted, 1.1 * fitted)
    assert len(figure.axes) == 2 * 3 * 2
    upper, lower = figure.axes[2:4]  # y of the tip
    dots, fit, rolled_out = (line.get_ydata() for line in upper.lines)
    np.testing.assert_allclose(dots, 1e3 * measured_m[:, 0, 1])
    np.testing.assert_allclose(fit, 1e3 * fitted[:, 0, 1])
    np.testing.assert_allclose(rolled_out, 1.1e3 * fitted[:, 0, 1])
    errors = [line.get_ydata() for line in lower.lines[1:]]
    np.testing.assert_allclose(errors[0], 1e3 * (fitted - measured_m)[:, 0, 1])
    assert len(errors) == 2


def test_missing_samples_leave_gaps():
    measured_m, fitted = noisy_tracks()
    measured_m[5:8, 1] = np.nan
    figure = marker_tracks(TIMES, ["tip", "side"], measured_m, fitted)
    side = figure.axes[6].lines[0].get_ydata()
    assert np.flatnonzero(np.isnan(side)).tolist() == [5, 6, 7]


def test_tracks_fit_legibly_on_a_page():
    measured_m, fitted = noisy_tracks(markers=9)
    figure = marker_tracks(TIMES, [f"m{k}" for k in range(9)], measured_m, fitted)
    assert len(figure.axes) == 2 * 3 * 3
    assert figure.get_figheight() < 0.75 * figure.get_figwidth()


def test_a_budget_has_its_whole_legend_and_colours_that_differ():
    names = [f"a long name of source {k}" for k in range(12)]
    shares = {"young_pa": dict.fromkeys(names, 1 / 12), "poisson": {names[3]: 1.0}}
    figure = budget_picture(shares)
    figure.draw_without_rendering()
    (legend,) = figure.legends
    inside, whole = legend.get_window_extent(), figure.bbox
    assert inside.x0 >= 0
    assert inside.x1 <= whole.width
    assert inside.y0 >= figure.axes[0].get_window_extent().y1
    drawn = [to_hex(bars[0].get_facecolor()).upper() for bars in figure.axes[0].containers]
    assert drawn == [*COLOUR_CYCLE, GREY]  # for any colour vision, each once
    ends = [bars[-1].get_x() + bars[-1].get_width() for bars in figure.axes[0].containers]
    assert ends[-1] == pytest.approx(1.0)


def test_the_worst_of_many_markers_are_shown():
    measured_m, fitted = noisy_tracks(markers=9)
    fitted[:, 4] += 0.1
    fitted[:, 7] += 0.1
    fitted[:, 8] += 0.1
    figure = marker_tracks(TIMES, [f"m{k}" for k in range(9)], measured_m, fitted)
    titles = [axes.get_title(loc="left").partition(",")[0] for axes in figure.axes]
    assert list(dict.fromkeys(title for title in titles if title)) == ["m4", "m7", "m8"]
    assert "3 of 9" in figure.legends[0].get_title().get_text()


def test_validation_has_no_fitted_track():
    measured_m, fitted = noisy_tracks()
    assert len(marker_tracks(TIMES, ["tip", "side"], measured_m, None, fitted).axes[0].lines) == 2
    assert len(marker_errors(TIMES, measured_m, None, fitted).axes[0].lines) == 1


def test_error_over_time_is_the_rms_distance_of_the_markers_seen():
    measured_m, fitted = (np.zeros((len(TIMES), 2, 3)), np.zeros((len(TIMES), 2, 3)))
    fitted[:, 0, 0], fitted[:, 1, 1] = 3e-3, 4e-3
    measured_m[3, 0] = measured_m[4] = np.nan
    error = marker_errors(TIMES, measured_m, fitted).axes[0].lines[0].get_ydata()
    assert error[0] == pytest.approx(np.sqrt((9 + 16) / 2))
    assert error[3] == pytest.approx(4.0)
    assert np.isnan(error[4])


@pytest.mark.parametrize(("friction", "titles"), [(0.0, ["fz"]), (0.3, ["fx", "fy", "fz"])])
def test_components_that_vanish_have_no_panel(friction, titles):
    """Noise about a force that an obstacle without friction does not have is none; friction is."""
    rng = np.random.default_rng(0)
    t_s = np.linspace(0.0, 1.0, 50)
    force_n = np.outer(t_s, [friction, friction, 1.0]) + 1e-12
    columns = [t_s, force_n + rng.normal(0, 5e-3, (50, 3)), force_n, np.full((50, 3), np.nan)]
    figure = sensor_picture(np.column_stack(columns), ["fx", "fy", "fz"], ["N", "N", "N"])
    assert [axes.get_title(loc="left") for axes in figure.axes if axes.get_visible()] == titles


def test_significant_measurements_about_a_prediction_of_zero_are_drawn():
    t_s = np.linspace(0.0, 1.0, 50)
    measured = np.outer(t_s, [0.2, 1.0])
    fitted = np.outer(t_s, [0.0, 1.0])
    columns = [t_s, measured, fitted, fitted]
    figure = sensor_picture(np.column_stack(columns), ["fx", "fz"], ["N", "N"])
    assert len(figure.axes) == 2
    alone = sensor_picture(np.column_stack([t_s, *[0 * t_s] * 3]), ["fx"], ["N"])
    assert len(alone.axes) == 1  # nothing else could be drawn


def test_numbers_with_the_largest_errors_are_drawn():
    t_s = np.linspace(0.0, 1.0, 10)
    measured = np.outer(t_s, np.ones(20))
    fitted = measured + 0.01 * np.arange(20)
    figure = sensor_picture(
        np.column_stack([t_s, measured, fitted, fitted]), [f"n{k}" for k in range(20)]
    )
    assert [axes.get_title(loc="left") for axes in figure.axes] == [f"n{k}" for k in range(5, 20)]
    assert figure.legends[0].get_title().get_text().startswith("15 of 20 numbers")


def test_numbers_of_a_sensor_have_the_names_of_its_columns():
    tracks = tracks_of()
    experiment = swung([tracks])
    values = np.column_stack([tracks.t_s, *[tracks.measured_values] * 3])
    record = MotionRecord.from_experiment(experiment, recorded={"readings": {"front": values}})
    kept = MotionRecord.from_arrays("swing", record.to_arrays())
    pictures = dict(experiment_pictures(kept))
    figure = pictures["reading_swing_front"]
    titles = [axes.get_title(loc="left") for axes in figure.axes if axes.get_visible()]
    assert titles == [f"{name}_{axis}" for name in NAMES for axis in "uv"]
    assert {axes.get_ylabel() for axes in figure.axes[:3]} == {"[px]"}


def test_errors_far_apart_get_a_logarithmic_axis():
    measured_m, fitted = noisy_tracks()
    near = marker_errors(TIMES, measured_m, fitted, fitted)
    far = marker_errors(TIMES, measured_m, fitted, fitted + 0.1)
    assert (near.axes[0].get_yscale(), far.axes[0].get_yscale()) == ("linear", "log")


# Sparsity


def test_sparsity_shows_the_first_blocks_below_the_diagonal():
    solution = solved()
    _, band, _ = rasters(jacobian_sparsity(solution.collocation, solution.z))
    filled = ~np.ma.getmaskarray(band)
    rows, columns = (np.arange(size) * SHOWN_STEPS // size for size in filled.shape)
    blocks = np.array(
        [
            [filled[np.ix_(rows == i, columns == j)].mean() for j in range(SHOWN_STEPS)]
            for i in range(SHOWN_STEPS)
        ]
    )
    lag = np.subtract.outer(np.arange(SHOWN_STEPS), np.arange(SHOWN_STEPS))
    assert (blocks[(lag >= 0) & (lag <= 2)] > 0.1).all()
    assert (blocks[(lag < -1) | (lag > 3)] == 0).all()


def test_sparsity_needs_few_of_the_timesteps():
    solution = solved()
    jacobian_sparsity(solution.collocation, solution.z)
    assert "jacobian_structure" not in vars(solution.collocation)


def test_sparsity_shows_the_mesh_graph_of_one_block():
    solution = solved()
    transcription = solution.collocation.transcriptions[0]
    block = rasters(jacobian_sparsity(solution.collocation, solution.z))[2]
    rows, columns, _ = transcription.body.pattern.full
    expected = np.zeros((transcription.dof_count, transcription.dof_count), dtype=bool)
    expected[rows, columns] = True
    drawn = ~np.ma.getmaskarray(block)
    np.testing.assert_array_equal(drawn, expected[transcription.free_dofs])


def test_parameter_columns_are_dense():
    solution = solved()
    columns = rasters(jacobian_sparsity(solution.collocation, solution.z))[0]
    assert columns.shape[1] == 4
    assert not np.ma.getmaskarray(columns).any()


@pytest.mark.parametrize("make", [released_cube, bar_in_two_hands])
@pytest.mark.parametrize("scheme", ["backward-euler", "bdf2"])
def test_sparsity_is_drawn_for_every_start_and_scheme(make, scheme):
    solution = solved(make, scheme)
    figure = jacobian_sparsity(solution.collocation, solution.z)
    shown = rasters(figure)
    assert len(shown) == 3
    assert max(max(raster.shape) for raster in shown) <= RASTER_SIZE


def test_curves_tell_where_the_horizon_grows():
    lines = [replace(line, share=0.5 if k < 2 else 1.0) for k, line in enumerate(history())]
    figure = convergence(lines)
    panel = figure.axes[0]
    assert panel.get_title() == "continuation: 50, 100 % of the time steps in turn"
    curves = [line for line in panel.lines if line.get_marker() == "o"]
    assert [len(line.get_xdata()) for line in curves] == [2, 3]
    assert not convergence(history()).axes[0].get_title()


# In space


@cache
def replay(make=hung_cube) -> MotionRecord:
    """An experiment seen as it is simulated, with the same for a fit."""
    experiment = measured(make())
    x = simulate(experiment, TRUTH, "midpoint", substeps=1)
    seen = (x.positions_m, x.markers_m)
    return MotionRecord.from_experiment(experiment, seen, seen, np.array([3.0, 7.0]))


def test_a_picture_has_the_right_and_up_of_its_camera():
    camera = ParallelCamera.from_direction((0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
    np.testing.assert_allclose(camera.project(np.eye(3)), [[1, 0], [0, 0], [0, 1]], atol=1e-15)
    np.testing.assert_allclose(camera.coordinates_to_viewer_m(np.eye(3)), [0, -1, 0], atol=1e-15)


def test_a_camera_faces_the_plane_of_motion():
    swing = np.zeros((20, 4, 3)) + np.eye(4, 3) * 0.01
    swing[:, :, 1] += np.sin(np.linspace(0, 6, 20))[:, None]
    right, top, near = ParallelCamera.facing_motion(swing, (0.0, 0.0, 1.0)).axes
    assert abs(right[1]) > 0.85
    assert top[2] > 0.9
    assert near[0] > 0.8


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.6, 0.0, -0.8)])
def test_up_is_up_in_the_picture(up):
    camera = ParallelCamera.facing_motion(replay().positions_m, up)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    across, along = camera.project(np.array(up))
    assert across == pytest.approx(0.0, abs=1e-12)
    assert along > 0.9


def test_only_faces_towards_the_viewer_are_drawn_the_nearest_last():
    mesh = box_mesh((1.0, 1.0, 1.0), (1, 1, 1))
    camera = ParallelCamera.from_direction((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    brightness, chosen = camera.visible_faces(mesh.points_m, mesh.surface)
    assert len(chosen) == 2
    assert (mesh.points_m[mesh.surface[chosen], 2] == 1.0).all()  # of the top
    assert ((brightness > 0.5) & (brightness <= 1.0)).all()
    oblique = ParallelCamera.from_direction((1.0, 2.0, 3.0), (0.0, 0.0, 1.0))
    assert len(oblique.visible_faces(mesh.points_m, mesh.surface)[0]) == 6


def test_lines_behind_the_body_are_hidden():
    mesh = box_mesh((1.0, 1.0, 1.0), (1, 1, 1))
    camera = ParallelCamera.from_direction((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    points = np.array([[0.4, 0.3, 1.0], [0.4, 0.3, 0.0], [2.0, 0.3, 0.0], [np.nan] * 3])
    found = camera.are_hidden(points, mesh.points_m, mesh.surface)
    assert found.tolist() == [False, True, False, False]


def test_every_marker_is_named_once_on_the_mesh():
    seen = replay()
    names = [f"m{k}" for k in range(len(seen.marker_names))]
    figure = mesh_picture(replace(seen, marker_names=names))
    written = [text.get_text() for text in figure.axes[0].texts]
    assert sorted(text for text in written if text.startswith("m")) == sorted(names)


def test_names_keep_their_order_and_a_distance():
    levels = np.array([0.0, 0.1, 0.2, 5.0])
    moved = spread_levels(levels, 1.0)
    assert (np.diff(moved) > 1.0 - 1e-12).all()
    assert moved[-1] == 5.0
    assert moved[:3].mean() == pytest.approx(levels[:3].mean())


def test_shapes_stand_side_by_side_in_one_scale():
    seen = replay()
    figure = shapes_picture(seen, 3)
    skins = [c for c in figure.axes[0].collections if isinstance(c, PolyCollection)]
    boxes = [np.vstack([path.vertices for path in skin.get_paths()]) for skin in skins]
    assert len(boxes) == 3
    assert boxes[0][:, 0].max() < boxes[1][:, 0].min() < boxes[2][:, 0].min()
    times = [t.get_text() for t in figure.axes[0].texts if t.get_text().endswith(" s")]
    assert times == ["0 s", "0.05 s", "0.1 s"]


def hues(colours):
    """Colours, however bright."""
    return colours[:, :3] / colours[:, :3].max(axis=1, keepdims=True)


def test_a_field_colours_each_shape_by_its_values_there():
    seen = replay()
    count = len(seen.surface)
    values = np.arange(1.0, 2 * count + 1).reshape(2, count)
    pressure = SurfaceField("pressure [Pa]", lambda samples: values[: len(samples)])
    figure = shapes_picture(seen, 2, pressure)
    sheet_axes = figure.axes[0]
    assert any(text.get_text() == "pressure [Pa]" for text in sheet_axes.texts)
    (bar,) = sheet_axes.child_axes
    assert bar.get_ylim() == (0.0, 2 * count)
    skins = [c for c in sheet_axes.collections if isinstance(c, PolyCollection)]
    for skin, own in zip(skins, values, strict=True):
        expected = hues(FIELD_COLOURS(own / values.max()))
        for hue in hues(skin.get_facecolor()):
            assert np.abs(expected - hue).max(axis=1).min() < 1e-6


@pytest.mark.long
def test_quadratic_bodies_are_drawn_by_their_corners(tmp_path):
    seen = replay(quadratic_bar)
    assert seen.surface.max() < len(seen.undeformed_m)
    files = save_pictures(tmp_path, all_pictures([seen], told()))
    assert all(imread(file)[..., :3].std() > 0.01 for file in files)


def test_equal_elements_fill_one_bin():
    mesh = box_mesh((0.3, 0.3, 0.3), (1, 1, 1))
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(8)
    size, quality = elements_picture(regular, np.array([[0, 1, 3, 2]])).axes
    (filled,) = [bar for bar in quality.patches if bar.get_height()]
    assert filled.get_x() + filled.get_width() == pytest.approx(1.0)
    (filled,) = [bar for bar in size.patches if bar.get_height()]
    assert filled.get_x() <= 1000.0 <= filled.get_x() + filled.get_width() + 1e-9
    of_box = elements_picture(mesh.points_m, mesh.tetrahedra).axes[1]
    assert sum(bar.get_height() for bar in of_box.patches) == len(mesh.tetrahedra)
    assert not of_box.texts  # the worst is told in the title, not over the bars


# What the data say


def two_parameters(rho=0.8) -> Confidence:
    deviation = np.array([0.02, 0.05])
    correlation = np.array([[1.0, rho], [rho, 1.0]])
    covariance = correlation * np.outer(deviation, deviation)
    return Confidence(["lambda_pa", "mu_pa"], np.array([5.0, 7.0]), covariance, np.full(2, 1.96))


def told(covariance: np.ndarray | None = None) -> Result:
    """A result of these two parameters, with a history."""
    given = two_parameters()
    pairs = zip(given.names, given.values.tolist(), strict=True)
    known = uncertainty(given.names, given.covariance if covariance is None else covariance)
    parameters = {name: value(each) for name, each in pairs}
    return a_result(parameters, uncertainty=known, history=tuple(history()))


@pytest.mark.parametrize("rho", [-0.95, 0.0, 0.8])
def test_an_ellipse_holds_95_per_cent_of_the_pairs(rho):
    found = two_parameters(rho)
    outline = ellipse_outline(found, 0, 1)
    inverse = np.linalg.inv(found.covariance)
    squares = np.einsum("ki,ij,kj->k", outline, inverse, outline)
    np.testing.assert_allclose(squares, -2 * np.log(0.05), rtol=1e-3)


def test_every_pair_has_a_panel_and_every_correlation_a_number():
    found = Confidence(
        ["lambda_pa", "mu_pa", "gamma_r_s"], np.ones(3), np.diag([1e-4, 4.0, 1e-2]), np.ones(3)
    )
    drawn = [axes for axes in confidence_ellipses(found).axes if axes.patches]
    assert len(drawn) == 3
    matrix = correlation_matrix(two_parameters())
    assert {text.get_text() for text in matrix.axes[0].texts} == {"1.00", "0.80"}


def test_wide_intervals_are_read_as_factors(tmp_path):
    found = two_parameters()
    wide = replace(found, covariance=np.diag([1e-4, 4.0]))
    (axes,) = confidence_ellipses(wide).axes
    assert axes.get_xlabel().endswith("[%]")
    assert any("×" in label.get_text() for label in axes.get_yticklabels())
    save_pictures(tmp_path, {"wide": confidence_ellipses(wide)})


def test_undetermined_parameters_are_not_drawn():
    covariance = np.array([[np.nan, np.nan], [np.nan, 0.01]])
    found = Confidence.from_result(told(covariance))
    assert found is not None
    assert found.names == ["mu_pa"]
    assert found.covariance.tolist() == [[0.01]]
    assert Confidence.from_result(a_result()) is None


def test_a_tone_stands_out_at_its_frequency():
    t = 0.01 * np.arange(200)
    track = 1e-3 * np.sin(2 * np.pi * 8.0 * t)[:, None, None] * np.array([1.0, 0.0, 0.0])
    hertz, density = spectral_density(track, 100.0)
    assert hertz[np.nanargmax(density)] == pytest.approx(8.0, abs=0.2)
    assert np.nansum(density) * (hertz[1] - hertz[0]) == pytest.approx(0.5, rel=0.02)  # mm²


def test_gaps_hardly_change_a_spectrum_and_unseen_markers_do_not_count():
    t = 0.01 * np.arange(200)
    track = np.repeat(1e-3 * np.sin(2 * np.pi * 3.0 * t)[:, None, None], 3, axis=2)
    _, whole = spectral_density(track, 100.0)
    gappy = np.concatenate([track, np.full_like(track, np.nan)], axis=1)
    gappy[50:53, 0] = np.nan
    _, seen = spectral_density(gappy, 100.0)
    assert np.nanmax(seen) == pytest.approx(np.nanmax(whole), rel=0.02)


def test_modes_are_numbered_and_near_modes_share_a_label():
    t = 0.01 * np.arange(100)
    track = np.random.default_rng(0).normal(size=(100, 2, 3))
    figure = spectrum_picture(t, track, None, np.array([3.0, 3.1, 20.0, 80.0]))
    assert [text.get_text() for text in figure.axes[0].texts] == ["1–2", "3"]


# Files


def bench(measured_axes: tuple[int, ...] = (2,)) -> MotionRecord:
    """A record of a bench that presses down by 4 mm and back, with a stiffness of 1000 N/m."""
    seen = replay()
    way_m = 0.004 * (1 - np.abs(np.linspace(-1, 1, len(seen.t_s))))
    columns = np.full((len(seen.t_s), 19), np.nan)
    columns[:, 0] = seen.t_s
    for axis in measured_axes:
        columns[:, 1 + axis] = -1000.0 * way_m
    columns[:, 7:10] = np.outer(-1100.0 * way_m, [0.3, 0.3, 1.0])
    travel_m = np.outer(way_m, [0.0, 0.0, -1.0])
    return replace(seen, wrenches=[columns], travel_m=travel_m)


def test_a_bench_is_drawn_as_force_over_displacement():
    pictures = with_unique_names(experiment_pictures(bench()))
    axes, errors = pictures["force_displacement_hung_cube"].axes
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    assert lines.keys() == {"measured", "measured, unloading", "fitted"}
    for label, stiffness in (("measured", 1.0), ("measured, unloading", 1.0), ("fitted", 1.1)):
        np.testing.assert_allclose(lines[label][:, 1], stiffness * lines[label][:, 0], atol=1e-12)
    assert lines["measured"][:, 0].max() > 0
    assert errors.get_xlabel() == "displacement [mm]"
    assert axes.get_ylabel() == "force [N]"


def test_a_bench_without_the_force_along_its_way_has_no_curve():
    names = with_unique_names(experiment_pictures(bench(measured_axes=(0,))))
    assert "wrench_hung_cube" in names
    assert "force_displacement_hung_cube" not in names


def test_forces_that_were_not_measured_have_no_panel():
    figure = with_unique_names(experiment_pictures(bench()))["wrench_hung_cube"]
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["fz"]


@pytest.mark.parametrize(
    ("at", "expected"),
    [
        ([0, 1, 2, 3], [0, 0, 0, 0]),
        ([0, 2, 4, 2, 0], [0, 0, 0, 1, 1]),
        ([0, -2, -4, -2, -3, -5], [0, 0, 0, 1, 0, 0]),
        ([0, 100, 99.9, 200], [0, 0, 0, 0]),
        ([], []),
    ],
)
def test_unloading_is_a_decrease_of_the_magnitude(at: list[float], expected: list[int]):
    np.testing.assert_array_equal(is_unloading(np.array(at, dtype=float)), expected)


def test_a_run_has_all_its_pictures(tmp_path):
    seen = replay()
    pictures = all_pictures([seen], told())
    files = save_pictures(tmp_path, pictures)
    assert {file.stem for file in files} == {
        "confidence",
        "convergence",
        "correlation",
        "elements",
        "error_hung_cube",
        "mesh",
        "shapes_hung_cube",
        "spectrum_hung_cube",
        "tracks_hung_cube",
    }
    height, width = imread(files[0]).shape[:2]
    inches = pictures[files[0].stem].get_size_inches()
    np.testing.assert_allclose([width, height], RESOLUTION_DPI * inches, atol=1)


@pytest.mark.long
def test_type_can_be_read_in_a_column():
    seen = replay()
    pictures = all_pictures([seen], told())
    for name, figure in pictures.items():
        assert figure.get_size_inches()[0] * 25.4 <= 2.1 * COLUMN_MM
        sizes = [t.get_fontsize() for t in figure.findobj(Text) if t.get_text()]
        assert min(sizes) >= SMALL_PT - 1e-9, name


def test_validation_is_drawn_by_its_simulation():
    seen = replace(replay(), positions_m=None, markers_m=None)
    pictures = all_pictures([seen], a_result())
    assert "shapes_hung_cube" in pictures
    assert len(pictures["error_hung_cube"].axes[0].lines) == 1


@pytest.mark.long
@pytest.mark.parametrize(("first", "wrong"), [(0, np.inf), (6, np.nan)])
def test_diverged_samples_leave_gaps(tmp_path, wrong, first):
    seen = replay()
    positions, markers = seen.positions_m.copy(), seen.markers_m.copy()
    positions[first:], markers[first:] = wrong, wrong
    pictures = all_pictures([replace(seen, positions_m=positions, markers_m=markers)], a_result())
    assert ("shapes_hung_cube" in pictures) == (first > 0)
    save_pictures(tmp_path, pictures)


def test_an_experiment_can_be_read_back_from_its_arrays():
    seen = replay()
    arrays = seen.to_arrays("hung cube/")
    assert arrays["hung cube/rolled_out_positions_m"].dtype == np.float32
    again = MotionRecord.from_arrays("hung cube", arrays)
    np.testing.assert_array_equal(again.positions_m, seen.positions_m)
    np.testing.assert_array_equal(again.is_prescribed, seen.is_prescribed)
    assert again.marker_names == list(seen.marker_names)


@pytest.mark.long
def test_drawing_needs_no_display_and_leaves_pyplot_alone():
    code = (
        "import sys; sys.path.insert(0, '.');"  # commands before may have set PYTHONSAFEPATH
        "import collocation_sysid; assert 'matplotlib' not in sys.modules;"
        "import collocation_sysid.result.animation; from kit.results import a_result;"
        "from collocation_sysid.result.pictures import all_pictures; all_pictures([], a_result());"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    here = Path(__file__).parents[1]
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=here).returncode == 0


def test_grasped_nodes_on_the_sides_are_marked():
    experiment = quadratic_bar()
    body = experiment.body
    seen = MotionRecord.from_experiment(
        experiment, (np.tile(body.nodes_m, (len(experiment.t_s), 1, 1)), None)
    )
    assert seen.surface_nodes.shape == (len(seen.surface), 6)
    corners, sides = (body.nodes_m[seen.surface], body.nodes_m[seen.surface_nodes[:, 3:]])
    middles = (corners + np.roll(corners, -1, axis=1)) / 2
    for found, expected in zip(sides, middles, strict=True):
        distances = np.linalg.norm(found[:, None] - expected, axis=2)
        np.testing.assert_allclose(distances.min(axis=1), 0.0, atol=1e-12)
    _, axes = sheet(80, 60)
    camera = ParallelCamera.facing_motion(body.nodes_m[None], seen.up)
    view = SheetView.fit_points(camera, body.nodes_m, (70, 50), (5, 5))
    drawn = BodyDrawing(axes, view, seen.surface, face_outlines=seen.face_outlines)
    drawn.update(body.nodes_m, np.ones(len(body.nodes_m), bool), np.empty((0, 3)))
    marked = len(drawn.grasped.get_xdata())
    _, faces = camera.visible_faces(body.nodes_m, seen.surface)
    assert marked == len(np.unique(seen.surface_nodes[faces])) > len(np.unique(seen.surface[faces]))


def test_faces_of_quadratic_elements_are_drawn_through_the_nodes_on_their_sides():
    experiment = quadratic_bar()
    body = experiment.body
    seen = MotionRecord.from_experiment(
        experiment, (np.tile(body.nodes_m, (len(experiment.t_s), 1, 1)), None)
    )
    outlines_m = body.nodes_m[seen.face_outlines]
    before, after = (np.roll(outlines_m, k, axis=1)[:, 1::2] for k in (1, -1))
    np.testing.assert_allclose(outlines_m[:, 1::2], (before + after) / 2, atol=1e-12)
    bulged_m = (
        0.5
        + (body.nodes_m - 0.5)
        * np.where(np.isin(np.arange(len(body.nodes_m)), seen.surface), 1.0, 1.3)[:, None]
    )
    _, axes = sheet(80, 60)
    camera = ParallelCamera.facing_motion(body.nodes_m[None], seen.up)
    view = SheetView.fit_points(camera, bulged_m, (70, 50), (5, 5))
    drawn = BodyDrawing(axes, view, seen.surface, face_outlines=seen.face_outlines)
    drawn.update(bulged_m, np.ones(len(bulged_m), bool), np.empty((0, 3)))
    edges_mm = np.concatenate([path.vertices for path in drawn.faces.get_paths()])
    for place in np.asarray(drawn.grasped.get_xydata()):
        assert np.linalg.norm(edges_mm - place, axis=1).min() < 1e-6


def test_letters_that_the_font_lacks_are_no_news(tmp_path):
    figure, axes = sheet(40.0, 20.0)
    axes.text(5, 5, "手 tip")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.savefig(tmp_path / "named.png")
    assert (tmp_path / "named.png").stat().st_size > 0


@pytest.mark.long
def test_commands_hide_messages_of_matplotlib_about_its_files(tmp_path):
    code = "from collocation_sysid.cli import main; main()"
    beside = {
        "MPLCONFIGDIR": str(tmp_path / "a_file"),
        "PYTHONPATH": str(Path(__file__).parents[2]),
    }
    (tmp_path / "a_file").touch()
    command = [sys.executable, "-c", code, "plot", str(tmp_path)]
    done = subprocess.run(command, env=os.environ | beside, capture_output=True, text=True)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "not a run folder" in done.stderr


def test_planes_of_symmetry_are_not_marked_as_grasped():
    bar = bar_in_two_hands(4)
    still, moving = bar.grasps
    nodes_m = bar.body.nodes_m
    along = int(np.ptp(nodes_m[moving.nodes], axis=0).argmin())
    fixed = replace(moving, axes="xyz"[along], poses=PoseSequence.fixed())
    marked = MotionRecord.from_experiment(replace(bar, grasps=(still, fixed))).is_prescribed
    np.testing.assert_array_equal(np.flatnonzero(marked[0]), np.sort(still.nodes))
    platen = replace(moving, axes="xyz"[along])
    marked = MotionRecord.from_experiment(replace(bar, grasps=(still, platen))).is_prescribed
    assert marked[0].sum() == len(still.nodes) + len(moving.nodes)
