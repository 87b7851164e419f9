"""Single wrong samples are named and do not affect the analysis of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.fits import PARAMETERS, autoregressive, problem
from kit.problems import EDGE_M, TRUTH, point_markers
from kit.static import block

import collocation_sysid as cs
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment, Wrench
from collocation_sysid.statistics.assessment import Assessment, fit_concerns
from collocation_sysid.statistics.residuals.diagnostics import diagnose_markers, remove_outliers
from collocation_sysid.statistics.uncertainty import uncertainty_from_fit

RNG = np.random.default_rng
OF = problem((60,), markers=3)


def fit_to(errors: np.ndarray):
    return OF.fit([errors], np.zeros(len(OF.names)))


def with_outlier(errors: np.ndarray) -> np.ndarray:
    """Errors (T, M, 3) with one sample of the second marker far off."""
    spoiled = errors.copy()
    spoiled[20, 1] += [150.0, 0.0, 50.0]
    return spoiled


def judged(errors: np.ndarray) -> tuple[Assessment, float]:
    fit, wrong = fit_to(errors)
    found = uncertainty_from_fit(fit, PARAMETERS, wrong[:4])
    return Assessment.from_concerns(fit_concerns(found)), found.dependence.lag1


def test_a_sample_that_spoils_the_rest_is_named():
    fit, _ = fit_to(with_outlier(RNG(0).normal(size=(60, 3, 3))))
    rest, (outlier,) = remove_outliers(fit)
    assert (outlier.series, outlier.t_s) == ("swing 0/m1", pytest.approx(0.2))
    assert outlier.share > 0.9
    assert outlier.deviations == pytest.approx(158, rel=0.1)
    assert rest.measurement_count == fit.measurement_count - 3
    trust, _ = judged(with_outlier(RNG(0).normal(size=(60, 3, 3))))
    assert any(
        "swing 0/m1: the sample at t = 0.2 s deviates by 1.5e+02" in r for r in trust.reasons
    )


def test_white_and_coloured_noise_have_no_outlier():
    for seed in range(100):
        for errors in (RNG(seed).normal(size=(60, 3, 3)), autoregressive(RNG(seed), 60, 3, 0.95)):
            fit, _ = fit_to(errors)
            assert remove_outliers(fit) == (fit, ())


def test_a_sample_that_does_not_pull_is_only_to_be_checked():
    """As where hundreds of others hold the answer."""
    errors = RNG(3).normal(size=(60, 3, 3))
    errors[20, 1, 2] += 20.0
    trust, _ = judged(errors)
    assert trust.verdict == "check"
    assert len(trust.reasons) == 1


def test_an_outlier_hides_no_correlation_of_other_samples():
    for seed in range(5):
        errors = 5 * autoregressive(RNG(seed), 60, 3, 0.9)
        (_, alone), (trust, beside) = (judged(errors), judged(with_outlier(errors)))
        assert beside == pytest.approx(alone, abs=0.15)
        assert trust.verdict == "doubtful"
        assert any("consecutive samples are correlated" in reason for reason in trust.reasons)
        assert any("swing 0/m1" in reason for reason in trust.reasons)


def test_several_are_set_apart_but_no_more_than_exceptions():
    fit, _ = fit_to(RNG(0).normal(size=(60, 3, 3)))
    residual = fit.blocks[0].residual.copy()
    residual[:12, 0, 0] += 1e5 / 3.0 ** np.arange(12)
    spoiled = replace(fit, blocks=(replace(fit.blocks[0], residual=residual),))
    assert [outlier.sample for outlier in remove_outliers(spoiled)[1]] == [0, 1, 2, 3, 4, 5]


def test_the_diagnosis_of_a_marker_names_an_outlier_instead_of_a_pattern():
    fit, _ = fit_to(with_outlier(RNG(0).normal(size=(60, 3, 3))))
    (said,) = (each.sentence for each in diagnose_markers(fit) if each.marker == "m1")
    assert "mm RMS; the sample at t = 0.2 s deviates by 1.5e+02 sigma and contributes 94 %" in said


def relaxing_bench() -> tuple[Experiment, dict[str, float]]:
    """A block with memory pressed at once and held; the row before the load has been cut."""
    body = cs.Body(box_mesh((EDGE_M,) * 3, (1, 1, 1)), density_kg_m3=30.0, prony=["prony_1"])
    truth = TRUTH | {"prony_1.share": 0.5, "prony_1.tau_s": 5.0}
    t_s, sigma_n = 0.5 * np.arange(41), 2e-3
    z_m = -0.02 * np.minimum(t_s, 1.0)

    def bench(rows: slice, force_n: np.ndarray) -> Experiment:
        pressed = block("z", t_s[rows], z_m[rows], body=body)
        values = np.full((len(t_s[rows]), 6), np.nan)
        values[:, 2] = force_n[rows]
        grasps = list(pressed.grasps)
        grasps[1] = replace(grasps[1], wrench=Wrench(t_s[rows], values, sigma_n))
        unseen = point_markers(body, np.zeros((0, 3)), t_s[rows])
        return replace(pressed, grasps=grasps, markers=unseen)

    whole = bench(slice(None), np.zeros(len(t_s)))
    force_n = simulate(whole, truth).wrenches[0][:, 2]
    return bench(slice(1, None), force_n + sigma_n * RNG(0).normal(size=len(t_s))), truth


@pytest.mark.long
def test_a_first_sample_that_is_no_rest_is_reported():
    experiment, truth = relaxing_bench()
    unknown = {"mu_pa": 250.0, "prony_1.share": 0.3, "prony_1.tau_s": 3.0}
    still = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    given = truth | still | {name: cs.Unknown(value) for name, value in unknown.items()}
    trust = cs.run(cs.Problem([experiment], given)).trust
    assert trust.verdict == "doubtful"
    (named,) = (reason for reason in trust.reasons if "block/force: the sample" in reason)
    assert "at t = 0.5 s" in named
    assert "is assumed to be relaxed at the first sample" in named
    assert any("consecutive samples are correlated" in reason for reason in trust.reasons)


def test_a_sample_below_three_sigma_is_no_reason_although_it_dominates():
    trust, _ = judged(0.01 * with_outlier(RNG(0).normal(size=(60, 3, 3))))
    assert not any("deviates by" in reason for reason in trust.reasons)
