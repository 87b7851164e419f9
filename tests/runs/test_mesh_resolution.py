"""A mesh too coarse for bending is a reason to check the answer, not only the problem."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.common.display import plain_text
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.mesh_resolution import mesh_resolution_concerns, mesh_resolution_notes
from collocation_sysid.statistics.budget.discretisation_error import Refinement, RefinementLevel

FOAM_CYLINDER = Path(__file__).parents[2] / "problems" / "foam_cylinder" / "problem.toml"
LEVEL = RefinementLevel("mesh", 1, 1, 1, 1, 1.0, {})


def declared_simulated() -> cs.Problem:
    return cs.Problem.read(FOAM_CYLINDER)


def of_real_body() -> cs.Problem:
    return replace(declared_simulated(), uncertainty=cs.UncertaintyOptions())


def test_a_coarse_mesh_of_a_real_body_is_to_be_checked():
    (concern,) = mesh_resolution_concerns(of_real_body(), None, {})
    assert (concern.code, concern.grade) == ("mesh/few", "check")
    assert "stiffness of a real body will be too low" in concern.message
    assert mesh_resolution_notes(of_real_body()) == []


def test_a_declared_simulation_has_a_note_instead():
    (concern,) = mesh_resolution_concerns(of_real_body(), None, {})
    exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
    for problem in (declared_simulated(), replace(of_real_body(), uncertainty=exact)):
        assert mesh_resolution_concerns(problem, None, None) == []
        assert mesh_resolution_notes(problem) == [concern.message]


def test_a_solve_on_a_finer_mesh_answers_the_concern():
    estimated = Refinement({}, ())
    assert mesh_resolution_concerns(of_real_body(), estimated, {})
    step = Refinement({}, (replace(LEVEL, refined="step"),))
    assert mesh_resolution_concerns(of_real_body(), step, {})
    measured = Refinement({}, (LEVEL,))
    assert mesh_resolution_concerns(of_real_body(), measured, {}) == []


def test_averaged_dilatation_has_a_note_unless_the_mesh_error_is_unknown():
    body = cs.Body(
        cs.box_mesh((0.03, 0.03, 0.12), (1, 1, 4)), density_kg_m3=30.0, element="tet10-p0"
    )
    t_s = 0.01 * np.arange(5)
    poses = np.tile(np.eye(4), (5, 1, 1))
    grasp = cs.Grasp(cs.Box((-1, -1, -1), (1, 1, 1e-3)), poses)
    markers = cs.Markers(t_s, np.zeros((5, 1, 3)), sigma_m=1e-3, places_m=[(0.0, 0.0, 0.12)])
    rebuilt = cs.Experiment(body, t_s, [grasp], markers, name="bar")
    problem = cs.Problem(
        [rebuilt], {"mu_pa": cs.Unknown(), "poisson": 0.3, "gamma_r_s": 0.0} | {"gamma_m_1_s": 0.0}
    )
    known = {"mu_pa": -0.1}
    assert mesh_resolution_concerns(problem, None, known) == []
    (note,) = mesh_resolution_notes(problem, known)
    (concern,) = mesh_resolution_concerns(problem, None, None)
    assert concern.message == note
    assert mesh_resolution_notes(problem) == []
    assert "stiffness of a real body will be too high" in note


def test_a_mesh_matters_only_to_estimated_moduli_of_fitted_bodies():
    problem = of_real_body()
    known = {"lambda_pa": 800.0, "mu_pa": 600.0, "gamma_m_1_s": 1.5}
    damping = cs.Problem(problem.experiments, {**known, "gamma_r_s": cs.Unknown()})
    assert mesh_resolution_concerns(damping, None, None) == []


@pytest.mark.long
def test_the_answer_and_its_file_carry_the_concern(tmp_path):
    run = cs.run(of_real_body(), "reduced-space")
    assert run.trust.verdict == "check"
    (concern,) = (c for c in run.trust.concerns if c.code == "mesh/few")
    run.save(tmp_path / "run", pictures=False)
    text = (tmp_path / "run" / "result.json").read_text(encoding="utf8")
    assert '"mesh/few"' in text
    assert concern.message in plain_text(run_summary(run.result, details=True), width=10_000)
