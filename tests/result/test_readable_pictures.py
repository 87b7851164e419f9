"""Pictures without empty axes and cut labels, in which measurements do not hide the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.filmed import EXACT, NAMES, PLACES_M, T_S, TRUTH, filming, motion_m, projected, swung
from kit.results import a_result, value
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

import collocation_sysid as cs
from collocation_sysid.kinds.image_tracks.residual import ImageTrackResidual
from collocation_sysid.methods.solution import Iteration
from collocation_sysid.result.pictures import convergence, correlation_matrix
from collocation_sysid.result.pictures.cameras import tracks_picture
from collocation_sysid.result.pictures.confidence import Confidence, combinations_picture
from collocation_sysid.result.pictures.stress_strain import relaxation_picture, strain_picture
from collocation_sysid.result.replay import first_and_worst_images
from collocation_sysid.result.run_sections import _cards, parameter_section
from collocation_sysid.statistics.combinations import Direction


def require_inside(figure: Figure) -> None:
    """Require that no label of an axis is cut by the border of the figure."""
    figure.draw_without_rendering()
    for axes in figure.axes:
        for text in (*axes.get_xticklabels(), *axes.get_yticklabels()):
            box = text.get_window_extent()
            if text.get_text():
                assert box.x0 >= 0, text
                assert box.y0 >= 0, text
                assert box.x1 <= figure.bbox.width, text


@pytest.mark.parametrize(
    ("trust", "violation_n", "labels"),
    [
        (3.0, 1.0, ["loss", "violation [N]", "trust region", "θ / final θ"]),
        (np.nan, 1.0, ["loss", "violation [N]", "θ / final θ"]),
        (np.nan, 0.0, ["loss", "θ / final θ"]),
    ],
)
def test_convergence_has_no_empty_axes(trust, violation_n, labels):
    history = [
        Iteration(
            number=k,
            loss=10.0**-k,
            misfit=1.0,
            trust=trust,
            noise=0.0,
            violation_n=violation_n / (k + 1),
            parameters={"mu_pa": 2.0 + k},
            time_s=float(k),
        )
        for k in range(4)
    ]
    assert [axes.get_ylabel() for axes in convergence(history).axes] == labels


@pytest.mark.parametrize(
    "names",
    [
        ("young_pa", "poisson"),
        ("upper_layer.young_pa", "lower_layer.young_pa", "gamma_r_s"),
        tuple(f"region_{k}.young_pa" for k in range(9)),
    ],
)
def test_labels_of_correlations_are_complete(names):
    count = len(names)
    covariance = 0.01 * (np.eye(count) + 0.5)
    confidence = Confidence(names, np.ones(count), covariance, np.full(count, 1.96))
    require_inside(correlation_matrix(confidence))


@pytest.mark.parametrize("regions", [("",), ("core.", "skin."), ("the_upper_layer.",) * 2])
def test_labels_of_combinations_are_complete(regions):
    names = [f"{region}{name}" for region in regions for name in ("young_pa", "mu_1_pa")]
    weights = np.linspace(1.0, 0.2, len(names))
    directions = [
        Direction(tuple(names), tuple((weights / k).tolist()), "product", 1.01 + k) for k in (1, 2)
    ]
    require_inside(combinations_picture(dict.fromkeys(names, 1.3), directions))


@pytest.mark.parametrize("picture", [strain_picture, relaxation_picture])
def test_the_fit_is_above_the_dots_and_has_its_errors_below(picture):
    t_s = np.linspace(0.1, 1.0, 60)
    stress_pa = 1e5 * t_s
    samples = np.column_stack([t_s, stress_pa + 500.0, stress_pa, stress_pa])
    options = {} if picture is relaxation_picture else {"name": "stress", "unit": "Pa"}
    figure = picture(np.ones_like(t_s) if not options else t_s, t_s, samples, **options)
    curve, errors = figure.axes
    by_label = {str(line.get_label()): line for line in curve.lines}
    assert by_label["fitted"].get_zorder() > by_label["measured"].get_zorder()
    assert "error" in errors.get_ylabel()
    np.testing.assert_allclose(errors.lines[1].get_ydata(), -0.5, atol=1e-9)


def tracks(times_s=T_S) -> cs.ImageTracks:
    camera = filming("front")
    return cs.ImageTracks(
        "front", camera, times_s, projected(camera, motion_m()), NAMES,
        places_m=list(PLACES_M.values()), sigma_px=0.5, **EXACT,
    )  # fmt: skip


def test_the_contour_in_an_image_is_that_of_the_projected_body():
    experiment = swung([tracks()])
    problem = cs.Problem([experiment], parameters=cs.Parameters.from_mapping(TRUTH))
    (transcription,) = problem.collocation().transcriptions
    (residual,) = transcription.residuals_of(ImageTrackResidual)
    shapes_m = experiment.rigid_positions(residual.observable_s)
    x = shapes_m.reshape(len(shapes_m), -1)
    phi = np.zeros(residual.nuisance.size)
    for image in (0, 20):
        contour = residual.contour_px(image, x, phi)
        expected = projected(filming("front"), shapes_m[image])
        np.testing.assert_allclose(np.nanmin(contour, axis=0), expected.min(axis=0), atol=0.1)
        np.testing.assert_allclose(np.nanmax(contour, axis=0), expected.max(axis=0), atol=0.1)


def test_first_and_worst_image_have_arrows_from_the_measured_points():
    measured = 100.0 + np.cumsum(np.ones((5, 2, 2)), axis=0)
    measured[0] = np.nan
    fitted = measured + 0.1
    fitted[3, 1] += [2.0, -1.0]
    fitted[4, 0] = np.nan
    samples = np.column_stack(
        [np.arange(5.0), *(part.reshape(5, 4) for part in (measured, fitted, np.nan * fitted))]
    )
    assert first_and_worst_images(samples) == [1, 3]
    rows = np.array([[t, 1.0, 90.0 + u, 95.0] for t in (1.0, 3.0) for u in (0.0, 30.0)])
    figure = tracks_picture(rows, samples)
    first, worst = figure.axes
    assert "first image, t = 1 s" in first.get_title()
    assert "worst image, t = 3 s" in worst.get_title()
    (arrows,) = (each for each in worst.collections if isinstance(each, Quiver))
    along_u = np.asarray(arrows.U)
    np.testing.assert_allclose(along_u / along_u[1], [0.1 / 2.1, 1.0])
    assert first_and_worst_images(np.where(np.arange(13) < 5, samples, np.nan)) == [1]


def test_a_report_of_a_fit_has_a_card_for_each_constant():
    result = a_result()
    extra = {"c10_pa": value(1e4), "c01_pa": value(2e3)}
    result = replace(result, parameters=dict(result.parameters) | extra)
    titles = [item[0] for item in _cards(result).items]
    assert {"C₁₀", "C₀₁"} <= set(titles)


def test_estimates_with_the_same_contributions_share_a_sentence():
    names = ("c10_pa", "c01_pa", "kappa_pa")
    wide = replace(value(1e4), combined_std_error=50.0, combined95=(9.9e3, 1.01e4))
    budget = {name: {"poisson": 0.97, "noise": 0.03} for name in names}
    result = a_result(dict.fromkeys(names, wide), budget=budget)
    texts = [part for part in parameter_section(result).parts if isinstance(part, str)]
    (sentence,) = [text for text in texts if text.startswith("largest contributions")]
    assert all(symbol in sentence for symbol in ("C₁₀", "C₀₁", "κ"))
