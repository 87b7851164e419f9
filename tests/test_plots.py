from __future__ import annotations

import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from matplotlib.image import imread
from problems_small import GUESS, TRUTH, bar_in_two_hands, hung_cube, measured, released_cube

from collocation_sysid.nlp.collocation import Collocation
from collocation_sysid.nlp.dynamics import Dynamics
from collocation_sysid.nlp.marching import march
from collocation_sysid.nlp.parameters import Theta
from collocation_sysid.results.plots import (
    RESOLUTION_DPI,
    convergence,
    error_over_time,
    jacobian_sparsity,
    save_plots,
    solution_plots,
    tracks,
)
from collocation_sysid.results.solution import Iteration, Solution, Status, Timing
from collocation_sysid.results.sparsity_plot import RASTER, SHOWN_STEPS

THETA = Theta(**TRUTH)
TIMES = 0.01 * np.arange(20.0)


def history(count=5):
    return [
        Iteration(
            number=k,
            loss=10.0 ** (3 - k),
            rms_m=10.0 ** (-2 - k),
            violation_n=0.0 if k == 0 else 10.0**-k,
            theta=Theta(200.0 * 2 ** (count - 1 - k), 300.0, 0.009, 1.0),
            time_s=float(k),
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
    x = march(experiment, Dynamics.of(experiment, scheme), THETA)
    z = collocation.pack(collocation.parameters.guess_q, [x])
    multipliers = np.zeros(collocation.constraints)
    return Solution(
        Status.CONVERGED, "", "known", collocation, z, multipliers, 5, history(), Timing()
    )


def rasters(figure):
    """Parameter columns, block band and single block, masked where there is no entry."""
    return [np.ma.asarray(image.get_array()) for a in figure.axes[:3] for image in a.get_images()]


# Convergence


def test_convergence_draws_errors_in_millimetres_and_newtons_on_logarithmic_axes():
    rms, loss, violation, _ = convergence(history()).axes
    assert {axes.get_yscale() for axes in (rms, loss, violation)} == {"log"}
    np.testing.assert_allclose(rms.lines[0].get_ydata(), [10.0 ** (1 - k) for k in range(5)])
    np.testing.assert_allclose(loss.lines[0].get_ydata(), [10.0 ** (3 - k) for k in range(5)])
    assert "mm" in rms.get_ylabel()
    assert "N" in violation.get_ylabel()


def test_zeros_leave_gaps_on_a_logarithmic_axis():
    violation = convergence(history()).axes[2].lines[0].get_ydata()
    np.testing.assert_allclose(violation, [np.nan, 0.1, 0.01, 1e-3, 1e-4])


def test_parameters_are_drawn_relative_to_their_final_values():
    _, first, *others = convergence(history()).axes[3].lines
    np.testing.assert_allclose(first.get_ydata(), [16, 8, 4, 2, 1])
    assert len(others) == 3
    assert "200 Pa" in str(first.get_label())


def test_parameters_are_drawn_relative_to_the_truth_where_it_is_known():
    axes = convergence(history(), truth={**TRUTH, "lambda_pa": 100.0}).axes[3]
    np.testing.assert_allclose(axes.lines[1].get_ydata(), [32, 16, 8, 4, 2])
    assert "truth" in axes.get_ylabel()


def test_parameters_can_be_drawn_in_the_other_convention():
    lines = convergence(history(), ("young_pa", "poisson")).axes[3].lines
    assert "0.2" in str(lines[2].get_label())
    assert len(lines) == 3


@pytest.mark.parametrize("names", [(), ("mu_pa",)])
def test_nothing_to_draw_is_no_error(names, tmp_path):
    save_plots(tmp_path, {"none": convergence([], names), "some": convergence(history(), names)})


# Markers


def test_tracks_show_each_coordinate_with_its_error_below():
    measured_m, fitted = noisy_tracks()
    figure = tracks(TIMES, ["tip", "side"], measured_m, fitted, 1.1 * fitted)
    assert len(figure.axes) == 2 * 3 * 2
    upper, lower = figure.axes[1], figure.axes[4]  # y of the tip
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
    figure = tracks(TIMES, ["tip", "side"], measured_m, fitted)
    side = figure.axes[6].lines[0].get_ydata()
    assert np.flatnonzero(np.isnan(side)).tolist() == [5, 6, 7]


def test_of_many_markers_the_worst_are_shown():
    measured_m, fitted = noisy_tracks(markers=9)
    fitted[:, 4] += 0.1
    fitted[:, 7] += 0.1
    figure = tracks(TIMES, [f"m{k}" for k in range(9)], measured_m, fitted, max_markers=2)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert [title for title in titles if title] == ["m4", "m7"]
    assert "2 of 9" in figure.legends[0].get_title().get_text()


def test_validation_has_no_fitted_track():
    measured_m, fitted = noisy_tracks()
    assert len(tracks(TIMES, ["tip", "side"], measured_m, None, fitted).axes[0].lines) == 2
    assert len(error_over_time(TIMES, measured_m, None, fitted).axes[0].lines) == 1


def test_error_over_time_is_the_rms_distance_of_the_markers_seen():
    measured_m, fitted = np.zeros((len(TIMES), 2, 3)), np.zeros((len(TIMES), 2, 3))
    fitted[:, 0, 0], fitted[:, 1, 1] = 3e-3, 4e-3
    measured_m[3, 0] = measured_m[4] = np.nan
    error = error_over_time(TIMES, measured_m, fitted).axes[0].lines[0].get_ydata()
    assert error[0] == pytest.approx(np.sqrt((9 + 16) / 2))
    assert error[3] == pytest.approx(4.0)
    assert np.isnan(error[4])


def test_errors_far_apart_get_a_logarithmic_axis():
    measured_m, fitted = noisy_tracks()
    near = error_over_time(TIMES, measured_m, fitted, fitted)
    far = error_over_time(TIMES, measured_m, fitted, fitted + 0.1)
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


def test_sparsity_shows_the_mesh_graph_of_one_block():
    solution = solved()
    segment = solution.collocation.segments[0]
    block = rasters(jacobian_sparsity(solution.collocation, solution.z))[2]
    rows, columns, _ = segment.body.pattern.full
    expected = np.zeros((segment.dofs, segment.dofs), dtype=bool)
    expected[rows, columns] = True
    drawn = ~np.ma.getmaskarray(block)
    np.testing.assert_array_equal(drawn, expected[segment.free_dofs])


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
    assert max(max(raster.shape) for raster in shown) <= RASTER


# Files


def test_a_solution_is_drawn_and_saved_at_150_dpi(tmp_path):
    solution = solved()
    experiment = solution.collocation.segments[0].experiment
    figures = solution_plots(solution, {experiment.name: experiment.markers.positions_m})
    files = save_plots(tmp_path, figures)
    assert sorted(file.name for file in files) == [
        "convergence.png",
        "error_hung_cube.png",
        "jacobian.png",
        "tracks_hung_cube.png",
    ]
    height, width = imread(files[0]).shape[:2]
    inches = figures["convergence"].get_size_inches()
    np.testing.assert_allclose([width, height], RESOLUTION_DPI * inches, atol=1)


def test_plotting_needs_no_display_and_leaves_pyplot_alone():
    code = (
        "import sys, collocation_sysid.results.plots as p; p.convergence([]);"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
