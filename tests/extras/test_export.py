"""Exports: content of the files, and results of installed simulators that read them."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import runpy
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import casadi as ca
import numpy as np
import pytest
from kit.materials import HYPERFOAM, OGDEN, term_constants
from kit.problem_files import run_command, write_problem
from kit.problems import IDEAL, nodes_where, smooth_poses, times, vertex_markers

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.extras.export import (
    MAIN_FILES,
    TARGETS,
    IdentifiedBody,
    parse_destination,
    verify_export,
    write_ensemble,
    write_export,
)
from collocation_sysid.extras.export.identified import without_obstacles
from collocation_sysid.extras.export.obstacle_shapes import Facets, faceted_obstacles
from collocation_sysid.extras.export.target import equilibria
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.fibres import Fibres
from collocation_sysid.fem.laws.materials import MATERIALS
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.regions import Region
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    Capsule,
    Cuboid,
    Cylinder,
    Experiment,
    Grasp,
    Obstacle,
    Plane,
    PointMass,
    PoseSequence,
    Solid,
    Sphere,
    Wrench,
)
from collocation_sysid.statistics.budget.combined_intervals import ReportedEstimate

needs_ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX is not installed")
needs_mujoco = pytest.mark.skipif(
    importlib.util.find_spec("mujoco") is None, reason="mujoco is not installed"
)
BAR_M, DIVISIONS = (0.1, 0.02, 0.02), (5, 1, 1)
MODULI = {"young_pa": 5e4, "poisson": 0.3}
OTHERS = {"gamma_r_s": 0.002, "gamma_m_1_s": 0.0}


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    problem = write_problem(folder, {"swing": 8})
    with problem.open("a", encoding="utf-8") as file:  # simulated on this mesh
        file.write('\n[uncertainty]\nassumptions = "none"\n')
    assert (
        run_command(
            "solve", problem, "--out", folder / "run", "-q", "--method", "reduced-space"
        ).code
        == 0
    )
    return folder / "run"


# A law that each target has.
OWN_LAW = {
    **dict.fromkeys(TARGETS, "neo-hookean"),
    "mujoco": "st-venant-kirchhoff",
    "newton": "stable-neo-hookean",
    "usd": "stable-neo-hookean",
}


def run_for(target: str, run_folder: Path, tmp_path: Path) -> Path:
    """A copy of a run, as if it had identified the same λ and μ of a law of the target."""
    run = Path(shutil.copytree(run_folder, tmp_path / f"run_for_{target}"))
    text = (run / "problem.toml").read_text()
    changed = f'[object]\nmaterial = "{OWN_LAW[target]}"\n'
    assert text.count("[object]\n") == 1
    assert "material" not in text
    (run / "problem.toml").write_text(text.replace("[object]\n", changed))
    return run


def held_bar(
    material: str = "st-venant-kirchhoff",
    values: dict[str, float] = MODULI,
    element: str = "tet4",
    axes: str = "xyz",
    prony: tuple[str, ...] = (),
    moving: bool = False,
    damping: str = "kelvin-voigt",
) -> IdentifiedBody:
    """A bar held at one end, as if a run had identified it."""
    mesh = box_mesh(BAR_M, DIVISIONS)
    body = Body(mesh, material, 900.0, element, damping=damping, prony=prony)
    t_s = times(8)
    poses = smooth_poses(t_s, sway_m=(0.004, 0.002, 0.003)) if moving else PoseSequence.fixed()
    still = Grasp(nodes_where(body, 0, 0.0), poses)
    grasps = [still] if axes == "xyz" else [still, Grasp([5], PoseSequence.fixed(), axes=axes)]
    markers = vertex_markers(body, nodes_where(body, 0, BAR_M[0]), t_s)
    kind = "dynamic" if moving else "static"
    experiment = Experiment(body, t_s, grasps, markers, nuisance=IDEAL, kind=kind)
    theta = body.theta_from_values({**OTHERS, **values})
    shapes = simulate(experiment, theta).positions_m if moving else None
    return IdentifiedBody("a bar", "good", (), {}, body, theta, experiment, shapes)


def exported(body: IdentifiedBody, to: str, folder: Path) -> Path:
    write_export(body, to, folder / to)
    return folder / to


def numbers_in(text: str | None) -> np.ndarray:
    assert text is not None
    return np.array(text.split(), dtype=float)


def test_a_run_without_a_problem_file_is_exported_from_python(run_folder, tmp_path):
    problem = cs.Problem.read(run_folder.parent / "problem.toml")
    run = cs.run(replace(problem, origin=None), "reduced-space")
    run.save(tmp_path / "run", pictures=False)
    refused = run_command("export", tmp_path / "run", "--to", "json")
    assert refused.code == 2
    assert "IdentifiedBody.from_run(run)" in refused.err
    found = IdentifiedBody.from_run(run)
    write_export(found, "calculix", tmp_path / "deck")
    expected = IdentifiedBody.read(run_folder)
    assert found.regions[0].young_pa == pytest.approx(expected.regions[0].young_pa, rel=1e-3)
    assert found.simulated_m is not None
    np.testing.assert_allclose(found.simulated_m, expected.simulated_m, atol=1e-4)
    with pytest.raises(InputError, match="expected one of swing"):
        IdentifiedBody.from_run(run, "other")


@pytest.mark.long
def test_an_ensemble_has_an_export_for_each_draw(run_folder, tmp_path):
    law = ["object.material=st-venant-kirchhoff"]
    run = cs.run(cs.Problem.read(run_folder.parent / "problem.toml", law), "reduced-space")
    assert run.uncertainty is not None
    samples = run.samples(3, seed=1)
    # The command draws from the run folder what Python draws from the run.
    run.save(run_folder.parent / "again", pictures=False)
    for target, files in (("mujoco", "body.xml"), ("calculix", "body.inp")):
        folder = tmp_path / f"{target}_of_command"
        options = ("--to", target, "--out", folder, "--samples", 3, "--seed", 1)
        assert run_command("export", run_folder.parent / "again", *options).code == 0
        table = np.genfromtxt(folder / "samples.csv", delimiter=",", names=True)
        for name in samples:
            np.testing.assert_allclose(table[name], samples[name], rtol=1e-12)
        assert (folder / "sample_003" / files).is_file()
    for target, files in (("mujoco", "body.xml"), ("calculix", "body.inp")):
        folder = tmp_path / target
        write_ensemble(run, target, folder, 3, seed=1)
        table = np.genfromtxt(folder / "samples.csv", delimiter=",", names=True)
        for k in range(3):
            place = folder / f"sample_{k + 1:03d}"
            assert (place / files).is_file()
            values = json.loads((place / "identified.json").read_text())
            for name in run.uncertainty.names:
                assert values["parameters"][name]["value"] == samples[name].iloc[k]
                assert table[name][k] == samples[name].iloc[k]
            assert table["sample"][k] == k + 1
            (region,) = values["regions"]
            assert region["young_pa"] == pytest.approx(samples["young_pa"].iloc[k])
        write_ensemble(run, target, folder, 2)  # replaces the earlier one
        assert len([*folder.glob("sample_*")]) == 2
    xml = ElementTree.parse(tmp_path / "mujoco" / "sample_001" / "body.xml").getroot()
    elasticity = xml.find(".//elasticity")
    assert elasticity is not None
    stated = float(elasticity.get("young", ""))
    assert stated == pytest.approx(run.samples(2)["young_pa"].iloc[0], rel=1e-4)
    mujoco = pytest.importorskip("mujoco")
    tips_m = []
    for k in (1, 2):
        path = tmp_path / "mujoco" / f"sample_{k:03d}" / "body.xml"
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=50)
        tips_m.append(data.flexvert_xpos.copy())
    assert np.isfinite(tips_m).all()
    assert np.abs(tips_m[1] - tips_m[0]).max() > 0  # the bodies differ


def test_samples_need_a_folder_of_bodies(run_folder, tmp_path):
    for options in (["--to", tmp_path / "body.xml"], ["--to", "mujoco", "--verify"]):
        refused = run_command("export", run_folder, *options, "--samples", 2)
        assert refused.code == 2
        assert "--samples" in refused.err


# What files hold


def test_the_json_contains_the_estimates(run_folder, tmp_path):
    assert run_command("export", run_folder, "--to", "json", "--out", tmp_path / "out").code == 0
    found = json.loads((tmp_path / "out" / "identified.json").read_text())
    result = json.loads((run_folder / "result.json").read_text())
    (region,) = found["regions"]
    assert region["constants"]["mu_pa"] == result["parameters"]["mu_pa"]["value"]
    assert region["young_pa"] == pytest.approx(result["derived"]["young_pa"]["value"])
    assert sum(found["node_mass_kg"]) == pytest.approx(30.0 * 0.06 * 0.06 * 0.09)
    held = np.array(found["nodes_m"])[found["grasps"][0]["nodes"]]
    np.testing.assert_allclose(held[:, 2], 0.09)
    poses = np.loadtxt(tmp_path / "out" / "poses_1.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(poses[:, 0], found["grasps"][0]["pose_t_s"])


def test_a_run_without_a_guess_is_exported_too(run_folder, tmp_path):
    folder = Path(shutil.copytree(run_folder, tmp_path / "run"))
    problem = folder / "problem.toml"
    problem.write_text(re.sub(r"(?m)^mu_pa .*", "mu_pa = {}", problem.read_text()))
    assert Problem.read(problem, folder=run_folder.parent).parameters.names_without_guess == (
        "mu_pa",
    )
    assert run_command("export", folder, "--to", "json", "--out", tmp_path / "out").code == 0
    (region,) = json.loads((tmp_path / "out" / "identified.json").read_text())["regions"]
    result = json.loads((folder / "result.json").read_text())
    assert region["constants"]["mu_pa"] == result["parameters"]["mu_pa"]["value"]


def test_mujoco_gets_nodes_cells_and_the_flex(run_folder, tmp_path):
    body = IdentifiedBody.read(run_for("mujoco", run_folder, tmp_path))
    model = ElementTree.parse(exported(body, "mujoco", tmp_path) / "body.xml")
    flex, elasticity = model.find(".//flex"), model.find(".//elasticity")
    assert flex is not None
    assert elasticity is not None
    (region,) = body.regions
    assert float(elasticity.get("young", "")) == region.young_pa
    assert float(elasticity.get("poisson", "")) == region.poisson
    assert float(elasticity.get("damping", "")) == region.gamma_r_s
    np.testing.assert_array_equal(numbers_in(flex.get("element")).reshape(-1, 4), body.body.cells)
    masses = [
        float(node.get("mass", ""))
        for each in model.iterfind(".//worldbody/body")
        if each.get("name", "").startswith("node")
        for node in each.iterfind("inertial")
    ]
    free = ~body.is_prescribed.all(axis=1)
    np.testing.assert_array_equal(masses, body.node_mass_kg[free])
    assert flex.get("body", "").split().count("grasp0") == (~free).sum()


def test_newton_gets_the_constants_of_its_own_energy(run_folder, tmp_path):
    body = IdentifiedBody.read(run_for("newton", run_folder, tmp_path))
    folder = exported(body, "newton", tmp_path)
    found = json.loads((folder / "body.json").read_text())
    (region,) = body.regions
    assert set(found["k_mu"]) == {region.mu_pa}
    assert set(found["k_lambda"]) == {region.lambda_pa}
    np.testing.assert_array_equal(found["cells"], body.body.cells)
    compile((folder / "body.py").read_text(), "body.py", "exec")


def stage_of(folder: Path):
    from pxr import Usd

    return Usd.Stage.Open(str(folder / "body.usda"))


def test_usd_gets_mesh_material_masses_and_weight(tmp_path):
    body = held_bar("stable-neo-hookean", {**MODULI, "gamma_r_s": 0.004})
    stage = stage_of(exported(body, "usd", tmp_path))
    mesh, material = map(stage.GetPrimAtPath, ("/World/Body/Mesh", "/World/Materials/body"))

    def told(prim, name):
        return np.array(prim.GetAttribute(name).Get())

    np.testing.assert_allclose(told(mesh, "points"), body.nodes_m, atol=1e-8)
    np.testing.assert_array_equal(told(mesh, "tetVertexIndices"), body.body.cells)
    assert told(mesh, "physics:masses").sum() == pytest.approx(body.node_mass_kg.sum(), rel=1e-6)
    for name, value in (("youngsModulus", 5e4), ("poissonsRatio", 0.3), ("density", 900.0)):
        assert told(material, f"physics:{name}") == pytest.approx(value)
    assert told(material, "collocationSysid:gammaR_s") == pytest.approx(0.004)
    assert mesh.GetRelationship("material:binding:physics").GetTargets() == [material.GetPath()]
    scene = stage.GetPrimAtPath("/World/Physics")
    assert told(scene, "physics:gravityMagnitude") == pytest.approx(9.81)
    np.testing.assert_allclose(told(scene, "physics:gravityDirection"), (0, 0, -1))
    outside = told(mesh, "surfaceFaceVertexIndices")
    assert {tuple(sorted(f)) for f in outside} == {tuple(sorted(f)) for f in body.body.mesh.surface}


def test_usd_has_the_motion_of_the_gripper_and_the_held_nodes(tmp_path):
    body = held_bar("stable-neo-hookean", moving=True)
    stage = stage_of(exported(body, "usd", tmp_path))
    gripper, grasp = map(stage.GetPrimAtPath, ("/World/Gripper_1", "/World/Gripper_1/Grasp"))
    np.testing.assert_array_equal(
        grasp.GetAttribute("physics:indices0").Get(), np.flatnonzero(body.is_node_prescribed)
    )
    from pxr import UsdGeom

    rate_hz = stage.GetTimeCodesPerSecond()
    local = np.array(grasp.GetAttribute("physics:coords1").Get())
    for k, t in enumerate(body.experiment.t_s):
        # USD's matrices act on rows.
        matrix = np.array(UsdGeom.Xformable(gripper).ComputeLocalToWorldTransform(t * rate_hz))
        there = local @ matrix[:3, :3] + matrix[3, :3]
        held = body.experiment.prescribed_displacements([t])[1][0][body.is_node_prescribed]
        np.testing.assert_allclose(there, held, atol=1e-7, err_msg=f"sample {k}")


def test_usd_plays_the_motion_of_the_body_at_the_rate_of_the_recording(tmp_path):
    body = held_bar("stable-neo-hookean", moving=True)
    stage = stage_of(exported(body, "usd", tmp_path))
    points = stage.GetPrimAtPath("/World/Body/Mesh").GetAttribute("points")
    t_s, rate_hz = body.experiment.t_s, stage.GetTimeCodesPerSecond()
    assert rate_hz == pytest.approx(1 / body.experiment.timestep_s)
    assert stage.GetFramesPerSecond() == rate_hz
    codes = points.GetTimeSamples()
    np.testing.assert_allclose(np.array(codes) / rate_hz, t_s, atol=1e-12)
    np.testing.assert_allclose(
        [stage.GetStartTimeCode(), stage.GetEndTimeCode()], np.array(codes)[[0, -1]]
    )
    assert body.simulated_m is not None
    for code, shape_m in zip(codes, body.simulated_m, strict=True):
        np.testing.assert_allclose(np.array(points.Get(code)), shape_m, atol=1e-7)
    assert np.ptp(body.simulated_m, axis=0).max() > 1e-3  # and it moves
    placed_m = np.where(body.is_prescribed, body.prescribed_m, body.nodes_m)
    np.testing.assert_allclose(np.array(points.Get()), placed_m, atol=1e-7)


@pytest.mark.parametrize(
    ("section", "is_round"),
    [
        (cs.CrossSection.rectangle(0.012, 0.002), False),
        (cs.CrossSection.rectangle(2e-4, 1e-4), False),
        (cs.CrossSection.rectangle(0.2, 0.19), False),
        (cs.CrossSection.rectangle(1e-4, 1e-4), True),
        (cs.CrossSection.round(3e-4), True),
    ],
)
def test_usd_states_that_it_has_one_bending_stiffness_for_two(tmp_path, section, is_round):
    pytest.importorskip("pxr")
    line_m = [(0.0, 0.0, 0.0), (60 * max(section.extent_m), 0.0, 0.0)]
    body = Body(cs.rod_mesh(line_m, section, 5), "rod", density_kg_m3=1200.0)
    t_s = times(8)
    tip = vertex_markers(body, [12, 13, 14], t_s)
    held = Grasp([0, 1, 2], PoseSequence.fixed())
    experiment = Experiment(body, t_s, held, tip, nuisance=IDEAL, kind="static")
    theta = body.theta_from_values({**OTHERS, **MODULI})
    cable = IdentifiedBody("a cable", "good", (), {}, body, theta, experiment, None)
    limits = write_export(cable, "usd", tmp_path / "usd").limitations
    assert any("the mean about both axes" in limit for limit in limits) is not is_round


def test_usd_reports_tilted_gravity_and_missing_motion(tmp_path):
    body = held_bar("stable-neo-hookean")
    limits = write_export(body, "usd", tmp_path / "level").limitations
    assert not any("gravity" in limit for limit in limits)
    assert any("no forward simulation" in limit for limit in limits)
    angle = np.radians(0.5)
    tilted = replace(
        body.experiment, gravity_m_s2=9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    )
    limits = write_export(replace(body, experiment=tilted), "usd", tmp_path / "tilted").limitations
    assert any("gravity points 0.5° away from −z" in limit for limit in limits)
    assert "0.5°" in (tmp_path / "tilted" / "body.usda").read_text()


def test_usd_has_a_material_for_each_region_and_names_limits_of_simulators(tmp_path):
    bar = box_mesh(BAR_M, DIVISIONS)
    regions = [Region("soft-end", np.arange(6)), Region("grip", np.arange(6, 30))]
    body = Body(bar, "stable-neo-hookean", 900.0, regions=regions)
    still = Grasp(nodes_where(body, 0, 0.0), PoseSequence.fixed())
    t_s = times(8)
    markers = vertex_markers(body, nodes_where(body, 0, BAR_M[0]), t_s)
    experiment = Experiment(body, t_s, [still], markers, nuisance=IDEAL)
    values = {f"{r.name}.{n}": v for r in regions for n, v in {**MODULI, **OTHERS}.items()}
    body_ = IdentifiedBody(
        "a bar", "good", (), {}, body, body.theta_from_values(values), experiment, None
    )
    stage = stage_of(exported(body_, "usd", tmp_path))
    subset = stage.GetPrimAtPath("/World/Body/Mesh/soft_end")
    assert len(subset.GetAttribute("indices").Get()) == 6
    text = (tmp_path / "usd" / "body.usda").read_text()
    assert "uses that of the largest" in text


def scaled_terms(terms, kappa_pa: float | None = None) -> dict[str, float]:
    """Constants of terms for a shear modulus of 300 Pa, scaled to 20 kPa."""
    scale = 20e3 / 300
    values = {n: v * scale if n.endswith("_pa") else v for n, v in term_constants(terms).items()}
    return values if kappa_pa is None else {**values, "kappa_pa": kappa_pa}


OGDEN_TERMS = {count: scaled_terms(terms, 5e4) for count, terms in OGDEN.items()}
FOAM_TERMS = {count: scaled_terms(terms) for count, terms in HYPERFOAM.items()}


def card_values(folder: Path, keyword: str) -> list[float]:
    """Numbers of the card of a material in the deck of CalculiX."""
    lines = (folder / "body.inp").read_text().splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(keyword)) + 1
    stop = next(k for k, line in enumerate(lines) if k > start and line.startswith("*"))
    return [float(value) for line in lines[start:stop] for value in line.split(",")]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_calculix_gets_the_terms_of_ogdens_law(count, tmp_path):
    folder = exported(held_bar(f"ogden-{count}", OGDEN_TERMS[count]), "calculix", tmp_path)
    values = card_values(folder, f"*HYPERELASTIC,OGDEN,N={count}")
    c = OGDEN_TERMS[count]
    # 2μ/α² there is μ/α here.
    pairs = [(c[f"mu_{p}_pa"] * c[f"alpha_{p}"] / 2, c[f"alpha_{p}"]) for p in range(1, count + 1)]
    np.testing.assert_allclose(values[: 2 * count], np.ravel(pairs), rtol=1e-10)
    assert values[2 * count] == pytest.approx(2 / 5e4)
    assert values[2 * count + 1 :] == [1e20] * (count - 1)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_calculix_gets_the_terms_of_the_foam(count, tmp_path):
    folder = exported(held_bar(f"hyperfoam-{count}", FOAM_TERMS[count]), "calculix", tmp_path)
    values = card_values(folder, f"*HYPERFOAM,N={count}")
    c = FOAM_TERMS[count]
    pairs = [(c[f"mu_{p}_pa"], c[f"alpha_{p}"]) for p in range(1, count + 1)]
    poisson = [c[f"beta_{p}"] / (1 + 2 * c[f"beta_{p}"]) for p in range(1, count + 1)]
    np.testing.assert_allclose(values, [*np.ravel(pairs), *poisson], rtol=1e-10)


ISOCHORIC = {
    "mooney-rivlin": (
        {"c10_pa": 1e4, "c01_pa": 2e3, "kappa_pa": 1e6},
        {"type": "Mooney-Rivlin", "c1": "10000.0", "c2": "2000.0"},
    ),
    "yeoh": (
        {"c10_pa": 1e4, "c20_pa": 2e3, "c30_pa": 300.0, "kappa_pa": 1e6},
        {"type": "Yeoh", "c1": "10000.0", "c2": "2000.0", "c3": "300.0"},
    ),
    "ogden-2": (
        {"mu_1_pa": 1e4, "alpha_1": 2.0, "mu_2_pa": -500.0, "alpha_2": -2.0, "kappa_pa": 1e6},
        {"type": "Ogden", "c1": "20000.0", "m1": "2.0", "c2": "1000.0", "m2": "-2.0"},
    ),
}


@pytest.mark.parametrize("material", ISOCHORIC)
def test_febio_gets_laws_of_isochoric_invariants_and_stretches(material, tmp_path):
    values, expected = ISOCHORIC[material]
    folder = exported(held_bar(material, values), "febio", tmp_path)
    (law,) = ElementTree.parse(folder / "body.feb").getroot().iter("material")
    found = {each.tag: each.text for each in law}
    assert law.get("type") == expected["type"]
    assert {key: found[key] for key in expected if key != "type"} == {
        key: value for key, value in expected.items() if key != "type"
    }
    # κ/2 (J − 1)²
    assert (float(found["k"] or 0), found["pressure_model"]) == (1e6, "2")


CONSTANTS_OF = {
    "neo-hookean": MODULI,
    "stable-neo-hookean": MODULI,
    "st-venant-kirchhoff": MODULI,
    "linear": MODULI,
    "mooney-rivlin": ISOCHORIC["mooney-rivlin"][0],
    "yeoh": ISOCHORIC["yeoh"][0],
    "gent": {"mu_pa": 1e4, "gent_limit": 20.0, "kappa_pa": 1e6},
    "arruda-boyce": {"mu_pa": 1e4, "chain_stretch": 3.0, "kappa_pa": 1e6},
    **{f"ogden-{count}": values for count, values in OGDEN_TERMS.items()},
    **{f"hyperfoam-{count}": values for count, values in FOAM_TERMS.items()},
}
# Words in the file of the target that show its law, without white space.
SHOWN = {
    ("mujoco", "st-venant-kirchhoff"): "<elasticity",
    ("newton", "stable-neo-hookean"): "k_mu",
    ("usd", "stable-neo-hookean"): "physics:youngsModulus",
    **{
        (target, law): f"*{card}"
        for target in ("calculix", "abaqus")
        for law, card in {
            "neo-hookean": "HYPERELASTIC,NEOHOOKE",
            "st-venant-kirchhoff": "ELASTIC",
            "linear": "ELASTIC",
            "mooney-rivlin": "HYPERELASTIC,MOONEY-RIVLIN",
            "yeoh": "HYPERELASTIC,YEOH",
            "arruda-boyce": "HYPERELASTIC,ARRUDA-BOYCE",
            **{f"ogden-{count}": f"HYPERELASTIC,OGDEN,N={count}" for count in range(1, 4)},
            **{f"hyperfoam-{count}": f"HYPERFOAM,N={count}" for count in range(1, 4)},
        }.items()
    },
    ("abaqus", "ogden-4"): "*HYPERELASTIC,OGDEN,N=4",
    ("abaqus", "hyperfoam-4"): "*HYPERFOAM,N=4",
    ("febio", "neo-hookean"): 'type="neo-Hookean"',
    ("febio", "st-venant-kirchhoff"): 'type="isotropicelastic"',
    ("febio", "mooney-rivlin"): 'type="Mooney-Rivlin"',
    ("febio", "yeoh"): 'type="Yeoh"',
    **{("febio", f"ogden-{count}"): 'type="Ogden"' for count in range(1, 5)},
    **{("json", law): f'"material":"{law}"' for law in MATERIALS},
}


@pytest.mark.parametrize("law", MATERIALS)
@pytest.mark.parametrize("target", TARGETS)
def test_a_target_gets_a_law_that_it_has_and_refuses_all_others(target, law, tmp_path):
    body = held_bar(law, CONSTANTS_OF[law])
    if (target, law) in SHOWN:
        folder = exported(body, target, tmp_path)
        text = re.sub(r"\s", "", (folder / TARGETS[target].main_file).read_text())
        assert SHOWN[target, law] in text
        return
    with pytest.raises(InputError, match=f"region 'body': {target} has no law {law}; ") as refused:
        write_export(body, target, tmp_path / target)
    known, remedy = refused.value.message.split(": solve again with such a material, or export ")
    assert {*known.split("expected one of ")[1].split(", ")} >= {
        each for to, each in SHOWN if to == target
    }
    others = remedy.removeprefix("with one of ").split(", ")
    assert others == [f"--to {to}" for to in TARGETS if (to, law) in SHOWN]
    assert not (tmp_path / target).exists()


def test_the_linear_law_beside_others_is_refused(tmp_path):
    bar = held_bar()
    regions = [Region("soft", np.arange(6), "linear"), Region("grip", np.arange(6, 30))]
    body = Body(bar.body.mesh, "st-venant-kirchhoff", 900.0, regions=regions)
    values = {f"{r.name}.{n}": v for r in regions for n, v in {**MODULI, **OTHERS}.items()}
    mixed = replace(
        bar,
        body=body,
        theta=body.theta_from_values(values),
        experiment=replace(bar.experiment, body=body),
    )
    with pytest.raises(InputError, match=r"'soft': calculix has no law linear beside other laws"):
        write_export(mixed, "calculix", tmp_path / "deck")


def test_a_law_that_is_refused_leaves_no_file(run_folder, tmp_path):
    for options in (["--to", "mujoco", "--out", tmp_path / "out"], ["--to", tmp_path / "b.usda"]):
        ended = run_command("export", run_folder, *options)
        assert ended.code == 2
        assert "has no law neo-hookean; expected one of" in ended.err
        assert len(ended.err.strip().splitlines()) == 1
    assert not any(tmp_path.iterdir())


def with_memory(material, values) -> IdentifiedBody:
    """A bar whose stiffness relaxes to 2 / 5 of the instantaneous one."""
    bar = held_bar(material, values)
    body = Body(bar.body.mesh, material, 900.0, prony=("slow", "fast"))
    memory = {"slow.share": 1.0, "slow.tau_s": 2.0, "fast.share": 0.5, "fast.tau_s": 0.1}
    theta = body.theta_from_values({**values, **OTHERS, **memory})
    return replace(bar, body=body, theta=theta, experiment=replace(bar.experiment, body=body))


@pytest.mark.parametrize(
    ("material", "kind"),
    [("yeoh", "uncoupled viscoelastic"), ("st-venant-kirchhoff", "viscoelastic")],
)
def test_febio_gets_the_memory_over_the_long_term_stress(material, kind, tmp_path):
    values = ISOCHORIC[material][0] if material in ISOCHORIC else MODULI
    folder = exported(with_memory(material, values), "febio", tmp_path)
    (law,) = ElementTree.parse(folder / "body.feb").getroot().iter("material")
    assert law.get("type") == kind
    found = {each.tag: each.text for each in law}
    assert [found[key] for key in ("g0", "g1", "t1", "g2", "t2")] == [
        "1.0",
        "1.0",
        "2.0",
        "0.5",
        "0.1",
    ]
    assert len(law.findall("elastic")) == 1


def test_abaqus_gets_a_card_with_intervals_and_shares_of_the_instantaneous_modulus(tmp_path):
    body = with_memory("yeoh", ISOCHORIC["yeoh"][0])
    known = ReportedEstimate(1e4, combined95=(9e3, 1.1e4))
    folder = exported(replace(body, parameters={"c10_pa": known}), "abaqus", tmp_path)
    lines = (folder / "material.inc").read_text().splitlines()
    assert "** c10_pa = 10000 (95 % interval 9000 to 1.1e+04)" in lines
    card = [line for line in lines if not line.startswith("**")]
    assert card[:2] == ["*MATERIAL,NAME=BODY", "*HYPERELASTIC,YEOH"]
    start = card.index("*VISCOELASTIC,TIME=PRONY") + 1
    assert card[start : start + 2] == ["0.4,0.4,2", "0.2,0.2,0.1"]
    assert card[-2:] == ["*DENSITY", "900"]
    assert len(lines) < 15


def test_calculix_gets_mesh_material_and_grasp(run_folder, tmp_path):
    body = IdentifiedBody.read(run_folder)
    deck = (exported(body, "calculix", tmp_path) / "body.inp").read_text()
    (region,) = body.regions
    card = deck.split("*HYPERELASTIC,NEO HOOKE\n")[1].splitlines()[0]
    np.testing.assert_allclose(
        np.array(card.split(","), dtype=float), [region.mu_pa / 2, 2 / region.kappa_pa]
    )
    boundary = deck.split("*BOUNDARY\n")[1].split("*")[0].splitlines()
    assert len(boundary) == body.is_prescribed.sum()
    nodes = deck.split("*NODE,NSET=ALL\n")[1].split("*")[0].split()
    rows = np.array([row.split(",") for row in nodes], dtype=float)
    np.testing.assert_allclose(rows[:, 1:], body.nodes_m, rtol=1e-11, atol=1e-15)


def test_no_number_of_a_deck_is_longer_than_calculix_reads(tmp_path):
    body = held_bar("neo-hookean", {"young_pa": 5e5 / 3, "poisson": 1 / 3})
    deck = (exported(body, "calculix", tmp_path) / "body.inp").read_text()
    lines = [line for line in deck.splitlines() if not line.startswith("*")]
    assert max(len(field) for line in lines for field in line.split(",")) <= 20


# What they say


@pytest.mark.parametrize(
    ("to", "expected"),
    [
        ("mujoco", "only those of the first sample are exported"),
        ("usd", "point masses on nodes are not exported"),
    ],
)
def test_a_point_mass_that_ends_has_one_sentence_by_target(to, expected, tmp_path):
    bar = held_bar(OWN_LAW[to], moving=True)
    t_s = bar.experiment.t_s
    mass = PointMass([5], 0.004, until_s=float(t_s[4]))
    loaded = replace(bar, experiment=replace(bar.experiment, masses=[mass]))
    limitations = write_export(loaded, to, tmp_path / to).limitations
    (sentence,) = (each for each in limitations if "point masses" in each)
    assert expected in sentence


@pytest.mark.parametrize("to", ["mujoco", "newton", "calculix"])
def test_unexported_air_is_reported_and_left_out_of_the_equilibrium(to, tmp_path):
    bar = held_bar(OWN_LAW[to])
    in_air = replace(bar, experiment=replace(bar.experiment, air_density_kg_m3=1.2))
    said = [write_export(each, to, tmp_path / to).limitations for each in (bar, in_air)]
    assert set(said[1]) - set(said[0]) == {
        "buoyancy, added mass and drag of the air are not exported"
    }
    np.testing.assert_array_equal(equilibria(bar)[0], equilibria(in_air)[0])


@pytest.mark.parametrize("to", ["mujoco", "newton", "calculix"])
def test_memory_that_is_lost_is_reported(to, tmp_path):
    values = {**MODULI, "prony_1.share": 0.5, "prony_1.tau_s": 0.2}
    limits = write_export(
        held_bar(OWN_LAW[to], values, prony=("prony_1",)), to, tmp_path / to
    ).limitations
    assert any("memory is not supported" in said and "1.5 times" in said for said in limits)


@pytest.mark.parametrize("to", TARGETS)
def test_doubts_about_the_run_go_along(run_folder, tmp_path, to):
    run = run_for(to, run_folder, tmp_path)
    result = json.loads((run / "result.json").read_text())
    swings = {"code": "residuals/shared", "grade": "doubtful", "data": {}}
    result["trust"] = {"concerns": [swings]}
    result["parameters"]["mu_pa"] |= {"at_bound": True, "value": 300.0}
    (run / "result.json").write_text(json.dumps(result))
    ended = run_command("export", run, "--to", to, "--out", tmp_path / "out")
    assert ended.code == 0, ended.err
    written = "".join(file.read_text() for file in (tmp_path / "out").iterdir())
    for said in (
        "'doubtful': the residuals are not independent noise",
        "mu_pa = 300 ended at a bound",
    ):
        assert "warning: " in ended.out
        assert said in ended.out
        assert said in written


HOSTILE = "a --- b --> \"<&'\x00\x1b[2J\x0c\ufffe\n"


@pytest.mark.parametrize("to", ["mujoco", "calculix", "newton", "usd", "febio"])
def test_any_title_or_name_is_written_in_the_form_of_the_target(to: str, tmp_path: Path):
    bar = box_mesh(BAR_M, DIVISIONS)
    cells = np.arange(len(bar.tetrahedra))
    names = ["a-²", "a_²"]
    parts = np.array_split(cells, len(names))
    regions = [Region(name, part) for name, part in zip(names, parts, strict=True)]
    body = Body(bar, OWN_LAW[to], 900.0, regions=regions)
    still = Grasp(nodes_where(body, 0, 0.0), PoseSequence.fixed())
    t_s = times(8)
    markers = vertex_markers(body, nodes_where(body, 0, BAR_M[0]), t_s)
    wall = Obstacle(shape=Plane(point_m=(0.0, 0.0, -1.0)), name=HOSTILE)
    experiment = Experiment(body, t_s, [still], markers, nuisance=IDEAL)
    touching = experiment.with_obstacles([wall])
    values = {f"{name}.{n}": v for name in names for n, v in {**MODULI, **OTHERS}.items()}
    theta, words = body.theta_from_values(values), (HOSTILE, "good", (HOSTILE,))
    identified = IdentifiedBody(*words, {}, body, theta, experiment, None, touching)
    folder = exported(identified, to, tmp_path)
    for file in folder.iterdir():
        text = file.read_text(encoding="utf-8")
        assert all(mark.isprintable() or mark in "\n\t" for mark in text)
        if file.suffix in (".xml", ".feb"):
            ElementTree.parse(file)
        elif file.suffix == ".py":
            compile(text, file, "exec")


# What is refused


def test_an_unknown_target_writes_nothing(run_folder, tmp_path):
    ended = run_command("export", run_folder, "--to", "mujco", "--out", tmp_path / "out")
    assert ended.code == 2
    assert "did you mean 'mujoco'" in ended.err
    assert not (tmp_path / "out").exists()


def test_other_files_are_left_alone(run_folder, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    ended = run_command("export", run_folder, "--to", "json", "--out", tmp_path)
    assert ended.code == 2
    assert "not an earlier export" in ended.err
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.skipif(os.name != "posix", reason="links of POSIX")
def test_an_export_is_not_written_through_a_link(run_folder: Path, tmp_path: Path):
    run, theirs = tmp_path / "run", tmp_path / "theirs"
    shutil.copytree(run_folder, run)
    theirs.mkdir()
    (theirs / "identified.json").write_text("{}")
    (theirs / "recording.csv").write_text("precious")
    (run / "export-json").symlink_to(theirs)
    ended = run_command("export", run, "--to", "json")
    assert ended.code == 2
    assert f"export-json: this is a link to {theirs}" in ended.err
    assert sorted(file.name for file in theirs.iterdir()) == ["identified.json", "recording.csv"]
    (run / "export-json").unlink()
    for _ in range(2):
        assert run_command("export", run, "--to", "json").code == 0


def test_an_earlier_export_is_replaced(run_folder, tmp_path):
    for to in ("febio", "json"):
        assert run_command("export", run_folder, "--to", to, "--out", tmp_path / "out").code == 0
    assert not (tmp_path / "out" / "body.feb").exists()


# Destinations


def test_a_file_gets_the_format_of_its_suffix(run_folder, tmp_path):
    file = tmp_path / "deck" / "swing.inp"
    ended = run_command("export", run_folder, "--to", file, "--json")
    assert ended.code == 0, ended.err
    said = json.loads(ended.out)
    assert (said["folder"], said["file"]) == (str(file.parent), str(file))
    names = ["swing.inp", "swing_identified.json", "swing_poses_1.csv"]
    assert sorted(f.name for f in file.parent.iterdir()) == [".collocation-sysid.json", *names]
    assert run_command("export", run_folder, "--to", "calculix", "--out", tmp_path / "b").code == 0
    for name, same in zip(names, ("body.inp", "identified.json", "poses_1.csv"), strict=True):
        assert (file.parent / name).read_bytes() == (tmp_path / "b" / same).read_bytes()


@pytest.mark.parametrize("to", MAIN_FILES)
def test_every_format_is_found_by_its_name_and_by_its_suffix(to: str):
    run = Path("run")
    suffix = Path(MAIN_FILES[to]).suffix
    by_name = parse_destination(to, MAIN_FILES, run)
    assert (by_name.format_name, by_name.folder) == (to, run / f"export-{to}")
    assert parse_destination(to, MAIN_FILES, run, Path("out")).folder == Path("out")
    by_suffix = parse_destination(f"a/b{suffix.upper()}", MAIN_FILES, run)
    assert (by_suffix.format_name, by_suffix.is_folder) == (to, False)
    for folder in (f"a/{to}", f"export-{to}"):
        found = parse_destination(folder, MAIN_FILES, run)
        assert (found.format_name, found.folder, found.is_folder) == (to, Path(folder), True)


def test_newton_finds_its_numbers_under_any_name(run_folder, tmp_path):
    run = run_for("newton", run_folder, tmp_path)
    assert run_command("export", run, "--to", tmp_path / "foam.py").code == 0
    assert {"nodes_m", "cells"} <= json.loads((tmp_path / "foam.json").read_text()).keys()
    assert 'Path(__file__).with_suffix(".json")' in (tmp_path / "foam.py").read_text()


@needs_mujoco
def test_a_file_is_verified_like_a_folder(run_folder, tmp_path):
    run = run_for("mujoco", run_folder, tmp_path)
    ended = run_command("export", run, "--to", tmp_path / "swing.xml", "--verify", "--json")
    assert ended.code == 0, ended.err
    assert all(abs(each["relative"]) < 0.1 for each in json.loads(ended.out)["verified"])
    assert json.loads(ended.out)["verified"]


@pytest.mark.parametrize("to", ["body.stl", "body", "out/body", "mujco"])
def test_an_unknown_destination_is_refused_with_all_formats(run_folder, to: str, tmp_path):
    ended = run_command("export", run_folder, "--to", to if to == "mujco" else tmp_path / to)
    assert ended.code == 2
    said = " ".join(ended.err.split())
    for name, file in MAIN_FILES.items():
        assert f"{name} ({Path(file).suffix})" in said
    assert [*tmp_path.iterdir()] == []


def test_a_suffix_of_several_formats_needs_the_name():
    several = {**MAIN_FILES, "abaqus": "model.inp"}
    with pytest.raises(InputError, match="suffix of calculix and abaqus; write the name") as error:
        parse_destination("deck.inp", several, Path("run"))
    assert error.value.where == "--to"


def test_a_destination_is_named_once(run_folder, tmp_path):
    ended = run_command("export", run_folder, "--to", "body.inp", "--out", tmp_path / "out")
    assert (ended.code, "leave out --out" in ended.err) == (2, True)
    assert [*tmp_path.iterdir()] == []


def test_a_file_replaces_only_files_of_an_earlier_export(run_folder, tmp_path):
    words = ("export", run_folder, "--to", tmp_path / "swing.json")
    (tmp_path / "mine.txt").write_text("mine")
    for _ in range(2):
        assert run_command(*words).code == 0
    assert (tmp_path / "mine.txt").read_text() == "mine"
    (tmp_path / "swing_poses_1.csv").write_text("edited")
    (tmp_path / "swing.json").unlink()
    ended = run_command(*words)
    assert ended.code == 2
    assert "swing_poses_1.csv: this file exists and was not written" in ended.err
    assert (tmp_path / "swing_poses_1.csv").read_text() == "edited"
    assert not (tmp_path / "swing.json").exists()


@pytest.mark.skipif(os.name != "posix", reason="links of POSIX")
def test_a_file_is_not_written_through_a_link(run_folder, tmp_path):
    (tmp_path / "theirs.json").write_text("{}")
    (tmp_path / "swing.json").symlink_to(tmp_path / "theirs.json")
    ended = run_command("export", run_folder, "--to", tmp_path / "swing.json")
    assert (ended.code, (tmp_path / "theirs.json").read_text()) == (2, "{}")
    (tmp_path / "linked").symlink_to(tmp_path)
    ended = run_command("export", run_folder, "--to", tmp_path / "linked" / "other.json")
    assert (ended.code, "nothing is written through links" in ended.err) == (2, True)
    assert not (tmp_path / "other.json").exists()
    (tmp_path / "folder.json").mkdir()
    ended = run_command("export", run_folder, "--to", tmp_path / "folder.json")
    assert (ended.code, "is a folder; expected a file" in ended.err) == (2, True)


def test_an_unknown_experiment_is_refused(run_folder, tmp_path):
    ended = run_command("export", run_folder, "--to", "json", "--experiment", "sway")
    assert ended.code == 2
    assert "expected one of swing" in ended.err


def test_models_that_a_target_cannot_represent_are_refused(tmp_path):
    with pytest.raises(InputError, match="grasp 2 holds only z"):
        write_export(held_bar(axes="z"), "mujoco", tmp_path / "out")
    body = held_bar("stable-neo-hookean")
    with pytest.raises(InputError, match="cannot be run by this program"):
        verify_export(body, "newton", exported(body, "newton", tmp_path))
    assert not (tmp_path / "out").exists()


def test_a_simulator_that_is_missing_is_named(tmp_path, monkeypatch):
    body = held_bar()
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"collocation-sysid\[mujoco\]"):
        verify_export(body, "mujoco", exported(body, "mujoco", tmp_path))
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match="install CalculiX"):
        verify_export(body, "calculix", exported(body, "calculix", tmp_path))


# What simulators make of them

SAME_ENERGY = {
    "st-venant-kirchhoff": {"young_pa": 5e4, "poisson": 0.3},
    "linear": {"young_pa": 5e4, "poisson": 0.3},
    "mooney-rivlin": {"c10_pa": 7e3, "c01_pa": 3e3, "kappa_pa": 5e4},
    "yeoh": {"c10_pa": 1e4, "c20_pa": 1e3, "c30_pa": 1e2, "kappa_pa": 5e4},
    **{f"ogden-{n}": OGDEN_TERMS[n] for n in (1, 2, 3)},
    "hyperfoam-3": FOAM_TERMS[3],
}


@needs_ccx
@pytest.mark.parametrize("material", SAME_ENERGY)
def test_calculix_sags_alike_with_the_same_energy(material, tmp_path):
    body = held_bar(material, SAME_ENERGY[material])
    (sag,) = verify_export(body, "calculix", exported(body, "calculix", tmp_path))
    assert sag.ours > 0.05 * BAR_M[0]  # not small
    assert abs(sag.relative_difference) < 1e-4


MATRIX = {"mu_pa": 2e4, "lambda_pa": 1e6 - 2 / 3 * 2e4}  # hardly compressible, as CalculiX's is


def reinforced_bar(fibres: Fibres, constants: dict[str, float]) -> IdentifiedBody:
    """A bar with fibres."""
    bar = held_bar("neo-hookean", MATRIX, "tet10")  # linear elements would lock
    body = Body(bar.body.mesh, "neo-hookean", 900.0, "tet10", fibres=fibres)
    theta = body.theta_from_values({**MATRIX, **OTHERS, **constants})
    return replace(bar, body=body, theta=theta, experiment=replace(bar.experiment, body=body))


def test_calculix_gets_fibres_in_their_axes(tmp_path):
    fibres = Fibres(direction=[1, 1, 0], normal=[0, 0, 1], families=2, law="exponential")
    constants = {"fibre_pa": 8e4, "fibre_exponent": 0.5, "fibre_angle_rad": 0.3}
    folder = exported(reinforced_bar(fibres, constants), "calculix", tmp_path)
    deck = (folder / "body.inp").read_text()
    values = card_values(folder, "*USER MATERIAL,CONSTANTS=10")
    own = [2e4, 0.5]
    sine = np.sin(0.3)
    np.testing.assert_allclose(values, [1e4, 2e-6, 0, -sine, *own, 0, sine, *own], rtol=1e-10)
    axes = np.array(card_values(folder, "*ORIENTATION,NAME=F0_0")).reshape(2, 3)
    local = np.vstack([axes, np.cross(*axes)])  # rows X, Y and Z of the deck
    along = [np.array([0, a, np.sqrt(1 - a * a)]) @ local for a in (-sine, sine)]
    turned = np.pi / 4 + np.array([0.3, -0.3])
    expected = np.column_stack([np.cos(turned), np.sin(turned), 0 * turned])
    np.testing.assert_allclose(np.abs(np.sum(along * expected, axis=1)), 1.0, rtol=1e-9)
    assert deck.count("*SOLID SECTION") == 1


PARALLEL = Fibres(direction=[1, 0, 0])
SCATTERED = Fibres(direction=[1, 0, 0], dispersed=True)
BOTH_WAYS = Fibres(direction=[1, 0, 0], tension_only=False)


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize(
    ("fibres", "constants", "name", "have_it"),
    [
        (PARALLEL, {}, "fibres", ("calculix", "abaqus", "febio", "json")),
        (SCATTERED, {"fibre_dispersion": 0.1}, "dispersed fibres", ("abaqus", "febio", "json")),
        (BOTH_WAYS, {}, "fibres that carry compression", ("json",)),
    ],
)
def test_fibres_that_a_target_does_not_have_are_refused(
    target, fibres, constants, name, have_it, tmp_path
):
    body = reinforced_bar(fibres, {"fibre_pa": 8e4, **constants})
    if target in have_it:
        write_export(body, target, tmp_path / "out")
        return
    with pytest.raises(InputError, match=f"has no law neo-hookean with {name}; ") as refused:
        write_export(body, target, tmp_path / "out")
    assert refused.value.message.endswith(", ".join(f"--to {each}" for each in have_it))


@needs_ccx
@pytest.mark.parametrize(
    ("fibres", "constants"),
    [
        (Fibres(direction=[1, 0, 0]), {}),
        (
            Fibres(direction=[1, 0.5, 0], normal=[0, 0, 1], families=2, law="exponential"),
            {"fibre_exponent": 0.5, "fibre_angle_rad": 0.3},
        ),
        (Fibres(axis=(1, 0, 0), axis_point_m=(0.0, 0.01, -0.02)), {}),
    ],
    ids=["parallel", "two families", "hoops"],
)
def test_calculix_bends_alike_with_fibres(fibres, constants, tmp_path):
    body = reinforced_bar(fibres, {"fibre_pa": 8e4, **constants})
    (sag,) = verify_export(body, "calculix", exported(body, "calculix", tmp_path))
    assert sag.ours > 0.2 * BAR_M[0]
    assert abs(sag.relative_difference) < 0.01


@needs_ccx
@pytest.mark.parametrize("material", ["neo-hookean", "stable-neo-hookean"])
def test_calculix_sags_alike_at_small_strain(material, tmp_path):
    body = held_bar(material, {"young_pa": 5e5, "poisson": 0.3})
    (sag,) = verify_export(body, "calculix", exported(body, "calculix", tmp_path))
    assert sag.ours > 0
    assert abs(sag.relative_difference) < 0.02


@needs_ccx
def test_quadratic_elements_sag_alike_in_calculix(tmp_path):
    body = held_bar(element="tet10")
    (sag,) = verify_export(body, "calculix", exported(body, "calculix", tmp_path))
    assert abs(sag.relative_difference) < 0.02


@needs_ccx
def test_an_error_of_calculix_is_reported(tmp_path):
    body = held_bar()
    folder = exported(body, "calculix", tmp_path)
    deck = folder / "body.inp"
    deck.write_text(deck.read_text().replace("*STATIC", "*STATIK"))
    with pytest.raises(InputError, match="CalculiX could not compute the exported model"):
        verify_export(body, "calculix", folder)


@needs_mujoco
def test_the_flex_of_mujoco_has_the_damping_law_in_material_form(tmp_path, rng):
    """Its passive force on random shapes and velocities, less that at rest."""
    import mujoco

    identified = held_bar()
    folder = exported(identified, "mujoco", tmp_path)
    model = mujoco.MjModel.from_xml_path(str(folder / "body.xml"))
    model.opt.timestep = 1e-7  # its damping is of first order in the step
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    free = ~identified.is_node_prescribed
    moved = rng.uniform(-2e-3, 2e-3, (int(free.sum()), 3))
    velocity = rng.standard_normal(moved.shape)
    data.qpos[-moved.size :] = moved.ravel()
    passive = []
    for speed in (velocity, 0 * velocity):
        data.qvel[:] = 0.0
        data.qvel[-moved.size :] = speed.ravel()
        mujoco.mj_forward(model, data)
        passive.append(data.qfrc_passive[-moved.size :].copy())
    found = passive[0] - passive[1]
    off = {}
    for law in ("material", "kelvin-voigt"):
        body = Body(identified.body.mesh, "st-venant-kirchhoff", 900.0, damping=law)
        x = identified.nodes_m.copy()
        v = np.zeros_like(x)
        x[free] += moved
        v[free] = velocity
        state = x.reshape(1, -1)
        force = body.force(state, v.reshape(1, -1), identified.theta)
        force -= body.force(state, np.zeros_like(state), identified.theta)
        expected = force.reshape(-1, 3)[free].ravel() + _mass_damping(identified, free, velocity)
        off[law] = np.abs(found - expected).max() / np.abs(expected).max()
    assert off["material"] < 1e-5
    assert off["kelvin-voigt"] > 1e-2


def _mass_damping(identified: IdentifiedBody, free: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """γ_m M v, which MuJoCo does not have, to be added to our force."""
    gamma_m = identified.regions[0].gamma_m_1_s
    return (gamma_m * identified.node_mass_kg[free][:, None] * velocity).ravel()


def test_the_law_of_mujoco_needs_no_note(tmp_path):
    """A body that is damped in material form is exported as it is."""
    write_export(held_bar(), "mujoco", tmp_path / "kelvin")
    write_export(held_bar(damping="material"), "mujoco", tmp_path / "own")
    told = [(folder / "body.xml").read_text() for folder in (tmp_path / "kelvin", tmp_path / "own")]
    assert 'the law "material"' in told[0]
    assert 'the law "material"' not in told[1]


@needs_mujoco
def test_mujoco_swings_alike(tmp_path):
    body = held_bar(moving=True)
    frequency, motion = verify_export(body, "mujoco", exported(body, "mujoco", tmp_path))
    assert frequency.ours > 1.0
    assert abs(frequency.relative_difference) < 1e-6  # the same energy, mesh and masses
    assert motion.ours > 1e-3
    assert abs(motion.relative_difference) < 0.03


def test_an_older_mujoco_that_makes_bodies_stiffer_is_refused(tmp_path, monkeypatch):
    body = held_bar(moving=True)
    folder = exported(body, "mujoco", tmp_path)
    monkeypatch.setitem(sys.modules, "mujoco", SimpleNamespace(__version__="3.17.0"))
    with pytest.raises(InputError, match=r"found MuJoCo 3\.17\.0, .* expected 4 or newer"):
        verify_export(body, "mujoco", folder)


def laid_block(shape: Solid) -> IdentifiedBody:
    """A block let go a millimetre above something, as if a run had identified it."""
    block = Body(box_mesh((0.04, 0.04, 0.04), (2, 2, 2)), "st-venant-kirchhoff", 300.0)
    t_s = np.linspace(0.0, 0.3, 31)
    table = Obstacle(shape=shape, name="table", friction=0.5)
    seen = vertex_markers(block, np.array([0]), t_s)
    fallen = Experiment(block, t_s, [table], seen, start="undeformed", nuisance=IDEAL)
    values = {"young_pa": 1e4, "poisson": 0.3, "gamma_r_s": 0.02, "gamma_m_1_s": 0.0}
    motion = simulate(fallen, values, "bdf2", substeps=4).positions_m
    still = without_obstacles(fallen)
    theta, shapes = (still.body.theta_from_values(values), motion[:, : len(block.nodes_m)])
    return IdentifiedBody("b", "good", (), {}, still.body, theta, still, shapes, fallen)


LAID_ON = {
    "plane": Plane(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -0.001])),
    "box": Cuboid(np.array([(-0.1, -0.1, -0.05), (0.1, 0.1, -0.001)])),
}


@needs_mujoco
@pytest.mark.parametrize("name", LAID_ON)
def test_an_exported_block_rests_as_high_in_mujoco(name, tmp_path):
    import mujoco

    body = laid_block(LAID_ON[name])
    model = mujoco.MjModel.from_xml_path(str(exported(body, "mujoco", tmp_path) / "body.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    while data.time < 0.3:
        mujoco.mj_step(model, data)
    height_m = (data.qpos.reshape(-1, 3) + body.nodes_m)[:, 2].mean()
    assert body.simulated_m is not None
    fallen_m = body.nodes_m[:, 2].mean() - body.simulated_m[-1, :, 2].mean()
    assert fallen_m > 1e-3
    assert height_m == pytest.approx(body.simulated_m[-1, :, 2].mean(), abs=0.05 * fallen_m)


def test_all_solids_are_geoms_and_losses_are_reported(tmp_path):
    ends = np.array([(0.0, 0.0, -0.01), (0.0, 0.04, -0.01)])
    body = laid_block(LAID_ON["plane"])
    solids = [
        Sphere(0.01, np.array([0.02, 0.02, -0.02])),
        Cylinder(0.005, ends, 0.001),
        Capsule(0.005, ends),
    ]
    others = [replace(body.obstacles[0], shape=s, name=f"it {k}") for k, s in enumerate(solids)]
    assert body.experiment_with_obstacles is not None
    touching = body.experiment_with_obstacles.with_obstacles((*body.obstacles, *others))
    several = replace(body, experiment_with_obstacles=touching)
    model = exported(several, "mujoco", tmp_path)
    geoms = ElementTree.parse(model / "body.xml").findall(".//geom")
    assert [geom.get("type") for geom in geoms] == ["plane", "sphere", "cylinder", "capsule"]
    assert {geom.get("friction") for geom in geoms} == {"0.5 0 0"}
    told = json.loads((model / "identified.json").read_text())
    assert told["obstacles"][1]["shape"]["sphere_m"]["radius_m"] == 0.01
    said = " ".join(told["not_expressed"])
    assert "it 1: its edges are not rounded" in said
    assert "table" not in said


SOLIDS = {
    "plane": Plane(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 0.0401])),
    "sphere": Sphere(0.02, np.array([0.02, 0.02, 0.0601])),
    "box": Cuboid(np.array([(0.01, 0.01, 0.0401), (0.03, 0.03, 0.06)]), 0.004),
    "cylinder": Cylinder(0.008, np.array([(0.02, 0.02, 0.0401), (0.02, 0.02, 0.06)]), 0.002),
    "capsule": Capsule(0.0099, np.array([(0.02, -0.01, 0.05), (0.02, 0.05, 0.05)])),
}


def pressed_block(
    *shapes: Solid, friction: float = 0.0, material: str = "st-venant-kirchhoff"
) -> IdentifiedBody:
    """A block held below into which something comes 3 mm, as if a run had identified it."""
    block = Body(box_mesh((0.04, 0.04, 0.04), (2, 2, 2)), material, 300.0)
    t_s = np.arange(3.0)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = [-0.0015, -0.003, -0.003]
    pressing = [
        Obstacle(shape=shape, name=f"it {k}", friction=friction, poses=poses)  # pyright: ignore
        for k, shape in enumerate(shapes)
    ]
    grasps = [Grasp(nodes_where(block, 2, 0.0), PoseSequence.fixed()), *pressing]
    seen = vertex_markers(block, np.array([0]), t_s)
    whole = Experiment(block, t_s, grasps, seen, nuisance=IDEAL, kind="static")
    still = without_obstacles(whole)
    values = {"young_pa": 1e4, "poisson": 0.3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    theta = still.body.theta_from_values(values)
    return IdentifiedBody("b", "good", (), {}, still.body, theta, still, None, whole)


@pytest.mark.parametrize("name", SOLIDS)
def test_facets_lie_on_the_surface_of_their_solid_and_face_outwards(name):
    solid, about_m = SOLIDS[name], np.array([0.02, 0.02, 0.02])
    facets = Facets.from_solid(solid, about_m, 0.1, tolerance_m=2e-5)
    gap = ca.Function("gap", [place := ca.SX.sym("p", 3)], [solid.signed_distance(place)])
    corners = facets.points_m[facets.triangles]
    middles = corners.mean(axis=1)
    gaps = np.array(gap(np.vstack([corners.reshape(-1, 3), middles]).T))
    assert np.abs(gaps).max() < 3e-4 * (name != "plane") + 1e-9
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outside = middles + 1e-3 * normals / np.linalg.norm(normals, axis=1)[:, None]
    assert np.array(gap(outside.T)).min() > 5e-4
    assert float(np.array(gap(facets.points_m[-1])).squeeze()) < -1e-3
    seen = facets.facing(about_m[None])
    assert 0 < len(seen.triangles) <= len(facets.triangles)
    if name in ("box", "cylinder"):  # not those on top
        assert seen.points_m[seen.triangles][..., 2].max() < 0.06


@needs_ccx
def test_calculix_is_pressed_with_the_same_force(tmp_path):
    body = pressed_block(SOLIDS["plane"], friction=0.2)
    moved, force = verify_export(body, "calculix", exported(body, "calculix", tmp_path))
    assert moved.ours > 2.5e-3
    assert force.ours > 0.5
    assert abs(moved.relative_difference) < 5e-3
    assert abs(force.relative_difference) < 5e-3


def test_a_body_of_which_only_a_force_was_measured_is_exported(tmp_path):
    body = pressed_block(SOLIDS["plane"])
    assert body.experiment_with_obstacles is not None
    (tip,) = body.obstacles
    felt = replace(
        tip, wrench=Wrench(body.experiment_with_obstacles.t_s, np.zeros((3, 6)), 0.01, 1.0)
    )
    whole = replace(
        body.experiment_with_obstacles,
        grasps=[*body.experiment_with_obstacles.body_grasps, felt],
        markers=None,
    )
    still = without_obstacles(whole)
    np.testing.assert_array_equal(still.is_prescribed([0.0])[0], body.is_prescribed)
    lone = replace(body, experiment=still, body=still.body, experiment_with_obstacles=whole)
    decks = [
        (exported(each, "calculix", tmp_path / str(k)) / "body.inp").read_text()
        for k, each in enumerate((body, lone))
    ]
    assert decks[0] == decks[1]


def test_usd_gets_solids_their_motion_and_friction(tmp_path):
    body = pressed_block(*SOLIDS.values(), friction=0.2, material="stable-neo-hookean")
    stage = stage_of(exported(body, "usd", tmp_path))
    from pxr import UsdGeom, UsdPhysics, UsdShade

    for k, name in enumerate(SOLIDS, start=1):
        solid = stage.GetPrimAtPath(f"/World/Obstacle_{k}/Shape")
        assert solid.GetTypeName() == {"box": "Cube"}.get(name, name.title())
        assert solid.HasAPI(UsdPhysics.CollisionAPI)
        material, _ = UsdShade.MaterialBindingAPI(solid).ComputeBoundMaterial("physics")
        assert UsdPhysics.MaterialAPI(material).GetDynamicFrictionAttr().Get() == pytest.approx(0.2)
        # USD's matrices act on rows; the last row is where its middle is.
        at = [UsdGeom.Xformable(solid).ComputeLocalToWorldTransform(t) for t in (0.0, 1.0)]
        assert at[1][3][2] - at[0][3][2] == pytest.approx(-0.0015)
    box = np.array(
        UsdGeom.Xformable(stage.GetPrimAtPath("/World/Obstacle_3/Shape")).GetLocalTransformation()
    )
    np.testing.assert_allclose(np.abs(box[:3, :3]), np.diag([0.01, 0.01, 0.00995]), atol=1e-9)
    capsule = UsdGeom.Capsule(stage.GetPrimAtPath("/World/Obstacle_5/Shape"))
    assert capsule.GetHeightAttr().Get() == pytest.approx(0.06)
    assert capsule.GetRadiusAttr().Get() == pytest.approx(0.0099)


def test_newton_reports_different_contact(tmp_path):
    law = "stable-neo-hookean"
    alike = pressed_block(SOLIDS["plane"], SOLIDS["sphere"], friction=0.2, material=law)
    assert alike.experiment_with_obstacles is not None
    first, second = alike.obstacles
    obstacles = [first, replace(second, friction=0.8)]
    whole = replace(
        alike.experiment_with_obstacles,
        grasps=[*alike.experiment_with_obstacles.body_grasps, *obstacles],
    )
    unlike = replace(alike, experiment_with_obstacles=whole)
    for body, count in ((alike, 0), (unlike, 1)):
        folder = exported(body, "newton", tmp_path / str(count))
        told = json.loads((folder / "identified.json").read_text())["not_expressed"]
        said = [each for each in told if "obstacles differ in friction, but a soft body" in each]
        assert len(said) == count
        numbers = json.loads((folder / "body.json").read_text())
        assert numbers["contact_mu"] == 0.2
        assert numbers["contact_m"] == faceted_obstacles(body)[0].width_m / 2


@pytest.mark.long
def test_newton_opens_the_stage_and_sags_alike_with_the_same_energy(tmp_path):
    pytest.importorskip("newton")
    pytest.importorskip("newton_usd_schemas")
    body = held_bar("stable-neo-hookean")
    (sag,) = verify_export(body, "usd", exported(body, "usd", tmp_path))
    assert sag.ours > 0.1 * BAR_M[0]  # not small
    assert abs(sag.relative_difference) < 1e-3


@pytest.mark.long
def test_newton_is_pressed_alike_from_the_stage_and_has_all_solids(tmp_path):
    newton = pytest.importorskip("newton")
    pytest.importorskip("newton_usd_schemas")
    body = pressed_block(SOLIDS["plane"], material="stable-neo-hookean")
    (moved,) = verify_export(body, "usd", exported(body, "usd", tmp_path))
    assert moved.ours > 1e-3
    assert abs(moved.relative_difference) < 0.02
    several = pressed_block(*SOLIDS.values(), friction=0.2, material="stable-neo-hookean")
    folder = exported(several, "newton", tmp_path)
    build = runpy.run_path(str(folder / "body.py"))
    model = build["model"]("cpu")
    kinds = [newton.GeoType(kind).name.lower() for kind in model.shape_type.numpy()]
    assert kinds == list(SOLIDS)
    np.testing.assert_allclose(model.shape_material_mu.numpy(), 0.2)


def test_constants_of_a_specimen_are_exported_as_a_material_but_not_as_a_body(tmp_path):
    strain = np.linspace(0.02, 0.3, 6)
    stress_pa = 1e5 * (1 + strain - (1 + strain) ** -2) / 3
    specimen = cs.Specimen("uniaxial", strain, stress_pa, 100.0)
    run = cs.run(
        cs.Problem(
            [specimen.experiment("neo-hookean", "pull")],
            {"young_pa": cs.Unknown(1e5), "poisson": 0.4999},
        )
    )
    body = IdentifiedBody.from_run(run)
    (deck,) = exported(body, "calculix", tmp_path).glob("*.inp")
    text = deck.read_text()
    assert "one homogeneous cell with a nominal density" in text
    assert text.count("*STEP") == text.count("*AMPLITUDE") == 1
    curve = text.split("*AMPLITUDE,NAME=U4_3\n")[1].split("*")[0].split()
    moved = np.array([float(row.split(",")[1]) / 0.01 for row in curve])
    zero = run.solution.nuisance("zero of the strain")  # the strains are corrected by it
    np.testing.assert_allclose(moved, [0, *(strain + zero)], rtol=1e-9)
    # A card alone has no cell to which the nominal density would belong.
    assert "*DENSITY" not in (exported(body, "abaqus", tmp_path) / "material.inc").read_text()
    with pytest.raises(InputError, match="no body that moves"):
        exported(body, "mujoco", tmp_path)


@pytest.mark.long
def test_a_run_is_exported_from_any_working_folder(tmp_path: Path, monkeypatch) -> None:
    write_problem(tmp_path, {"swing": 8})
    monkeypatch.chdir(tmp_path)
    solve = ("solve", "problem.toml", "--out", "run", "-q", "--method", "reduced-space")
    assert run_command(*solve).code == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert run_command("export", "../run", "--to", "calculix", "--out", "calculix").code == 0
