"""Standard deviations of each sample, of every kind of measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problem_files import replace_text
from kit.problems import hung_cube, measured

import collocation_sysid as cs
from collocation_sysid.features.measurements import instrument_misfits
from collocation_sysid.problem.loading import read_problem_file
from collocation_sysid.problem.specimen_reader import layout_from_section
from collocation_sysid.recording.marker_files import read_markers
from collocation_sysid.recording.specimen_files import specimen_columns
from collocation_sysid.result.synthesis import Recipe, write_data

CUBE = measured(hung_cube())
COUNT = len(CUBE.t_s)
SIGMAS = np.linspace(0.5, 2.0, COUNT)


def markers():
    noise = 1e-3 * SIGMAS[:, None] * np.ones(len(CUBE.markers.names))
    return replace(CUBE, markers=replace(CUBE.markers, sigma_m=noise))


def wrench():
    force = cs.Wrench(CUBE.t_s, np.ones((COUNT, 3)), sigma_n=SIGMAS)
    return replace(CUBE, grasps=[replace(CUBE.grasps[0], wrench=force)], markers=None)


def custom_sensor():
    def height(at):
        return at.position_m[2, 0]

    gauge = cs.Gauge("height", height, CUBE.t_s, np.ones(COUNT), SIGMAS, [[0, 0, 0]])
    return replace(CUBE, readings=[gauge], markers=None)


def specimen():
    strain = np.linspace(0.1, 0.5, COUNT)
    return cs.Specimen("uniaxial", strain, 1.0 + 0 * strain, SIGMAS).experiment()


@pytest.fixture(params=[markers, wrench, custom_sensor, specimen])
def experiment(request):
    return request.param()


def the_measurement(experiment):
    return next(each for each in experiment.measurements if each.has_samples())


def test_an_array_is_stored_as_median_and_ratios(experiment):
    measurement = the_measurement(experiment)
    sigmas = measurement.sample_sigmas
    assert sigmas.shape == measurement.measured_values.shape
    seen = np.isfinite(measurement.measured_values)
    by_row = sigmas / sigmas[:1]
    assert by_row[seen] == pytest.approx(np.broadcast_to(SIGMAS[:, None] / 0.5, by_row.shape)[seen])
    assert measurement.value_sigmas[0] == pytest.approx(np.median(sigmas[:, 0]))


def test_misfits_are_those_of_each_sample(experiment):
    measurement = the_measurement(experiment)
    values = [
        each.measured_values + (each.sample_sigmas if each is measurement else 0.0)
        for each in experiment.measurements
    ]
    (misfit,) = [each for each in instrument_misfits(experiment, values) if each.sigmas > 0]
    assert misfit.sigmas == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [
        (np.ones(3), "sigma of the reading 'height' has the shape (3,)"),
        (np.r_[0.0, np.ones(9)], "is 0 in row 1; expected more than 0"),
        (np.r_[np.ones(9), np.nan], "is nan in row 10; expected more than 0"),
    ],
)
def test_noise_that_is_none_is_refused(sigma, expected):
    def height(at):
        return at.position_m[2, 0]

    t_s = np.arange(10.0)
    with pytest.raises(cs.InputError) as fault:
        cs.Gauge("height", height, t_s, np.ones(10), sigma, [[0, 0, 0]])
    assert expected in str(fault.value)


def test_a_missing_value_needs_no_noise():
    values, sigmas = np.ones(5), np.r_[np.nan, np.ones(4)]
    values[0] = np.nan
    wrench = cs.Wrench(np.arange(5.0), values[:, None] * np.ones(3), sigma_n=sigmas)
    assert wrench.sigma_n == 1.0
    assert (wrench.sample_sigmas == 1.0).all()


def test_ratios_stay_if_the_noise_is_scaled_and_follow_the_samples():
    force = wrench().grasps[0].wrench
    larger = replace(force, sigma_n=2 * force.sigma_n)
    assert larger.sample_sigmas[:, :3] == pytest.approx(2 * force.sample_sigmas[:, :3])
    part = force.within(force.t_s[3:7], 1)
    assert part.sample_sigmas[:, 0] == pytest.approx(SIGMAS[3:7])


STRAIN = np.linspace(0.01, 0.2, 20)
NOISES_PA = np.where(np.arange(20) % 2, 10.0, 200.0)
STRESS_PA = 1e4 * STRAIN + NOISES_PA * np.random.default_rng(1).normal(size=20)


def specimen_problem(folder, columns, lines, test="uniaxial", top=""):
    rows = np.column_stack([*columns.values()])
    table = [",".join(columns), *(",".join(f"{x:.12g}" for x in row) for row in rows)]
    (folder / "pull.csv").write_text("\n".join(table))
    (folder / "problem.toml").write_text(
        f'[object]\nmaterial = "linear"\n{top}[parameters]\nyoung_pa = {{}}\npoisson = 0.3\n'
        + '[[experiment]]\nname = "pull"\nkind = "specimen"\n'
        + f'test = "{test}"\nfile = "pull.csv"\n'
        + "\n".join(lines)
    )
    return cs.Problem.read(folder / "problem.toml")


EXACT = ['strain_zero = "none"', 'area_error = "none"']


def test_the_estimate_weighs_each_sample(tmp_path):
    """Least squares with a weight for each row, which a linear law has in closed form."""
    columns = {"strain (1)": STRAIN, "stress (Pa)": STRESS_PA, "stress sd (kPa)": NOISES_PA / 1e3}
    read = specimen_problem(tmp_path, columns, ['sigma_pa = "stress sd (kPa)"', *EXACT])
    answer = cs.solve(read)
    weights = NOISES_PA**-2
    expected = np.sum(weights * STRAIN * STRESS_PA) / np.sum(weights * STRAIN**2)
    assert answer.parameters["young_pa"] == pytest.approx(expected, rel=1e-6)


def test_a_specimen_has_the_column_that_its_noise_names(tmp_path):
    columns = {
        "strain (1)": STRAIN,
        "force (N)": STRESS_PA * 1e-4,
        "force sigma (mN)": NOISES_PA * 0.1,
        "lateral strain (1)": -0.3 * STRAIN,
        "width sd (1)": 1e-3 + 0 * STRAIN,
    }
    lines = ['sigma_n = "force sigma (mN)"', "area_m2 = 1e-4", 'lateral_sigma = "width sd (1)"']
    (experiment,) = specimen_problem(tmp_path, columns, lines).experiments
    stress, lateral = experiment.readings
    assert stress.sample_sigmas[:, 0] == pytest.approx(NOISES_PA)
    assert lateral.sample_sigmas[:, 0] == pytest.approx(1e-3)


def test_true_stresses_scale_their_noise(tmp_path):
    columns = {"strain (1)": STRAIN, "true stress (Pa)": STRESS_PA, "sd (Pa)": NOISES_PA}
    lines = ['sigma_pa = "sd (Pa)"', 'stress = "true"']
    (experiment,) = specimen_problem(tmp_path, columns, lines).experiments
    (stress,) = experiment.readings
    ratio = stress.measured_values[:, 0] / STRESS_PA
    assert stress.sample_sigmas[:, 0] == pytest.approx(NOISES_PA * ratio)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("sd", "sigma_pa is 'sd', which does not exist"), ("sd (1)", "column sd has the unit 1")],
)
def test_a_column_of_noise_that_is_not_there_is_refused(tmp_path, name, expected):
    columns = {"strain (1)": STRAIN, "stress (Pa)": STRESS_PA}
    if name != "sd":
        columns["sd"] = NOISES_PA
    with pytest.raises(cs.InputError) as fault:
        specimen_problem(tmp_path, columns, [f'sigma_pa = "{name}"'])
    assert expected in str(fault.value)


def test_a_noise_of_zero_in_a_file_is_refused(tmp_path):
    columns = {"strain (1)": STRAIN, "stress (Pa)": STRESS_PA, "sd (Pa)": 0 * STRAIN}
    with pytest.raises(cs.InputError, match="row 1; expected more than 0"):
        specimen_problem(tmp_path, columns, ['sigma_pa = "sd (Pa)"'])


def test_simulated_tables_have_the_noise_that_the_problem_names(tmp_path):
    columns = {
        "strain (1)": STRAIN,
        "true stress (kPa)": STRESS_PA / 1e3,
        "sd (kPa)": NOISES_PA / 1e3,
    }
    lines = ['sigma_pa = "sd (kPa)"', 'stress = "true"']
    read = specimen_problem(tmp_path, columns, lines)
    file, _ = read_problem_file(tmp_path / "problem.toml")
    (section,) = file.experiment
    layout = layout_from_section(section)
    values = {each.name: each.measured_values[:, 0] for each in read.experiments[0].readings}
    written = specimen_columns(read.experiments[0], values, layout)
    assert written["sd (kPa)"] == pytest.approx(NOISES_PA / 1e3)


def test_a_bench_and_a_sensor_and_markers_have_columns_of_noise(tiny):
    (experiment,) = cs.Problem.read(tiny / "problem.toml").experiments
    times_s = experiment.t_s
    sigmas = 0.1 + times_s
    force = "t_s,fz_n,noise_n"
    rows = [f"{t:.9g},1.0,{s:.9g}" for t, s in zip(times_s, sigmas, strict=True)]
    (tiny / "swing_wrench.csv").write_text("\n".join([force, *rows]))
    rows = [f"{t:.9g},1.0,{s:.9g}" for t, s in zip(times_s, sigmas, strict=True)]
    (tiny / "height.csv").write_text("\n".join(["t_s,height,noise", *rows]))
    (tiny / "sensor.py").write_text("def height(at):\n    return at.position_m[2, 0]\n")
    header, *tracks = (tiny / "swing_markers.csv").read_text().splitlines()
    noisy = [f"{row},{s / 100:.9g}" for row, s in zip(tracks, sigmas, strict=True)]
    (tiny / "swing_markers.csv").write_text("\n".join([f"{header},low_sigma", *noisy]))
    poses = 'poses = "swing_motion.csv" }'
    sensed = (
        'poses = "swing_motion.csv", wrench = { file = "swing_wrench.csv", sigma_n = "noise_n" } }'
    )
    replace_text(poses, sensed)(tiny)
    with (tiny / "problem.toml").open("a") as file:
        file.write(
            '\n[[experiment.reading]]\nname = "height"\ncode = "sensor.py"\nfunction = "height"\n'
            'file = "height.csv"\nsigma = "noise"\npoints_m = [[0.0, 0.0, 0.0]]\n'
        )
    (experiment,) = cs.Problem.read(tiny / "problem.toml", allow_code=True).experiments
    (wrench,), (gauge,) = experiment.wrenches, experiment.readings
    assert wrench.sample_sigmas[:, 2] == pytest.approx(sigmas)
    assert gauge.columns == ("height",)
    assert gauge.sample_sigmas[:, 0] == pytest.approx(sigmas)
    low, *others = experiment.markers.names
    assert low == "low"
    assert others
    assert experiment.markers.sample_sigmas[:, :3] == pytest.approx(
        np.repeat(sigmas[:, None] / 100, 3, axis=1)
    )
    assert experiment.markers.sample_sigmas[:, 3:] == pytest.approx(1e-3)


def test_simulated_tracks_have_the_noise_of_their_file(tiny):
    header, *tracks = (tiny / "swing_markers.csv").read_text().splitlines()
    noisy = [f"{row},{0.001 * (1 + k % 3):.9g}" for k, row in enumerate(tracks)]
    (tiny / "swing_markers.csv").write_text("\n".join([f"{header},low_sigma", *noisy]))
    tracks_file = 'file = "swing_markers.csv"'
    replace_text(tracks_file, f"{tracks_file}\nweights = {{ low = 4.0 }}")(tiny)
    problem = cs.Problem.read(tiny / "problem.toml", simulation=True)
    written = write_data(problem, tiny / "twin", recipe=Recipe(noise_m=1e-3))
    (file,) = [each for each in written if "markers" in each.name]
    (measured,), table = problem.experiments, read_markers(file)
    k = table.names.index("low")
    in_file = 0.001 * (1 + np.arange(len(measured.t_s)) % 3)
    assert table.sigma_m[:, k] == pytest.approx(in_file[: len(table.t_s)])
    exact = cs.simulate(measured, problem.parameters).markers_m
    errors = (table.positions_m - exact)[:, k]
    by_noise = [np.std(errors[kind::3]) for kind in range(3)]
    assert by_noise[0] < by_noise[1] < by_noise[2]
