"""Test-bench files as machines write them, and what the recordings of a problem share."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import run_command
from make_templates import KINDS, SHEAR_MODULUS_PA, SWUNG, YOUNG_PA
from rendered_video import TRUTH as FILMED

from collocation_sysid import run
from collocation_sysid.common.display import as_markdown, plain_text
from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.mesh import ElementNodes
from collocation_sysid.fem.meshes.selection import Face
from collocation_sysid.fem.meshes.structured import box_mesh, cylinder_of_edge
from collocation_sysid.judge.modes import find_misspecifications_by_modes
from collocation_sysid.problem import Problem
from collocation_sysid.problem.new import TEMPLATES, create_problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import displaced_axes, read_displacement, read_wrench
from collocation_sysid.recording.sources.units import si_factor
from collocation_sysid.recording.time_tables import read_pressure
from collocation_sysid.result.run_sections import run_report
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.result.synthesis import write_data

TIMES = [0.0, 0.1, 0.2]
PRESSED_MM = [0.0, 0.25, 0.5]
LOAD_N = [0.0, 2.5, 6.0]

PLAIN = """\
Time (s),Displacement (mm),Force (N)
0,0,0
0.1,0.25,2.5
0.2,0.5,6
"""
WITH_HEADER = """\
sample_1
Compression test;
Cylinder Diameter: 50mm;
Speed (mm/min): 10;
Time (s),Compression (mm),Load (N),Engineering Strain [-],True Strain [-],True Stress (kPa)
0.000,0.00,0.0,-0.00,-0.00,0.0
0.100,0.25,2.5,-0.01,-0.01,-9.9
0.200,0.50,6.0,-0.02,-0.02,-9.8
"""
UNITS_BELOW = """\
"Results Table 1"
"Time","Compressive extension","Load"
"(s)","(mm)","(kN)"
"0.0","0.00","0.0000"
"0.1","0.25","0.0025"
"0.2","0.50","0.0060"
"""
GERMAN = """\
Prüfzeit;Standardweg;Standardkraft
s;mm;N
0,0;0,00;0,0
0,1;0,25;2,5
0,2;0,50;6,0
"""
OTHER_WORDS = [
    "Zeit in s;Stauchung in mm;Last in N",
    "Messzeit [s];Kolbenweg [mm];Druckkraft [N];Stauchung [%];Druckspannung [kPa]",
    "Versuchszeit (s);Dehnung (mm);Prüflast (N);Sollkraft (N)",
    "Tiempo (s);Desplazamiento (mm);Fuerza (N);Tensión (MPa)",
]
THOUSANDS = "Zeit in ms;Weg in µm;Kraft in mN\n0,0;0,0;0,0\n100,0;250,0;2.500,0\n200,0;500;6.000\n"
TABS = PLAIN.replace(",", "\t").replace(" (mm)", " / mm").replace(" (s)", " [ms]")
TABS = TABS.replace("0.1\t", "100\t").replace("0.2\t", "200\t")


@pytest.fixture
def written(tmp_path: Path):
    """Write a file of a machine."""

    def write(text: str, encoding: str = "utf-8") -> Path:
        file = tmp_path / "press.csv"
        file.write_text(text, encoding=encoding)
        return file

    return write


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (PLAIN, "utf-8"),
        (WITH_HEADER, "utf-8-sig"),
        (UNITS_BELOW, "utf-8"),
        (GERMAN, "cp1252"),
        (TABS, "utf-16"),
        (THOUSANDS, "utf-8"),
        (
            THOUSANDS.replace(",0", "").replace("2.500", "2,500.0").replace("6.000", "6,000"),
            "utf-8",
        ),
    ],
    ids=[
        *("plain", "header", "units below", "semicolons from Windows", "tabs in UTF-16"),
        *("thousands with points", "thousands with commas"),
    ],
)
def test_a_machines_columns_are_recognised_with_their_units(written, text, encoding):
    file = written(text, encoding)
    moved = read_displacement(file, sign=-1)
    np.testing.assert_allclose(moved.t_s, TIMES)
    np.testing.assert_allclose(moved.positions_m[:, 2], -1e-3 * np.array(PRESSED_MM))
    assert displaced_axes(file) == "z"
    t_s, quarter, _ = read_wrench(file, sign=-1, symmetry=4, axis="x")
    np.testing.assert_allclose(t_s, TIMES)
    np.testing.assert_allclose(quarter[:, 0], -np.array(LOAD_N) / 4)
    assert np.isnan(quarter[:, 1:]).all()


@pytest.mark.parametrize("header", OTHER_WORDS)
def test_words_of_other_languages_are_understood_by_their_units(written, header):
    blank = ";9" * (header.count(";") - 2)
    file = written(f"{header}\n0,0;0,0;0,0{blank}\n0,1;0,25;2,5{blank}\n0,2;0,5;6,0{blank}\n")
    moved = read_displacement(file)
    np.testing.assert_allclose(moved.t_s, TIMES)
    np.testing.assert_allclose(moved.positions_m[:, 2], 1e-3 * np.array(PRESSED_MM))
    np.testing.assert_allclose(read_wrench(file)[1][:, 2], LOAD_N)


@pytest.mark.parametrize(
    "header", ["Strain (%),Stress [MPa]", "Stauchung in %,Druckspannung in MPa"]
)
def test_strain_and_stress_become_displacement_and_force(written, header):
    file = written(f"{header}\n0,0\n1,0.02\n2,0.05\n")
    moved = read_displacement(file, length_m=0.03, timed=False)
    np.testing.assert_allclose(moved.positions_m[:, 2], [0, 3e-4, 6e-4])
    t_s, values, _ = read_wrench(file, area_m2=1e-4, timed=False)
    np.testing.assert_array_equal(t_s, [0, 1, 2])
    np.testing.assert_allclose(values[:, 2], [0, 2.0, 5.0])


def test_rows_without_times_are_equilibria_of_a_body_without_memory(tmp_path):
    file = block_problem(tmp_path)
    untimed = re.sub("^[^,]*,", "", PLAIN, flags=re.MULTILINE)
    for name in ("first", "second"):
        (tmp_path / f"{name}.csv").write_text(untimed)
    np.testing.assert_array_equal(Problem.read(file).experiments[1].t_s, [0, 1, 2])
    memory = '[[object.prony]]\nname = "prony_1"\n\n[parameters]\nprony_1.share = 0.1\n'
    file.write_text(SHARED.replace("[parameters]", memory + "prony_1.tau_s = 1.0"))
    with pytest.raises(
        InputError, match=r"line 1: the columns are .*; expected t_s and any of x_m"
    ):
        Problem.read(file)


def test_unrecognised_columns_are_named(written):
    file = written("Takt [s],Kanal 1 (mm),Kanal 2,rest\n0,0,0,5\n1,2,3,5\n")
    moved = read_displacement(file, {"t": "Takt [s]", "displacement": "Kanal 1 (mm)"})
    np.testing.assert_allclose(moved.positions_m[:, 2], [0, 2e-3])
    columns = {"t": "Takt [s]", "force": "Kanal 2 (kN)"}
    np.testing.assert_allclose(read_wrench(file, columns)[1][:, 2], [0, 3000])


def test_one_file_in_this_projects_own_form_holds_both(written):
    file = written("t_s,z_mm,fz_n\n0,0,0\n1,-2,\n2,-3,-1\n")
    np.testing.assert_allclose(read_displacement(file).positions_m[:, 2], [0, -2e-3, -3e-3])
    np.testing.assert_array_equal(read_wrench(file)[1][:, 2], [0, np.nan, -1])


def test_pressures_have_any_unit(written):
    file = written("Time (min),Druck (kPa)\n0,0\n1,2\n")
    t_s, pressure_pa = read_pressure(file)
    np.testing.assert_allclose(t_s, [0, 60])
    np.testing.assert_allclose(pressure_pa, [0, 2000])


BAD = {
    "no unit": ("Time (s),Force\n0,1\n1,2\n", {}, "line 1: column Force names no unit"),
    "a mass": ("Time (s),Load (kg)\n0,1\n1,2\n", {}, "a unit of force, one of N, mN"),
    "two": (
        "Time (s),Load (N),Force (N)\n0,1,1\n1,2,2\n",
        {},
        "Load (N), Force (N) could all be force; expected one of them, or "
        'columns = { force = "Load (N)" } or columns = { force = "Force (N)" }',
    ),
    "only stress": ("Time (s),Stress (kPa)\n0,1\n1,2\n", {}, "a stress needs area_m2"),
    "no area": (PLAIN, {"area_m2": 1.0}, "expected t_s and any of stress_pa"),
    "true stress": (
        "Time (s),True Stress (kPa)\n0,1\n1,2\n",
        {"area_m2": 1.0, "columns": {"stress": "True Stress (kPa)"}},
        "column True Stress (kPa) holds a true stress, force over deformed area; expected an engin",
    ),
    "not there": (PLAIN, {"columns": {"force": "Forse (N)"}}, "did you mean 'Force (N)'"),
    "no such key": (PLAIN, {"columns": {"load": "Force (N)"}}, "the key 'load'; expected one of t"),
    "header": (
        WITH_HEADER.replace("0.25,2.5", "0.25,wet"),
        {},
        "line 7: column Load (N) holds 'we",
    ),
    "mixed commas": (GERMAN.replace("0,25", "0.25"), {}, "holds '0,0'"),
    "a length": ("Time (s),Force (mm)\n0,1\n1,2\n", {}, "Force (mm) has the unit mm"),
}


@pytest.mark.parametrize(("text", "how", "words"), BAD.values(), ids=BAD)
def test_an_unusable_force_column_is_refused_with_reason_and_remedy(written, text, how, words):
    with pytest.raises(InputError, match=re.escape(words)):
        read_wrench(written(text), **how)


# What recordings share ----------------------------------------------------------------------------

SHARED = """\
[object]
mesh = "block.vtu"
density_kg_m3 = 1000.0

[parameters]
young_pa = { guess = 5e4 }
poisson = 0.3
gamma_r_s = 0.0
gamma_m_1_s = 0.0

[experiment_defaults]
kind = "static"
every = 2
grasp = [
    { nodes = { box_m = [[-1, -1, -1], [1, 1, 1e-4]] } },
    { nodes = { box_m = [[-1, -1, 0.0999], [1, 1, 1]] }, displacement = { sign = -1 }, \
wrench = { sign = -1, symmetry = 4, sigma_n = 0.04 } },
]

[[experiment]]
name = "first"
file = "first.csv"

[[experiment]]
name = "second"
file = "second.csv"
every = 1
"""


def block_problem(folder: Path, text: str = SHARED) -> Path:
    box_mesh((0.05, 0.05, 0.1), (1, 1, 2)).write(folder / "block.vtu")
    for k, name in enumerate(("first", "second")):
        (folder / f"{name}.csv").write_text(PLAIN + f"0.3,0.{7 + k},{8 + k}\n")
    (folder / "problem.toml").write_text(text)
    return folder / "problem.toml"


def test_experiments_share_keys_stated_above(tmp_path):
    problem = Problem.read(block_problem(tmp_path))
    first, second = problem.experiments
    np.testing.assert_allclose(first.t_s, [0, 0.2])
    np.testing.assert_allclose(second.t_s, [0, 0.1, 0.2, 0.3])
    (sensor,) = (grasp.wrench for grasp in second.grasps if grasp.wrench)
    np.testing.assert_allclose(sensor.values[:, 2], np.array([0, -2.5, -6, -9]) / 4)
    assert sensor.sigma_n == 0.01
    assert problem.origin is not None
    assert {file.name for file in problem.origin.files} == {"block.vtu", "first.csv", "second.csv"}
    overridden = Problem.read(tmp_path / "problem.toml", ["experiment_defaults.every=3"])
    np.testing.assert_allclose(overridden.experiments[0].t_s, [0, 0.3])


def test_a_half_height_takes_the_scaled_displacement(tmp_path):
    file = block_problem(tmp_path)
    complete = Problem.read(file).experiments[1].grasps[1]
    text = SHARED.replace("sign = -1 }", "sign = -1, scale = 0.5 }", 1)
    file.write_text(text)
    problem = Problem.read(file)
    half = problem.experiments[1].grasps[1]
    assert half.displacement_scale == 0.5
    assert np.abs(complete.poses.positions_m[:, 2]).max() > 0
    np.testing.assert_allclose(half.poses.positions_m, complete.poses.positions_m / 2)
    # Files of a simulation have the displacement of the whole specimen again.
    write_data(Problem.read(file, simulation=True), tmp_path / "twin")
    written = read_displacement(tmp_path / "twin" / "second.csv", sign=-1)
    np.testing.assert_allclose(written.positions_m, complete.poses.positions_m, atol=1e-12)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ("scale = 0", "greater than 0|above 0|positive"),
        ("scale = -0.5", "greater than 0|above 0|positive"),
        ('scale = 0.5, length_m = "body"', "expected one of them"),
    ],
)
def test_a_scale_is_positive_and_not_of_strains(tmp_path, stated, message):
    text = SHARED.replace("sign = -1 }", f"sign = -1, {stated} }}", 1)
    with pytest.raises(InputError, match=message):
        Problem.read(block_problem(tmp_path, text))


PLANES = """\
    { nodes = { box_m = [[-1e-4, -1, 1e-4], [1e-4, 1, 0.0999]] }, axes = "x" },
    { nodes = { box_m = [[-1, -1e-4, 1e-4], [1, 1e-4, 0.0999]] }, axes = "y" },
]
"""


def test_components_that_vanish_by_symmetry_are_not_fitted(tmp_path):
    """Those of the quarter do not vanish: the other quarters balance them."""
    cell = SHARED.replace("wrench = { sign = -1", 'wrench = { file = "cell.csv", sign = -1')
    cell = cell.replace("sigma_n = 0.04", "sigma_n = 0.04, sigma_nm = 0.01")
    file = block_problem(tmp_path, cell)
    head = "t_s,fx_n,fy_n,fz_n,tx_nm,ty_nm,tz_nm\n"
    rows = [f"{k / 10},0.01,0.02,{load},0.1,0.1,0.1" for k, load in enumerate((0, -2.5, -6, -9))]
    (tmp_path / "cell.csv").write_text(head + "\n".join(rows) + "\n")
    without = Problem.read(file)
    (sensor,) = without.experiments[1].wrenches
    assert len(sensor.component_names) == 6
    file.write_text(cell.replace("]\n\n[[experiment]]", f"{PLANES}\n[[experiment]]", 1))
    problem = Problem.read(file)
    (sensor,) = problem.experiments[1].wrenches
    assert sensor.component_names == ("fz",)
    np.testing.assert_allclose(sensor.values[:, 2], np.array([0, 2.5, 6, 9]) / 4)
    assert any("fx, fy, tx, ty and tz of the sensor are not used" in n for n in problem.notes)
    columns = [row.rpartition(",")[0] for row in (head, *rows)]
    columns = [",".join(row.split(",")[:3]) for row in columns]
    (tmp_path / "cell.csv").write_text("\n".join(columns) + "\n")
    with pytest.raises(InputError, match=r"fx and fy of the complete specimen vanish by symmetry"):
        Problem.read(file)


def cycle_of_a_bench(folder: Path, softening: float, each_way: int = 9) -> Path:
    """A block of 50 kPa that unloads with a force that is less by a share, with noise of 0.01 N."""
    text = SHARED.partition("[[experiment]]")[0].replace("every = 2\n", "")
    text += '[[experiment]]\nname = "press"\nfile = "press.csv"\n'
    text = text.replace("sign = -1, symmetry = 4, sigma_n = 0.04", "sign = -1, sigma_n = 0.01")
    file = block_problem(folder, text)
    mm = np.concatenate([np.linspace(0, 2, each_way), np.linspace(2, 0, each_way)[1:]])

    def write_table(load_n):
        rows = [f"{k},{x:.4f},{f:.5f}" for k, (x, f) in enumerate(zip(mm, load_n, strict=True))]
        (folder / "press.csv").write_text("\n".join([PLAIN.partition("\n")[0], *rows, ""]))

    write_table(10 * mm)
    (experiment,) = Problem.read(file).experiments
    truth = {"young_pa": 5e4, "poisson": 0.3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    (wrench,) = simulate(experiment, truth).wrenches
    load_n = -wrench[:, 2]
    load_n = load_n - softening * (load_n - load_n[0]) * (np.arange(len(mm)) >= each_way)
    write_table(load_n + np.random.default_rng(0).normal(0, 0.01, len(mm)))
    return file


@pytest.mark.long
@pytest.mark.parametrize("each_way", [9, 121])
def test_hysteresis_of_a_bench_is_not_good(tmp_path, each_way):
    found = run(Problem.read(cycle_of_a_bench(tmp_path, 0.1, each_way)))
    assert found.trust.verdict != "good"


@pytest.mark.long
def test_loads_of_a_part_are_reported_for_the_whole_specimen(tmp_path):
    """As those of the same part whose file has its own loads, times four."""
    part = SHARED.replace("sign = -1, symmetry = 4, sigma_n = 0.04", "sign = -1, sigma_n = 0.01")
    block_problem(tmp_path)
    (tmp_path / "part.toml").write_text(part)
    for name in ("first", "second"):
        head, *rows = (tmp_path / f"{name}.csv").read_text().splitlines()
        cells = [row.split(",") for row in rows]
        lines = [",".join([*row[:-1], repr(float(row[-1]) / 4)]) for row in cells]
        (tmp_path / f"{name}_part.csv").write_text("\n".join([head, *lines, ""]))
    parts = [f"experiment.{name}.file={name}_part.csv" for name in ("first", "second")]
    found = run(Problem.read(tmp_path / "problem.toml"), seek_causes=False)
    alone = run(Problem.read(tmp_path / "part.toml", parts), seek_causes=False)
    whole_fit, part_fit = found.result.fit, alone.result.fit
    assert part_fit.wrench_rms_n is not None
    assert part_fit.wrench_rms_n > 0
    assert whole_fit.wrench_rms_n == pytest.approx(4 * part_fit.wrench_rms_n, rel=1e-6)
    assert whole_fit.experiments["first"].wrench_sigma_n == pytest.approx(0.04)
    assert whole_fit.symmetry == {"first": 4, "second": 4}
    assert part_fit.symmetry is None
    simulated = [each.rollout.experiments["second"] for each in (found.result, alone.result)]
    assert simulated[0].wrench_rms_n == pytest.approx(4 * simulated[1].wrench_rms_n, rel=1e-6)
    arrays = []
    for name, finished in (("whole", found), ("part", alone)):
        finished.save(tmp_path / name, frames=False)
        arrays.append(np.load(tmp_path / name / "trajectory.npz")["second/wrench_1"])
    np.testing.assert_allclose(arrays[0][:, 3], [0, -2.5, -6, -9])  # as in the file
    np.testing.assert_allclose(arrays[0][:, 1:], 4 * arrays[1][:, 1:], rtol=1e-6)
    said = plain_text(run_summary(found.result, tmp_path / "whole", details=True))
    words = (
        "loads of 'first' and 'second' are those of the whole specimen, 4 times those of the "
        "modelled part"
    )
    assert words in said
    alone_said = plain_text(run_summary(alone.result, tmp_path / "part", details=True))
    assert "whole specimen" not in alone_said
    priors_n = [
        float(re.search(r"tare: up to \S+ N \(prior ±(\S+) N\)", said)[1])
        for each in (found.result, alone.result)
        if (said := each.fit.experiments["first"].notes[-1])
    ]
    assert priors_n[0] == pytest.approx(4 * priors_n[1])
    assert "Forces are those of the modelled part." in as_markdown([run_report(tmp_path / "whole")])


def test_a_sign_that_only_displacement_or_load_has_is_named(tmp_path):
    def said(text: str) -> list[str]:
        problem = Problem.read(block_problem(tmp_path, text))
        return [
            cause.message
            for each in problem.experiments
            for cause in find_misspecifications_by_modes(each, {})
        ]

    assert said(SHARED) == []
    assert said(SHARED.replace("sign = -1", "sign = 1")) == []  # pulled, not pressed
    for wrong in (
        SHARED.replace("{ sign = -1 }", "{}"),
        SHARED.replace("{ sign = -1, sym", "{ sym"),
    ):
        both = said(wrong)
        assert [sentence.partition(":")[0] for sentence in both] == ["'second'"]
        assert (
            "along z the displacement of grasp 2 and its force on the body have opposite signs"
        ) in both[0]
        assert "set sign = -1 for the displacement or for the wrench" in both[0]


def test_a_part_of_a_default_is_overridden_for_one_experiment(tmp_path):
    file = block_problem(tmp_path)
    problem = Problem.read(file, ["experiment.second.grasp.1.wrench.sigma_n=0.4"])
    sigmas = [e.grasps[1].wrench.sigma_n for e in problem.experiments if e.grasps[1].wrench]
    assert sigmas == [0.01, 0.1]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("every = 2", "every = 0", "problem.toml: experiment_defaults.every: found 0"),
        ("kind =", "kynd =", "experiment_defaults.kynd: unknown key; did you mean 'kind'"),
        ("every = 1", "every = 0", "experiment 'second': every: found 0"),
        ('"first.csv"', '"third.csv"', "experiment 'first': file: "),
        ('file = "first.csv"', "", "experiment 'first': grasp.1.displacement: missing; expected a"),
        ("{ sign = -1 }", "{ sign = 2 }", "experiment_defaults.grasp.1.displacement.sign: found 2"),
        ("[experiment_defaults]", "[[experiment_defaults]]", "experiment_defaults: found ["),
    ],
)
def test_a_mistake_in_shared_keys_is_named_at_its_place(tmp_path, old, new, words):
    assert old in SHARED
    file = block_problem(tmp_path, SHARED.replace(old, new))
    with pytest.raises(InputError) as caught:
        Problem.read(file)
    assert words in str(caught.value)
    assert "more mistakes" not in str(caught.value)


@pytest.mark.parametrize(
    ("unit", "dimension", "si"),
    [
        ("min", "time", 60),
        ("inch", "length", 0.0254),
        ("lbf", "force", 0.45359237 * 9.80665),
        ("kgf", "force", 9.80665),
        ("N mm", "torque", 1e-3),
        ("psi", "pressure", 0.45359237 * 9.80665 / 0.0254**2),
        ("bar", "pressure", 1e5),
        ("hPa", "pressure", 1e2),
        ("N/mm²", "pressure", 1e6),
        ("%", "ratio", 1e-2),
    ],
)
def test_units_have_their_defined_factors(unit: str, dimension: str, si: float):
    assert si_factor(unit, dimension) == pytest.approx(si, rel=1e-7)


# New problems -------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "data"),
    [
        ("compression", {"run_1.csv"}),
        ("tension", {"run_1.csv"}),
        ("swing", {"body.vtu", "poses.csv", "markers.csv"}),
        ("specimen", {"pull.csv"}),
        ("video", {"body.vtu", "poses.csv", "front.csv", "front.yaml"}),
    ],
)
def test_a_new_problem_of_each_kind_runs_unchanged(tmp_path, monkeypatch, kind, data):
    monkeypatch.chdir(tmp_path)
    begun = run_command("new", "mine", "--kind", kind)
    assert begun.code == 0
    assert {Path(line).name for line in begun.out.splitlines()} == {
        "problem.toml",
        "schema.json",
        *data,
    }
    assert "collocation-sysid check mine/problem.toml" in begun.err
    assert "collocation-sysid solve mine/problem.toml" in begun.err
    guess = {"specimen": "mu_pa", "swing": "", "video": ""}.get(kind, "young_pa")
    guessed = ("--set", f"parameters.{guess}.guess=3e4" if guess else "solver.huber=9.0")
    assert run_command("check", "mine/problem.toml", *guessed).code == 0
    problem = Problem.read("mine/problem.toml", guessed[1:])
    found = run(problem, seek_causes=False)
    reasons = {concern.code for concern in found.trust.concerns}
    assert not {code for code in reasons if code.startswith(("residuals/", "noise/"))}
    assert kind == "video" or found.trust.verdict == "good"
    truth = {"swing": SWUNG, "specimen": {"mu_pa": SHEAR_MODULUS_PA}, "video": FILMED}.get(
        kind, {"young_pa": YOUNG_PA, "poisson": 0.49}
    )
    assert _stated_truth(Path("mine/problem.toml")) == truth
    free = [item.name for item in problem.parameters.free]
    for name, value in truth.items():
        if name in free:
            low, high = found.interval(name)
            assert low < value < high
        else:
            assert found.solution.parameters[name] == value


def _stated_truth(file: Path) -> dict[str, float]:
    """True constants in the comment at the head of a template."""
    head, _ = file.read_text().split("[object]")
    _, stated = head.split("was simulated with")
    found = re.findall(r"([a-z_0-9]+) = (\d[\d.e]*\d)", stated)
    return {name: float(value) for name, value in found}


def test_an_empty_problem_states_no_truth_of_an_example(tmp_path):
    file, *_ = create_problem(tmp_path / "mine")
    assert "simulated" not in file.read_text()


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_the_recordings_of_templates_equal_a_simulation(tmp_path, kind):
    shutil.copytree(TEMPLATES / kind, tmp_path / kind)
    shipped = sorted((TEMPLATES / kind).glob("*.csv"))
    for file in shipped:
        (tmp_path / kind / file.name).unlink()
    KINDS[kind](tmp_path / kind)
    for file in shipped:
        made, there = ((at / file.name).read_text() for at in (tmp_path / kind, file.parent))
        assert made.splitlines()[0] == there.splitlines()[0]
        numbers = [np.genfromtxt(t.splitlines()[1:], delimiter=",") for t in (made, there)]
        np.testing.assert_allclose(*numbers, rtol=1e-6, atol=1e-6 if kind == "swing" else 2e-4)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["compression", "tension"])
def test_a_simulated_bench_is_solved_by_its_own_problem(tmp_path, kind):
    shutil.copytree(TEMPLATES / kind, tmp_path / "measured")
    file, twin = tmp_path / "measured" / "problem.toml", tmp_path / "twin"
    told = run_command(
        *("simulate", file, "--out", twin, "--set", "parameters.young_pa.guess=4e4"),
        *("--noise-n", "0.01"),
    )
    assert told.code == 0, told.err
    assert [each.name for each in twin.glob("[!.]*")] == ["run_1.csv"]
    rows = len((TEMPLATES / kind / "run_1.csv").read_text().splitlines())
    assert len((twin / "run_1.csv").read_text().splitlines()) == rows
    shutil.copy(file, twin)
    again, measured = (Problem.read(at / "problem.toml") for at in (twin, file.parent))
    for ours, theirs in zip(again.experiments, measured.experiments, strict=True):
        np.testing.assert_allclose(ours.t_s, theirs.t_s)
        for grasp, recorded in zip(ours.grasps, theirs.grasps, strict=True):
            np.testing.assert_allclose(
                grasp.poses.positions_m, recorded.poses.positions_m, atol=1e-12
            )
    found = run(again, seek_causes=False)
    assert found.optimum["young_pa"].value == pytest.approx(4e4, rel=0.01)


@pytest.mark.parametrize(
    ("displacement", "wrench", "measured", "simulated"),
    [
        (
            "sign = -1",
            "sign = -1, symmetry = 4",
            "Time (s),Displacement (mm),Force (N)",
            "t_s,displacement_m,force_n",
        ),
        (
            'columns = { displacement = "Weg 1 (mm)", t = "Takt [ms]" }',
            'sign = -1, columns = { force = "Kanal 2 (kN)", t = "Takt [ms]" }',
            "Takt [ms],Weg 1 (mm),Kanal 2 (kN)",
            "Takt [ms],Weg 1 (mm),Kanal 2 (kN)",
        ),
        (
            'length_m = "body", sign = -1',
            "area_m2 = 2e-3",
            "Time (s),Strain (%),Stress (Pa)",
            "t_s,strain_1,stress_pa",
        ),
        (
            "sign = -1",
            'columns = { fz = "F (N)" }',
            "Time (s),Displacement (mm),F (N)",
            "Time (s),displacement_m,F (N)",
        ),
        (
            'sign = -1, columns = { displacement = "Weg 1 (mm)", t = "T (s)" }',
            "sign = -1",
            "T (s),Weg 1 (mm),Force (N)",
            "T (s),Weg 1 (mm),force_n",
        ),
        (
            "sign = -1, scale = 0.5",
            "sign = -1, symmetry = 4",
            "Time (s),Displacement (mm),Force (N)",
            "t_s,displacement_m,force_n",
        ),
    ],
    ids=["signs", "names", "strain and stress", "a name for one", "a time for one", "half"],
)
def test_a_simulated_table_reads_back_unchanged(
    tmp_path, displacement, wrench, measured, simulated
):
    text = SHARED.replace("displacement = { sign = -1 }", f"displacement = {{ {displacement} }}")
    file = block_problem(tmp_path, text.replace("sign = -1, symmetry = 4", wrench))
    columns = measured
    rows = "0,0,0\n100,0.02,0.001\n200,0.04,0.002\n300,0.06,0.003\n"
    for name in ("first", "second"):
        (tmp_path / f"{name}.csv").write_text(f"{columns}\n{rows}")
    problem = Problem.read(file, simulation=True)
    write_data(problem, tmp_path / "twin")
    for name in ("first", "second"):
        assert (tmp_path / "twin" / f"{name}.csv").read_text().splitlines()[0] == simulated
    for name in ("block.vtu", "problem.toml"):
        shutil.copy(tmp_path / name, tmp_path / "twin")
    again = Problem.read(tmp_path / "twin" / "problem.toml", simulation=True)
    for ours, theirs in zip(again.experiments, problem.experiments, strict=True):
        np.testing.assert_allclose(
            ours.grasps[1].poses.positions_m, theirs.grasps[1].poses.positions_m, atol=1e-12
        )
        (sensed,) = simulate(theirs, problem.parameters).wrenches
        np.testing.assert_allclose(ours.wrenches[0].values[:, 2], sensed[:, 2], rtol=1e-9)


def test_a_table_with_times_in_seconds_has_the_noise_of_its_force(tmp_path):
    file = block_problem(tmp_path, SHARED.replace("sigma_n = 0.04", 'sigma_n = "sd_mn"'))
    rows = "".join(f"{0.1 * k},{1e-4 * k},{2 * k},{k + 1}\n" for k in range(5))
    for name in ("first", "second"):
        (tmp_path / f"{name}.csv").write_text(f"t_s,displacement_m,force_n,sd_mn\n{rows}")
    problem = Problem.read(file)
    sensed = problem.experiments[1].wrenches[0]
    np.testing.assert_allclose(sensed.sample_sigmas[:, 2], 1e-3 * np.arange(1, 6) / 4)
    write_data(problem, tmp_path / "twin")
    for name in ("block.vtu", "problem.toml"):
        shutil.copy(tmp_path / name, tmp_path / "twin")
    again = Problem.read(tmp_path / "twin" / "problem.toml").experiments[1].wrenches[0]
    np.testing.assert_allclose(again.sample_sigmas, sensed.sample_sigmas)


def test_one_table_of_two_recordings_is_not_simulated(tmp_path):
    file = block_problem(tmp_path, SHARED.replace("second.csv", "first.csv"))
    with pytest.raises(
        InputError, match=r"'second': file: the file first.csv is read by 'first' too"
    ):
        write_data(Problem.read(file, simulation=True), tmp_path / "twin")
    assert not (tmp_path / "twin").exists()


def test_faces_are_found_without_any_length():
    mesh = box_mesh((0.02, 0.03, 0.04), (2, 2, 2), origin_m=(0.01, 0.0, -0.5))
    nodes = ElementNodes.corners(mesh)
    faces = ((Face("top"), 2, -0.46, 9), (Face("bottom"), 2, -0.5, 9), (Face("side_x"), 0, 0.01, 3))
    for face, axis, place, count in faces:
        chosen = mesh.points_m[face.resolve(nodes)]
        np.testing.assert_allclose(chosen[:, axis], place)
        assert len(chosen) == count
    assert len(Face("side_x").resolve_faces(mesh)) == 8
    with pytest.raises(InputError, match="the face top selects nodes, and no cells"):
        Face("top").resolve_cells(mesh)
    with pytest.raises(InputError, match="expected 'top', 'bottom', 'side_x' or 'side_y'"):
        Face("left")  # pyright: ignore[reportArgumentType]


def test_a_machines_own_file_takes_the_examples_place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_command("new", "mine", "--kind", "compression")
    file = tmp_path / "mine" / "run_1.csv"
    ours = Problem.read("mine/problem.toml", simulation=True).experiments[0].grasps[1].wrench
    text = file.read_text().replace("Displacement (mm),Force (N)", "Standardweg (mm),Kraft (N)")
    text = "Probe 7\nWerkstoff,Silikon\n\n" + text
    file.write_text(text.replace(",", ";").replace(".", ","), encoding="cp1252")
    again = Problem.read("mine/problem.toml", simulation=True).experiments[0].grasps[1].wrench
    assert ours is not None
    assert again is not None
    np.testing.assert_array_equal(again.values, ours.values)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (
            "edge_length_m = 1e-5",
            "object.edge_length_m: with this length the mesh has 4.5e+11 elements; expected at most",
        ),
        ("mass_kg = 1.0", "edge_length_m is missing; expected the length"),
        ('edge_length_m = 0.01\nmesh = "a.vtu"', "found mesh and cylinder; expected exactly one"),
    ],
)
def test_a_shape_that_cannot_be_meshed_is_refused(tmp_path, shape, words):
    cylinder = f"cylinder = {{ diameter_m = 0.05, height_m = 0.03 }}\n{shape}"
    text = SHARED.replace('mesh = "block.vtu"', cylinder)
    with pytest.raises(InputError) as caught:
        Problem.read(block_problem(tmp_path, text))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (
            "cylinder = { diameter_m = 0.05, height_m = 24 }",
            "object.cylinder.height_m: found 24 m; expected at most 10 m, likely 0.024",
        ),
        ("box_m = [0.02, 24, 0.02]", "object.box_m: found 24 m; expected at most 10 m, likely"),
    ],
)
def test_a_length_in_millimetres_is_named_instead_of_too_many_edges(tmp_path, shape, words):
    text = SHARED.replace('mesh = "block.vtu"', f"{shape}\nedge_length_m = 0.0005")
    with pytest.raises(InputError) as caught:
        Problem.read(block_problem(tmp_path, text))
    assert words in str(caught.value)
    assert "edge_length_m" not in str(caught.value)


def test_a_quarter_of_a_cylinder_has_a_quarter_of_its_volume():
    whole, quarter = (cylinder_of_edge(0.05, 0.03, 0.011, part) for part in (False, True))
    assert whole.volume_m3 == pytest.approx(np.pi * 0.025**2 * 0.03, rel=1e-9)
    assert quarter.volume_m3 == pytest.approx(whole.volume_m3 / 4, rel=1e-9)
    assert quarter.points_m[:, :2].min() == 0.0


def test_a_platen_that_passes_the_other_one_is_refused(tmp_path: Path):
    """Displacements in mm that are read as cm."""
    create_problem(tmp_path / "bench", kind="compression")
    file = tmp_path / "bench" / "run_1.csv"
    file.write_text(file.read_text().replace("(mm)", "(cm)"))
    message = (
        r"mm nearer along z than in the undeformed body, where 30 mm are between them; expected"
    )
    with pytest.raises(InputError, match=message):
        Problem.read(tmp_path / "bench" / "problem.toml")
