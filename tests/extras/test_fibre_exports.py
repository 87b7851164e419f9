"""Fibres in the formats of FEBio and Abaqus, evaluated with the energies that both document.

pyfebio is a schema of FEBio's format, which its authors test with FEBio.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import meshio
import numpy as np
import pytest
from kit.problems import IDEAL, nodes_where, times, vertex_markers

from collocation_sysid.extras.export import IdentifiedBody, write_export
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.fibres import Fibres
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.recording import Experiment, Grasp, PointMass, PoseSequence

BAR_M = (0.1, 0.02, 0.02)
CONSTANTS = {
    "fibre_pa": 8e4,
    "fibre_exponent": 0.7,
    "fibre_dispersion": 0.1,
    "fibre_angle_rad": 2.1,
}
MATRIX = {"young_pa": 3e5, "poisson": 0.3}
ALONG: dict[str, Any] = {"direction": [1.0, 0.4, 0.0]}
TURNED: dict[str, Any] = {**ALONG, "normal": [0.0, 0.1, 1.0]}
HELICES: dict[str, Any] = {"axis": (1, 0, 0), "axis_point_m": (0.0, 0.01, -0.02), "helix": True}
KINDS = {
    "parallel": Fibres(**ALONG),
    "turned": Fibres(**TURNED, law="exponential"),
    "families": Fibres(**TURNED, families=2),
    "dispersed": Fibres(**TURNED, law="exponential", dispersed=True),
    "helices": Fibres(**HELICES, families=2, law="exponential", dispersed=True),
}


def reinforced_bar(
    fibres: Fibres, material: str = "neo-hookean", values: dict[str, float] = MATRIX
) -> IdentifiedBody:
    """A bar that is held at one end and carries a mass, with the z axis of its mesh along y."""
    body = Body(box_mesh(BAR_M, (3, 1, 1)), material, 900.0, "tet10", fibres=fibres)
    t_s = times(8)
    turn = [[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]]
    poses = PoseSequence([0.0], [[0.0, 0.0, 0.0]], turn)
    grasp = Grasp(nodes_where(body, 0, 0.0), poses)
    markers = vertex_markers(body, nodes_where(body, 0, BAR_M[0]), t_s)
    mass = PointMass([5], 0.01)
    experiment = Experiment(
        body, t_s, [grasp], markers, nuisance=IDEAL, kind="static", masses=[mass]
    )
    used = {n: v for n, v in CONSTANTS.items() if n in {c.name for c in body.parts[0].constants}}
    theta = body.theta_from_values({"gamma_r_s": 0.0, "gamma_m_1_s": 0.0, **values, **used})
    return IdentifiedBody("a bar", "good", (), {}, body, theta, experiment, None)


def energies(body: IdentifiedBody, stretched: np.ndarray) -> np.ndarray:
    """Energy density of each element at a deformation in the world."""
    (part,) = body.body.parts
    F = ca.SX.sym("F", 3, 3)
    psi = ca.Function(
        "psi", [F], [part.material.psi(F, ca.SX(body.theta[: len(part.material.constants)]))]
    )
    found = np.zeros(len(part.cells))
    for cells, axes in body.fibre_axes(part):
        found[cells] = float(psi(stretched @ axes))
    return found


def exponential(k1: float, k2: float, e: float) -> float:
    return float(k1 / (2 * k2) * np.expm1(k2 * e**2)) if e > 0 else 0.0


def deformations(rng, isochoric=False):
    for _ in range(3):
        F = np.eye(3) + 0.2 * rng.normal(size=(3, 3))
        F *= np.sign(np.linalg.det(F))
        yield F / np.cbrt(np.linalg.det(F)) if isochoric else F


def vector(text: str) -> np.ndarray:
    return np.array(text.split(","), dtype=float)


def febio_energy(material, F: np.ndarray) -> float:
    """Energy density of a material as FEBio's theory manual defines it."""
    if material.type == "solid mixture":
        return sum(febio_energy(each, F) for each in material.solid_list)
    J, C = np.linalg.det(F), F.T @ F
    if material.type == "neo-Hookean":
        young, poisson = material.E.text, material.v.text
        mu, lam = young / 2 / (1 + poisson), young * poisson / (1 + poisson) / (1 - 2 * poisson)
        return mu / 2 * (np.trace(C) - 3) - mu * np.log(J) + lam / 2 * np.log(J) ** 2
    if material.type == "fiber-exp-pow":
        a = vector(material.fiber.text)
        assert (material.beta.text, material.lam0.text) == (2.0, 1.0)
        return exponential(
            material.ksi.text, material.alpha.text or 1e-9, float(a @ C @ a / (a @ a)) - 1
        )
    assert material.type == "HGO unconstrained"
    first = vector(material.mat_axis.a)
    third = np.cross(first, vector(material.mat_axis.d))
    second = np.cross(third, first)
    first, second = first / np.linalg.norm(first), second / np.linalg.norm(second)
    angle, kappa = np.radians(material.gamma.text), material.kappa.text
    energy = 0.0
    for side in (1, -1):
        a = np.cos(angle) * first + side * np.sin(angle) * second
        e = kappa * (np.trace(C) - 3) + (1 - 3 * kappa) * (a @ C @ a - 1)
        energy += exponential(material.k1.text, material.k2.text, e)
    return float(energy)


def read_febio(folder: Path):
    """Model of FEBio as its schema reads it, which has no density of a fibre."""
    model = pytest.importorskip("pyfebio.model")
    text = re.sub(r"^ *<!--.*-->\n", "", (folder / "body.feb").read_text(), flags=re.M)
    text = re.sub(r'(type="fiber-exp-pow">\n) *<density>0.0</density>\n', r"\1", text)
    text = text.replace("<density>0.0</density>", "<density>1e-9</density>")
    return model.Model.from_xml(text.encode())


@pytest.mark.parametrize("kind", KINDS)
def test_febio_has_the_energy_of_a_body_with_fibres(kind, tmp_path, rng):
    body = reinforced_bar(KINDS[kind])
    write_export(body, "febio", tmp_path / "out")
    model = read_febio(tmp_path / "out")
    materials = {each.name: each for each in model.material_.all_materials}
    domains = {each.name: each.mat for each in model.meshdomains_.solid_domains}
    for F in deformations(rng):
        expected = energies(body, F)
        found = np.full(len(expected), np.nan)
        for part in model.mesh_.elements:
            numbers = [each.id - 1 for each in part.all_elements]
            found[numbers] = febio_energy(materials[domains[part.name]], F)
        # Within the smooth start of fibres that carry tension only.
        np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_febio_gets_mesh_grasp_weight_and_loads(tmp_path):
    body = reinforced_bar(KINDS["parallel"])
    write_export(body, "febio", tmp_path / "out")
    model = read_febio(tmp_path / "out")
    nodes = [vector(each.text) for each in model.mesh_.nodes[0].all_nodes]
    np.testing.assert_allclose(nodes, body.nodes_m)
    cells = np.concatenate(
        [[vector(each.text) for each in part.all_elements] for part in model.mesh_.elements]
    )
    np.testing.assert_array_equal(np.sort(cells, axis=0), np.sort(body.body.cells + 1, axis=0))
    (held,) = {tuple(vector(s.text)) for s in model.mesh_.node_sets if s.name.startswith("held")}
    np.testing.assert_array_equal(np.array(held) - 1, np.flatnonzero(body.is_node_prescribed))
    assert [bc.dof for bc in model.boundary_.all_bcs] == ["x", "y", "z"]
    (weight,) = model.loads_.all_body_loads
    pull = [weight.x.text, weight.y.text, weight.z.text]  # FEBio subtracts it
    np.testing.assert_allclose(pull, -body.experiment.gravity_m_s2)
    loads = [vector(each.value.text) for each in model.loads_.all_nodal_loads]
    np.testing.assert_allclose(np.sum(loads, axis=0), 0.01 * body.experiment.gravity_m_s2)


def abaqus_cards(deck: str, keyword: str) -> dict[str, list[np.ndarray]]:
    """Rows of the data lines of each card with a keyword, by its parameters."""
    blocks = re.findall(rf"^\*{keyword},(.*)\n((?:[^*].*\n)+)", deck, re.M)
    return {head: [vector(line) for line in lines.splitlines()] for head, lines in blocks}


@pytest.mark.parametrize("kind", KINDS)
def test_abaqus_has_the_energy_of_a_body_with_fibres_at_constant_volume(kind, tmp_path, rng):
    body = reinforced_bar(KINDS[kind])
    write_export(body, "abaqus", tmp_path / "out")
    deck = (tmp_path / "out" / "abaqus.inp").read_text()
    families = KINDS[kind].families
    (card,) = abaqus_cards(deck, "ANISOTROPIC HYPERELASTIC").items()
    assert card[0] == f"HOLZAPFEL,LOCAL DIRECTIONS={families}"
    ((c10, d, k1, k2, kappa),) = card[1]
    (region,) = body.regions
    assert d == pytest.approx(2 / region.kappa_pa)
    sections = re.findall(r"\*SOLID SECTION,ELSET=(\w+),MATERIAL=M0,ORIENTATION=(\w+)", deck)
    orientations = abaqus_cards(deck, "ORIENTATION")
    sets = abaqus_cards(deck.replace("ELSET=BODY\nE0", ""), "ELSET")
    for F in deformations(rng, isochoric=True):
        C = F.T @ F
        expected = energies(body, F)
        found = np.full(len(expected), np.nan)
        for cells, name in sections:
            head = f"NAME={name},SYSTEM=RECTANGULAR,LOCAL DIRECTIONS={families}"
            points, turn, *directions = orientations[head]
            assert (turn == (3, 0)).all()
            assert len(directions) == families
            first = points[:3] / np.linalg.norm(points[:3])
            third = np.cross(first, points[3:])
            third /= np.linalg.norm(third)
            axes = np.column_stack([first, np.cross(third, first), third])
            energy = c10 * (np.trace(C) - 3)
            for each in directions:
                a = axes @ each
                e = kappa * (np.trace(C) - 3) + (1 - 3 * kappa) * (a @ C @ a - 1)
                energy += exponential(k1, k2, e)
            found[np.concatenate(sets[f"ELSET={cells}"]).astype(int) - 1] = energy
        np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_only_a_body_with_fibres_has_a_deck_for_abaqus_which_says_its_limits(tmp_path):
    body = reinforced_bar(KINDS["helices"])
    write_export(body, "abaqus", tmp_path / "with")
    file = tmp_path / "with" / "abaqus.inp"
    assert "resist their stretch without the change of volume" in file.read_text()
    assert len(meshio.read(file, "abaqus").points) == len(body.nodes_m)
    plain = Body(body.body.mesh, "neo-hookean", 900.0, "tet10")
    experiment = replace(body.experiment, body=plain, masses=())
    theta = plain.theta_from_values({"gamma_r_s": 0.0, "gamma_m_1_s": 0.0, **MATRIX})
    write_export(
        replace(body, body=plain, theta=theta, experiment=experiment),
        "abaqus",
        tmp_path / "without",
    )
    assert not (tmp_path / "without" / "abaqus.inp").exists()
