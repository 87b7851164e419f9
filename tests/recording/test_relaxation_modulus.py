"""Tables of the relaxation modulus E(t) and G(t)."""

from __future__ import annotations

import numpy as np
import pytest
from kit.problem_files import run_command

import collocation_sysid as cs
from collocation_sysid.features.measurements import prediction_error, stated_sigmas
from collocation_sysid.recording.specimen_files import specimen_strains
from collocation_sysid.result.pictures.stress_strain import relaxation_picture

T_S = np.geomspace(0.01, 30.0, 25)
LONG_TERM, SHARE, TAU_S = 2e5, 0.5, 1.5


@pytest.mark.long
@pytest.mark.parametrize(("test", "modulus"), [("uniaxial", "young_pa"), ("simple-shear", "mu_pa")])
def test_a_relaxation_modulus_determines_the_constants_of_the_memory(test, modulus):
    sigma_pa = 100.0
    exact_pa = LONG_TERM * (1 + SHARE * np.exp(-T_S / TAU_S))
    noise_pa = sigma_pa * np.random.default_rng(0).normal(size=len(T_S))
    specimen = cs.Specimen.relaxation(T_S, exact_pa + noise_pa, sigma_pa, test)
    problem = cs.Problem(
        [specimen.experiment("neo-hookean", "held", prony=("b",))],
        {
            modulus: cs.Unknown(),
            "poisson": 0.4999,
            "b.share": cs.Unknown(),
            "b.tau_s": cs.Unknown(),
        },
    )
    found = cs.solve(problem)
    assert found.status.converged
    assert found.parameters[modulus] == pytest.approx(LONG_TERM, rel=2e-3)
    assert found.parameters["b.share"] == pytest.approx(SHARE, rel=5e-3)
    assert found.parameters["b.tau_s"] == pytest.approx(TAU_S, rel=5e-3)
    assert found.history[-1].loss < 2 * len(T_S)


@pytest.mark.parametrize(
    ("t_s", "test", "found"),
    [
        ([0.0, 1.0], "uniaxial", "positive"),
        ([2.0, 1.0], "uniaxial", "increase"),
        ([1.0, 2.0], "planar", "planar"),
    ],
)
def test_other_times_and_tests_are_refused(t_s, test, found):
    with pytest.raises(cs.InputError, match=found):
        cs.Specimen.relaxation(t_s, [2.0, 1.0], 0.1, test)


def test_differences_and_picture_are_those_of_the_modulus():
    experiment = cs.Specimen.relaxation(T_S, MODULUS_PA, 20.0).experiment("linear")
    measured = experiment.readings[0].measured_values
    found = prediction_error(experiment, [1.1 * measured]).reading_rms
    expected_pa = 0.1 * np.sqrt(np.mean(MODULUS_PA**2))
    assert found == {"relaxation modulus": pytest.approx(expected_pa)}
    stated = stated_sigmas(experiment)
    assert stated["reading_sigma"] == {"relaxation modulus": pytest.approx(20.0)}
    assert stated["reading_unit"] == {"relaxation modulus": "Pa"}
    strain, _ = specimen_strains(experiment)
    samples = np.column_stack([experiment.t_s, measured, measured, measured])
    axes, _ = relaxation_picture(strain, experiment.t_s, samples).axes
    assert axes.get_ylabel() == "relaxation modulus [kPa]"
    np.testing.assert_allclose(np.asarray(axes.lines[0].get_xydata()), np.c_[T_S, MODULUS_PA / 1e3])


def relaxation_file(folder, test, columns, lines=("sigma_pa = 20",)):
    rows = np.column_stack([*columns.values()])
    table = [",".join(columns), *(",".join(f"{x:.12g}" for x in row) for row in rows)]
    (folder / "relax.csv").write_text("\n".join(table))
    (folder / "problem.toml").write_text(
        '[object]\nmaterial = "linear"\n[[object.prony]]\nname = "b"\n'
        '[parameters]\nyoung_pa = {}\npoisson = 0.45\n"b.share" = {}\n"b.tau_s" = {}\n'
        f'[[experiment]]\nname = "relax"\nkind = "specimen"\ntest = "{test}"\nfile = "relax.csv"\n'
        + "\n".join(lines)
    )
    return folder / "problem.toml"


MODULUS_PA = 2e4 * (1 + 0.5 * np.exp(-T_S / 2.0))


@pytest.mark.parametrize(
    ("test", "kind", "header"),
    [
        ("relaxation", "uniaxial", "relaxation modulus (kPa)"),
        ("relaxation", "uniaxial", "Relaxationsmodul (kPa)"),
        ("shear-relaxation", "simple-shear", "modulus (kPa)"),
    ],
)
def test_a_file_is_read_as_in_python(tmp_path, test, kind, header):
    columns = {"time (s)": T_S, header: MODULUS_PA / 1e3, "sd (Pa)": 10 + T_S}
    file = relaxation_file(tmp_path, test, columns, ['sigma_pa = "sd (Pa)"'])
    (read,) = cs.Problem.read(file).experiments
    stated = cs.Specimen.relaxation(T_S, MODULUS_PA, 10 + T_S, kind).experiment("linear")
    (found,), (expected,) = read.readings, stated.readings
    assert read.specimen.test == kind
    np.testing.assert_allclose(read.t_s, stated.t_s, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.measured_values, expected.measured_values, rtol=1e-9)
    np.testing.assert_allclose(found.sample_sigmas, expected.sample_sigmas, rtol=1e-9)


@pytest.mark.parametrize(
    ("columns", "lines", "expected"),
    [
        ({"time (s)": T_S - T_S[0], "modulus (Pa)": MODULUS_PA}, [], "the time is 0 s"),
        ({"modulus (Pa)": MODULUS_PA}, [], "expected t_s"),
        ({"time (s)": T_S, "stress (Pa)": MODULUS_PA}, [], "modulus_pa"),
        ({"time (s)": T_S, "storage modulus (Pa)": MODULUS_PA}, [], "modulus_pa"),
        ({"time (s)": T_S, "modulus (Pa)": MODULUS_PA}, ["length_m = 0.1"], "found length_m with"),
    ],
)
def test_another_table_is_refused(tmp_path, columns, lines, expected):
    file = relaxation_file(tmp_path, "relaxation", columns, ["sigma_pa = 20", *lines])
    with pytest.raises(cs.InputError) as fault:
        cs.Problem.read(file)
    assert expected in str(fault.value)


@pytest.mark.long
def test_a_simulated_file_has_times_and_modulus(tmp_path):
    columns = {"t_s": T_S, "modulus_pa": MODULUS_PA}
    file = relaxation_file(tmp_path, "relaxation", columns)
    text = file.read_text()
    for name, value in (("young_pa", 2e4), ('"b.share"', 0.5), ('"b.tau_s"', 2.0)):
        text = text.replace(f"{name} = {{}}", f"{name} = {value}")
    file.write_text(text)
    done = run_command("simulate", file, "--out", tmp_path / "made")
    assert done.code == 0, done.err
    header, *rows = (tmp_path / "made" / "relax.csv").read_text().splitlines()
    assert header == "t_s,modulus_pa"
    assert len(rows) == len(T_S)
