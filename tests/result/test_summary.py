"""The summary in the terminal: in proportion, with consistent digits."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from kit.problems import TRUTH, hung_cube
from kit.results import FIT, a_result, value

import collocation_sysid as cs
from collocation_sysid.common.display import (
    plain_text,
    quantity,
    readable_stress,
    rounded,
    two_digits,
)
from collocation_sysid.result.pictures.confidence import Confidence
from collocation_sysid.result.run_sections import (
    _cards,
    _nuisance_sections,
    effects_table,
    refinement_table,
)
from collocation_sysid.result.run_summary import next_step, run_summary
from collocation_sysid.runs.result_content import NuisanceResult, Result
from collocation_sysid.statistics.budget.discretisation_error import DiscretisationError
from collocation_sysid.statistics.budget.effect_estimates import EffectEstimate
from collocation_sysid.statistics.concerns import Concern
from collocation_sysid.statistics.hypothesis import NO_CAUSE

MOST_LINES = 16


@cache
def solved(recordings: int = 1) -> Result:
    """A swinging cube, once or as several recordings with the same residuals."""
    if recordings > 1:
        one = solved()
        names = [f"swing {k + 1}" for k in range(recordings)]
        (fitted,) = one.fit.experiments.values()
        (simulated,) = one.rollout.experiments.values()
        return replace(
            one,
            fit=replace(one.fit, experiments=dict.fromkeys(names, fitted)),
            rollout=replace(one.rollout, experiments=dict.fromkeys(names, simulated)),
        )
    return finished().result


@cache
def finished() -> cs.Run:
    hung = hung_cube(10)
    exact_m = cs.simulate(hung, TRUTH, "midpoint", substeps=1).markers_m
    noise_m = 1e-4 * np.random.default_rng(0).standard_normal(exact_m.shape)
    sigma_m = np.full(exact_m.shape[1], 1e-4)
    seen = replace(hung.markers, positions_m=exact_m + noise_m, sigma_m=sigma_m)
    unknown = TRUTH | {"mu_pa": cs.Unknown(250.0), "lambda_pa": cs.Unknown(300.0)}
    problem = cs.Problem([replace(hung, markers=seen)], unknown, substeps=1)
    return cs.run(problem, seek_causes=False)


def lines(result: Result, **options: bool) -> list[str]:
    return plain_text(run_summary(result, Path("runs/swing"), **options), width=10_000).splitlines()


def test_one_recording_takes_one_screen():
    shown = lines(solved())
    reasons = solved().trust.concerns
    assert len(shown) <= MOST_LINES
    assert shown[0] == f"Verdict: {solved().trust.verdict}"
    assert shown[-1] == "written to runs/swing"
    assert sum(line.startswith("fit: ") for line in shown) == 1
    assert sum("to reduce " in line for line in shown) == 1 + sum(
        "to reduce " in concern.message for concern in reasons
    )
    assert not any(line.startswith(("note: ", "residuals: ", "time: ")) for line in shown)


def test_each_recording_takes_one_line():
    one, three = lines(solved()), lines(solved(3))
    rows = [line for line in three if line.startswith("swing ")]
    assert [row.split("  ")[0] for row in rows] == ["swing 1", "swing 2", "swing 3"]
    assert len(three) <= len(one) + len(rows) + 1 + len(solved(3).trust.concerns)


def test_everything_else_is_in_the_details():
    told = "\n".join(lines(solved(), details=True))
    for words in ("Converged", "± syst", "guess", "note: ", "residuals: ", "time: search"):
        assert words in told
    for note in solved().notes:
        assert note in told


def test_the_gravest_of_many_reasons_are_shown_and_the_others_counted():
    concerns = [
        Concern(
            "specimen/outlier",
            "doubtful",
            data={"sample": f"sample {k}", "deviations": 9.0, "percent": 30.0},
        )
        for k in range(7)
    ]
    result = replace(solved(), trust=replace(solved().trust, concerns=concerns))
    shown = [line for line in lines(result) if line.startswith("  ")]
    count = sum("sigma" in line for line in shown)
    assert 1 <= count <= 5
    assert any(f"{7 - count} further reasons" in line for line in shown)
    assert len(lines(result)) < MOST_LINES
    assert sum("of the sum of squared" in line for line in lines(result, details=True)) == 7


def test_tests_of_causes_without_a_finding_are_stated():
    tested = replace(solved(), notes=(*solved().notes, NO_CAUSE))
    assert NO_CAUSE in lines(tested)


@pytest.mark.parametrize(
    ("value", "deviation", "texts"),
    [
        (24948.0, 1407.0, ("24900", "1400")),
        (24.948, 1.407, ("24.9", "1.4")),
        (0.30089, 0.0996, ("0.30", "0.10")),
        (0.30089, 0.1004, ("0.30", "0.10")),
        (100.81, 5.5, ("100.8", "5.5")),
        (2e-9, 3e-11, ("2e-09", "3e-11")),
        (-0.0004, 0.02, ("0.000", "0.020")),
        (7.0, 0.0, ("7", "0")),
    ],
)
def test_a_value_ends_with_the_second_digit_of_its_uncertainty(value, deviation, texts):
    assert (rounded(value, deviation), two_digits(deviation)) == texts


def test_digits_do_not_depend_on_the_last_bits():
    for k in range(-50, 50):
        assert two_digits(0.1 * (1 + k * 1e-12)) == "0.10"


def test_stresses_of_a_table_have_one_readable_unit():
    assert readable_stress([700.0, 300.0]) == (1.0, "Pa")
    assert readable_stress([24948.0, 9588.0]) == (1e-3, "kPa")
    assert readable_stress([4e5, 2e9]) == (1e-6, "MPa")


def test_the_table_has_the_unit_of_its_values():
    result = solved()
    stiff = replace(result.parameters["mu_pa"], value=3e5, combined_std_error=2e4)
    parameters = {**result.parameters, "mu_pa": replace(stiff, combined95=(2.6e5, 3.4e5))}
    (row,) = (
        line for line in lines(replace(result, parameters=parameters)) if line.startswith("μ ")
    )
    assert row.split()[:7] == ["μ", "kPa", "300", "20", "260", "…", "340"]


def test_a_fixed_bulk_modulus_does_not_choose_the_unit():
    result = solved()
    fixed = replace(result.parameters["lambda_pa"], value=1e9, fixed=True)
    shown = lines(replace(result, parameters={**result.parameters, "lambda_pa": fixed}))
    assert any(line.startswith("μ Pa ") for line in shown)
    assert any(line.startswith("fixed: λ 1 GPa") for line in shown)


def test_a_summary_of_specimens_has_no_row_of_what_is_fixed_or_absent():
    result = solved()
    young = result.derived["young_pa"]
    parameters = {"mu_pa": result.parameters["mu_pa"], "kappa_pa": replace(young, fixed=True)}
    parameters |= {"gamma_r_s": replace(young, value=0.0, fixed=True)}
    ((name, fitted),) = result.fit.experiments.items()
    fit = replace(result.fit, experiments={name: replace(fitted, test="uniaxial")})
    shown = lines(replace(result, parameters=parameters, fit=fit))
    symbols = [line.split()[0] for line in shown if " … " in line]
    assert symbols == ["μ", "E"]
    assert [line for line in shown if line.startswith("fixed: ")] == [
        f"fixed: κ {quantity(young.value, 'Pa', digits=5)}"
    ]


def test_the_table_of_a_refinement_has_the_units_of_the_estimates_and_no_empty_column():
    result = solved()
    stiff = replace(result.parameters["mu_pa"], value=84e3, combined_std_error=2e4)
    error = DiscretisationError(None, 2.8e3, None, None, 84e3, (5.3e4, 1.34e5))
    stiff = replace(stiff, combined95=(5.3e4, 1.34e5), numerical_error=error)
    table = refinement_table(replace(result, parameters={"mu_pa": stiff}, derived={}))
    heads, row = plain_text([table], width=200).splitlines()
    assert heads.split("  ")[-1].strip() == "95 % interval"
    assert "order" not in heads
    assert "step" not in heads
    assert row.split() == ["μ", "kPa", "+2.8", "84", "20", "53", "…", "134"]


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (638e3, "Pa", "638 kPa"),
        (9506.0, "Pa", "9.5 kPa"),
        (799.0, "Pa", "799 Pa"),
        (0.02, "", "0.02"),
    ],
)
def test_a_misfit_has_a_readable_unit(value: float, unit: str, text: str):
    assert quantity(value, unit) == text


def test_the_next_command_suits_the_result():
    result = solved()
    folder = Path("runs/a swing")
    assert "report 'runs/a swing' (" in next_step(result, folder)
    file = replace(result.provenance, problem_file="p.toml")
    good = replace(result, provenance=file, trust=replace(result.trust, concerns=()))
    assert good.trust.verdict == "good"
    # Also of static tests, in which the mesh is not estimated but considered.
    for shares, said in (
        ({"mesh": 0.4, "noise": 0.6}, "contain as an estimate"),
        ({"noise": 1.0}, "do not"),
    ):
        step = next_step(replace(good, budget={"young_pa": shares}, effects=()), folder)
        assert "refine 'runs/a swing' (" in step
        assert said in step


def test_the_combined_covariance_agrees_with_the_table():
    run = finished()
    assert run.uncertainty is not None
    names = run.uncertainty.names
    combined = [run.estimates[name].combined_std_error for name in names]
    np.testing.assert_allclose(np.sqrt(np.diag(run.covariance(units="si"))), combined, rtol=1e-9)
    relative = np.array(combined) / [run.estimates[name].value for name in names]
    np.testing.assert_allclose(np.sqrt(np.diag(run.covariance())), relative, rtol=1e-9)
    statistical = run.covariance("statistical")
    np.testing.assert_allclose(statistical, run.uncertainty.covariance)
    assert (np.diag(statistical) < np.diag(run.covariance())).all()
    eigenvalues = np.linalg.eigvalsh(run.covariance())
    assert eigenvalues.min() > -1e-12 * eigenvalues.max()
    with pytest.raises(cs.InputError, match="found 'both'; expected one of combined, statistical"):
        run.covariance("both")  # type: ignore[arg-type]


def test_pictures_of_the_confidence_have_the_combined_width():
    result = solved()
    found = Confidence.from_result(result)
    assert found is not None
    assert found.is_combined
    for k, name in enumerate(found.names):
        low, high = result.parameters[name].combined95 or (0.0, 0.0)
        half = found.quantiles[k] * np.sqrt(found.covariance[k, k])
        assert half == pytest.approx(np.log(high / low) / 2, rel=0.02)


def test_a_run_without_markers_has_no_cards_of_markers():
    result = replace(a_result({"young_pa": value()}), fit=replace(FIT, wrench_rms_n=0.25))
    cards = dict((name, shown) for name, shown, _ in _cards(result).items)
    assert cards["force, fitted"] == "0.25 N"
    assert cards["E"].endswith((" kPa", " Pa"))
    assert not any("markers" in name for name in cards)


def test_the_table_of_effects_has_the_largest_of_many():
    effects = [
        EffectEstimate("mass", 0.0, 0.01, 1e-3 * k, 0.005, surprise=0.1 * k * (-1) ** k)
        for k in range(30)
    ]
    table = effects_table(replace(a_result({"mu_pa": value()}), effects=effects))
    assert table.heads[0] == "effect (12 of 30)"
    shown = [abs(float(row[-1])) for row in table.rows]
    assert shown == pytest.approx([0.1 * k for k in range(29, 17, -1)])
    assert (
        effects_table(replace(a_result({"mu_pa": value()}), effects=effects[:12])).heads[0]
        == "effect"
    )


def test_rounding_is_no_estimate_of_a_nuisance_parameter():
    moved, unmoved = NuisanceResult(2.5e-3, 5e-3, 1e-3), NuisanceResult(-4.5e-21, 5e-3, 5e-3)
    result = replace(
        a_result({"mu_pa": value()}),
        nuisance={"swing": {"drift [s]": moved, "time shift [s]": unmoved}},
    )
    ((_, table),) = (part.parts for part in _nuisance_sections(result))
    assert [row[1] for row in table.rows] == ["2.5 ms", "0 ms"]
