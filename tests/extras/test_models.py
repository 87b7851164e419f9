"""Model choice: variants of a problem, evidence, predictions and advice."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.fits import autoregressive, problem
from kit.problem_files import EXPERIMENT, PROBLEM, replace_text, run_command, write_problem
from kit.problems import TRUTH, as_theta, box, hung_cube, smooth_poses, times
from kit.region_files import TWO_REGIONS
from kit.static import block
from kit.wrenches import fitted, predicted_wrenches

import collocation_sysid as cs
from collocation_sysid import Unknown
from collocation_sysid.errors import InputError
from collocation_sysid.extras.studies import PlannedRun, plan_models
from collocation_sysid.extras.studies.model_choice import (
    advice,
    evidence_from_fit,
    fit_record,
    model_rows,
    reserve_test_data,
)
from collocation_sysid.extras.studies.model_variants import (
    as_inline_toml,
    file_variants,
    models,
    parse_branches,
    parse_dampings,
    parse_materials,
    variants,
)
from collocation_sysid.extras.studies.tables import model_tables
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.constants import usual_value
from collocation_sysid.fem.laws.materials import MATERIALS
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.problem import Problem
from collocation_sysid.problem.new import create_problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.recording import Experiment, Markers, Wrench, write_poses_csv
from collocation_sysid.result.synthesis import Recipe, write_data
from collocation_sysid.statistics.linearised import DerivedModuli

BOTH = ("neo-hookean", "yeoh")
DAMPING = "gamma_r_s = 0.009, gamma_m_1_s = 1.0, lambda_pa = 120.0"
TRUTHS = {
    "neo-hookean": (f"parameters={{mu_pa = 80.0, {DAMPING}}}",),
    "yeoh": (
        "object.material=yeoh",
        f"parameters={{c10_pa = 40.0, c20_pa = 60.0, c30_pa = 0.0, {DAMPING}}}",
    ),
}
TIMES_S = (0.01, 1.0)


def soft_bar(folder: Path, material: str, steps: dict[str, int]) -> Path:
    """Recordings of a bar so soft that it strains much, with 0.5 mm of noise."""
    folder.mkdir(exist_ok=True)
    box_mesh((0.06, 0.06, 0.12), (2, 2, 4)).write(folder / "body.vtu")
    text = PROBLEM.replace("interior-point", "reduced-space")
    for k, (name, count) in enumerate(steps.items()):
        sway_m = np.roll((0.02, 0.02, 0.03), k).tolist()
        poses = smooth_poses(times(count), sway_m, (0.2, -0.1, 0.1), 12 + 3 * k)
        write_poses_csv(folder / f"{name}_motion.csv", poses)
        text += EXPERIMENT.replace("swing", name).replace("0.089", "0.119")
    file = folder / "problem.toml"
    file.write_text(text)
    truth = Problem.read(file, TRUTHS[material], simulation=True)
    write_data(truth, folder, Recipe("midpoint", noise_m=5e-4, seed=1))
    return file


def compared(file: Path) -> list[dict]:
    """The rows of a comparison, its runs done here."""
    planned = plan_models(Problem.read(file), variants(file, (), BOTH, (), TIMES_S))
    records = {
        run.label: {"model": fit_record(read(run), run.method, run.test_name or "")}
        for run in planned
    }
    return model_rows(planned, json.loads(json.dumps(records)))


def read(run: PlannedRun) -> Problem:
    return Problem.read(run.problem, run.overrides)


# Twins ------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    "steps",
    [
        pytest.param({"a": 40}, id="one", marks=pytest.mark.slow),
        pytest.param({"a": 25, "b": 25}, id="two"),
    ],
)
def test_yeohs_material_is_recognised_at_large_strain(steps, tmp_path: Path):
    neo_hookean, yeoh = rows = compared(soft_bar(tmp_path / "bar", "yeoh", steps))
    assert yeoh["chosen"]
    assert (yeoh["delta_aic"], yeoh["free"], neo_hookean["free"]) == (0, 6, 4)
    assert neo_hookean["delta_aic"] > 100
    assert neo_hookean["log_ratio"] > 2 * neo_hookean["log_ratio_error"] > 0
    assert neo_hookean["log_ratio"] > np.log(1.2)
    assert set(yeoh["predictions"]) == set(steps)
    said = advice(rows)
    assert said.startswith("Use yeoh: its prediction error for held-out samples is")
    assert "2 parameters more" in said
    assert said.endswith("The difference is significant.")


@pytest.mark.long
def test_yeohs_is_not_preferred_on_data_of_a_neo_hookean(tmp_path: Path):
    neo_hookean, yeoh = rows = compared(soft_bar(tmp_path / "bar", "neo-hookean", {"a": 40}))
    assert neo_hookean["chosen"]
    assert yeoh["delta_aic"] > 0
    # 0.5 mm in three directions
    assert neo_hookean["held_out_rms"] == pytest.approx(5e-4 * np.sqrt(3), rel=0.15)
    assert advice(rows).startswith("Use neo-hookean: its prediction error for held-out samples is")


# Forces alone -----------------------------------------------------------------------------------


def pressed_block(platen: str, name: str, z_m: np.ndarray, load_n: np.ndarray) -> Experiment:
    """A block pressed between platens that hold it along some axes; its load alone is measured."""
    pressing = block(platen, np.arange(float(len(z_m))), z_m)
    values = np.full((len(z_m), 3), np.nan)
    values[:, 2] = load_n
    lower, upper, *sides = pressing.grasps
    upper = replace(upper, wrench=Wrench(pressing.t_s, values, sigma_n=0.003))
    grasps = (lower, upper, *sides)
    return replace(pressing, name=name, grasps=grasps, markers=Markers.none(pressing.t_s))


def load_n(experiment: Experiment) -> np.ndarray:
    """What the upper platen gives, by the truth."""
    collocation = fitted(experiment, Parameters.from_mapping(TRUTH))
    x = simulate_scheme(
        experiment, collocation.transcriptions[0].dynamics.with_theta(as_theta(TRUTH))
    )
    (part,) = collocation.iterates_at(np.zeros(0), [x])
    return predicted_wrenches(part)[0][:, 2]


@pytest.mark.long
def test_forces_rank_the_platens_where_there_are_no_markers():
    """Those that stick made the load; lubricated ones are made up for by a stiffer material."""
    rng, found = np.random.default_rng(5), {"xyz": [], "z": []}
    for name, deepest_m in (("a", -0.03), ("b", -0.04)):
        z_m = np.linspace(0.0, deepest_m, 9)
        made = load_n(pressed_block("xyz", name, z_m, np.zeros(9)))
        noisy = made + rng.normal(scale=0.003, size=9)
        for platen, experiments in found.items():
            experiments.append(pressed_block(platen, name, z_m, noisy))
    models = []
    for platen, experiments in found.items():
        problem = Problem(experiments, TRUTH | {"mu_pa": Unknown(300.0)})
        records = {each: fit_record(problem, "reduced-space", each) for each in ("", "a", "b")}
        models.append({"model": platen, "found": records})
    sticking, sliding = rows = rows_of(*models)
    assert sticking["chosen"]
    assert sticking["held_out_rms"] == pytest.approx(0.003, rel=0.5)
    assert sliding["held_out_rms"] > 3 * sticking["held_out_rms"]
    assert sliding["delta_aic"] > 10
    assert sliding["parameters"]["mu_pa"] > 1.05 * sticking["parameters"]["mu_pa"]
    assert re.search(
        r"^Use xyz: its prediction error for held-out samples is \S+ N, that of z is \S+ N",
        advice(rows),
    )


def test_the_end_of_the_load_of_one_pressing_is_held_out():
    pressing = pressed_block("xyz", "a", np.linspace(0.0, -0.03, 9), np.zeros(9))
    left, start_s = reserve_test_data(Problem([pressing], TRUTH), "a")
    wrench = left.experiments[0].grasps[1].wrench
    np.testing.assert_array_equal(np.isnan(wrench.values[:, 2]), wrench.t_s > start_s)
    assert 0 < np.isnan(wrench.values[:, 2]).sum() < 9


def test_files_with_other_data_are_no_models_of_one_another(tmp_path: Path):
    both = Problem.read(write_problem(tmp_path, {"a": 6, "b": 7}))
    other = tmp_path / "other.toml"
    other.write_text(both.path.read_text())
    held = Problem.read(other, ["experiment.b.validation=true"])
    with pytest.raises(InputError, match="given twice"):
        file_variants([both, both], ())
    with pytest.raises(InputError, match=r"this file fits 'a' .* expected the same recordings"):
        file_variants([both, held], ())
    assert [each.label for each in file_variants([both, Problem.read(other)], ())] == [
        "problem",
        "other",
    ]


# Held out ---------------------------------------------------------------------------------------


def test_one_of_two_recordings_is_held_out(tmp_path: Path):
    several = Problem.read(write_problem(tmp_path, {"a": 6, "b": 7}))
    left, start_s = reserve_test_data(several, "b")
    assert [(e.name, e.validation) for e in left.experiments] == [("a", False), ("b", True)]
    assert start_s == -np.inf


def test_the_last_third_of_one_recording_is_held_out(tiny: Path):
    alone = Problem.read(tiny / "problem.toml")
    left, start_s = reserve_test_data(alone, "swing")
    (kept,), (whole,) = left.experiments, alone.experiments
    later = kept.t_s > start_s
    assert later.sum() == 3  # of 9
    assert not kept.markers.is_present[later].any()
    earlier = kept.markers.positions_m[~later]
    np.testing.assert_array_equal(earlier, whole.markers.positions_m[~later])


LAWS = ("kelvin-voigt", "material", "rayleigh")

# Variants ---------------------------------------------------------------------------------------


@pytest.fixture
def bar(tiny: Path) -> Path:
    return tiny / "problem.toml"


def changed(
    file: Path, label: str, materials=(), branches=(), overrides=(), region=None
) -> Problem:
    """The problem as one of its variants has it."""
    found = {v.label: v for v in variants(file, overrides, materials, branches, TIMES_S, region)}
    return Problem.read(file, found[label].overrides)


@pytest.mark.parametrize(
    ("material", "expected"),
    [
        ("neo-hookean", "lambda_pa mu_pa gamma_r_s gamma_m_1_s"),
        ("yeoh", "lambda_pa gamma_r_s gamma_m_1_s c10_pa c20_pa c30_pa"),
        ("mooney-rivlin", "lambda_pa gamma_r_s gamma_m_1_s c10_pa c01_pa"),
        ("gent", "lambda_pa mu_pa gamma_r_s gamma_m_1_s gent_limit"),
        ("ogden-1", "lambda_pa gamma_r_s gamma_m_1_s mu_1_pa alpha_1"),
        ("ogden-2", "lambda_pa gamma_r_s gamma_m_1_s mu_1_pa alpha_1 mu_2_pa alpha_2"),
    ],
)
def test_a_material_brings_its_constants_and_the_rest_stays_as_stated(bar, material, expected):
    overrides = ("parameters.gamma_m_1_s=0.7",)
    problem = changed(bar, material, {material: 0, "linear": 0}, overrides=overrides)
    assert problem.bodies[0].parts[0].material.name == material
    assert set(problem.parameters.names) == set(expected.split())
    fixed = [i.name for i in problem.parameters.items if i.is_fixed]
    assert fixed == ["gamma_m_1_s"]
    given = {i.name: (i.guess, i.lower, i.upper) for i in problem.parameters.items}
    assert given["lambda_pa"] == (400.0, 10.0, 1e5)


def test_the_fixed_poisson_ratio_stays_whatever_the_material(bar):
    stated = "parameters={young_pa = {}, poisson = 0.45, gamma_r_s = {}, gamma_m_1_s = {}}"
    problem = changed(bar, "yeoh", BOTH, overrides=(stated,))
    assert set(problem.parameters.names) == {
        *("poisson", "gamma_r_s", "gamma_m_1_s", "c10_pa", "c20_pa", "c30_pa")
    }
    assert next(i.guess for i in problem.parameters.items if i.is_fixed) == 0.45
    back = changed(bar, "neo-hookean", BOTH, overrides=(*_as_yeoh(), "object.density_kg_m3=40"))
    assert set(back.parameters.names) == {"kappa_pa", "mu_pa", "gamma_r_s", "gamma_m_1_s"}


def test_a_foam_replaces_all_moduli(bar):
    problem = changed(bar, "hyperfoam-1", {"hyperfoam-1": 0, "linear": 0})
    constants = {"mu_1_pa", "alpha_1", "beta_1"}
    assert set(problem.parameters.names) == {"gamma_r_s", "gamma_m_1_s", *constants}
    # As stiff as the file's guess of μ = 200 Pa.
    guesses = problem.parameters.guesses
    assert guesses["mu_1_pa"] == pytest.approx(200.0)


@pytest.mark.parametrize(
    ("material", "constants", "shear_pa"),
    [
        (
            "ogden-2",
            "mu_1_pa = 100, alpha_1 = 3, mu_2_pa = -50, alpha_2 = -2, kappa_pa = {}",
            200.0,
        ),
        ("hyperfoam-1", "mu_1_pa = 100, alpha_1 = 3, beta_1 = 0.2", 100.0),
    ],
)
def test_another_law_starts_as_stiff_as_the_powers_of_the_stretches(
    bar, material, constants, shear_pa
):
    stated = f"parameters={{{constants}, gamma_r_s = {{}}, gamma_m_1_s = {{}}}}"
    overrides = (f"object.material={material}", stated)
    problem = changed(bar, "gent", {"gent": 0, material: 0}, overrides=overrides)
    guesses = {item.name: item.guess for item in problem.parameters.items}
    assert guesses["mu_pa"] == pytest.approx(shear_pa)


def _as_yeoh() -> tuple[str, ...]:
    own = "c10_pa = {}, c20_pa = {}, c30_pa = {}, kappa_pa = {guess = 300.0}"
    stated = f"parameters={{{own}, gamma_r_s = {{}}, gamma_m_1_s = {{}}}}"
    return "object.material=yeoh", stated


def test_branches_are_tables_with_a_share_and_a_time_constant_each(bar):
    none, one, two = variants(bar, (), (), (0, 1, 2), TIMES_S)
    assert [v.label for v in (none, one, two)] == ["no memory", "1 branch", "2 branches"]
    assert not any("prony" in setting for setting in none.overrides)
    assert 'object.prony=[{"name" = "prony_1"}]' in one.overrides
    assert 'object.prony=[{"name" = "prony_1"}, {"name" = "prony_2"}]' in two.overrides
    assert (
        '"prony_1.share" = {"guess" = 0.1}, "prony_1.tau_s" = {"guess" = 0.1}' in one.overrides[-1]
    )
    assert '"prony_1.tau_s" = {"guess" = 0.0464}' in two.overrides[-1]
    assert '"prony_2.tau_s" = {"guess" = 0.215}' in two.overrides[-1]


def test_materials_and_branches_are_combined(bar):
    found = variants(bar, (), BOTH, (0, 1), TIMES_S)
    assert [v.label for v in found] == [
        "neo-hookean, no memory",
        "neo-hookean, 1 branch",
        "yeoh, no memory",
        "yeoh, 1 branch",
    ]


def test_laws_of_damping_take_the_place_of_their_budget_entry(bar):
    found = {v.label: v for v in variants(bar, (), (), (), TIMES_S, dampings=LAWS)}
    assert tuple(found) == LAWS
    for law in LAWS:
        problem = Problem.read(bar, found[law].overrides)
        assert [part.damping.name for part in problem.bodies[0].parts] == [law]
        stated = problem.uncertainty.assumptions.collect_deviations()
        assert stated["damping_law"] is None
        assert stated["rayleigh_damping"] is None
        assert problem.parameters.names == Problem.read(bar).parameters.names


def test_laws_of_damping_are_combined_with_materials(bar):
    found = variants(bar, (), BOTH, (), TIMES_S, dampings=LAWS[:2])
    assert [v.label for v in found] == [
        "neo-hookean, kelvin-voigt",
        "neo-hookean, material",
        "yeoh, kelvin-voigt",
        "yeoh, material",
    ]
    last = Problem.read(bar, found[-1].overrides).bodies[0].parts[0]
    assert (last.material.name, last.damping.name) == ("yeoh", "material")


def test_a_region_alone_may_have_the_laws_of_damping(bar, tiny):
    TWO_REGIONS(tiny)
    found = {v.label: v for v in variants(bar, (), (), (), TIMES_S, "stiff", LAWS)}
    problem = Problem.read(bar, found["stiff: material"].overrides)
    laws = {part.name: part.damping.name for part in problem.bodies[0].parts}
    assert laws["stiff"] == "material"
    assert set(laws.values()) == {"kelvin-voigt", "material"}


def test_files_are_combined_with_materials(bar, tiny):
    other = tiny / "other.toml"
    other.write_text(bar.read_text().replace("= 30.0", "= 31.0"))
    found = models([Problem.read(bar), Problem.read(other)], (), BOTH)
    assert [(v.label, v.path) for v in found] == [
        ("problem: neo-hookean", bar),
        ("problem: yeoh", bar),
        ("other: neo-hookean", other),
        ("other: yeoh", other),
    ]
    planned = plan_models(Problem.read(bar), found)
    assert len({run.label for run in planned}) == len(planned) == 2 * len(found)


def test_a_written_value_is_read_back_by_toml():
    value = {"a.b": {"guess": 1e-5, "bounds": [1, -2.5]}, "text": 'a "quoted" ß', "flag": True}
    assert tomllib.loads(f"value = {as_inline_toml(value)}")["value"] == value


def test_bad_models_are_refused_in_one_line(bar, tiny):
    with pytest.raises(InputError, match=r"'yeho'.*did you mean 'yeoh'"):
        parse_materials("yeho,gent")
    with pytest.raises(InputError, match=r"'matrial'.*did you mean 'material'"):
        parse_dampings("kelvin-voigt,matrial")
    with pytest.raises(InputError, match=r"--damping: .*material alone; expected two or more"):
        models([Problem.read(bar)], (), dampings=("material",))
    with pytest.raises(InputError, match="whole numbers up to 20, such as 0,1,2"):
        parse_branches("1,x")
    with pytest.raises(InputError, match="yeoh alone; expected two or more"):
        models([Problem.read(bar)], (), ("yeoh",))
    with pytest.raises(InputError, match="found the region 'core', but the object has no regions"):
        variants(bar, (), BOTH, (), TIMES_S, "core")
    TWO_REGIONS(tiny)
    with pytest.raises(InputError, match=r"'stif'; expected one of stiff.*did you mean 'stiff'"):
        variants(bar, (), BOTH, (), TIMES_S, "stif")
    of_all = ('object.prony=[{"name" = "prony_1"}]',)
    with pytest.raises(InputError, match="all parts without their own; expected no --region"):
        variants(bar, of_all, (), (0, 1), TIMES_S, "stiff")


# The body has young_pa and poisson, its region "stiff" Yeoh's constants.
OWN = "gamma_r_s gamma_m_1_s young_pa poisson"


@pytest.mark.parametrize(
    ("region", "material", "laws", "expected"),
    [
        (None, "neo-hookean", ["neo-hookean"] * 2, f"{OWN} stiff.mu_pa"),
        (None, "gent", ["gent"] * 2, f"{OWN} gent_limit stiff.mu_pa stiff.gent_limit"),
        ("stiff", "neo-hookean", ["neo-hookean"] * 2, f"{OWN} stiff.mu_pa"),
        ("stiff", "gent", ["neo-hookean", "gent"], f"{OWN} stiff.mu_pa stiff.gent_limit"),
        ("stiff", "yeoh", ["neo-hookean", "yeoh"], f"{OWN} stiff.c10_pa stiff.c20_pa stiff.c30_pa"),
    ],
)
def test_a_region_or_all_of_a_body_has_the_material(bar, tiny, region, material, laws, expected):
    TWO_REGIONS(tiny)
    label = material if region is None else f"stiff: {material}"
    problem = changed(bar, label, {material: 0, "linear": 0}, region=region)
    assert [part.material.name for part in problem.bodies[0].parts] == laws
    assert set(problem.parameters.names) == set(expected.split())


def test_a_region_keeps_its_own_constants(bar, tiny):
    TWO_REGIONS(tiny)
    own = ("parameters.stiff.young_pa=900", "object.region.0.material=neo-hookean")
    rid = "c10_pa", "c20_pa", "c30_pa"
    text = bar.read_text()
    bar.write_text("".join(s for s in text.splitlines(True) if not any(r in s for r in rid)))
    problem = changed(bar, "gent", {"gent": 0, "linear": 0}, overrides=own)
    extra = "stiff.young_pa gent_limit stiff.gent_limit"
    assert set(problem.parameters.names) == {*OWN.split(), *extra.split()}


def test_branches_may_be_a_regions(bar, tiny):
    TWO_REGIONS(tiny)
    problem = changed(bar, "stiff: 2 branches", branches=(0, 2), region="stiff")
    assert [len(part.prony) for part in problem.bodies[0].parts] == [0, 2]
    assert {"prony_1.share", "prony_2.tau_s"} <= set(problem.parameters.names)


# Evidence ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("phi", [0.0, 0.6, 0.9])
def test_the_effective_number_of_measurements_follows_from_the_mean_of_their_errors(phi: float):
    of = problem((400,), markers=4, offsets=False)
    found = []
    for seed in range(6):
        errors = [autoregressive(np.random.default_rng(seed), 400, 4, phi)]
        evidence = evidence_from_fit(of.fit(errors, np.zeros(len(of.names)))[0])
        found.append(evidence.independent / evidence.measurements)
    # Of a first-order process 1 + 2 Σ φᵏ = (1 + φ) / (1 − φ).
    assert np.mean(found) == pytest.approx((1 - phi) / (1 + phi), rel=0.3)


def test_errors_that_all_markers_share_count_once():
    of = problem((400,), markers=4, offsets=False)
    errors = [autoregressive(np.random.default_rng(0), 400, 4, 0.0, shared=0.98)]
    evidence = evidence_from_fit(of.fit(errors, np.zeros(len(of.names)))[0])
    assert evidence.independent == pytest.approx(400, rel=0.2)  # of 4800


def test_a_needless_parameter_costs_two_and_gains_one_on_average():
    of, rng, changes = (problem((60,), markers=2, offsets=False), np.random.default_rng(0), [])
    # The errors are all there is to fit: any parameter is needless.
    fewer = replace(
        of,
        slopes=tuple(slope[..., 1:] for slope in of.slopes),
        names=of.names[1:],
        prior_slope=of.prior_slope[1:],
    )
    for _ in range(80):
        errors = [autoregressive(rng, 60, 2, 0.0)]
        small, large = (
            evidence_from_fit(each.fit(errors, np.zeros(len(each.names)))[0])
            for each in (fewer, of)
        )
        assert large.fitted - small.fitted == pytest.approx(1, abs=1e-4)
        changes.append(large.criterion(360) - small.criterion(360))
    assert np.mean(changes) == pytest.approx(2 - 1, abs=0.5)


# The advice -------------------------------------------------------------------------------------


def row_of(model: str, free: int, blocks: dict, misfit: float, failure: str = "") -> dict:
    """Records of a model: fitted, and each recording predicted with these Σ of squares by block."""
    evidence = {"misfit": misfit, "prior": 0.0, "fitted": float(free)}
    evidence |= {"measurements": 900, "independent": 300.0}
    whole = {"converged": True, "status": "converged", "free": ["p"] * free, "rms": {"m": 1e-3}}
    found = {"": whole | {"evidence": evidence, "parameters": {}}}
    for name, each in blocks.items():
        missed = {"rms": float(np.sqrt(np.sum(each) / 100)), "unit": "m", "samples": 100}
        found[name] = whole | {"prediction": missed | {"blocks": each}}
        if failure:
            found[name] = whole | {"prediction": None, "failure": failure}
    return {"model": model, "found": found}


def rows_of(*models: dict) -> list[dict]:
    planned, records = [], {}
    for each in models:
        for held_out, found in each["found"].items():
            run = PlannedRun("problem.toml", "m", model_name=each["model"], test_name=held_out)
            planned.append(run)
            records[run.label] = {"model": found}
    return model_rows(planned, records)


STEADY = np.full(8, 1e-5)
WAVY = STEADY * (1 + 0.3 * np.cos(np.arange(8)))


def test_the_smallest_of_models_with_equal_predictions_is_taken():
    small = row_of("small", 4, {"a": (1.01 * WAVY).tolist()}, 900)
    large = row_of("large", 6, {"a": (WAVY + 1e-6 * np.sin(np.arange(8))).tolist()}, 899)
    rows = rows_of(small, large)
    assert rows[0]["chosen"]
    assert "hardly distinguish the models" in advice(rows)


def test_a_clear_difference_of_predictions_is_not_called_small():
    better = row_of("better", 4, {"a": WAVY.tolist()}, 900)
    worse = row_of("worse", 4, {"a": (15.0 * WAVY).tolist()}, 900)
    text = advice(rows_of(better, worse))
    assert "3.87 times as large" in text
    assert "better certainly predicts these held-out samples better" in text
    assert "hardly distinguish" not in text


def test_a_ratio_of_predictions_that_may_be_one_has_its_interval():
    uneven = STEADY * np.array([0.1, 0.1, 0.1, 12.0, 0.1, 0.1, 0.1, 0.1])
    small = row_of("small", 4, {"a": STEADY.tolist()}, 900)
    large = row_of("large", 4, {"a": (1.05 * uneven).tolist()}, 900)
    text = advice(rows_of(small, large))
    assert "times as large" not in text
    assert "which may be one (" in text
    assert "hardly distinguish the models" in text


def test_a_constant_at_its_bound_is_marked_and_named(tmp_path):
    bounded = row_of("mooney-rivlin", 2, {"a": WAVY.tolist()}, 900)
    bounded["found"][""] |= {
        "parameters": {"c10_pa": 7.5e4, "c01_pa": 1.0},
        "at_bound": {"c01_pa": "lower"},
    }
    other = row_of("yeoh", 4, {"a": (0.5 * WAVY).tolist()}, 800)
    rows = rows_of(bounded, other)
    text = advice(rows)
    assert text.startswith("Use yeoh")
    assert "mooney-rivlin ended with C₀₁ = 1 Pa (its lower bound)" in text
    assert "yeoh ended" not in text
    table = model_tables(rows)[-1]
    assert table.rows[0] == ("C₁₀ Pa", "7.5e+04", "–")
    assert table.rows[1] == ("C₀₁ Pa", "1 (at lower bound)", "–")
    inside = row_of("mooney-rivlin", 2, {"a": WAVY.tolist()}, 900)
    assert "bound" not in advice(rows_of(inside, other))


@pytest.mark.parametrize(
    ("c01_pa", "stated", "at_bound"),
    [
        (-2e4, "{ lower = 1.0 }", {"c01_pa": "lower"}),
        (-2e4, "{}", {}),  # the default bound is no physical limit
        (2e4, "{}", {}),
    ],
)
def test_a_fit_records_which_constants_end_at_bounds(tmp_path, c01_pa, stated, at_bound):
    stretch = np.linspace(1.05, 2.0, 12)
    stress_pa = 2 * (stretch - stretch**-2) * (8e4 + c01_pa / stretch)
    rows = [f"{a},{b}" for a, b in zip(stretch, stress_pa, strict=True)]
    (tmp_path / "pull.csv").write_text("\n".join(["stretch,stress (Pa)", *rows]) + "\n")
    (tmp_path / "problem.toml").write_text(
        f"""[object]
material = "mooney-rivlin"
[parameters]
c10_pa = {{}}
c01_pa = {stated}
kappa_pa = 1e9
[[experiment]]
name = "pull"
kind = "specimen"
test = "uniaxial"
file = "pull.csv"
sigma_pa = 1e3
"""
    )
    problem = Problem.read(tmp_path / "problem.toml")
    record = fit_record(problem, "reduced-space", "")
    assert record["converged"]
    assert record["at_bound"] == at_bound


@pytest.mark.long
def test_a_comparison_in_python_has_the_estimates_of_a_solve():
    stretch = np.linspace(1.05, 1.8, 12)
    noise_pa = np.random.default_rng(3).normal(scale=1e3, size=len(stretch))
    stress_pa = 1e5 * (stretch - stretch**-2) + noise_pa
    pull = cs.Specimen("uniaxial", stretch - 1, stress_pa, sigma_pa=1e3)
    problems = {
        "neo-hookean": cs.Problem(
            [pull.experiment("neo-hookean", "pull")], {"mu_pa": cs.Unknown(), "kappa_pa": 1e9}
        ),
        "yeoh": cs.Problem(
            [pull.experiment("yeoh", "pull")],
            {**{f"c{k}0_pa": cs.Unknown() for k in (1, 2, 3)}, "kappa_pa": 1e9},
        ),
    }
    compared = cs.compare_models(problems)
    assert compared.chosen == "neo-hookean"
    assert "Use neo-hookean" in str(compared)
    for row in compared.rows:
        solved = cs.run(problems[row["model"]], seek_causes=False)
        assert row["parameters"]["young_pa"] == solved.estimates["young_pa"].value
        assert row["budget"]["young_pa"]["combined95"] == solved.interval("young_pa")
    assert [table.title for table in compared.tables] == ["Models", "Parameters"]
    (prediction, young, *_) = compared.plot().axes
    assert prediction.get_title(loc="left") + prediction.get_title()
    assert young.get_xlabel().endswith("[kPa]")
    with pytest.raises(cs.InputError, match="two or more"):
        cs.compare_models({"yeoh": problems["yeoh"]})


@pytest.mark.long
@pytest.mark.parametrize("kind", ["specimen", "compression", "swing"])
def test_a_complete_fit_has_the_estimates_and_intervals_of_the_command_solve(tmp_path, kind):
    create_problem(tmp_path / "example", kind)
    problem = Problem.read(tmp_path / "example" / "problem.toml")
    record = fit_record(problem, "reduced-space", "")
    solved = cs.run(problem)
    assert record["parameters"].keys() >= solved.parameters.keys()
    for name, estimate in (solved.result.parameters | solved.result.derived).items():
        assert record["parameters"][name] == pytest.approx(estimate.value, rel=1e-9), name
        if estimate.combined95 is not None:
            combined95 = record["budget"][name]["combined95"]
            assert combined95 == pytest.approx(estimate.combined95, rel=1e-9), name


@pytest.mark.parametrize("law", MATERIALS)
def test_every_law_has_a_stiffness_at_small_strain(law):
    own = {
        c.name: Unknown(c.usual or usual_value(c.name, 2.6e3) or 1e3)
        for c in MATERIALS[law].constants
    }
    values = own | {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    body = Body(box().mesh, density_kg_m3=30.0, material=law)
    hung = replace(hung_cube(2), body=body)
    collocation = Collocation([hung], Parameters.from_mapping(values))
    constants = (transcription.constants for transcription in collocation.transcriptions)
    numbers = DerivedModuli.from_bodies(constants, collocation.guess_p[: collocation.nq])
    assert numbers.values["young_pa"] > 0
    assert numbers.derivatives["young_pa"].any()


def test_a_model_that_fits_better_but_predicts_worse_is_not_taken():
    small = row_of("small", 4, {"a": STEADY.tolist()}, 900)
    large = row_of("large", 6, {"a": (1.4 * WAVY).tolist()}, 700)
    rows = rows_of(small, large)
    assert rows[0]["chosen"]
    assert rows[0]["delta_aic"] == pytest.approx(300 * np.log(900 / 700) - 4)
    assert "large fits better, but does not predict better" in advice(rows)


def test_recordings_that_disagree_leave_the_choice_open():
    small = row_of("small", 4, {"a": (2 * STEADY).tolist(), "b": STEADY.tolist()}, 900)
    large = row_of("large", 6, {"a": STEADY.tolist(), "b": (1.5 * STEADY).tolist()}, 850)
    rows = rows_of(small, large)
    assert rows[0]["log_ratio_error"] > rows[0]["log_ratio"] > 0
    assert rows[0]["chosen"]


def test_a_model_that_cannot_be_simulated_elsewhere_is_named():
    small = row_of("small", 4, {"a": STEADY.tolist(), "b": STEADY.tolist()}, 900)
    large = row_of("large", 6, {"a": [], "b": []}, 700, failure="time step 7 failed")
    said = advice(rows_of(small, large))
    assert said.startswith(
        "Use small: no other model predicts the held-out samples. large does not predict"
    )
    assert "but fits all recordings better (its AIC is 71.4 lower)" in said


# The command line -------------------------------------------------------------------------------


@pytest.mark.long
def test_a_comparison_of_models_from_the_command_line(tiny: Path, monkeypatch):
    monkeypatch.chdir(tiny)
    monkeypatch.setenv("COLUMNS", "80")
    replace_text("[rollout]", '[environment]\nair_density_kg_m3 = "none"\n\n[rollout]')(tiny)
    words = ("compare-models", "problem.toml", "--materials", "neo-hookean,st-venant-kirchhoff")
    words = (*words, "--method", "reduced-space", "--workers", "2", "--out", "models")
    done = run_command(*words, "--quiet")
    assert done.code == 0, done.err
    assert "the last third of the recording" in done.out
    written = {path.name for path in (tiny / "models").iterdir()}
    assert written == {"summary.md", "models.png"}
    summary = json.loads(run_command(*words, "--quiet", "--json").out)
    assert summary["kind"] == "compare-models"
    assert summary["advice"].startswith("Use ")
    assert summary["advice"] in done.out
    assert [row["model"] for row in summary["runs"]] == ["neo-hookean", "st-venant-kirchhoff"]
    assert sum(row["chosen"] for row in summary["runs"]) == 1
    solved = run_command(
        "solve", "problem.toml", "--method", "reduced-space", "-q", "--no-pictures", "--out", "run"
    )
    assert solved.code == 0, solved.err
    estimates = json.loads((tiny / "run" / "result.json").read_text())["parameters"]
    row = next(row for row in summary["runs"] if row["model"] == "neo-hookean")
    assert row["parameters"].keys() >= estimates.keys() >= {"mu_pa", "gamma_r_s"}
    for name, estimate in estimates.items():
        assert row["parameters"][name] == pytest.approx(estimate["value"], rel=1e-9)
        assert row["budget"][name]["combined95"] == pytest.approx(estimate["combined95"], rel=1e-9)
    assert summary["advice"].split(":")[0] in (tiny / "models" / "summary.md").read_text()


@pytest.mark.long
def test_a_comparison_of_laws_of_damping_from_the_command_line(tiny: Path, monkeypatch):
    monkeypatch.chdir(tiny)
    words = (
        "compare-models",
        "problem.toml",
        "--damping",
        "kelvin-voigt,material",
        "--out",
        "laws",
    )
    summary = json.loads(run_command(*words, "--quiet", "--json").out)
    assert [row["model"] for row in summary["runs"]] == ["kelvin-voigt", "material"]
    assert all("gamma_r_s" in row["parameters"] for row in summary["runs"])
    for row in summary["runs"]:
        assert all("damping_law" not in line["shares"] for line in row["budget"].values())


def test_a_comparison_needs_two_models(tiny: Path):
    nothing = run_command("compare-models", "problem.toml")
    assert (nothing.code, "--materials, --damping, --prony or --with" in nothing.err) == (2, True)
    words = ("compare-models", "problem.toml", "--materials", "gent,yeoh", "--method")
    refused = run_command(*words, "reduced-spaced")
    assert (refused.code, "--method: " in refused.err) == (2, True)
    assert "did you mean 'reduced-space'?" in refused.err


def test_one_method_fits_all_models(tiny: Path):
    words = ("compare-models", "problem.toml", "--materials", "gent,yeoh", "--dry-run", "--json")
    planned = json.loads(run_command(*words, "--method", "interior-point").out)
    assert planned
    assert {run["method"] for run in planned} == {"interior-point"}
    several = run_command(*words, "--method", "interior-point,reduced-space")
    assert (several.code, "expected one method" in several.err) == (2, True)
