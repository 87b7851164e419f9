"""How a body was made and where its mesh comes from: defaults of the budget, densities, questions."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from kit.problem_files import run_command, write_problem

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.runs.check.body import check_body
from collocation_sysid.runs.result_builder import _modulus_axis_sentence
from collocation_sysid.statistics.budget.systematic_effects import usual_deviations
from collocation_sysid.statistics.estimates import Estimate
from collocation_sysid.statistics.plausibility import density_concerns

BOX = cs.box_mesh((0.04, 0.04, 0.08), (1, 1, 2))


def body(density_kg_m3: float = 1070.0, **origin: str) -> cs.Body:
    mesh = TetMesh(BOX.points_m, BOX.tetrahedra)  # not generated from stated lengths
    return cs.Body(mesh, density_kg_m3=density_kg_m3, **origin)


def test_the_origin_selects_default_deviations():
    unknown, cast, foam = (
        usual_deviations([body(**o)]) for o in ({}, {"made": "cast"}, {"made": "foam"})
    )
    assert cast["anisotropy"] < unknown["anisotropy"] < foam["anisotropy"]
    assert unknown["mass"] == cast["mass"] == foam["mass"]
    # Of several bodies the largest counts.
    assert usual_deviations([body(made="cast"), body(made="foam")]) == foam
    stated = cs.Assumptions(anisotropy=0.07)
    assert stated.collect_deviations([body(made="foam")])["anisotropy"] == 0.07


@pytest.mark.parametrize(
    ("origin", "words"),
    [({"made": "steel"}, "expected 'cast'"), ({"mesh_from": "photo"}, "expected 'cad'")],
)
def test_unknown_words_are_refused(origin, words):
    with pytest.raises(InputError, match=words):
        body(**origin)


def test_a_drawing_cannot_hang():
    hung = cs.UnderGravity(cs.Indices([0, 1, 2, 3]), (0, 0, -9.81))
    with pytest.raises(InputError, match="a drawing is free of stress"):
        body(mesh_from="cad", rest_shape=hung)


def test_an_implausible_density_is_a_concern():
    assert not density_concerns(body(1070.0, made="cast"))
    (concern,) = density_concerns(body(1.2 * 1070.0, made="cast"))
    assert concern.grade == "check"
    assert "1284 kg/m³" in concern.message
    assert not density_concerns(body(1.2 * 1070.0))


def test_check_asks_for_unstated_origins():
    theta = body().theta_from_values(
        {"young_pa": 1e4, "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 0.1}
    )

    def asked(**origin: str) -> str | None:
        return check_body(body(**origin), theta, ("swing",)).open_question

    assert (
        asked() == "object.made (cast, foam, printed, tissue) and mesh_from (cad, scan) not stated"
    )
    assert asked(made="cast") == "object.mesh_from (cad, scan) not stated"
    assert asked(made="cast", mesh_from="cad") is None


def test_a_problem_file_states_the_origin(tmp_path):
    file = write_problem(tmp_path, {"swing": 5})
    read = cs.Problem.read(file, ['object.made="foam"', 'object.mesh_from="scan"'])
    (own,) = read.bodies
    assert (own.made, own.mesh_from) == ("foam", "scan")
    assert read.assumed_deviations["anisotropy"] == 0.2
    assert run_command("check", file, "object.made=steel").code == 2


@pytest.mark.parametrize(
    ("anisotropy", "along_z", "is_said"),
    [(0.05, 0.9, True), (0.05, 0.5, False), (0.005, 0.9, False), (None, 0.9, False)],
)
def test_the_answer_states_along_which_axis_the_modulus_is_measured(anisotropy, along_z, is_said):
    """E of 1000 Pa, of which q is the logarithm, changes by these shares of the anisotropy."""
    shares = np.array([0.05, 0.02, along_z])
    names = tuple(f"anisotropy {axis}" for axis in "xyz") if anisotropy else ()
    posterior = SimpleNamespace(
        sources=(("mass", *names), np.array([[0.5, *(shares * anisotropy if anisotropy else ())]])),
        derivatives={"young_pa": np.array([1000.0])},
    )
    answer: Any = SimpleNamespace(
        posterior=posterior,
        estimates={"young_pa": Estimate(1000.0, 10.0, (980.0, 1020.0))},
        problem=SimpleNamespace(assumed_deviations={"anisotropy": anisotropy}),
    )
    sentence = _modulus_axis_sentence(answer)
    assert ("E is mainly the modulus along the z axis of the mesh" in sentence) is is_said
    assert ("E is 90% of this larger" in sentence) is is_said


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (np.pi / 4, ["a round section is meshed as a square one", "1.27 times the volume"]),
        (4 / np.pi, ["a square section is meshed as a round one"]),
        (0.9, ["1.11 times the volume"]),
    ],
)
def test_a_mesh_of_another_section_shows_in_the_density(times, words):
    known = 1070.0
    mesh = TetMesh(BOX.points_m, BOX.tetrahedra)
    mass_kg = times * known * BOX.volume_m3
    (concern,) = density_concerns(cs.Body(mesh, mass_kg=mass_kg, material_density_kg_m3=known))
    assert concern.code == "description/density-of-mesh"
    assert all(word in concern.message for word in words)
    right = cs.Body(mesh, mass_kg=known * BOX.volume_m3, material_density_kg_m3=1.02 * known)
    assert not density_concerns(right)


def test_the_known_density_needs_a_mass():
    with pytest.raises(InputError, match="expected the weighed mass"):
        cs.Body(BOX, density_kg_m3=1070.0, material_density_kg_m3=1070.0)
