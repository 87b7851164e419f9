"""Problems that release 0.4.0 answered wrongly, from the folder `shared/cases` beside the checkout.

The folder is not part of the repository; without it the tests are skipped.
"""

from __future__ import annotations

import contextlib
import runpy
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from kit.falling import FREE, TRUTH, TWIN_HZ, falling_block, noise_of

import collocation_sysid as cs

CASES = next(
    (
        parent / "shared" / "cases"
        for parent in Path(__file__).parents
        if (parent / "shared" / "cases").is_dir()
    ),
    None,
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CASES is None, reason="there is no folder shared/cases"),
]


@cache
def answer(name: str, file: str = "problem.toml") -> cs.Run:
    """Run of a problem of the folder."""
    assert CASES is not None
    return cs.run(cs.Problem.read(CASES / name / file))


def codes(run: cs.Run) -> list[str]:
    """Codes of the reasons of a verdict, in their order."""
    return [concern.code for concern in run.trust.concerns]


def assert_within(run: cs.Run, name: str, value: float) -> None:
    """Assert that the combined interval of an estimate contains a value."""
    low, high = run.interval(name)
    assert low <= value <= high, (name, low, value, high)


def test_an_auxetic_foam_is_no_compression_test():
    run = answer("auxetic_named_compression")
    assert codes(run) == []
    assert_within(run, "poisson", -0.6538)
    assert_within(run, "young_pa", 69.23e3)


def test_the_length_of_a_dogbone_is_in_the_interval():
    run = answer("dogbone_crosshead")
    assert_within(run, "young_pa", 3.0e6)
    assert any("effective length of its narrow part" in note for note in run.problem.notes)


def test_a_stated_ratio_of_rubber_hardly_widens_the_interval():
    run = answer("fixed_nu_of_rubber_default_deviation")
    low, high = run.interval("c10_pa")
    assert 130e3 < low < 176e3 < high < 230e3


def test_a_foam_is_advised_laws_of_foams():
    run = answer("foam_law_advice")
    assert run.trust.verdict == "doubtful"
    assert "hyperfoam-2" in run.trust.reasons[0]
    assert run.parameters["beta_1"] == 0.0
    assert run.estimates["poisson"].combined95 is None


def test_stresses_in_kilograms_force_are_read():
    assert answer("kgf_remedy").parameters["c10_pa"] == pytest.approx(176e3, rel=0.03)


def test_a_shear_curve_declared_planar_is_no_good_answer():
    run = answer("kind_of_shear_swapped")
    assert codes(run)[0] == "description/specimen-kind/likelier"
    assert "simple-shear (E = 224 kPa)" in run.trust.reasons[0]


def test_a_liquid_has_an_instantaneous_modulus():
    run = answer("liquid_limit")
    assert codes(run)[0] == "information/liquid"
    # The data are those of a linear law: engineering stress at 5 % of the stated law is 4.7 % less.
    assert run.optimum["instantaneous_young_pa"].value == pytest.approx(1e5, rel=0.06)
    assert run.parameters["b.tau_s"] == pytest.approx(2.0, rel=0.02)


def test_a_steel_ruler_is_no_rubber():
    assert CASES is not None
    path = CASES / "metal_upper_bound" / "problem.toml"
    # Demanded: an interval that contains the truth, not the verdict "good", which neither the steps
    # nor the mesh allow. Without these steps it is solved again with 8 for three minutes, and ends
    # at 182 GPa (176 to 188) with the verdict "check".
    steps = "transcription.substeps=1"
    run = cs.run(cs.Problem.read(path, overrides=["object.element=tet10", steps]))
    assert_within(run, "young_pa", 200e9)
    assert run.parameters["young_pa"] == pytest.approx(200e9, rel=0.1)
    # One flat element of mean dilatation is too soft, which is a reason.
    found = codes(cs.run(cs.Problem.read(path, overrides=[steps])))
    assert "mesh/few" in found
    assert "density/metal" not in found


def test_a_falling_block_needs_no_guess():
    # The numbers of the case fall_without_guess, with elements and time steps as they are advised.
    t_s = np.arange(48) / 120
    exact_m = cs.simulate(falling_block(3, t_s), TRUTH, "bdf2", substeps=TWIN_HZ // 120).markers_m
    fall = cs.with_markers(falling_block(2, t_s), exact_m + noise_of(0, exact_m.shape))
    unknown = {name: cs.Unknown() for name in FREE}
    run = cs.run(cs.Problem([fall], TRUTH | unknown, scheme="bdf2"))
    # The verdict is "doubtful": the error of the mesh in an impact is not that of a linear motion.
    assert_within(run, "young_pa", 200e3)
    assert abs(np.log10(run.parameters["young_pa"] / 200e3)) < 0.05
    low, high = run.interval("young_pa")
    assert high < 1.6 * low


def test_two_estimates_with_one_uncertainty_are_alike():
    run = answer("mu_not_identifiable_E_is")
    of_mu, of_young = (run.estimates[name] for name in ("mu_pa", "young_pa"))
    assert (of_mu.statistical_std_error is None) == (of_young.statistical_std_error is None)


def test_a_column_of_zeros_is_left_out():
    run = answer("placeholder_zero_column")
    assert run.solution.parameters["c10_pa"] == pytest.approx(171e3, rel=0.02)
    assert any("taken as not measured" in note for note in run.problem.notes)


def test_a_stress_difference_is_no_stress():
    with pytest.raises(cs.InputError, match="stress difference"):
        answer("stress_difference_read_as_stress")


def test_two_terms_of_ogden_converge_without_a_guess():
    run = answer("two_similar_ogden_terms", "og.toml")
    assert run.solution.status.converged
    assert_within(run, "mu_1_pa", 320e3)
    assert_within(run, "alpha_1", 2.0)
    assert_within(run, "alpha_2", -2.0)


def test_predicted_stresses_count():
    run = answer("validation_of_stress_never_counts")
    assert run.trust.verdict == "doubtful"
    assert codes(run)[0] == "roll-out/predicted"
    assert_within(run, "mu_pa", 100e3)


def test_a_volume_ratio_is_read():
    assert_within(answer("volume_ratio_header"), "lambda_pa", 27.78e3)


def test_another_law_is_no_turn():
    run = answer("mujoco_law_mistaken_for_turn")
    assert run.trust.verdict != "good"
    assert not any("widen its prior" in reason for reason in run.trust.reasons[:1])
    assert np.isfinite(run.parameters["young_pa"])


# Inputs of another form ---------------------------------------------------------------------------


def copied(name: str, folder: Path) -> Path:
    """Copy of a case, which may write beside its inputs."""
    assert CASES is not None
    return Path(shutil.copytree(CASES / name, folder / name))


def command(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, with a working folder."""
    code = "import sys; sys.path[:] = [p for p in sys.path if p]; import collocation_sysid.cli as c; c.main()"
    return subprocess.run(
        [sys.executable, "-c", code, *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=500,
    )


def test_nothing_of_the_working_folder_is_executed(tmp_path):
    case = copied("working_folder_executed", tmp_path)
    laws = "neo-hookean,mooney-rivlin"
    done = command("compare-models", "problem.toml", "--materials", laws, "--out", "o", folder=case)
    assert done.returncode == 0, done.stderr
    assert not (case / "executed.txt").exists()


def test_settings_of_pictures_in_the_working_folder_have_no_effect(tmp_path):
    case = copied("volume_ratio_header", tmp_path)
    shutil.copy(copied("matplotlibrc_obeyed", tmp_path) / "matplotlibrc", case)
    done = command("solve", "problem.toml", "--out", "o", folder=case)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("number", ["0", "8", "53"])
def test_depth_images_of_a_wrong_shape_have_one_line(number):
    assert CASES is not None
    with pytest.raises(cs.InputError, match="depth_m"):
        cs.Problem.read(CASES / "depth_array_shapes" / number / "problem.toml")


def test_a_table_of_priors_that_is_not_called_is_accepted_or_refused():
    assert CASES is not None
    with contextlib.suppress(cs.InputError):
        runpy.run_path(str(CASES / "nuisance_none_not_called" / "case.py"))


def test_tracks_of_two_coordinates_are_used():
    assert CASES is not None
    run = runpy.run_path(str(CASES / "planar_tracks_dropped" / "case.py"))["run"]
    assert any(
        "present in less than half" in note for note in (*run.all_notes, *run.solution.notes)
    )
    # The estimate is corrected for a coarse mesh, which these simulated data do not need.
    assert run.solution.parameters["young_pa"] == pytest.approx(2e4, rel=0.05)


def test_a_finger_filmed_by_a_phone_is_identified():
    run = answer("phone_finger")
    assert run.trust.verdict in ("good", "check")
    assert_within(run, "young_pa", 150e3)


FILMED = """
[object]
mesh = "hook.msh"
density_kg_m3 = 500.0
material = "st-venant-kirchhoff"
damping = "material"
rest_shape = "stress_free"
[parameters]
young_pa = {}
poisson = {}
gamma_r_s = {}
gamma_m_1_s = 0.0
[environment]
air_density_kg_m3 = "none"
[[experiment]]
name = "swing"
[experiment.grasp]
nodes = "clamp"
poses = "poses.csv"
[[experiment.image_tracks]]
name = "front"
file = "FILE"
sigma_px = 0.5
[experiment.image_tracks.places_m]
end_out = [-0.02540, 0.06979, 0.00464]
end_in = [-0.01564, 0.04298, -0.00464]
end_top = [-0.02052, 0.05638, 0.01500]
mid_out = [0.03438, 0.06665, 0.00044]
mid_in = [0.02260, 0.03893, 0.00077]
mid_top = [0.03069, 0.05155, 0.01500]
[experiment.image_tracks.camera]
matrix = [[1000, 0, 640], [0, 1000, 360], [0, 0, 1]]
pose = [[1, 0, 0, 0.03], [0, 0, 1, -0.6], [0, -1, 0, 0], [0, 0, 0, 1]]
"""


def test_pixels_of_one_camera_are_solved(tmp_path):
    case = copied("pixel_tracks", tmp_path)
    (case / "problem.toml").write_text(FILMED.replace("FILE", "uv.csv"))
    run = cs.run(cs.Problem.read(case / "problem.toml"))
    assert_within(run, "young_pa", 60e3)
    assert_within(run, "poisson", 0.35)
    assert_within(run, "gamma_r_s", 2e-3)


@pytest.mark.parametrize(
    ("case", "note"),
    [
        ("bluehill_results_table", "length_m = 0.05 is the length that is stretched"),
        ("unordered_time_of_elastic_specimen", "21 of 30 rows are used"),
        ("c3d_model_outputs_as_markers", "LWristAngles of POINT:ANGLES are outputs of a model"),
    ],
)
def test_files_of_other_programs_are_read_with_a_note(case, note):
    assert CASES is not None
    notes = cs.Problem.read(CASES / case / "problem.toml").notes
    assert any(note in each for each in notes), notes


@pytest.mark.parametrize(
    ("case", "file", "found"),
    [
        ("lagrange_strain", "problem.toml", "holds a Green-Lagrange strain"),
        ("lagrange_strain", "mr.toml", "holds a Green-Lagrange strain"),
        ("shear_modulus_read_as_E", "harmonic.toml", 'expected test = "shear-harmonic"'),
        ("shear_modulus_read_as_E", "relaxation.toml", 'expected test = "shear-relaxation"'),
        ("template_video_keys", "problem.toml", "belongs to image_tracks, above the table camera"),
    ],
)
def test_words_that_contradict_a_reading_are_refused(case, file, found):
    assert CASES is not None
    with pytest.raises(cs.InputError, match=found):
        cs.Problem.read(CASES / case / file)


@pytest.mark.parametrize("file", ["problem.toml", "mr.toml"])
def test_platens_that_are_not_parallel_are_no_law(file):
    first, *others = answer("foot_curve_traceback", file).trust.reasons
    assert "window_s" in first
    assert not any("compare laws" in reason for reason in [first, *others])


def test_the_curve_without_its_toe_is_good():
    run = answer("foot_curve_traceback", "win.toml")
    assert run.trust.verdict == "good"
    assert_within(run, "young_pa", 9e5)


def test_times_of_slow_motion_are_named():
    reason, *_ = answer("slow_motion_ring_down").trust.reasons
    assert "4 times too long" in reason


@pytest.mark.parametrize("file", ["specimen.toml", "specimen_strain.toml"])
def test_the_platens_of_a_flat_disc_are_in_the_interval(file):
    assert_within(answer("disc_compression_specimen", file), "young_pa", 1e6)


def test_terms_of_ogden_that_nearly_cancel_end_with_an_answer():
    run = answer("two_term_ogden_no_convergence")
    assert run.solution.status.converged
    assert_within(run, "young_pa", 478e3)
