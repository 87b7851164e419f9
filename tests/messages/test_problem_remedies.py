"""The remedies of messages about problem files, followed mechanically: the problem that is read in the
end is the one without the mistake.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from kit.depth import MATRIX, POSE
from kit.problem_files import replace_text, write_problem

import collocation_sysid as cs
from collocation_sysid.problem.new import create_problem

MOST_STEPS = 3
# What a person knows who follows a remedy that asks for it.
KNOWN = {"sigma_n": "0.01", "sigma_nm": "0.001"}
SENSED = 'poses = "swing_motion.csv", wrench = { file = "swing_wrench.csv", sigma_n = 0.01 } }'
OBSTACLE = """
[[experiment.obstacle]]
name = "table"
friction = 0.3
shape = { plane = { normal = [0, 0, 1], point_m = [0, 0, -0.05] } }
"""
DEPTH = """
[[experiment.depth]]
name = "front"
file = "front.npz"
sigma_m = 0.001
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of a bar with markers, a wrench, an obstacle and a depth camera, and of a bench."""
    folder = tmp_path_factory.mktemp("made")
    bar = folder / "bar"
    bar.mkdir()
    write_problem(bar, {"swing": 8})
    rows = (f"{0.01 * k},0.1,0.2,{0.3 + 0.01 * k}" for k in range(9))
    (bar / "swing_wrench.csv").write_text("\n".join(["t_s,fx_n,fy_n,fz_n", *rows]))
    np.savez(
        bar / "front.npz",
        depth_m=np.full((3, 12, 16), 0.3),
        t_s=[0.0, 0.04, 0.08],
        camera_matrix=MATRIX,
        camera_pose=POSE,
    )
    replace_text('poses = "swing_motion.csv" }', SENSED)(bar)
    with (bar / "problem.toml").open("a") as file:
        file.write(OBSTACLE + DEPTH)
    create_problem(folder / "bench", "compression")
    return folder


def state(file: Path) -> list[object]:
    """What a problem file states, apart from guesses and bounds."""
    problem = cs.Problem.read(file)
    states: list[object] = [str(problem.method), problem.scheme, problem.uncertainty.noise]
    states += sorted(each.name for each in problem.parameters.items)
    for experiment in problem.experiments:
        body = experiment.body
        states += [body.element.name, *(part.material.name for part in body.parts)]
        states += [part.damping.name for part in body.parts]
        states += [round(body.mass_kg, 9), body.made, experiment.kind, experiment.start]
        states += [len(grasp.nodes) for grasp in experiment.grasps]
        states += [(each.name, each.friction) for each in experiment.obstacles]
        states += [*experiment.gravity_m_s2, round(float(experiment.t_s[-1]), 9)]
        for each in experiment.measurements:
            states += [each.title, *np.round(each.value_sigmas, 9), len(each.sample_times_s)]
            states.append(round(float(np.nansum(each.measured_values)), 6))
        states.append(np.round(experiment.markers.placement.distance_m, 6).tolist())
    return states


def remedied(folder: Path, message: str) -> Iterator[tuple[str, str, str]]:
    """File, old and new text for each remedy that a message offers."""
    text = (folder / "problem.toml").read_text()
    csv = re.search(r"(\w+\.csv): line", message)
    if found := re.search(r"(\w+): unknown key; did you mean '(\w+)'", message):
        (old,) = {*re.findall(rf"\b{found[1]}\b(?=\s*=|\]|\.)", text)}
        yield "problem.toml", rf"\b{old}\b(?=\s*=|\]|\.)", found[2]
    elif found := re.search(r"found '([^']+)'; expected .*did you mean '([^']+)'", message):
        yield "problem.toml", rf"(?<=[\"\s]){found[1]}(?=\"|\s*=)", found[2]
    elif found := re.search(r"/([\w.]+) does not exist.*did you mean '([^']+)'", message):
        yield "problem.toml", re.escape(found[1]), found[2]
    elif found := re.search(r"parameters\.(\w+): .* no such parameter.*mean '(\w+)'", message):
        yield "problem.toml", rf"(?m)^{found[1]}\b", found[2]
    elif found := re.search(r"probably ([\d.]+) kg/m³", message):
        yield "problem.toml", r"density_kg_m3 = [\d.]+", f"density_kg_m3 = {found[1]}"
    elif "give the lowest coordinates first, then the highest" in message:
        corners = re.search(r"box_m = \[(\[.*?\]), (\[.*?\])\]", text)
        assert corners is not None
        yield "problem.toml", re.escape(corners[0]), f"box_m = [{corners[2]}, {corners[1]}]"
    elif found := re.search(r"guess = (\S+), expected a value within \[(\S+), (\S+)\]", message):
        middle = np.sqrt(float(found[2]) * float(found[3]))
        yield "problem.toml", r"guess = 4e6", f"guess = {middle:g}"
    elif found := re.search(r"window_s = .* from (\S+) s to (\S+) s", message):
        yield "problem.toml", r"window_s = \[.*?\]", f"window_s = [{found[1]}, {found[2]}]"
    elif found := re.search(r"write (\w+ = \{\}) to estimate it", message):
        yield "problem.toml", r"\[parameters\]", f"[parameters]\n{found[1]}"
    elif found := re.search(r"(?:wrench: found no|but) (\w+)(?:;| is missing)", message):
        key = found[1]
        yield "problem.toml", r"(?=file = \"swing_wrench)", f"{key} = {KNOWN[key]}, "
    elif csv and (found := re.search(r"column (.+?) names no unit;.*for example (.+)$", message)):
        yield csv[1], rf"\b{re.escape(found[1])}\b", found[2]
    elif found := re.search(r"found \[?-?[\d.]+\]?; expected a number of at least 0", message):
        yield "problem.toml", r"friction = -", "friction = "


BOX = "box_m = [[-1, -1, 0.089], [1, 1, 1]]"
BAR = {
    "key of markers": replace_text("reference_m", "reference_mm"),
    "unit of a key": replace_text("[experiment.markers]", '[experiment.markers]\nunit = "m"'),
    "marker": replace_text("{ low =", "{ lo ="),
    "weight of a marker": replace_text(
        "[experiment.markers]", "[experiment.markers]\nweights = { lo = 1.0 }"
    ),
    "file of markers": replace_text('"swing_markers.csv"', '"swing_marker.csv"'),
    "file of poses": replace_text("swing_motion.csv", "swing_motions.csv"),
    "order of quaternions": replace_text(
        '"swing_motion.csv",', '"swing_motion.csv", quaternion = "xyzv",'
    ),
    "mesh": replace_text('"body.vtu"', '"body.vtk"'),
    "corners of a box": replace_text(BOX, "box_m = [[1, 1, 1], [-1, -1, 0.089]]"),
    "density in g/cm³": replace_text("density_kg_m3 = 30.0", "density_kg_m3 = 0.03"),
    "name of the density": replace_text("density_kg_m3", "density"),
    "parameter": replace_text("mu_pa  ", "mu  "),
    "parameter that is missing": replace_text(
        "gamma_r_s   = { guess = 0.02, lower = 1e-5, upper = 1.0 }\n", ""
    ),
    "guess beyond its bounds": replace_text("guess = 400.0", "guess = 4e6"),
    "material": replace_text("[parameters]", 'material = "neohookean"\n[parameters]'),
    "damping law": replace_text("[parameters]", 'damping = "kelvinvoigt"\n[parameters]'),
    "element": replace_text("[parameters]", 'element = "tet-4"\n[parameters]'),
    "method": replace_text("interior-point", "interior_point"),
    "window beyond the recording": replace_text(
        'nuisance = "none"', 'nuisance = "none"\nwindow_s = [10.0, 20.0]'
    ),
    "nuisance parameters": replace_text('nuisance = "none"', 'nuisance = "non"'),
    "table of experiments": lambda folder: (folder / "problem.toml").write_text(
        (folder / "problem.toml")
        .read_text()
        .replace("[[experiment]]", "[[experimen]]")
        .replace("[experiment.", "[experimen.")
        .replace("[[experiment.", "[[experimen.")
    ),
    "file of a wrench": replace_text("swing_wrench.csv", "swing_wrenches.csv"),
    "noise of a wrench": replace_text(", sigma_n = 0.01", ""),
    "name of the noise of a wrench": replace_text("sigma_n", "sigma_N"),
    "sign of a wrench": replace_text("sigma_n = 0.01", "sigma_n = 0.01, sgn = 1"),
    "frame of a wrench": replace_text("sigma_n = 0.01", 'sigma_n = 0.01, frame = "worlds"'),
    "unit of a wrench": replace_text("fx_n,fy_n,fz_n", "fx,fy,fz", "swing_wrench.csv"),
    "table of an obstacle": replace_text("[[experiment.obstacle]]", "[[experiment.obstacles]]"),
    "shape of an obstacle": replace_text("plane", "plan"),
    "normal of an obstacle": replace_text("normal", "normals"),
    "friction of an obstacle": replace_text("friction = 0.3", "friction = -0.3"),
    "noise of a depth camera": replace_text("sigma_m = 0.001", "sigma = 0.001"),
    "file of a depth camera": replace_text("front.npz", "frontal.npz"),
}
BENCH = {
    "noise of the load": ("sigma_n", "sigman"),
    "kind of the recording": ('"static"', '"statics"'),
    "displacement of the platen": ("displacement =", "displacment ="),
    "face": ('face = "top"', 'faces = "top"'),
    "shape": ("cylinder =", "cylinders ="),
    "file of the bench": ('"run_1.csv"', '"run1.csv"'),
    "column of the load": ("Force (N)", "Force"),
}


def assert_remedies_lead_to(folder: Path, expected: list[object], steps: int = MOST_STEPS) -> None:
    """Follow every remedy of every message; what is read in the end is as expected."""
    message = ""
    try:
        assert state(folder / "problem.toml") == expected
    except cs.InputError as fault:
        message = str(fault)
    if not message:
        return
    assert steps, f"after {MOST_STEPS} remedies: {message}"
    offered = [*remedied(folder, message)]
    assert offered, f"no remedy in: {message}"
    for number, (name, old, new) in enumerate(offered):
        changed = folder.with_name(f"{folder.name}_{number}")
        shutil.copytree(folder, changed)
        text = (changed / name).read_text()
        after = re.sub(old, lambda _, new=new: new, text, count=0 if csv_or_key(old) else 1)
        assert after != text, f"{old} is not in {name}: {message}"
        (changed / name).write_text(after)
        assert_remedies_lead_to(changed, expected, steps - 1)


def csv_or_key(pattern: str) -> bool:
    """Whether a remedy concerns every place of a name, as in the tables of an experiment."""
    return pattern.startswith(r"\b")


@pytest.mark.parametrize("mistake", BAR.values(), ids=BAR)
def test_followed_remedies_lead_to_the_problem_without_the_mistake(made, tmp_path, mistake):
    expected = state(made / "bar" / "problem.toml")
    folder = tmp_path / "bar"
    shutil.copytree(made / "bar", folder)
    mistake(folder)
    with pytest.raises(cs.InputError):
        cs.Problem.read(folder / "problem.toml")
    assert_remedies_lead_to(folder, expected)


@pytest.mark.parametrize(("old", "new"), BENCH.values(), ids=BENCH)
def test_followed_remedies_lead_to_the_bench_without_the_mistake(made, tmp_path, old, new):
    expected = state(made / "bench" / "problem.toml")
    folder = tmp_path / "bench"
    shutil.copytree(made / "bench", folder)
    for file in (folder / "problem.toml", folder / "run_1.csv"):
        file.write_text(file.read_text().replace(old, new))
    with pytest.raises(cs.InputError):
        cs.Problem.read(folder / "problem.toml")
    assert_remedies_lead_to(folder, expected)
