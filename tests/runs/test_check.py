"""Messages and advice of `check`."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import (
    REFERENCES,
    Edit,
    both,
    replace_cell,
    replace_text,
    run_command,
    settings,
    write_problem,
)
from kit.problems import TRUTH, bar_in_two_hands, hung_cube
from kit.static import block

from collocation_sysid.cli import common
from collocation_sysid.common.display import PlainConsole, plain_text
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.schemes import SCHEMES, as_scheme
from collocation_sysid.problem import Problem
from collocation_sysid.recording.obstacle import Obstacle
from collocation_sysid.recording.obstacle_solids import Sphere
from collocation_sysid.result.check_sections import (
    _marker_summary,
    full_check_tables,
    quick_check_tables,
)
from collocation_sysid.runs.check import CheckResult, check_problem, quick_check
from collocation_sysid.runs.check.body import (
    bending_concerns,
    element_concerns,
    longest_edges,
    slenderness,
    worst_elements,
)
from collocation_sysid.runs.check.modes import (
    ModeCheck,
    ModesCheck,
    check_modes,
    mode_concerns,
    numerical_mode,
)
from collocation_sysid.runs.cost import (
    FRICTION_FACTOR,
    STATIC_FACTOR,
    MethodCost,
    cost_concerns,
    cost_notes,
    nonzeros,
    search_factor,
)
from collocation_sysid.runs.derivatives import shortened_problem
from collocation_sysid.statistics.concerns import Concern

# The tiny problem's bar, stiff enough for 7.7 Hz and little damped, as silicone is.
SILICONE = (
    "parameters.lambda_pa.guess=570",
    "parameters.mu_pa.guess=570",
    "parameters.gamma_r_s.guess=1e-4",
    "parameters.gamma_m_1_s.guess=0.1",
)
SUBSTEPS = "transcription.substeps"
REGULAR = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 10
COMPRESSIBLE = np.array([100.0, 100.0, 0.0, 0.0])


def checked(folder: Path, *overrides: str) -> CheckResult:
    return check_problem(Problem.read(folder / "problem.toml", overrides))


def checked_motion(folder: Path, *overrides: str) -> ModesCheck:
    """How the body of the only experiment oscillates at the guess."""
    (transcription,) = Problem.read(folder / "problem.toml", overrides).collocation().transcriptions
    theta, step_s = (
        transcription.body.theta_from_values(transcription.parameters.guesses),
        transcription.dynamics.step_s,
    )
    return check_modes(transcription.experiment, as_scheme(transcription.scheme), step_s, theta)


def about(findings: CheckResult, *words: str) -> str:
    """The one warning that has all these words."""
    found = [warning for warning in findings.warnings if all(word in warning for word in words)]
    assert len(found) == 1, findings.warnings
    return found[0]


def sentences(concerns: Iterable[Concern]) -> list[str]:
    return [concern.message for concern in concerns]


# The motion and the time grid -------------------------------------------------------------------


@pytest.mark.long
def test_check_reports_chosen_substeps(tiny: Path):
    assert any("up to 8" in note for note in checked(tiny).notes)
    assert not any("up to 8" in note for note in checked(tiny, "transcription.substeps=2").notes)


def test_a_warning_of_backward_eulers_damping_names_sufficient_substeps(tiny: Path):
    euler = (*SILICONE, "transcription.scheme=backward-euler")
    findings = checked(tiny, *euler)
    first = findings.motions[0].modes[0]
    assert first.frequency_hz == pytest.approx(7.7, abs=0.2)
    assert first.numerical_damping_ratio == pytest.approx(0.23, abs=0.02)
    warning = about(findings, "backward-euler at 10 ms", "estimated damping too low")
    assert 'set transcription.scheme = "midpoint"' in warning
    named = re.search(r"substeps = (\d+)", warning)
    assert named is not None
    needed = int(named[1])
    assert needed == findings.motions[0].substeps_needed
    cured, nearly = (
        [
            concern.message
            for concern in mode_concerns(checked_motion(tiny, *euler, f"{SUBSTEPS}={count}"))
            if "backward-euler" in concern.message
        ]
        for count in (needed, needed - 1)
    )
    assert not cured
    assert f"substeps = {needed}" in " ".join(nearly)


def test_midpoint_at_ten_milliseconds_is_not_warned_of(tiny: Path):
    findings = checked(tiny, *SILICONE)
    first = findings.motions[0].modes[0]
    assert first.numerical_damping_ratio == pytest.approx(0, abs=1e-3)
    assert first.samples_per_period == first.steps_per_period == pytest.approx(13, abs=0.5)
    assert not any("midpoint" in warning for warning in findings.warnings)
    assert any("midpoint lengthens" in note and "substeps = 2" in note for note in findings.notes)


def test_damping_at_the_guess_is_rayleighs(tiny: Path):
    gammas = ("parameters.gamma_r_s.guess=0.02", "parameters.gamma_m_1_s.guess=0.5")
    modes = checked(tiny, *gammas, 'object.damping="rayleigh"').motions[0].modes
    assert modes
    for mode in modes:
        omega = 2 * np.pi * mode.frequency_hz
        assert mode.damping_ratio == pytest.approx(0.01 * omega + 0.25 / omega)


def test_numerical_damping_is_compared_with_the_damping_of_the_guess(tiny: Path):
    def first(*overrides: str) -> ModeCheck:
        return checked_motion(tiny, *SILICONE, *overrides).modes[0]

    def added(mode: ModeCheck, scheme: str, damping_ratio: float) -> float:
        omega = 2 * np.pi * mode.frequency_hz
        return numerical_mode(SCHEMES[scheme], omega, 0.01, damping_ratio).damping_ratio

    damped = first("parameters.gamma_r_s.guess=0.01")
    assert damped.damping_ratio > 0.2
    # Midpoint leaves the undamped alone and takes from the damped; the period is the undamped one.
    expected = added(damped, "midpoint", damped.damping_ratio)
    assert damped.numerical_damping_ratio == pytest.approx(expected, rel=1e-9)
    assert expected < -1e-3
    assert damped.period_error == first().period_error
    creeping = first("parameters.gamma_r_s.guess=0.1", "transcription.scheme=backward-euler")
    assert creeping.damping_ratio > 1
    undamped = added(creeping, "backward-euler", 0.0)
    assert creeping.numerical_damping_ratio == pytest.approx(undamped)


def test_a_scheme_that_takes_damping_away_is_warned_of(tiny: Path):
    motion = checked_motion(tiny, *SILICONE, "parameters.gamma_r_s.guess=0.02")
    first = replace(motion.modes[0], damping_ratio=0.3, numerical_damping_ratio=-0.05)
    said = mode_concerns(replace(motion, modes=(first,), duration_s=10.0))[0].message
    assert "removes a damping ratio of 0.05 from the first mode" in said
    assert "damping too high" in said
    assert f"set transcription.substeps = {motion.substeps_needed}" in said


def test_too_few_steps_or_samples_a_period_are_warned_of(tiny: Path):
    motion = checked(tiny, *SILICONE).motions[0]
    first = replace(motion.modes[0], steps_per_period=5.0, samples_per_period=2.5)
    found = mode_concerns(replace(motion, modes=(first,), duration_s=10.0))
    assert [each.topic for each in found] == ["scheme", "information"]
    steps, samples = (each.message for each in found)
    assert "only 5.0 time steps per period" in steps
    assert f"substeps = {motion.substeps_needed}" in steps
    assert "only 2.5 samples per period" in samples
    assert re.search(r"record at 6\d Hz or more", samples)


def test_a_recording_shorter_than_a_period_is_warned_of(tiny: Path):
    assert about(checked(tiny, *SILICONE), "0.08 s recorded", "record longer")


# The elements -----------------------------------------------------------------------------------


@pytest.mark.long
def test_nearly_incompressible_linear_elements_are_warned_of(tiny: Path):
    nearly = ("parameters.mu_pa.guess=200", "parameters.lambda_pa.guess=9800")
    warning = about(checked(tiny, *nearly), "Poisson's ratio is 0.49")
    assert 'set object.element = "tet10-p0"' in warning
    quadratic = checked(tiny, *nearly, "object.element=tet10")
    assert "tet10 elements lock from 0.45 on" in about(quadratic, "Poisson's ratio is 0.49")
    averaging = checked(tiny, *nearly, "object.element=tet10-p0")
    assert not any("Poisson" in warning for warning in averaging.warnings)


@pytest.mark.parametrize("young_pa", [2e5, 100.0, 1543.0])
def test_locking_is_warned_of_at_its_very_poisson_ratio(young_pa: float):
    body = Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), density_kg_m3=30.0, element="tet10")
    shape, worst = slenderness(body.mesh), worst_elements(body.mesh)[0]

    def warnings(poisson: float) -> list[str]:
        # By way of λ and μ, 0.45 comes back as 0.44999999999999996 for E = 200 kPa.
        shear = young_pa / (2 + 2 * poisson)
        theta = np.array([2 * shear * poisson / (1 - 2 * poisson), shear, 0.0, 0.0])
        return sentences(element_concerns(body, theta, shape, worst))

    (warning,) = warnings(0.45)
    assert "tet10 elements lock from 0.45 on" in warning
    assert 'set object.element = "tet10-p0"' in warning
    assert warnings(0.449) == []
    # Only rounding is forgiven: 0.4499999 is below the limit.
    assert warnings(0.4499999) == []


def test_the_worst_element_is_named():
    flat = REGULAR + np.array([1.0, 0.0, 0.0])
    flat[:, 2] *= 0.005
    mesh = TetMesh(np.vstack([REGULAR, flat]), [[0, 1, 2, 3], [4, 5, 6, 7]])
    worst, best = worst_elements(mesh)
    assert (worst.element, best.element) == (1, 0)
    assert best.quality == pytest.approx(1)
    assert best.aspect_ratio == pytest.approx(np.sqrt(1.5))
    assert worst.aspect_ratio > 20
    body = Body(mesh, density_kg_m3=30.0)
    concern, *_ = element_concerns(body, COMPRESSIBLE, slenderness(mesh), worst)
    assert concern.code == "mesh/flat"
    assert "element 1 is nearly flat" in concern.message


@pytest.mark.parametrize(
    ("size_m", "divisions", "element", "warned"),
    [
        ((0.1, 0.03, 0.03), (6, 2, 2), "tet4", True),
        ((0.1, 0.03, 0.03), (6, 2, 2), "tet10", False),
        ((0.1, 0.03, 0.03), (16, 5, 5), "tet4", False),
        ((0.1, 0.1, 0.01), (10, 10, 1), "tet4", True),
        ((0.1, 0.1, 0.1), (2, 2, 2), "tet4", False),
    ],
)
def test_slender_bodies_need_several_linear_elements_across(size_m, divisions, element, warned):
    mesh = box_mesh(size_m, divisions)
    shape = slenderness(mesh)
    assert shape[1] == pytest.approx(min(size_m))
    body = Body(mesh, density_kg_m3=30.0, element=element)
    warnings = sentences(element_concerns(body, COMPRESSIBLE, shape, worst_elements(mesh)[0]))
    said = [warning for warning in warnings if "too stiff in bending" in warning]
    assert bool(said) == warned
    assert all(
        "of a real body" in each and "not that of data simulated with" in each for each in said
    )


@pytest.mark.parametrize(("element", "most"), [("tet4", 1.5), ("tet10-p0", 3.0), ("tet10", 3.0)])
def test_edges_may_be_longer_until_too_few_are_across(element: str, most: float):
    """A mesh with the longest edges is not called too coarse, and no coarser one is proposed."""
    for number, ratio in ((6, most), (round(6 / most), 1.0)):
        mesh = box_mesh((0.12, 0.03, 0.03), (4 * number, number, number))
        body = Body(mesh, density_kg_m3=30.0, element=element)
        shape = slenderness(mesh)
        assert longest_edges(body, shape[2]) == pytest.approx(ratio)
        assert not bending_concerns(body, *shape)


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("poisson", [0.3, 0.47])
def test_followed_remedies_of_a_mesh_leave_no_warning(number: int, poisson: float):
    """The elements that warnings ask for, and as many across the body, are enough."""
    element, seen = "tet4", list[str]()
    while True:
        mesh = box_mesh((0.12, 0.03, 0.03), (4 * number, number, number))
        body = Body(mesh, density_kg_m3=30.0, element=element)
        mu_pa = 1e4
        lame = {"mu_pa": mu_pa, "lambda_pa": 2 * mu_pa * poisson / (1 - 2 * poisson)}
        theta = body.theta_from_values({**lame, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0})
        warnings = sentences(
            element_concerns(body, theta, slenderness(mesh), worst_elements(mesh)[0])
        )
        if not warnings:
            break
        seen += warnings
        assert element == "tet4"  # the first warnings say all that is to be done
        element = "tet10-p0" if poisson >= 0.45 else "tet10"
        assert all(f'"{element}"' in each for each in warnings)
        number = max(number, 2) if "2 or more across" in seen[0] else number
    assert seen


def test_as_many_elements_across_as_are_needed_are_enough():
    mesh = box_mesh((0.005, 0.005, 0.03), (2, 2, 12))
    body = Body(mesh, density_kg_m3=30.0, element="tet10-p0")
    assert not element_concerns(body, COMPRESSIBLE, slenderness(mesh), worst_elements(mesh)[0])


def test_thickness_does_not_depend_on_how_the_body_lies():
    mesh = box_mesh((0.1, 0.03, 0.03), (6, 2, 2))
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    length_m, thickness_m, _ = slenderness(TetMesh(mesh.points_m @ turn.T, mesh.tetrahedra))
    assert thickness_m == pytest.approx(0.03)
    assert length_m == pytest.approx(0.1)


# The measurements -------------------------------------------------------------------------------

AWAY = replace_text(REFERENCES, REFERENCES.replace("[0.06, 0.06, 0.03]", "[0.06, 0.085, 0.03]"))


def test_a_marker_far_from_the_body_is_named(tiny: Path):
    AWAY(tiny)
    findings = checked(tiny)
    assert about(findings, "marker 'side' of 'swing' lies 25 mm", "reference_m")
    assert findings.recordings[0].farthest_marker.name == "side"
    assert findings.largest_marker_distance_m == pytest.approx(0.025)


def test_places_that_the_poses_determine_have_no_distance(tiny: Path):
    """It would be small for wrong poses, too."""
    without = replace_text(f"reference_m = {REFERENCES}\n", "")
    without(tiny)
    (recording,) = checked(tiny).recordings
    assert recording.unplaced == len(recording.markers)
    summary = _marker_summary(recording)
    assert "no place stated, each attached at the point" in summary
    assert "farthest" not in summary
    some = _marker_summary(replace(recording, unplaced=1))
    assert "farthest from the body" in some
    assert "1 without a stated place" in some


def blank(*samples: tuple[int, int]) -> Edit:
    """Leave out the position of (line, marker)."""
    edits = [
        replace_cell("swing_markers.csv", line, 1 + 3 * m + axis, "")
        for line, m in samples
        for axis in range(3)
    ]
    return both(*edits)


def test_missing_samples_are_counted_by_marker(tiny: Path):
    blank((3, 1), (4, 1), (4, 2))(tiny)
    findings = checked(tiny)
    (recording,) = findings.recordings
    assert {m.name: (m.samples, m.missing) for m in recording.markers} == {
        "low": (9, 0),
        "mid": (7, 2),
        "side": (8, 1),
    }
    assert (findings.samples, findings.missing) == (24, 3)
    assert (recording.frames, recording.rate_hz) == (9, pytest.approx(100))
    assert recording.duration_s == pytest.approx(0.08)


def test_a_marker_that_is_mostly_missing_is_warned_of(tiny: Path):
    blank(*((line, 1) for line in range(3, 9)))(tiny)
    assert about(checked(tiny), "marker 'mid' of 'swing' is missing in 6 of 9 samples")


def test_tracks_in_another_unit_are_warned_of(tiny: Path):
    replace_text('file = "swing_markers.csv"', 'file = "swing_markers.csv"\nlength_unit = "cm"')(
        tiny
    )
    assert about(checked(tiny), "is first measured", "check length_unit")


# The cost ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["backward-euler", "midpoint", "bdf2"])
def test_nonzeros_are_those_of_the_whole_program(tiny: Path, monkeypatch, scheme: str):
    monkeypatch.setattr("collocation_sysid.runs.derivatives.SAMPLES", 5)
    overrides = (f"transcription.scheme={scheme}", "transcription.substeps=2")
    findings = checked(tiny, *overrides)
    whole = Problem.read(tiny / "problem.toml", overrides).collocation()
    assert findings.jacobian_nonzeros == len(whole.jacobian_structure[1])
    assert findings.hessian_nonzeros == len(whole.hessian_structure[1])


def test_only_some_of_many_recordings_are_examined(tiny: Path, monkeypatch):
    """Sizes count all recordings; memory and time grow with their number."""
    monkeypatch.setattr("collocation_sysid.runs.check.MOST_EXAMINED", 2)
    monkeypatch.setattr("collocation_sysid.runs.check.LONGEST_SIMULATION_S", 0.0)
    problem = Problem.read(tiny / "problem.toml")
    (swing,) = problem.experiments
    named = [replace(swing, name=f"swing {k}", validation=k == 4) for k in range(5)]
    many = replace(problem, experiments=named)
    one, some, whole = (check_problem(problem), check_problem(many), check_problem(many, full=True))
    assert [len(each.motions) for each in (one, some, whole)] == [1, 2, 4]
    assert len(some.recordings) == 5
    assert some.timesteps == whole.timesteps == 4 * one.timesteps
    assert one.jacobian_nonzeros is not None
    assert some.jacobian_nonzeros == pytest.approx(4 * one.jacobian_nonzeros, rel=0.01)
    assert some.memory_mb == pytest.approx(whole.memory_mb, rel=0.1)
    said = "5 recordings were read, but the description was only examined in the longest 2"
    assert any(said in note for note in some.notes)
    assert not any("only examined" in note for note in whole.notes)


def test_nonzeros_are_estimated_for_a_problem_without_guesses(tiny: Path):
    """A scan of the stiffness gives the program its guesses, and the problem none."""
    unguessed = ["parameters.mu_pa={}", "parameters.lambda_pa={}"]
    problem = Problem.read(tiny / "problem.toml")
    program = problem.collocation()
    expected = nonzeros(problem, program)
    without = Problem.read(tiny / "problem.toml", unguessed)
    assert without.collocation().parameters.names_without_guess
    assert nonzeros(without, program) == expected
    assert min(expected) > 0


def test_every_method_has_a_cost_and_the_chosen_one_counts(tiny: Path):
    findings = checked(tiny)
    by_name = {cost.method: cost for cost in findings.costs}
    assert set(by_name) == {"reduced-space", "interior-point"}
    assert all(cost.memory_mb > 0 and (cost.time_s or 0) > 0 for cost in findings.costs)
    assert findings.method == "interior-point"
    assert findings.memory_mb == by_name["interior-point"].memory_mb


def test_the_time_of_a_search_counts_equilibria_and_estimated_friction():
    ball = Obstacle(shape=Sphere(radius_m=0.01), friction="ball_friction")
    pressed = block("xyz")
    touched = pressed.with_obstacles([ball])
    alone = search_factor(pressed, {"young_pa"})
    assert search_factor(hung_cube(), {"young_pa"}) == 1.0
    assert alone == STATIC_FACTOR > 1.5
    assert search_factor(touched, {"young_pa"}) == alone
    assert search_factor(touched, {"young_pa", "ball_friction"}) == pytest.approx(
        FRICTION_FACTOR * alone
    )


def test_times_are_called_estimates_for_the_number_of_samples(tiny: Path):
    outcome = run_command("check", tiny / "problem.toml", "--details")
    (line,) = [e for e in outcome.out.splitlines() if "rough estimates" in e]
    count = checked(tiny).timesteps
    assert f"for {count:,} time steps or equilibria" in line


def test_a_method_that_does_not_fit_into_memory_is_warned_of(monkeypatch):
    monkeypatch.setattr("collocation_sysid.runs.cost.machine_memory_mb", lambda: 8000.0)
    small, large = (
        MethodCost("reduced-space", 500.0, 10.0),
        MethodCost("interior-point", 40000.0, 1000.0),
    )
    (warning,) = sentences(cost_concerns(large, (small, large)))
    assert "about 40 GB" in warning
    assert 'set solver.method = "reduced-space"' in warning
    assert cost_concerns(small, (small, large)) == []
    assert len(cost_notes(large, (small, large))) == 1
    assert cost_notes(small, (small, large)) == []


# What is seen at once, and what takes longer -----------------------------------------------------


def no_simulation(*_, **__):
    raise AssertionError("simulated")


def test_a_glance_needs_no_simulation_and_no_guess(tiny: Path, monkeypatch):
    for name in ("initial_variables", "start_problem"):
        monkeypatch.setattr(f"collocation_sysid.runs.check.{name}", no_simulation)
    unguessed = ["parameters.mu_pa={}", "parameters.lambda_pa={}"]
    seen = quick_check(Problem.read(tiny / "problem.toml", unguessed))
    assert seen.bodies[0].elements > 0
    assert seen.recordings[0].samples == 27
    assert seen.holds[0].nodes == 9
    assert seen.recordings[0].markers[0].start_miss_m is None


def test_the_command_shows_a_glance_before_anything_is_simulated(tiny: Path, monkeypatch):
    monkeypatch.setattr("collocation_sysid.runs.check.initial_variables", no_simulation)
    shown = []
    show = "collocation_sysid.cli.problem_commands.print_result"
    monkeypatch.setattr(show, lambda content: shown.append(plain_text(content)))
    with pytest.raises(AssertionError, match="simulated"):
        run_command("check", "problem.toml")
    (first,) = shown
    assert "  mesh " in first
    assert re.search(r"grasp +9 nodes", first)


def test_every_grasp_of_an_experiment_is_shown():
    found = quick_check(Problem([bar_in_two_hands()], TRUTH))
    shown = plain_text(quick_check_tables(found, details=True))
    (first,) = re.findall(r"grasp 1 of 'bar in two hands' .* at \((.*?)\) mm", shown)
    (second,) = re.findall(r"grasp 2 of 'bar in two hands' .* at \((.*?)\) mm", shown)
    assert (first, second) == ("0, 0, 0", "150, 0, 0")
    assert plain_text(quick_check_tables(found)).count("  grasp ") == 2


def test_grasps_in_the_same_words_are_shown_once():
    bar = bar_in_two_hands()
    two = Problem([bar, replace(bar, name="again")], TRUTH)
    assert plain_text(quick_check_tables(quick_check(two))).count("  grasp ") == 2


def test_a_long_simulation_is_left_out_and_told_unless_asked_for(tiny: Path, monkeypatch):
    monkeypatch.setattr("collocation_sysid.runs.check.LONGEST_SIMULATION_S", 0.0)
    monkeypatch.setattr("collocation_sysid.runs.derivatives.SAMPLES", 4)
    problem, told = Problem.read(tiny / "problem.toml"), []
    short = check_problem(problem, told.append)
    assert short.rms_at_guess_m is None
    assert any("only the first samples" in n and "check --full" in n for n in short.notes)
    assert "deviates from the markers by" not in plain_text(full_check_tables(short))
    assert not short.derivative_fault
    assert not any("simulating the recordings" in each for each in told)
    whole = check_problem(problem, told.append, full=True)
    assert (whole.rms_at_guess_m or 0) > 0
    assert "deviates from the markers by" in plain_text(full_check_tables(whole))
    assert any("simulating the recordings at the guess" in each for each in told)
    assert short.jacobian_nonzeros == whole.jacobian_nonzeros


@pytest.mark.parametrize("limit", ["LONGEST_START_S", "LONGEST_CHECK_S"])
def test_a_check_leaves_out_what_takes_too_long_with_the_remedy(tiny: Path, monkeypatch, limit):
    monkeypatch.setattr(f"collocation_sysid.runs.check.{limit}", 0.0)
    problem = Problem.read(
        tiny / "problem.toml", ["parameters.mu_pa={}", "parameters.lambda_pa={}"]
    )
    found = check_problem(problem)
    assert len(found.omitted) == 3
    assert not found.costs
    assert not found.motions
    shown = " ".join(plain_text(full_check_tables(found)).split())
    assert "Left out, because check would take longer than half a minute: time and memory" in shown
    # A mesh of few elements across the body is not to be coarser.
    assert "the test of derivatives: check --full." in shown
    assert "nonzeros not counted" in plain_text(full_check_tables(found, details=True))
    assert found.as_dict()["taylor_rates"] == {}
    whole = check_problem(problem, full=True)
    assert not whole.omitted
    assert not whole.derivative_fault


def test_an_edge_length_is_proposed_with_which_a_search_takes_a_minute(tiny: Path, monkeypatch):
    monkeypatch.setattr("collocation_sysid.runs.check.longest_edges", lambda *_: np.inf)
    problem = Problem.read(tiny / "problem.toml")
    assert check_problem(problem).longer_edges is None
    monkeypatch.setattr("collocation_sysid.runs.check.LONG_SOLVE_S", 1e-3)
    found = check_problem(problem)
    assert found.longer_edges is not None
    ratio, time_s = found.longer_edges
    assert ratio > 1.3
    assert time_s == pytest.approx(1e-3, rel=0.5)
    assert f"; edges {ratio:.2g} times as long: about" in plain_text(full_check_tables(found))
    # Not so long that too few elements are across a body that bends.
    monkeypatch.setattr("collocation_sysid.runs.check.longest_edges", lambda *_: 1.3)
    bending = check_problem(problem).longer_edges
    assert bending is not None
    assert bending[0] == 1.3
    assert bending[1] > time_s
    monkeypatch.setattr("collocation_sysid.runs.check.longest_edges", lambda *_: 0.9)
    assert check_problem(problem).longer_edges is None


def test_three_samples_of_equilibria_have_all_kinds_of_rows():
    static = shortened_problem(Problem([block(t_s=np.arange(6.0), z_m=np.zeros(6))], TRUTH))
    assert len(static.experiments[0].t_s) == 3
    moving = shortened_problem(Problem([hung_cube(30)], TRUTH))
    assert len(moving.experiments[0].t_s) == 12


# The screen and the JSON ------------------------------------------------------------------------


def test_the_findings_fit_a_screen_with_the_warnings_last(tiny: Path, monkeypatch):
    screen = io.StringIO()
    console = PlainConsole(file=screen, width=80, force_terminal=True, color_system=None)
    monkeypatch.setattr(common, "PlainConsole", lambda: console)
    nearly = ("parameters.mu_pa.guess=200", "parameters.lambda_pa.guess=9800")
    euler = "transcription.scheme=backward-euler"
    origin = "object.rest_shape=stress_free", "object.made=foam"
    outcome = run_command("check", "problem.toml", *settings(*nearly, euler, *origin))
    lines = [line.rstrip() for line in screen.getvalue().rstrip("\n").split("\n")]
    assert len(lines) <= 30  # of 80 characters, two of them on what is determined
    assert max(map(len, lines)) <= 80
    heads = [line.split()[0] for line in lines if line and not line.startswith(" ")]
    rows = [line.split()[0] for line in lines if line.startswith("  ")]
    assert {"object", "mesh", "guess", "first", "solve"} <= {*rows}
    assert heads[-1] == "The"
    assert heads[-2] == "what"
    assert heads[-3] == "warning:"
    assert outcome.code == 0


def test_the_json_holds_everything(tiny: Path):
    found = json.loads(run_command("check", "problem.toml", "--json").out)
    assert [m["name"] for m in found["recordings"][0]["markers"]] == ["low", "mid", "side"]
    assert found["motions"][0]["modes"][0]["frequency_hz"] > 0
    assert {cost["method"] for cost in found["costs"]} == {"reduced-space", "interior-point"}
    assert isinstance(found["warnings"], list)
    assert found["rms_at_guess_m"] > 0


def test_point_masses_are_stated_beside_the_mass_of_the_body(tmp_path):
    file = write_problem(tmp_path, {"swing": 4})
    file.write_text(
        file.read_text() + "\n[[experiment.mass]]\nnodes = { ball_m = [[0.03, 0.03, 0.0], 0.02] }\n"
        "mass_kg = 0.002\n"
    )
    (body,) = check_problem(Problem.read(file)).bodies
    assert body.point_masses_kg == {"swing": 0.002}
    out = run_command("check", file).out
    total_g = 1e3 * (body.mass_kg + 0.002)
    assert f"with point masses of 2 g {total_g:.4g} g" in out
