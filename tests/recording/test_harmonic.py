"""Harmonic tests (DMA): storage and loss modulus over frequency, also at other temperatures."""

from __future__ import annotations

import json

import numpy as np
import pytest
from kit.problem_files import run_command, write_problem

import collocation_sysid as cs
from collocation_sysid.features.measurements import prediction_error
from collocation_sysid.recording.specimen import is_harmonic
from collocation_sysid.result.pictures.stress_strain import harmonic_picture
from collocation_sysid.runs.check.measurements import check_recording

YOUNG_PA, SHARES, TAU_S = 2e5, np.array([0.5, 2.0]), np.array([10.0, 0.1])
MEMORY = {"a.share": 0.5, "a.tau_s": 10.0, "b.share": 2.0, "b.tau_s": 0.1}
UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


def complex_modulus_pa(frequency_hz, shift=1.0, long_term_pa=YOUNG_PA):
    """Storage and loss modulus (F,) of the branches, of relaxation times multiplied by a shift."""
    w = 2 * np.pi * frequency_hz[:, None] * TAU_S * shift
    modulus = long_term_pa * (1 + (SHARES * 1j * w / (1 + 1j * w)).sum(axis=1))
    return modulus.real, modulus.imag


def noisy_test(frequency_hz, rng, factor=1.0, shift=""):
    storage, loss = complex_modulus_pa(frequency_hz, factor)
    sigma = 0.01 * np.hypot(storage, loss)
    noise = sigma * rng.normal(size=(2, len(frequency_hz)))
    return cs.Specimen.harmonic(
        frequency_hz, storage + noise[0], np.abs(loss + noise[1]), 0.01, shift=shift
    )


@pytest.mark.parametrize(
    ("test", "long_term"),
    [
        ("uniaxial", {"young_pa": YOUNG_PA, "poisson": 0.4}),
        pytest.param("simple-shear", {"mu_pa": YOUNG_PA, "poisson": 0.4}, marks=pytest.mark.long),
    ],
)
def test_a_steady_oscillation_has_the_complex_modulus_of_the_branches(test, long_term):
    frequency_hz = np.array([1.0, 0.005, 100.0])
    storage, loss = complex_modulus_pa(frequency_hz)
    specimen = cs.Specimen.harmonic(frequency_hz, storage, loss, 0.01, test)
    experiment = specimen.experiment("neo-hookean", "dma", prony=("a", "b"))
    seen = cs.simulate(experiment, long_term | MEMORY | UNDAMPED).custom_sensor_values[0][:, 0]
    np.testing.assert_allclose(seen[1:], specimen.stress_pa[1:], rtol=5e-4)


def test_relaxation_times_are_those_of_the_temperature():
    moduli = complex_modulus_pa(np.ones(1))
    long_term = {"young_pa": YOUNG_PA, "poisson": 0.4} | MEMORY | UNDAMPED
    for shift, difference_k, values, factor in (
        ("warm", 0.0, {"warm.log10_shift": -2.0}, 1e-2),
        ("", 20.0, {"wlf_c1": 10.0, "wlf_c2_k": 80.0}, 1e-2),
        ("", 0.0, {}, 1.0),
    ):
        specimen = cs.Specimen.harmonic(
            np.ones(1), *moduli, 0.01, shift=shift, temperature_difference_k=difference_k
        )
        body = specimen.experiment(prony=("a", "b")).body
        theta = dict(zip(body.constants, body.theta_from_values(long_term | values), strict=True))
        assert theta["a.tau_s"] == pytest.approx(10.0 * factor)
        assert theta["b.tau_s"] == pytest.approx(0.1 * factor)
        assert set(values) <= set(body.parameter_names)


@pytest.mark.long
def test_tests_at_two_temperatures_determine_branches_and_shift():
    rng = np.random.default_rng(0)
    frequency_hz = np.geomspace(1e-3, 1e3, 19)
    cold = noisy_test(frequency_hz, rng)
    warm = noisy_test(frequency_hz, rng, 0.01, shift="warm")
    problem = cs.Problem(
        [
            cold.experiment("neo-hookean", "cold", prony=("a", "b")),
            warm.experiment("neo-hookean", "warm", prony=("a", "b")),
        ],
        {
            "young_pa": cs.Unknown(),
            "poisson": 0.4999,
            "a.share": cs.Unknown(),
            "a.tau_s": cs.Unknown(3.0),
            "b.share": cs.Unknown(),
            "b.tau_s": cs.Unknown(0.03),
            "warm.log10_shift": cs.Unknown(prior=(0.0, 3.0)),
        },
    )
    found = cs.solve(problem)
    assert found.status.converged
    assert found.parameters["young_pa"] == pytest.approx(YOUNG_PA, rel=0.01)
    assert found.parameters["warm.log10_shift"] == pytest.approx(-2.0, abs=0.02)
    for name, value in MEMORY.items():
        assert found.parameters[name] == pytest.approx(value, rel=0.03)
    assert found.history[-1].loss < 4 * len(frequency_hz)


@pytest.mark.long
def test_a_harmonic_test_of_a_liquid_determines_its_instantaneous_modulus():
    instantaneous_pa, tau_s = 2e5, 1.5
    w = 2 * np.pi * np.geomspace(1e-3, 10.0, 9) * tau_s
    modulus = instantaneous_pa * 1j * w / (1 + 1j * w)
    noise = 0.01 * np.random.default_rng(0).normal(size=(2, 9)) * np.abs(modulus)
    specimen = cs.Specimen.harmonic(
        w / (2 * np.pi * tau_s),
        np.abs(modulus.real + noise[0]),
        np.abs(modulus.imag + noise[1]),
        0.01,
    )
    parameters = {
        "young_pa": cs.Unknown(0.1, lower=1e-3),
        "poisson": 0.4999,
        "b.share": 1e6,
        "b.tau_s": cs.Unknown(),
    }
    problem = cs.Problem([specimen.experiment("neo-hookean", "dma", prony=("b",))], parameters)
    found = cs.solve(problem)
    assert found.status.converged
    assert 1e6 * found.parameters["young_pa"] == pytest.approx(instantaneous_pa, rel=0.01)
    assert found.parameters["b.tau_s"] == pytest.approx(tau_s, rel=0.02)


@pytest.mark.long
def test_too_few_branches_are_the_reason():
    frequency_hz = np.geomspace(1e-2, 10.0, 9)
    specimen = cs.Specimen.harmonic(frequency_hz, *complex_modulus_pa(frequency_hz), 0.01)
    unknown = {name: cs.Unknown() for name in ("young_pa", "a.share")}
    parameters = unknown | {"poisson": 0.4999, "a.tau_s": cs.Unknown(3.0)}
    run = cs.run(cs.Problem([specimen.experiment("neo-hookean", "dma", prony=("a",))], parameters))
    assert [each.code for each in run.trust.concerns] == ["specimen/branches"]
    # Beside moduli at small strain, tests to larger strains are no advice.
    assert not any("up to the same strain" in note for note in run.notes)


def test_a_check_counts_the_frequencies_of_each_modulus():
    specimen = cs.Specimen.harmonic([0.1, 1.0, 10.0], [1e5, 1e5, 2e5], [1e3, 2e3, 3e3], 0.01)
    recording = check_recording(specimen.experiment("neo-hookean", "dma", prony=("a",)), None)
    assert recording.frames == 3
    assert recording.instruments == ("storage modulus", "loss modulus")


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        (([0.0, 1.0], [2.0, 2.0], [1.0, 1.0], 0.01), "positive"),
        (([1.0, 2.0], [2.0, -2.0], [1.0, 1.0], 0.01), "row 2"),
        (([1.0, 2.0], [2.0, np.nan], [1.0, np.nan], 0.01), "row 2"),
    ],
)
def test_other_tables_are_refused(arguments, found):
    with pytest.raises(cs.InputError, match=found):
        cs.Specimen.harmonic(*arguments)
    with pytest.raises(cs.InputError, match="planar"):
        cs.Specimen.harmonic([1.0], [2.0], [1.0], 0.01, "planar")


def test_a_material_without_memory_and_a_temperature_stated_twice_are_refused():
    specimen = cs.Specimen.harmonic([1.0], [2.0], [1.0], 0.01)
    with pytest.raises(cs.InputError, match="memory"):
        specimen.experiment()
    with pytest.raises(cs.InputError, match="expected one of them"):
        cs.Specimen.harmonic([1.0], [2.0], [1.0], 0.01, shift="a", temperature_difference_k=1.0)
    body = cs.Specimen.harmonic([1.0], [2.0], [1.0], 0.01, shift="a").experiment(prony=("b",)).body
    long_term = {"young_pa": 1.0, "poisson": 0.4, "b.share": 1.0, "b.tau_s": 1.0}
    with pytest.raises(cs.InputError, match=r"a\.log10_shift"):
        body.theta_from_values(long_term | UNDAMPED)


# Files ----------------------------------------------------------------------------------------

FREQUENCY_HZ = np.geomspace(0.01, 100.0, 9)
STORAGE_PA, LOSS_PA = complex_modulus_pa(FREQUENCY_HZ)


def harmonic_file(folder, columns, lines=("relative_sigma = 0.01",), test="harmonic", more=""):
    rows = np.column_stack([*columns.values()])
    table = [",".join(columns), *(",".join(f"{x:.12g}" for x in row) for row in rows)]
    (folder / "dma.csv").write_text("\n".join(table))
    (folder / "problem.toml").write_text(
        '[object]\nmaterial = "linear"\n[[object.prony]]\nname = "a"\n[[object.prony]]\n'
        'name = "b"\n[parameters]\nyoung_pa = {}\npoisson = 0.45\n"a.share" = {}\n'
        f'"a.tau_s" = {{ guess = 3.0 }}\n"b.share" = {{}}\n"b.tau_s" = {{ guess = 0.03 }}\n{more}'
        f'[[experiment]]\nname = "dma"\nkind = "specimen"\ntest = "{test}"\nfile = "dma.csv"\n'
        + "\n".join(lines)
    )
    return folder / "problem.toml"


@pytest.mark.parametrize(
    ("test", "kind", "columns"),
    [
        (
            *("harmonic", "uniaxial"),
            {
                "Angular frequency (rad/s)": 2 * np.pi * FREQUENCY_HZ,
                "Storage modulus (MPa)": STORAGE_PA / 1e6,
                "Loss modulus (MPa)": LOSS_PA / 1e6,
                "Tan delta": LOSS_PA / STORAGE_PA,
            },
        ),
        (
            *("shear-harmonic", "simple-shear"),
            {
                "frequency_hz": FREQUENCY_HZ,
                "storage_pa": STORAGE_PA,
                "Loss factor": LOSS_PA / STORAGE_PA,
            },
        ),
    ],
)
def test_a_file_of_moduli_is_read_as_in_python(tmp_path, test, kind, columns):
    (read,) = cs.Problem.read(harmonic_file(tmp_path, columns, test=test)).experiments
    stated = cs.Specimen.harmonic(FREQUENCY_HZ, STORAGE_PA, LOSS_PA, 0.01, kind)
    stated = stated.experiment("linear", prony=("a", "b"))
    (found,), (expected,) = read.readings, stated.readings
    assert read.specimen.test == kind
    assert read.body.memory.oscillates
    np.testing.assert_allclose(read.t_s, stated.t_s, rtol=1e-9)
    np.testing.assert_allclose(found.measured_values, expected.measured_values, rtol=1e-9)
    np.testing.assert_allclose(found.sigma, expected.sigma, rtol=1e-9)


def test_columns_of_other_names_are_stated(tmp_path):
    columns = {"f (Hz)": FREQUENCY_HZ, "E' (Pa)": STORAGE_PA, "E'' (Pa)": LOSS_PA}
    with pytest.raises(cs.InputError) as fault:
        cs.Problem.read(harmonic_file(tmp_path, columns))
    assert 'frequency = "f (Hz)"' in str(fault.value)
    stated = 'columns = { frequency = "f (Hz)", storage = "E\' (Pa)", loss = "E\'\' (Pa)" }'
    file = harmonic_file(tmp_path, columns, ["relative_sigma = 0.01", stated])
    assert len(cs.Problem.read(file).experiments[0].t_s) == 2 * len(FREQUENCY_HZ) + 1


TABLE = {"frequency (Hz)": FREQUENCY_HZ, "storage (Pa)": STORAGE_PA, "loss (Pa)": LOSS_PA}


@pytest.mark.parametrize(
    ("columns", "lines", "expected"),
    [
        (TABLE, ["sigma_pa = 20"], "expected relative_sigma"),
        (TABLE, [], "no relative_sigma"),
        (TABLE, ["relative_sigma = 0.01", "window_s = [0, 1]"], "found window_s with"),
        (TABLE | {"loss (Pa)": -LOSS_PA}, ["relative_sigma = 0.01"], "line 2: the loss is"),
        (
            {"storage (Pa)": STORAGE_PA, "loss (Pa)": LOSS_PA},
            ["relative_sigma = 0.01"],
            "frequency",
        ),
        (TABLE, ["relative_sigma = 0.01", 'shift = "warm"'], "warm.log10_shift is missing"),
        (TABLE, ["relative_sigma = 0.01", 'shift = "a b"'], "shift"),
    ],
)
def test_another_table_of_moduli_is_refused(tmp_path, columns, lines, expected):
    with pytest.raises(cs.InputError) as fault:
        cs.Problem.read(harmonic_file(tmp_path, columns, lines))
    assert expected in str(fault.value)


def test_a_shift_in_a_file_is_a_parameter(tmp_path):
    lines = ["relative_sigma = 0.01", 'shift = "warm"']
    file = harmonic_file(tmp_path, TABLE, lines, more='"warm.log10_shift" = {}\n')
    problem = cs.Problem.read(file)
    assert "warm.log10_shift" in problem.parameters.names
    assert problem.experiments[0].body.parts[0].shift.name == "warm"


def test_a_harmonic_test_of_an_elastic_material_is_refused_with_its_remedy(tmp_path):
    file = harmonic_file(tmp_path, TABLE)
    lines = [x for x in file.read_text().splitlines() if '"a.' not in x and '"b.' not in x]
    text = "\n".join(lines).replace('[[object.prony]]\nname = "a"\n', "")
    file.write_text(text.replace('[[object.prony]]\nname = "b"\n', ""))
    with pytest.raises(cs.InputError, match="prony"):
        cs.Problem.read(file)


MIXED_TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "b.share": 0.8, "b.tau_s": 0.05}


def mixed_file(folder):
    """A swing, a table of G′ and G″ of the same foam, and their simulated data."""
    write_problem(folder, {"swing": 12})
    rows = "\n".join(f"{f:.6g},1,1" for f in np.geomspace(0.1, 30.0, 9))
    (folder / "dma.csv").write_text(
        "frequency (Hz),storage modulus (kPa),loss modulus (kPa)\n" + rows
    )
    file = folder / "problem.toml"
    text = file.read_text().replace("[parameters]", '[[object.prony]]\nname = "b"\n[parameters]')
    for line in text.splitlines():
        if line.startswith("gamma_r_s"):
            text = text.replace(line, "gamma_r_s = 0.0\nb.share = {}\nb.tau_s = {}")
    text = text.replace('method = "interior-point"\n', "")
    text += (
        '\n[[experiment]]\nname = "dma"\nkind = "specimen"\ntest = "shear-harmonic"\n'
        'file = "dma.csv"\nrelative_sigma = 0.01\n'
    )
    file.write_text(text)
    values = [f"parameters.{name}={value}" for name, value in MIXED_TRUTH.items()]
    settings = [
        word for each in [*values, "parameters.gamma_m_1_s=1.0"] for word in ("--set", each)
    ]
    made = run_command(
        "simulate",
        file,
        "--out",
        folder / "made",
        "--noise-m",
        "1e-4",
        "--noise-own",
        "1",
        *settings,
    )
    assert made.code == 0, made.err
    for name in ("dma.csv", "swing_markers.csv"):
        (folder / name).write_text((folder / "made" / name).read_text())
    return file


@pytest.mark.long
def test_a_table_and_a_swing_of_one_body_are_one_problem(tmp_path):
    file = mixed_file(tmp_path)
    done = run_command("solve", file, "--out", tmp_path / "run")
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "run" / "result.json").read_text())["parameters"]
    for name, relative in {"mu_pa": 0.05, "b.share": 0.15, "b.tau_s": 0.15}.items():
        lower, upper = found[name]["combined95"]
        assert lower < MIXED_TRUTH[name] < upper
        assert found[name]["value"] == pytest.approx(MIXED_TRUTH[name], rel=relative)
    assert found["lambda_pa"]["optimum"] == pytest.approx(MIXED_TRUTH["lambda_pa"], rel=0.2)


def test_differences_of_a_harmonic_test_are_those_of_its_moduli():
    storage, loss = complex_modulus_pa(FREQUENCY_HZ)
    specimen = cs.Specimen.harmonic(FREQUENCY_HZ, storage, loss, 0.01)
    experiment = specimen.experiment(prony=("a", "b"))
    measured = experiment.readings[0].measured_values
    predicted = measured.copy()
    predicted[1::2] *= 1.1
    predicted[2::2] *= 0.8
    found = prediction_error(experiment, [predicted]).reading_rms
    assert found is not None
    assert found["storage modulus"] == pytest.approx(0.1 * np.sqrt(np.mean(storage**2)))
    assert found["loss modulus"] == pytest.approx(0.2 * np.sqrt(np.mean(loss**2)))
    assert len(found) == 2


def test_the_picture_of_a_harmonic_test_has_its_moduli_over_frequency():
    storage, loss = complex_modulus_pa(FREQUENCY_HZ)
    specimen = cs.Specimen.harmonic(FREQUENCY_HZ, storage, loss, 0.01)
    assert is_harmonic(specimen.strain)
    assert not is_harmonic(cs.Specimen.relaxation([1.0, 2.0], [2.0, 1.0], 0.1).strain)
    assert not is_harmonic(np.linspace(0.0, 0.1, 5))
    stress = specimen.stress_pa
    samples = np.column_stack([specimen.t_s, stress, stress, np.full_like(stress, np.nan)])
    axes, _ = harmonic_picture(specimen.strain, specimen.t_s, samples).axes
    lines = {line.get_label(): line for line in axes.lines}
    np.testing.assert_allclose(lines["storage, measured"].get_ydata(), storage / 1e3)
    np.testing.assert_allclose(lines["loss, measured"].get_ydata(), loss / 1e3)
    np.testing.assert_allclose(lines["loss, measured"].get_xdata(), FREQUENCY_HZ)


@pytest.mark.parametrize(
    ("storage", "loss"),
    [("{}′ (Pa)", "{}″ (Pa)"), ("{}' (Pa)", "{}'' (Pa)"), ("{}’ [Pa]", '{}" [Pa]')],
)
@pytest.mark.parametrize(("symbol", "test"), [("G", "shear-harmonic"), ("E", "harmonic")])
def test_symbols_of_moduli_are_recognised(tmp_path, storage, loss, symbol, test):
    columns = {"ω (rad/s)": 2 * np.pi * FREQUENCY_HZ, storage.format(symbol): STORAGE_PA}
    named = columns | {loss.format(symbol): LOSS_PA, f"|{symbol}*| (Pa)": LOSS_PA, "δ (°)": LOSS_PA}
    problems = [
        cs.Problem.read(harmonic_file(tmp_path, each, test=test))
        for each in (named, columns | {"tan(δ)": LOSS_PA / STORAGE_PA})
    ]
    (first,), (second,) = (each.experiments[0].readings for each in problems)
    np.testing.assert_allclose(first.measured_values, second.measured_values, rtol=1e-9)
    assert not any("understood" in note for each in problems for note in each.notes)
    other = {"shear-harmonic": "harmonic", "harmonic": "shear-harmonic"}[test]
    with pytest.raises(cs.InputError, match=f'expected test = "{test}"'):
        cs.Problem.read(harmonic_file(tmp_path, named, test=other))


@pytest.mark.parametrize("column", ["|G*| (Pa)", "G* (kPa)", "complex modulus (Pa)"])
def test_a_complex_modulus_is_called_another_quantity(tmp_path, column):
    columns = {"frequency (Hz)": FREQUENCY_HZ, column: STORAGE_PA, "tan δ": LOSS_PA / STORAGE_PA}
    with pytest.raises(cs.InputError) as fault:
        cs.Problem.read(harmonic_file(tmp_path, columns, test="shear-harmonic"))
    assert f"{column} is not read, because the word 'complex'" in str(fault.value)
