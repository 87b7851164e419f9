"""One time step of a small body as a CasADi function: in Opti, as C code, and beside the program."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from kit.problems import (
    EDGE_M,
    GRAVITY_M_S2,
    IDEAL,
    TRUTH,
    box,
    hung_cube,
    measured,
    nodes_where,
    times,
    vertex_markers,
)

import collocation_sysid as cs
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.model.dynamics import Dynamics

CORE = cs.Region("core", cs.Box([0, 0, 0], [0.1, 0.1, 0.06]), density_kg_m3=60.0)
BODIES = {
    "tet4": lambda mesh: Body(mesh, density_kg_m3=30.0),
    "tet10": lambda mesh: Body(mesh, density_kg_m3=30.0, element="tet10", damping="rayleigh"),
    "tet10-p0": lambda mesh: Body(mesh, density_kg_m3=30.0, element="tet10-p0"),
    "regions": lambda mesh: Body(mesh, "mooney-rivlin", density_kg_m3=30.0, regions=[CORE]),
    "free density": lambda mesh: Body(mesh, density_kg_m3=30.0).with_free_densities([""]),
}


def motion(body: Body, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Some motion (N, 3n), and constants near those of a soft foam."""
    rng = np.random.default_rng(3)
    x = body.nodes_m.ravel() + 5e-4 * rng.normal(size=(rows, body.nodes_m.size)).cumsum(axis=0)
    usual = {"density_kg_m3": 35.0, "gamma_r_s": 0.01, "gamma_m_1_s": 0.5}
    theta = [usual.get(name.split(".")[-1], 300.0) for name in body.constants]
    return x, np.array(theta)


def residuals(body: Body, scheme: str, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Residuals (N, 3n) of the equations of motion of the program, with weight and no air."""
    t_s = times(len(x) - 1)
    grasp = cs.Grasp(nodes_where(body, 2, EDGE_M), cs.PoseSequence.fixed())
    markers = vertex_markers(body, nodes_where(body, 2, 0.0), t_s)
    still = cs.Experiment(body, t_s, [grasp], markers, nuisance=IDEAL, air_density_kg_m3="none")
    dynamics = Dynamics.from_experiment(still, scheme).with_theta(theta)
    return dynamics.residual(x)


@pytest.mark.parametrize(
    ("kind", "scheme"), [*((kind, "midpoint") for kind in BODIES), *(("tet4", s) for s in SCHEMES)]
)
def test_every_row_is_that_of_the_program(kind: str, scheme: str):
    plain = hung_cube(5)
    body = BODIES[kind](plain.body.mesh)
    x, theta = motion(body, 6)
    expected = residuals(body, scheme, x, theta)
    weight = np.repeat(body.mass_of_dofs(theta)[::3], 3) * np.tile(GRAVITY_M_S2, len(body.nodes_m))
    step_s = plain.timestep_s
    for row in range(1, 6):
        first = body.step_function(scheme, row=row)
        before = [x[row - lag] for lag in range(sum(n.startswith("x") for n in first.name_in()))]
        v_0 = [np.zeros_like(weight)] if "v_0" in first.name_in() else []
        stencil = SCHEMES[scheme].stencil(row)
        u = weight * sum(stencil.w[:row])
        own = first(*before, *v_0, u, theta, step_s).full().ravel()
        np.testing.assert_allclose(own, expected[row], rtol=0, atol=1e-11 * abs(expected).max())
    regular = body.step_function(scheme)
    assert regular.name_in()[-3:] == ["u", "theta", "step_s"]
    if scheme != "bdf2":
        own = regular(x[5], x[4], x[3], weight, theta, step_s).full().ravel()
        np.testing.assert_allclose(own, expected[5], rtol=0, atol=1e-11 * abs(expected).max())


def test_opti_identifies_the_stiffness_that_the_package_identifies():
    """A program of the user's own: positions and the modulus are variables of Opti."""
    known = replace(hung_cube(8, (1, 1, 1)), air_density_kg_m3="none")
    experiment = measured(known)
    fixed = {name: value for name, value in TRUTH.items() if name != "mu_pa"}
    problem = cs.Problem([experiment], {"mu_pa": cs.Unknown(200.0), **fixed})
    solution = cs.solve(problem)

    body, t_s = experiment.body, experiment.t_s
    size = body.nodes_m.size
    start, held = experiment.rigid_positions(t_s), experiment.prescribed_dofs
    free = [k for k in range(size) if k not in held]
    weight = np.repeat(body.node_mass, 3) * np.tile(GRAVITY_M_S2, len(body.nodes_m))
    opti = ca.Opti()
    mu = opti.variable()
    x = [opti.variable(size) for _ in t_s]
    theta = ca.vertcat(*[mu if n == "mu_pa" else TRUTH[n] for n in body.constants])
    step, step_s = body.step_function("midpoint"), float(t_s[1] - t_s[0])
    # The body starts at rest in equilibrium, as if it had been so before.
    rows = [x[0], x[0], *x]
    for k in range(2, len(rows)):
        residual = step(rows[k], rows[k - 1], rows[k - 2], weight, theta, step_s)
        opti.subject_to(residual[free] == 0)
    loss = 0
    nodes = nodes_where(body, 2, 0.0).tolist()  # of the markers
    for t, positions in enumerate(x):
        opti.subject_to(positions[held] == start[t].ravel()[held])
        opti.set_initial(positions, start[t].ravel())
        for node, seen in zip(nodes, experiment.markers.positions_m[t], strict=True):
            loss += ca.sumsqr((positions[3 * node : 3 * node + 3] - seen) / 1e-3)
    opti.set_initial(mu, 200.0)
    opti.minimize(loss)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    found = opti.solve()
    assert found.value(mu) == pytest.approx(solution.parameters["mu_pa"], rel=1e-6)
    assert found.value(mu) == pytest.approx(TRUTH["mu_pa"], rel=1e-5)
    positions_m = np.array([found.value(each) for each in x])
    np.testing.assert_allclose(positions_m, solution.positions_m[0].reshape(len(x), -1), atol=1e-8)


def test_c_code_agrees_to_rounding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no compiler")
    body = box(divisions=(1, 1, 2))
    step = body.step_function("midpoint")
    monkeypatch.chdir(tmp_path)
    step.generate("step.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "step.c", "-o", "step.so"], check=True)
    compiled = ca.external("step", "./step.so")
    x, theta = motion(body, 3)
    arguments = (x[2], x[1], x[0], np.ones(x.shape[1]), theta, 0.01)
    own, other = step(*arguments).full(), compiled(*arguments).full()
    np.testing.assert_allclose(other, own, rtol=0, atol=1e-12 * abs(own).max())


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"prony": ["prony_1"]}, r"memory \(prony\)"),
        (
            {"rest_shape": cs.UnderGravity(cs.Face("top"), (0, 0, -9.81))},
            "a mesh scanned under gravity",
        ),
    ],
)
def test_bodies_with_other_equations_are_refused(changes, what: str):
    body = Body(box().mesh, density_kg_m3=30.0, **changes)
    with pytest.raises(cs.InputError, match=f"the body has {what}.*expected a body without"):
        body.step_function("midpoint")
