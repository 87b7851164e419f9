"""Identifiability of the scale of stiffness and mass from known forces and masses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problem_files import replace_text, run_command
from kit.problems import hung_cube, noisy
from kit.rods import bent, cable, clamped

from collocation_sysid import Body
from collocation_sysid.errors import InputError
from collocation_sysid.model.parameters import Parameters, Tied, Unknown
from collocation_sysid.pipeline import run
from collocation_sysid.problem import Problem
from collocation_sysid.recording import Experiment, Force, PointMass
from collocation_sysid.runs.check import check_problem
from collocation_sysid.statistics.scale_identifiability import (
    parameters_of_open_scale,
    relative_moduli,
    scale_reference,
)

STIFF = {"lambda_pa": Unknown(300.0), "mu_pa": Unknown(200.0)}
DAMPED = {"gamma_r_s": Unknown(0.02), "gamma_m_1_s": 1.0}
HEAVY = {"density_kg_m3": Unknown(40.0)}
OPEN = STIFF | DAMPED | HEAVY
NAMES = ("lambda_pa", "mu_pa", "density_kg_m3")


def problem(given, **changes) -> Problem:
    return Problem([noisy(replace(hung_cube(), **changes), 1e-4)], given)


def names_of(found: Problem) -> tuple[str, ...]:
    return parameters_of_open_scale(found.experiments, found.parameters)


def tip(experiment: Experiment) -> np.ndarray:
    return experiment.free_dofs[[0, 3]] // 3


def test_without_a_force_all_moduli_and_densities_are_open():
    assert names_of(problem(OPEN)) == NAMES


@pytest.mark.parametrize(
    "given",
    [
        {"young_pa": Unknown(500.0), "poisson": Unknown(0.3)},
        {"young_pa": Unknown(500.0), "poisson": 0.3},
        {"kappa_pa": Tied("mu_pa", 2.0), "mu_pa": Unknown(200.0)},
        {"lambda_pa": 0.0, "mu_pa": Unknown()},
        {"young_pa": Unknown(500.0), "poisson": 0.3, "mass_kg": Unknown(0.03)},
    ],
)
def test_the_scale_is_open_however_moduli_and_densities_are_given(given):
    heavy = {} if "mass_kg" in given else HEAVY
    free = [name for name, each in given.items() if isinstance(each, Unknown)]
    expected = {*free, *heavy} - {"poisson"}
    assert set(names_of(problem(given | DAMPED | heavy))) == expected


@pytest.mark.parametrize(
    "given",
    [
        STIFF | DAMPED,
        STIFF | DAMPED | {"density_kg_m3": 30.0},
        OPEN | {"lambda_pa": 200.0},
        OPEN | {"density_kg_m3": Unknown(40.0, prior=(30.0, 0.1))},
    ],
)
def test_a_known_modulus_or_density_closes_the_scale(given):
    assert names_of(problem(given)) == ()


def test_a_known_mass_or_force_on_free_nodes_closes_the_scale():
    cube = hung_cube()
    mass = PointMass(tip(cube), 0.01)
    force = Force(tip(cube), [[0.0, 0.0, 0.1]])
    assert names_of(problem(OPEN, masses=[mass])) == ()
    assert names_of(problem(OPEN, forces=[force])) == ()
    held = PointMass(cube.prescribed_dofs[[0, 3]] // 3, 0.01)
    assert names_of(problem(OPEN, masses=[held])) == NAMES


def test_one_of_two_recordings_with_a_known_mass_is_enough():
    cube = hung_cube()
    loaded = replace(cube, name="loaded", masses=(PointMass(tip(cube), 0.01),))
    parameters = Problem([cube], OPEN).parameters
    assert parameters_of_open_scale([cube, loaded], parameters) == ()
    only_validated = replace(loaded, validation=True)
    assert (
        parameters_of_open_scale(Problem([cube, only_validated], OPEN).experiments, parameters)
        == NAMES
    )


@pytest.mark.long
def test_an_open_scale_is_reported_before_the_solve_and_in_the_verdict():
    found = problem(OPEN)
    said = "only the ratios of lambda_pa, mu_pa and density_kg_m3 are identifiable (E/ρ)"
    assert any(said in note and "fix a density" in note for note in found.notes)
    assert any(said in warning for warning in check_problem(found).warnings)
    finished = run(found, seek_causes=False)
    assert finished.trust.verdict == "doubtful"
    assert any(said in reason for reason in finished.trust.reasons)
    assert all(finished.estimates[name].statistical_std_error is None for name in NAMES)


def test_a_mass_sets_the_scale_and_the_density_is_found_without_a_note():
    cube = hung_cube()
    found = problem(OPEN, masses=[PointMass(tip(cube), 0.01)])
    finished = run(found, seek_causes=False)
    assert not any("ratios" in said for said in (*found.notes, *finished.trust.reasons))
    assert finished.solution.parameters["density_kg_m3"] == pytest.approx(30.0, rel=0.05)
    assert np.isfinite(finished.std_error("density_kg_m3"))


def test_moduli_relative_to_a_density_as_stated_are_called_so():
    found = problem(STIFF | DAMPED)
    assert relative_moduli(found.experiments, found.parameters) == ("lambda_pa", "mu_pa")
    scale = scale_reference(found.experiments, found.parameters, 0.02)
    assert scale.density_kg_m3 == pytest.approx(30.0)
    assert scale.sentence == (
        "λ and μ are relative to the stated density of 30 kg/m³, because no force was measured: an "
        "error of the mass is an equal error of the moduli (contained in the intervals: 2 %), which "
        "no test shows unless object.material_density_kg_m3 is stated"
    )
    exact = scale_reference(found.experiments, found.parameters, None)
    assert "(contained in the intervals: none)" in exact.sentence
    (experiment,) = found.experiments
    of_mass = Body(
        experiment.body.mesh, mass_kg=experiment.body.mass_kg, material_density_kg_m3=30.0
    )
    known = scale_reference([replace(experiment, body=of_mass)], found.parameters, 0.02)
    assert known.sentence.endswith(
        "only that beyond 5 % is seen beside the density of the material"
    )
    cube = hung_cube()
    loaded = problem(STIFF | DAMPED, masses=[PointMass(tip(cube), 0.01)])
    assert scale_reference(loaded.experiments, loaded.parameters, 0.01) is None
    assert scale_reference(problem(OPEN).experiments, problem(OPEN).parameters, 0.01) is None


# In a problem file ----------------------------------------------------------------------------


def test_the_bending_of_a_cable_is_relative_although_its_axial_stiffness_is_stated():
    held = clamped(cable(bent()))
    stated = {"bending_n_m2": Unknown(1e-3), "torsion_n_m2": 3e-4, "axial_n": 200.0}
    parameters = Parameters.from_mapping(stated | DAMPED)
    assert relative_moduli([held], parameters) == ("bending_n_m2",)


def read(folder, *edits, overrides=()) -> Problem:
    for old, new in edits:
        replace_text(old, new)(folder)
    return Problem.read(folder / "problem.toml", overrides)


FREE = "\n[parameters]\ndensity_kg_m3 = { guess = 45.0 }\n"


def test_a_density_may_be_a_parameter_instead_of_stated(tiny):
    found = read(tiny, ("density_kg_m3 = 30.0", ""), ("\n[parameters]\n", FREE))
    body = found.bodies[0]
    assert list(body.constants)[-1] == "density_kg_m3"
    assert body.mass_kg == pytest.approx(45.0 * body.mesh.volume_m3)
    assert found.parameters.guesses["density_kg_m3"] == pytest.approx(45.0)


def test_a_density_without_a_guess_starts_at_the_stated_value(tiny):
    found = read(tiny, ("\n[parameters]\n", "\n[parameters]\ndensity_kg_m3 = {}\n"))
    assert found.parameters.guesses["density_kg_m3"] == pytest.approx(30.0)


def test_the_mass_may_be_a_parameter_in_place_of_densities(tiny):
    cells = "{ box_m = [[-1, -1, -1], [1, 1, 0.045]] }"
    region = f'\n[[object.region]]\nname = "core"\ncells = {cells}\ndensity_kg_m3 = 60.0\n'
    mass = "\n[parameters]\nmass_kg = { guess = 0.02 }\n"
    found = read(tiny, ("\n[parameters]\n", region + mass))
    body = found.bodies[0]
    theta = body.theta_from_values(found.parameters.guesses)
    assert body.mass_of_dofs(theta).sum() / 3 == pytest.approx(0.02)
    of_rest, of_core = body.densities(theta)
    assert of_core == pytest.approx(2 * of_rest)


def test_a_density_stated_for_a_region_stays(tiny):
    cells = "{ box_m = [[-1, -1, -1], [1, 1, 0.045]] }"
    region = f'\n[[object.region]]\nname = "core"\ncells = {cells}\ndensity_kg_m3 = 60.0\n'
    found = read(tiny, ("\n[parameters]\n", region + FREE))
    assert [part.has_free_density for part in found.bodies[0].parts] == [True, False]
    assert names_of(found) == ()


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ([("density_kg_m3 = 30.0", "")], ["no mass_kg or density_kg_m3", "[parameters]"]),
        (
            [("\n[parameters]\n", "\n[parameters]\n'core.density_kg_m3' = {}\n")],
            ["core.density_kg_m3", "did you mean 'density_kg_m3'?"],
        ),
        (
            [("\n[parameters]\n", f"{FREE}mass_kg = {{ guess = 0.1 }}\n")],
            ["found density_kg_m3 and mass_kg, which both determine the density of the body"],
        ),
        (
            [("\n[parameters]\n", "\n[parameters]\ndensity_kg_m3 = { guess = -3.0 }\n")],
            ["density_kg_m3", "guess = -3"],
        ),
        (
            [("\n[parameters]\n", "\n[parameters]\ndensity_kg_m3 = 0.0\n")],
            ["density_kg_m3", "fixed = 0"],
        ),
    ],
)
def test_densities_that_cannot_be_are_refused(tiny, edits, words):
    with pytest.raises(InputError) as refused:
        read(tiny, *edits)
    for word in words:
        assert word in str(refused.value)


def test_the_terminal_states_the_reference_of_the_moduli(tiny):
    shown = run_command("solve", "problem.toml")
    assert "relative to the stated density of" in " ".join(shown.out.split())
