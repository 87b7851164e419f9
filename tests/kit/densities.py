"""Bodies of two regions whose densities are parameters, and their parameters."""

from __future__ import annotations

from dataclasses import replace

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.regions import Region
from collocation_sysid.model.parameters import Parameters, Unknown
from collocation_sysid.recording import Experiment, PointMass
from kit.problems import bar_let_go, bar_loaded, cube_with_nuisance, hung_cube, quadratic_bar

# In the ratio that is stated: then known masses are damped alike.
DENSITY_KG_M3 = {"density_kg_m3": 36.0, "core.density_kg_m3": 60.0}


TRUTH = {
    "lambda_pa": 200.0,
    "mu_pa": 300.0,
    "gamma_r_s": 0.009,
    "gamma_m_1_s": 1.0,
    "core.gamma_m_1_s": 3.0,
    **DENSITY_KG_M3,
}


GUESS = {"mu_pa": 400.0, "gamma_m_1_s": 0.5, "density_kg_m3": 45.0, "core.density_kg_m3": 35.0}


def with_core(experiment: Experiment, **changes) -> Experiment:
    """The experiment with a body of two parts, whose densities are free."""
    old = experiment.body
    core = Region("core", old.mesh.volumes_m3.argsort()[::2][:6], density_kg_m3=50.0)
    body = Body(
        old.mesh, density_kg_m3=30.0, element=old.element.name, regions=[core], **changes
    ).with_free_densities(["", "core"])
    return replace(experiment, body=body)


def weighted(experiment: Experiment) -> Experiment:
    """The experiment with a known mass on two of its nodes."""
    here = experiment.free_dofs[[-4, -1]] // 3
    return replace(experiment, masses=(*experiment.masses, PointMass(here, 0.01)))


def parameters(truth=TRUTH, guess=GUESS) -> Parameters:
    return Parameters.from_mapping(
        {n: Unknown(guess[n]) if n in guess else v for n, v in truth.items()}
    )


MADE = {
    "hung cube": lambda: with_core(weighted(hung_cube())),
    "rayleigh": lambda: with_core(weighted(hung_cube()), damping="rayleigh"),
    "quadratic": lambda: with_core(weighted(quadratic_bar(6))),
    "let go": lambda: with_core(bar_let_go()),
    "loaded": lambda: with_core(bar_loaded(6)),
    "nuisance": lambda: with_core(weighted(cube_with_nuisance(6))),
}


REMEMBERED = TRUTH | {"prony_1.share": 0.4, "prony_1.tau_s": 0.03}


def remembering_core() -> Experiment:
    return with_core(weighted(hung_cube(6)), prony=["prony_1"])
