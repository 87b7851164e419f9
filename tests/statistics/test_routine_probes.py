"""Routine probes of every solve: drift of stiffness and clock rates."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from assumed_twins import with_wrong_assumptions
from kit.problems import EDGE_M, IDEAL, box, hung_cube, nodes_where, smooth_poses, vertex_markers
from scipy.interpolate import CubicSpline

from collocation_sysid import (
    Body,
    Experiment,
    Field,
    Grasp,
    PoseSequence,
    Problem,
    Run,
    Specimen,
    UncertaintyOptions,
    Unknown,
    run,
)
from collocation_sysid.common.display import plain_text
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.recording.nuisance import TEMPERATURE
from collocation_sysid.result.probe_sections import DEEPER_CHECK_ADVICE, is_deeper_check_worthwhile
from collocation_sysid.result.run_summary import next_step, run_summary
from collocation_sysid.statistics.assessment import Assessment, probe_concerns
from collocation_sysid.statistics.budget.consider_analysis import changes_of_assumptions
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.concerns import TOPICS
from collocation_sysid.statistics.linearised import gauss_newton_step, linearise_fit
from collocation_sysid.statistics.probes.relaxed_assumptions import (
    EstimateChange,
    Probe,
    SolvedFit,
    has_monotonic_load,
    probed_changes,
)
from collocation_sysid.statistics.probes.routine import (
    RELEVANT,
    is_alarming,
    probed_deviations,
    routine_probes,
)
from collocation_sysid.statistics.thresholds import RARE
from collocation_sysid.statistics.uncertainty import AUTO

TRUTH = {"young_pa": 8e3, "poisson": 0.3, "gamma_r_s": 6e-3, "gamma_m_1_s": 1.0}
NOISE_M = 2.5e-4
# Timesteps of the truth, and of the fit, between two samples: else the scheme's own error shows.
FINER, SUBSTEPS = 6, 4
DRIFT, MEMORY, CLOCK = "stiffness_drift", "memory_share", "clock_rate"
ANISOTROPY = "anisotropy"
ANISOTROPY_PROBES = [f"{ANISOTROPY} {axis}" for axis in "xyz"]
# Relaxation times between the interval of the samples and the duration of the recording.
MEMORY_PROBES = [f"{MEMORY} τ={tau_s:g}s" for tau_s in (0.01, 0.03, 0.1, 0.3)]


@cache
def swung(
    fault: str = "", off: float = 0.0, samples: int = 60, noise_m: float = NOISE_M
) -> Problem:
    """A cube that was swung, of which something is off, described as if nothing were."""
    hung = hung_cube(samples)
    hung = replace(hung, body=Body(hung.body.mesh, density_kg_m3=60.0))
    fine_s = np.linspace(0.0, hung.t_s[-1], FINER * (len(hung.t_s) - 1) + 1)
    fine = replace(
        hung,
        t_s=fine_s,
        markers=vertex_markers(hung.body, nodes_where(hung.body, 2, 0.0), fine_s),
        grasps=(Grasp(hung.grasps[0].nodes, smooth_poses(fine_s)),),
    )
    recorded = with_wrong_assumptions(fine, TRUTH, {} if fault == CLOCK else {fault: off})
    tracks = recorded.markers.positions_m[::FINER]
    if fault == CLOCK:  # the times of the cameras are too large
        tracks = CubicSpline(hung.t_s, tracks)(hung.t_s * (1 - off))
    tracks = tracks + noise_m * np.random.default_rng(0).standard_normal(tracks.shape)
    sigma_m = np.full(tracks.shape[1], noise_m)
    seen = replace(hung.markers, positions_m=tracks, sigma_m=sigma_m)
    estimated = {name: Unknown(TRUTH[name]) for name in ("young_pa", "poisson", "gamma_r_s")}
    parameters = Parameters.from_mapping(TRUTH | estimated)
    # Nothing but the probes is to give concern: all assumptions are stated as exact.
    exact = Assumptions(**dict.fromkeys(Assumptions().collect_deviations(), "none"))
    options = UncertaintyOptions(assumptions=exact)
    recorded = replace(hung, markers=seen)
    return Problem([recorded], parameters, substeps=SUBSTEPS, uncertainty=options)


@cache
def solved(fault: str = "", off: float = 0.0, noise_m: float = NOISE_M) -> Run:
    return run(swung(fault, off, noise_m=noise_m), "reduced-space", seek_causes=False)


def named(finished: Run, name: str) -> Probe:
    (probe,) = (each for each in finished.probes if each.name == name)
    return probe


# Whole solves -------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_faultless_solve_has_all_routine_probes_and_no_alarm():
    faultless = solved()
    assert [probe.name for probe in faultless.probes] == [
        *ANISOTROPY_PROBES,
        DRIFT,
        *MEMORY_PROBES,
        CLOCK,
    ]
    assert not any(probe.sentences for probe in faultless.probes)
    assert faultless.trust.verdict == "good"
    assert not is_deeper_check_worthwhile(faultless.result)
    assert "solve --probe" not in plain_text(run_summary(faultless.result, Path("runs")))


@pytest.mark.long
@pytest.mark.parametrize(("fault", "off", "size"), [(DRIFT, -0.15, -0.15), (CLOCK, 7e-4, -7e-4)])
def test_a_drift_and_a_wrong_clock_rate_mean_check_with_corrected_estimates(fault, off, size):
    wrongly = solved(fault, off)
    probe = named(wrongly, fault)
    assert probe.sentences
    assert abs(probe.size - size) < 3 * probe.size_error
    assert probe.chi_squared > 15
    assert wrongly.trust.verdict == "check"
    (concern,) = wrongly.trust.concerns
    assert concern.code == "assumption/contradicted"
    assert fault.replace("_", " ") in concern.message
    for symbol in ("E = ", "ν = ", "γ_r = "):
        assert symbol in concern.message
    for name, move in probe.moves.items():
        if name in TRUTH:  # the corrected estimates are right
            assert abs(move.value - TRUTH[name]) < 3.5 * move.std_error
    assert is_deeper_check_worthwhile(wrongly.result)
    assert DEEPER_CHECK_ADVICE in plain_text(run_summary(wrongly.result, details=True))
    assert next_step(wrongly.result, Path("runs"), "solve").startswith("solve --probe ")


@pytest.mark.long
def test_fibres_along_an_axis_give_check_with_both_moduli():
    fibrous = solved("anisotropy z", 0.3, noise_m=NOISE_M / 4)
    truth_pa = TRUTH["young_pa"]
    assert fibrous.interval("young_pa")[0] > truth_pa
    assert fibrous.trust.verdict == "check"
    (concern,) = (c for c in fibrous.trust.concerns if c.topic == "assumption")
    assert "the material is equally stiff along all axes: with anisotropy z = " in concern.message
    assert "the modulus along this axis" in concern.message
    probe = named(fibrous, "anisotropy z")
    assert probe.chi_squared > 0
    assert abs(probe.size - 0.3) < 0.1
    young_pa = probe.moves["young_pa"].value
    assert abs(young_pa / truth_pa - 1) < 0.03
    assert young_pa * (1 + probe.size) == pytest.approx(1.3 * truth_pa, rel=0.06)


# Level of significance ----------------------------------------------------------------------------


def answered(problem: Problem) -> SolvedFit:
    """The fit of a problem at its guess, as if that were the answer."""
    collocation = replace(problem.collocation(), substeps=1)
    z, _ = initial_variables(collocation)
    fit = linearise_fit(collocation, z)
    deviations = probed_deviations(Assumptions().collect_deviations())
    kept = {
        name: deviations[name] if name in (DRIFT, MEMORY, CLOCK, ANISOTROPY) else None
        for name in deviations
    }
    return SolvedFit(
        collocation=collocation,
        z=z,
        fit=fit,
        error_model=AUTO,
        statistical={},
        budget={},
        deviations=kept,
        changes=probed_changes(collocation, z, kept),
    )


def test_faultless_fits_have_no_significant_probe():
    at = answered(swung(samples=24))
    rng, draws, alarms = np.random.default_rng(3), 60, 0
    for _ in range(draws):
        noisy = [
            replace(b, residual=rng.standard_normal(b.residual.shape) * b.is_measured, misfit=None)
            for b in at.fit.blocks
        ]
        fit = replace(at.fit, blocks=tuple(noisy))
        fit = fit.after_step(gauss_newton_step(fit))
        here = replace(at, fit=fit)
        of_fit = here.uncertainty_of_refit(fit, here.read_parameters())
        here = replace(here, statistical={**of_fit.estimates, **of_fit.derived})
        alarms += any(probe.sentences for probe in routine_probes(here))
    assert RARE == 1e-4
    assert alarms == 0


def with_residuals(at: SolvedFit, residuals: list[np.ndarray]) -> SolvedFit:
    """A fit with other residuals, at its optimum."""
    changed = [
        replace(block, residual=residual * block.is_measured, misfit=None)
        for block, residual in zip(at.fit.blocks, residuals, strict=True)
    ]
    fit = replace(at.fit, blocks=tuple(changed))
    fit = fit.after_step(gauss_newton_step(fit))
    known = at.uncertainty_of_refit(fit, at.read_parameters())
    return replace(at, fit=fit, statistical={**known.estimates, **known.derived})


def test_an_assumption_must_explain_all_of_the_residuals():
    at = answered(swung(samples=24))
    name = f"{MEMORY} τ=0.1s"
    column = at.changes.names.index(name)
    rng = np.random.default_rng(5)
    noise = [rng.standard_normal(block.residual.shape) for block in at.fit.blocks]
    of_memory = [noise[k] - 5 * at.changes.blocks[k][..., column] for k in range(len(noise))]
    waves = 2 * np.sin(0.8 * np.arange(len(noise[0])))[:, None, None]
    of_model = [each + waves * np.sign(rng.standard_normal(each.shape[1:])) for each in of_memory]
    for residuals, suffices in ((of_memory, True), (of_model, False)):
        probes = {probe.name: probe for probe in routine_probes(with_residuals(at, residuals))}
        probe = replace(probes[name], relevance=1.0)
        assert probe.sentences
        assert probe.size > 0
        assert probe.suffices is suffices
        assert is_alarming(probe) is suffices


def test_what_a_field_smooths_away_is_no_memory():
    plain = swung(samples=24)
    (hung,) = plain.experiments
    body = Body(hung.body.mesh, density_kg_m3=60.0, field=Field(0.1, modes=6, amplitude=0.02))
    at = answered(replace(plain, experiments=[replace(hung, body=body)]))
    name = f"{MEMORY} τ=0.1s"
    column = at.changes.names.index(name)
    of_memory = [change[..., column] for change in at.changes.blocks]
    of_field = [n.startswith("field_") for n in at.fit.names]
    assert sum(of_field) == 6
    slopes = np.concatenate([b.jacobian.reshape(-1, len(of_field)) for b in at.fit.blocks])
    stacked = np.concatenate([each.ravel() for each in of_memory])
    shares, *_ = np.linalg.lstsq(slopes[:, of_field], stacked, rcond=None)
    rng = np.random.default_rng(5)
    noise = [rng.standard_normal(block.residual.shape) for block in at.fit.blocks]
    # What the field could describe if its prior allowed it, or memory itself.
    smoothed = [block.jacobian[..., of_field] @ shares for block in at.fit.blocks]
    for wrong, size, is_named in ((smoothed, 10, False), (of_memory, 20, True)):
        residuals = [one - size * other for one, other in zip(noise, wrong, strict=True)]
        here = with_residuals(at, residuals)
        probes = {probe.name: probe for probe in routine_probes(here)}
        assert probes[name].is_beyond(5.0)
        assert bool(probes[name].sentences) is is_named


def test_quantities_stated_as_exact_are_probed_too():
    exact = dict.fromkeys(Assumptions().collect_deviations())
    assert {n: s for n, s in probed_deviations(exact).items() if s} == {
        DRIFT: 0.02,
        MEMORY: 0.1,
        CLOCK: 1e-4,
        ANISOTROPY: 0.05,
        TEMPERATURE.name: 5e-3,
        "image_focal": 5e-3,
        "image_centre_px": 2.0,
        "image_time_s": 5e-3,
        "image_clock_rate": 1e-4,
        "image_line_delay_s": 1e-5,
        "image_drift_px": 0.2,
    }
    assert probed_deviations({**exact, DRIFT: 0.1})[DRIFT] == 0.1


# Judgement of a probe -----------------------------------------------------------------------------


def probe(
    relevance: float, is_significant: bool = True, name: str = DRIFT, fall: float = 20.0
) -> Probe:
    moves = {"young_pa": EstimateChange(8100.0, 40.0, 100.0, 2.0, 0.5)}
    own = (name,) if is_significant else ()
    return Probe("assumption", name, fall, moves, -0.05, 0.01, own, True, relevance)


def test_a_significant_and_relevant_probe_alarms():
    assert is_alarming(probe(2 * RELEVANT))
    assert not is_alarming(probe(0.5 * RELEVANT))
    assert not is_alarming(probe(2 * RELEVANT, is_significant=False))
    assert not is_alarming(replace(probe(2.0), kind="window"))
    assert not is_alarming(replace(probe(2.0), suffices=False))


def test_a_negative_share_is_no_memory():
    negative = probe(2.0, name=f"{MEMORY} τ=0.1s")
    assert negative.size < 0
    assert not is_alarming(negative)
    assert is_alarming(replace(negative, size=0.05))


def test_the_concern_names_the_assumption_and_every_corrected_estimate():
    both = [probe(1.0, name=CLOCK, fall=12.0), probe(1.0)]
    (concern,) = probe_concerns(both, {"young_pa": 1.01, "poisson": 1.0})
    assert concern.grade == "check"
    assert Assessment.from_concerns([concern]).verdict == "check"
    assert concern.message == (
        "the data contradict the assumption that the stiffness is constant during a recording: "
        "with stiffness drift = -0.05 ± 0.01, χ² decreases by 20, and the estimates become E = "
        "8181 ± 40 Pa and ν not determined; alternatives that decrease χ² less: clock rate (12); a "
        "wrong damping or material law has similar effects: compare the laws first, with "
        "compare-models --damping and --materials"
    )
    assert probe_concerns([probe(0.0)], {"young_pa": 1.0}) == []


# Static recordings --------------------------------------------------------------------------------


def pressed(heights_m: list[float]) -> Experiment:
    """A cube on the floor under a platen at some heights, one after the other."""
    body, t_s = box(), np.arange(float(len(heights_m)))
    positions = np.outer(heights_m, [0.0, 0.0, 1.0])
    platen = PoseSequence(t_s, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)), "linear")
    grasps = [
        Grasp(nodes_where(body, 2, 0.0), PoseSequence.fixed()),
        Grasp(nodes_where(body, 2, EDGE_M), platen),
    ]
    markers = vertex_markers(body, nodes_where(body, 0, EDGE_M), t_s)
    still = {"gravity_m_s2": (0.0, 0.0, 0.0), "nuisance": IDEAL, "kind": "static"}
    return Experiment(body, t_s, grasps, markers, **still)


def test_without_motion_memory_is_advised_and_no_law_of_damping():
    still = [pressed([0.0, -0.001])]
    (concern,) = probe_concerns([probe(1.0)], {"young_pa": 1.0}, still)
    assert "compare-models --prony 0,1" in concern.message
    assert "--damping" not in concern.message


@pytest.mark.parametrize(
    ("heights_m", "drifts"),
    [
        ([0.0, -0.005, -0.01, -0.015], False),  # as a wrong law of the material would look
        ([0.0, -0.01], False),
        ([0.0, -0.01, 0.0, -0.01, -0.005], True),
    ],
)
def test_a_static_recording_shows_a_drift_only_where_its_load_returns(heights_m, drifts):
    stiffness = {"lambda_pa": Unknown(800.0), "mu_pa": Unknown(600.0)}
    guess = Parameters.from_mapping({**stiffness, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0})
    collocation = Collocation([pressed(heights_m)], guess)
    z, _ = initial_variables(collocation)
    (part,) = collocation.iterates(z)
    assert has_monotonic_load(part, collocation) is not drifts
    none = dict.fromkeys(Assumptions().collect_deviations())
    changes = probed_changes(collocation, z, {**none, DRIFT: 0.02})
    column = changes.names.index(DRIFT)
    assert any(block[..., column].any() for block in changes.blocks) is drifts


def test_specimens_are_not_probed_for_anisotropy():
    """In tests of one material along several axes, another material law has the same effect."""
    stretch = np.linspace(1.05, 1.5, 6)
    stress_pa = 1e5 * (stretch - stretch**-2)
    specimen = Specimen("uniaxial", stretch - 1, stress_pa, sigma_pa=1e3, strain_zero=0.0)
    fixed = {"kappa_pa": 1e9, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    collocation = Collocation(
        [specimen.experiment("neo-hookean", "pull")],
        Parameters.from_mapping({"mu_pa": Unknown(1e5), **fixed}),
    )
    z, _ = initial_variables(collocation)
    none = dict.fromkeys(Assumptions().collect_deviations())
    deviations = {**none, ANISOTROPY: 0.05}
    for changes, is_shown in (
        (changes_of_assumptions(collocation, z, deviations), True),
        (probed_changes(collocation, z, deviations), False),
    ):
        columns = [k for k, name in enumerate(changes.names) if name in ANISOTROPY_PROBES]
        assert any(block[..., columns].any() for block in changes.blocks) is is_shown


def test_a_significant_routine_probe_recommends_the_comparison_of_laws():
    probe = Probe(
        "assumption",
        "clock_rate",
        chi_squared=40.0,
        moves={},
        size=0.01,
        size_error=0.001,
        sentences=("clock_rate",),
        routine=True,
        relevance=1.0,
    )
    (concern,) = probe_concerns([probe], {})
    assert "compare-models --damping and --materials" in concern.message
    other = replace(probe, name="mass", routine=False)
    (concern,) = probe_concerns([other], {})
    assert "compare-models" not in concern.message
    remedy = TOPICS["assumption"].remedy
    assert "compare-models" in remedy
    assert "--damping" in remedy


def test_the_advice_names_the_command_and_the_argument():
    assert "`solve --probe`" in DEEPER_CHECK_ADVICE
    assert "probe=True" in DEEPER_CHECK_ADVICE
