"""Misspecification hypotheses about wrenches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from kit.problems import GUESS, TRUTH
from kit.static import ELASTIC_ONLY, TIMES, block
from kit.wrench_fits import swung

from collocation_sysid.judge.engine import find_misspecifications
from collocation_sysid.judge.fit import TestedFit
from collocation_sysid.judge.sensors import sensor_candidates
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.program.collocation import Collocation, ExperimentIterate
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.program.wrench_residual import WrenchResidual
from collocation_sysid.recording import Nuisance, Wrench
from collocation_sysid.recording.nuisance import TOOL_CENTRE, TOOL_MASS
from collocation_sysid.statistics.assessment import cause_concerns


def changed(change: Callable[[Wrench], Wrench]) -> Collocation:
    experiment = swung()
    (grasp,) = experiment.grasps
    assert grasp.wrench is not None
    wrong = replace(grasp, wrench=change(grasp.wrench))
    return Collocation([replace(experiment, grasps=[wrong])], GUESS)


def in_kilograms(wrench: Wrench) -> Wrench:
    values = np.array(wrench.values)
    values[:, :3] /= 9.80665
    return replace(wrench, values=values)


MISTAKES = {
    "sensor-sign": lambda w: replace(w, values=-w.values),
    "sensor-unit": in_kilograms,
    "sensor-axes": lambda w: replace(w, values=w.values[:, [0, 2, 1, 3, 5, 4]]),
}


@pytest.mark.long
@pytest.mark.parametrize(("cause", "change"), MISTAKES.items(), ids=MISTAKES)
def test_a_mistake_is_the_likeliest_cause(cause: str, change: Callable[[Wrench], Wrench]):
    collocation = changed(change)
    found = find_misspecifications(ReducedSpace()(collocation))
    assert found[0].code == cause
    assert cause_concerns(found)[0].grade == "doubtful"


def test_a_wrench_that_fits_has_no_cause():
    assert not find_misspecifications(ReducedSpace()(changed(lambda w: w)))


# Mass of the tool, more than that of the cube [kg], and its place beyond the grasp [m].
TOOL_KG = 0.5
TOOL_M = (0.01, 0.0, 0.03)
# Factor by which the noise is stated too small, so that the misfit is large enough for a search.
UNDERSTATED = 1.6


def with_tool() -> Collocation:
    """The swung cube whose sensor carries a heavy tool that is estimated."""
    experiment = swung(nuisance=Nuisance.none())
    allowed = replace(Nuisance.none(), tool_kg=1.0, tool_m=0.1)
    given = replace(experiment, nuisance=allowed)
    collocation = Collocation([given], GUESS)
    (transcription,) = collocation.transcriptions
    (sensor,) = transcription.residuals_of(WrenchResidual)
    solution = ReducedSpace()(Collocation([experiment], GUESS))
    (part,) = solution.parts
    phi = np.zeros(transcription.nuisance.size)
    tool = transcription.nuisance.indices_of_rows(TOOL_MASS, TOOL_CENTRE)
    phi[tool] = [TOOL_KG, *TOOL_M] / transcription.nuisance.scales[tool]
    iterate = ExperimentIterate(transcription, part.q, phi=phi, x=part.x)
    motion = iterate.motion_for(sensor.observable)
    added = sensor.numbers(
        sensor.predict_motion(motion, phi) - sensor.predict_motion(motion, 0 * phi)
    )
    (grasp,) = given.grasps
    assert grasp.wrench is not None
    carried = replace(
        grasp.wrench,
        values=grasp.wrench.values + added,
        sigma_n=grasp.wrench.sigma_n / UNDERSTATED,
        sigma_nm=grasp.wrench.sigma_nm / UNDERSTATED,
    )
    return Collocation([replace(given, grasps=[replace(grasp, wrench=carried)])], GUESS)


def test_a_wrench_with_an_estimated_tool_has_no_cause():
    solution = ReducedSpace()(with_tool())
    (part,) = solution.parts
    (mass,) = part.transcription.nuisance.indices_of_rows(TOOL_MASS)
    found_kg = part.phi[mass] * part.transcription.nuisance.scales[mass]
    assert found_kg == pytest.approx(TOOL_KG, rel=0.05)
    assert not find_misspecifications(solution)


@pytest.mark.parametrize("has_markers", [True, False])
def test_the_only_load_of_equilibria_has_no_wrong_unit(has_markers):
    below, above, *sides = block().grasps
    zeros = Wrench(TIMES, np.zeros((len(TIMES), 6)), sigma_n=0.01, sigma_nm=1.0)

    def loaded(wrench: Wrench):
        return replace(block(), grasps=[below, replace(above, wrench=wrench), *sides])

    right = simulate(loaded(zeros), TRUTH)
    late_n = np.full((len(TIMES), 6), np.nan)
    late_n[:, 2] = np.interp(TIMES - 0.5, TIMES, right.wrenches[0][:, 2])
    late = with_markers(loaded(replace(zeros, values=late_n)), right.markers_m)
    if not has_markers:
        late = late.with_measurements([None, *late.wrenches])
    names = [item.name for item in ELASTIC_ONLY.free]
    soft = ELASTIC_ONLY.with_estimates({name: 0.1 * TRUTH[name] for name in names})
    solution = ReducedSpace()(Collocation([late], soft))
    found = [each.code for _, each in sensor_candidates(TestedFit(solution, solution))]
    assert "sensor-unit" not in found
