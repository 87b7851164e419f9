"""Deep probes find the part of the data or the assumption that causes a hidden misfit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from assumed_twins import with_wrong_assumptions
from kit.problem_files import run_command, write_problem
from kit.problems import GUESS, hung_cube
from kit.problems import TRUTH as LAME
from scipy.interpolate import CubicSpline

from collocation_sysid import (
    Body,
    Nuisance,
    Problem,
    Run,
    UncertaintyOptions,
    Unknown,
    run,
    simulate,
    with_markers,
)
from collocation_sysid.common.display import plain_text
from collocation_sysid.common.step_counting import listen_to_shares
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.result_content import Result
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.probes.deep import WINDOWS, Probe

TRUTH = {"young_pa": 8e3, "poisson": 0.3, "gamma_r_s": 6e-3, "gamma_m_1_s": 1.0}
FREED = ("density_gradient", "anisotropy", "stiffness_drift", "clock_rate")
NOISE_M = 1e-4


@cache
def swung(fault: str = "", off: float = 0.0) -> Problem:
    """A cube that was swung, of which something is off, described as if nothing were."""
    hung = hung_cube(80)
    hung = replace(hung, body=Body(hung.body.mesh, density_kg_m3=60.0), nuisance=Nuisance.none())
    recorded = with_wrong_assumptions(hung, TRUTH, {} if fault == "clock_rate" else {fault: off})
    tracks = recorded.markers.positions_m
    if fault == "clock_rate":  # cameras' times are too large
        tracks = CubicSpline(recorded.t_s, tracks)(recorded.t_s * (1 - off))
    tracks = tracks + NOISE_M * np.random.default_rng(0).standard_normal(tracks.shape)
    sigma_m = np.full(tracks.shape[1], NOISE_M)
    seen = replace(recorded.markers, positions_m=tracks, sigma_m=sigma_m)
    parameters = Parameters.from_mapping({name: Unknown(value) for name, value in TRUTH.items()})
    exact = {n: "none" for n in Assumptions().collect_deviations() if n not in FREED}
    stated = Assumptions(**exact, density_gradient=0.1)
    options = UncertaintyOptions(assumptions=stated)
    return Problem([replace(recorded, markers=seen)], parameters, substeps=1, uncertainty=options)


@cache
def probed(fault: str = "", off: float = 0.0) -> Run:
    """The answer, with all probes."""
    return run(swung(fault, off), seek_causes=False, probe=True)


@cache
def plain(fault: str = "", off: float = 0.0) -> Run:
    """The answer, with the probes of every solve."""
    return run(swung(fault, off), seek_causes=False)


def named(solved: Run, name: str) -> Probe:
    (probe,) = (each for each in solved.probes if each.name == name)
    return probe


def told(solved: Run) -> list[str]:
    """Freed assumptions that are told, the best first."""
    freed = [p for p in solved.probes if p.kind == "assumption" and p.sentences]
    return [p.name for p in sorted(freed, key=lambda p: -p.chi_squared)]


@pytest.mark.long
def test_refits_report_the_share_of_significant_assumptions():
    name, off = "stiffness_drift", -0.05
    events: list[str | float | None] = []
    with listen_to_shares(events.append):
        solved = run(swung(name, off), log=events.append, seek_causes=False, probe=True)
    refits = [text for text in events if "refitting" in str(text)]
    after = events[events.index(refits[0]) + 1 :]
    tested = after[: after.index(None) + 1]
    assert tested[0] == 0.0
    assert tested[-2] == pytest.approx(1.0)
    assert (np.diff(tested[:-1]) >= 0).all()
    assert name in told(solved)


@pytest.mark.long
def test_nothing_is_reported_for_a_correct_description():
    faultless = probed()
    assert [p.name for p in faultless.probes if p.kind == "window"] == list(WINDOWS)
    assert not any(p.sentences for p in faultless.probes)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "off", "of"),
    [
        ("density_gradient z", -0.1, "young_pa"),
        ("stiffness_drift", -0.05, None),
        ("clock_rate", 1e-3, "gamma_m_1_s"),
    ],
)
def test_a_probe_finds_a_wrong_value(name, off, of):
    solved = probed(name, off)
    assert told(solved)[0] == name
    probe = named(solved, name)
    size = -off if name == "clock_rate" else off
    assert abs(probe.size - size) < 3 * probe.size_error
    if of is not None:  # which is nearer to the truth with it than without
        move = probe.moves[of]
        assert abs(move.value - TRUTH[of]) < 3 * move.std_error
        assert abs(move.value - TRUTH[of]) < 0.5 * abs(move.value - move.change - TRUTH[of])


def test_windows_of_time_have_the_stiffness_of_their_time():
    drifting = probed("stiffness_drift", -0.05)
    first, _, last = (named(drifting, w).moves["young_pa"].change for w in WINDOWS)
    assert first > 0 > last
    assert (first - last) / TRUTH["young_pa"] == pytest.approx(0.05 * 2 / 3, rel=0.3)


@pytest.mark.long
def test_probes_are_reported_for_each_recording_alone():
    rng, swings = np.random.default_rng(2), []
    for k, damping in enumerate((5e-3, 9e-3)):
        swing = replace(hung_cube(25), name=f"swing {k}")
        tracks = simulate(swing, LAME | {"gamma_r_s": damping}, "midpoint", substeps=1).markers_m
        tracks = tracks + swing.markers.sigma_m[:, None] * rng.standard_normal(tracks.shape)
        swings.append(with_markers(swing, tracks))
    exact = Assumptions(**{name: "none" for name in Assumptions().collect_deviations()})
    options = UncertaintyOptions(assumptions=exact)
    problem = Problem(swings, GUESS, substeps=1, uncertainty=options)
    solved = run(problem, seek_causes=False, probe=True)
    alone = {p.name: p for p in solved.probes if p.kind == "recording"}
    assert set(alone) == {"swing 0", "swing 1"}
    less, more = (alone[f"swing {k}"].moves["gamma_r_s"].value for k in range(2))
    assert less < solved.parameters["gamma_r_s"] < more
    assert all("gamma_r_s" in p.sentences and p.chi_squared > 10 for p in alone.values())


def test_shares_of_both_intervals_stand_beside_every_change():
    solved = probed("density_gradient z", -0.1)
    low, high = solved.optimum["young_pa"].statistical95
    least, most = solved.estimates["young_pa"].combined95
    move = named(solved, "density_gradient z").moves["young_pa"]
    assert move.of_statistical95 == pytest.approx(2 * move.change / (high - low))
    assert move.of_combined95 == pytest.approx(2 * move.change / (most - least))


def test_terminal_page_and_file_have_the_probes(tmp_path):
    solved = probed("density_gradient z", -0.1)
    folder = solved.save(tmp_path / "run", frames=False)
    result = Result.read(folder)
    assert {p.name for p in result.probes} == {p.name for p in solved.probes}
    said = plain_text(run_summary(result, folder))
    assert "the data determine density gradient z: with -0.1" in said
    assert "−Δχ²" in said
    assert run_command("report", folder).code == 0
    assert "the data determine density gradient z" in next(folder.glob("*.html")).read_text()


@pytest.mark.long
def test_a_solve_makes_the_routine_probes_and_all_probes_on_request(tmp_path):
    file = write_problem(tmp_path, {"swing": 12})
    plain = run_command("solve", file, "--out", tmp_path / "plain", "--quiet")
    routine = Result.read(tmp_path / "plain").probes
    names = [p.name.partition(" ")[0] for p in routine]
    assert [*dict.fromkeys(names)] == [
        "anisotropy",
        "stiffness_drift",
        "memory_share",
        "clock_rate",
    ]
    assert all(p.routine for p in routine)
    assert "without a finding" not in plain.out
    told = plain_text(run_summary(Result.read(tmp_path / "plain"), details=True))
    assert "tested without a finding: anisotropy z, stiffness drift, memory share" in told
    probing = run_command("solve", file, "--out", tmp_path / "probed", "--quiet", "--probe")
    deep = Result.read(tmp_path / "probed").probes
    assert not any(p.routine for p in deep)
    assert {p.kind for p in deep} == {"window", "assumption"}
    assert "solve --probe" not in probing.out
    assert (
        "relative to the half widths of the statistical and of the combined interval"
        in " ".join(probing.out.split())
    )


def test_an_assumption_that_a_deep_probe_contradicts_means_check():
    wrong_density = probed("density_gradient z", -0.1)
    (concern,) = (c for c in wrong_density.trust.concerns if c.topic == "assumption")
    assert concern.grade == "check"
    assert concern.data["name"] == "density gradient z"
    assert not [c for c in probed().trust.concerns if c.topic == "assumption"]
