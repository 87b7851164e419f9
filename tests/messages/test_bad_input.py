"""Every mistake in the input gets one message and exit code 2, and no file is written."""

from __future__ import annotations

import tomllib
from pathlib import Path

import meshio
import numpy as np
import pytest
from kit.problem_files import (
    DIVISIONS,
    EXPERIMENT,
    GRASP,
    REFERENCES,
    SIZE_M,
    Edit,
    both,
    contents,
    keep_lines,
    remove,
    replace_cell,
    replace_line,
    replace_text,
    run_command,
    settings,
    write,
)

from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem

POSES, MARKERS = "swing_motion.csv", "swing_markers.csv"
BOX = "{ box_m = [[-1, -1, 0.089], [1, 1, 1]] }"
MU = "mu_pa       = { guess = 200.0, lower = 10.0, upper = 1e5 }"
BODY = box_mesh(SIZE_M, DIVISIONS)


def bad(id: str, *words: str, edit: Edit = lambda folder: None, options: list[str] | None = None):
    """A slip, and the words its message must have."""
    return pytest.param(edit, options or [], words, id=id)


def nodes(text: str) -> Edit:
    return replace_text(BOX, text)


def write_mesh(points, cells: dict, file: str = "body.vtu") -> Edit:
    mesh = meshio.Mesh(points, list(cells.items()))
    return lambda folder: mesh.write(folder / file)


def from_surface(triangles: np.ndarray, edge_length_m: float) -> Edit:
    return both(
        replace_text('mesh = "body.vtu"', f'surface = "a.stl"\nedge_length_m = {edge_length_m}'),
        write_mesh(BODY.points_m, {"triangle": triangles}, "a.stl"),
    )


def flattened_points() -> np.ndarray:
    points = BODY.points_m.copy()
    a, b, c, d = BODY.tetrahedra[5]
    points[d] = points[[a, b, c]].mean(axis=0)
    return points


def points_with_nan() -> np.ndarray:
    points = BODY.points_m.copy()
    points[7, 1] = np.nan
    return points


def raised_markers(folder: Path) -> None:
    head, *rows = (folder / MARKERS).read_text().splitlines()
    table = np.array([row.split(",") for row in rows], dtype=float)
    table[:, 3::3] += 2.0
    np.savetxt(folder / MARKERS, table, delimiter=",", header=head, comments="")


def cut_start(file: str, count: int) -> Edit:
    def edit(folder: Path) -> None:
        head, *rows = (folder / file).read_text().splitlines()
        (folder / file).write_text("\n".join([head, *rows[count:]]))

    return edit


def times_1000(file: str) -> Edit:
    def edit(folder: Path) -> None:
        head, *rows = (folder / file).read_text().splitlines()
        cells = [row.partition(",") for row in rows]
        scaled = [f"{1000 * float(t):g},{rest}" for t, _, rest in cells]
        (folder / file).write_text("\n".join([head, *scaled]))

    return edit


def blank_markers(folder: Path) -> None:
    head, *rows = (folder / MARKERS).read_text().splitlines()
    blank = [row.split(",")[0] + "," * head.count(",") for row in rows]
    (folder / MARKERS).write_text("\n".join([head, *blank]))


def thesis(folder: Path) -> None:
    (folder / "thesis").mkdir()
    (folder / "thesis" / "chapter.tex").write_text("precious")


PROBLEM_FILE = [
    bad("no-file", "problem.toml", "no such file", edit=remove("problem.toml")),
    bad("binary", "problem.toml", "not a text", edit=write("problem.toml", b"\xff\xfe\x00\x01")),
    bad("empty", "object", "missing", "2 more mistakes", edit=write("problem.toml", "")),
    bad(
        "syntax", "problem.toml: line 20", "closing quote", 'name = "swing',
        edit=replace_text('name = "swing"', 'name = "swing'),
    ),
    bad(
        "key-twice", "line 6", "twice", "density_kg_m3 = 31",
        edit=replace_text("= 30.0", "= 30.0\ndensity_kg_m3 = 31"),
    ),
    bad(
        "unknown-key", "object.densty_kg_m3", "unknown key", "did you mean 'density_kg_m3'?",
        edit=replace_text("density", "densty"),
    ),
    bad(
        "unknown-table", "objekt: unknown key", "did you mean 'object'?",
        edit=replace_text("[object]", "[objekt]"),
    ),
    bad(
        "unknown-key-in-an-experiment", "experiment 'swing'", "grasp.pose:", "mean 'poses'?",
        edit=replace_text('poses = "', 'pose = "'),
    ),
    bad(
        "missing-key", "parameters: gamma_m_1_s is missing", "damping",
        edit=replace_text("gamma_m_1_s = { guess = 0.5, lower = 1e-3, upper = 100.0 }", ""),
    ),
    bad(
        "missing-nodes", "grasp.nodes", "missing", "box_m, ball_m, face or indices",
        edit=replace_text(f"nodes = {BOX}, ", ""),
    ),
    bad(
        "text-for-a-number", "object.density_kg_m3", "found '30 kg'", "expected a number",
        edit=replace_text("= 30.0", '= "30 kg"'),
    ),
    bad(
        "truth-for-a-number", "density_kg_m3", "found true", "expected a number",
        edit=replace_text("= 30.0", "= true"),
    ),
    bad(
        "number-for-truth", "experiment 'swing': validation", "found 1", "true or false",
        edit=replace_text('name = "swing"', 'name = "swing"\nvalidation = 1'),
    ),
    bad(
        "number-for-a-table", "parameters.mu_pa.prior", "found 0.2", "table", "mean, relative",
        options=settings("parameters.mu_pa.prior=0.2"),
    ),
    bad(
        "text-for-a-parameter", "parameters.mu_pa", "found 'soft'", "expected a number",
        edit=replace_text(MU, 'mu_pa = "soft"'),
    ),
    bad(
        "unknown-parameter", "parameters.mu_p: the model has no such parameter", "young_pa, poisson",
        "did you mean 'mu_pa'?",
        edit=replace_text("mu_pa  ", "mu_p"),
    ),
    bad(
        "unknown-key-of-a-parameter", "parameters.mu_pa.gues", "unknown key", "mean 'guess'?",
        edit=replace_text(MU, "mu_pa = { gues = 200.0, lower = 10.0 }"),
    ),
    bad(
        "unknown-key-alone-in-a-parameter", "parameters.young_pa.gues: unknown key",
        "expected one of guess, lower", "did you mean 'guess'?",
        options=settings("parameters.young_pa.gues=3"),
    ),
    bad(
        "table-for-a-list", "experiment: found", "[[experiment]]",
        edit=replace_text("[[experiment]]", "[experiment]"),
    ),
    bad(
        "several-slips", "object.fo", "unknown key", "and 2 more mistakes",
        options=settings("object.density_kg_m3=-1", "transcription.scheme=x", "object.fo=3"),
    ),
    bad(
        "no-experiment", "experiment", "missing", "[[experiment]]",
        edit=replace_text(EXPERIMENT, ""),
    ),
    bad(
        "experiments-of-one-name", "two experiments", "'swing'", "differ",
        edit=replace_text(EXPERIMENT, EXPERIMENT + EXPERIMENT),
    ),
    bad(
        "name-that-no-file-can-have", "name: found 'up/down'", "file name",
        edit=replace_text('name = "swing"', 'name = "up/down"'),
    ),
    bad(
        "nothing-to-fit", "every experiment", "validation", "at least one",
        options=settings("experiment.0.validation=true"),
    ),
]  # fmt: skip

OBJECT = [
    bad(
        "negative-mass", "object.mass_kg", "found -0.1", "above 0",
        edit=replace_text("density_kg_m3 = 30.0", "mass_kg = -0.1"),
    ),
    bad(
        "mass-not-finite", "object.mass_kg", "found inf", "finite",
        edit=replace_text("density_kg_m3 = 30.0", "mass_kg = inf"),
    ),
    bad(
        "mass-and-density", "found mass_kg and density_kg_m3", "exactly one",
        options=settings("object.mass_kg=0.1"),
    ),
    bad(
        "neither-mass-nor-density", "no mass_kg or density_kg_m3", "exactly one",
        edit=replace_text("density_kg_m3 = 30.0", ""),
    ),
    bad(
        "unknown-material", "object.material", "'neohookean'", "did you mean 'neo-hookean'?",
        "'linear'", options=settings("object.material=neohookean"),
    ),
    bad(
        "unknown-element", "object.element", "found 'hex8'", "'tet4'",
        options=settings("object.element=hex8"),
    ),
    bad(
        "mesh-missing",
        "object.mesh",
        "body.vtu does not exist",
        "relative to the folder of the problem file",
        edit=remove("body.vtu"),
    ),
    bad("mesh-is-a-folder", "object.mesh", "is a folder", options=settings("object.mesh=.")),
    bad("mesh-far-away", "body.vtu", "1e+60 m away",
        edit=write_mesh(BODY.points_m * 1e60 / 0.09, {"tetra": BODY.tetrahedra})),
    bad("mesh-garbage", "body.vtu", "cannot be read", ".msh", edit=write("body.vtu", "hello")),
    bad(
        "mesh-of-unknown-kind", "body.abc", "cannot be read", ".vtk",
        edit=write("body.abc", "hello"), options=settings("object.mesh=body.abc"),
    ),
    bad(
        "mesh-without-tetrahedra", "body.vtu", "no tetrahedra", "triangle", "surface",
        edit=write_mesh(BODY.points_m, {"triangle": BODY.surface}),
    ),
    bad(
        "mesh-with-a-flat-element", "body.vtu", "element 5", "degenerate", "mesh the body again",
        edit=write_mesh(flattened_points(), {"tetra": BODY.tetrahedra}),
    ),
    bad(
        "mesh-with-nan", "body.vtu", "node 7", "finite",
        edit=write_mesh(points_with_nan(), {"tetra": BODY.tetrahedra}),
    ),
    bad(
        "mesh-with-an-element-twice", "body.vtu", "element 72", "same nodes", "duplicates",
        edit=write_mesh(BODY.points_m, {"tetra": BODY.tetrahedra[[*range(72), 3]]}),
    ),
    bad(
        "mesh-and-surface", "found mesh and surface", "exactly one",
        options=settings("object.surface=a.stl", "object.edge_length_m=0.02"),
    ),
    bad(
        "surface-without-edge-length", "object", "edge_length_m is missing",
        edit=replace_text('mesh = "body.vtu"', 'surface = "a.stl"'),
    ),
    bad(
        "surface-missing", "object.surface", "a.stl does not exist",
        edit=replace_text('mesh = "body.vtu"', 'surface = "a.stl"\nedge_length_m = 0.02'),
    ),
    bad(
        "surface-open", "a.stl", "not closed", "open edges", "holes",
        edit=from_surface(BODY.surface[1:], 0.02),
    ),
    bad(
        "surface-coarser-than-the-body", "a.stl", "edge length 2 m", "length unit",
        edit=from_surface(BODY.surface, 2.0),
    ),
    bad(
        "surface-garbage", "a.stl", "cannot be read",
        edit=both(from_surface(BODY.surface, 0.02), write("a.stl", "solid nonsense\nfacet\n")),
    ),
]  # fmt: skip

PARAMETERS = [
    bad(
        "guess-out-of-bounds", "parameters.mu_pa", "guess = 1,", "[10, 100000]",
        options=settings("parameters.mu_pa.guess=1"),
    ),
    bad(
        "lower-above-upper", "parameters.mu_pa", "lower = 100000", "lower < upper",
        options=settings("parameters.mu_pa.lower=1e5"),
    ),
    bad(
        "guess-not-positive", "parameters.gamma_m_1_s", "guess = 0", "[0.001, 100]",
        options=settings("parameters.gamma_m_1_s.guess=0"),
    ),
    bad(
        "incompressible", "parameters.poisson", "upper = 0.5", "less than 0.5",
        edit=both(
            replace_text("lambda_pa  ", "young_pa"),
            replace_text(MU, "poisson = { guess = 0.3, lower = 0.1, upper = 0.5 }"),
        ),
    ),
    bad(
        "mixed-elastic-pair", "mu_pa, young_pa", "expects lambda_pa and mu_pa, or young_pa",
        edit=replace_text("lambda_pa  ", "young_pa"),
    ),
    bad(
        "guess-and-fixed", "parameters.mu_pa", "found guess and fixed", "one of them, or none",
        options=settings("parameters.mu_pa.fixed=300"),
    ),
    bad(
        "bounds-of-a-fixed-value", "parameters.mu_pa", "fixed together with lower", "fixed alone",
        edit=replace_text(MU, "mu_pa = { fixed = 300.0, lower = 10.0 }"),
    ),
    bad(
        "no-stiffness", "parameters.mu_pa", "fixed = 0", "above 0",
        edit=replace_text(MU, "mu_pa = { fixed = 0 }"),
    ),
]  # fmt: skip

GRASPS = [
    bad(
        "box-around-nothing", "experiment 'swing': grasp.nodes", "none of the 36 nodes",
        "z from 0 to 0.09 m", edit=nodes("{ box_m = [[-1, -1, 0.89], [1, 1, 1]] }"),
    ),
    bad(
        "box-with-swapped-corners", "grasp.nodes", "x = 1 m, above -1 m", "lowest",
        edit=nodes("{ box_m = [[1, -1, 0.089], [-1, 1, 1]] }"),
    ),
    bad(
        "box-with-one-corner", "grasp.nodes.box_m", "found [-1, -1, 0.089]",
        "[[x, y, z], [x, y, z]]", edit=nodes("{ box_m = [-1, -1, 0.089] }"),
    ),
    bad("unknown-point-array", "grasp.nodes", '"topp"', 'it has "top"', edit=nodes('"topp"')),
    bad("unknown-node", "node 99", "0 to 35", edit=nodes("{ indices = [0, 1, 99] }")),
    bad(
        "two-kinds-of-selection", "grasp.nodes", "found indices and name", "exactly one",
        edit=nodes('{ indices = [3], name = "top" }'),
    ),
    bad(
        "overlapping-grasps", "node 3", "grasps 1 and 2", "one grasp",
        edit=replace_text(GRASP, f"[{GRASP}, {{ nodes = {{ indices = [3] }} }}]"),
    ),
    bad(
        "nothing-in-the-second-grasp", "experiment 'swing': grasp.1.nodes", "none of the 36",
        edit=replace_text(
            GRASP, f"[{GRASP}, {{ nodes = {{ ball_m = [[0, 0, 1], 0.1] }} }}]"
        ),
    ),
    bad(
        "everything-held", "experiment 'swing': grasp", "all 36", "nothing can move",
        edit=nodes("{ box_m = [[-1, -1, -1], [1, 1, 1]] }"),
    ),
    bad(
        "equilibrium-without-grasp", "start = 'equilibrium'", "at least 3", "'undeformed'",
        edit=replace_text(f"grasp = {GRASP}", ""),
    ),
    bad(
        "equilibrium-on-a-hinge", "it can rotate about x", "at least 3 nodes", "one line",
        edit=nodes("{ box_m = [[-1, -1, 0.089], [1, 0.001, 1]] }"),
    ),
]  # fmt: skip

POSE_FILES = [
    bad("poses-missing", "grasp.poses", f"{POSES} does not exist", edit=remove(POSES)),
    bad("poses-empty", POSES, "empty", "column names", edit=write(POSES, "")),
    bad("poses-binary", POSES, "not a CSV text file", edit=write(POSES, b"\xff\xfe\x00\x01")),
    bad("poses-without-rows", POSES, "no rows", edit=keep_lines(POSES, 1)),
    bad(
        "unknown-pose-column", f"{POSES}: line 1", "x_mm", "expected t_s, x_m",
        edit=replace_text("x_m", "x_mm", POSES),
    ),
    bad(
        "ragged-row", f"{POSES}: line 4", "9 cells", "expected 8",
        edit=replace_line(POSES, 4, lambda row: row + ",1"),
    ),
    bad(
        "word-in-a-cell", f"{POSES}: line 4", "column y_m", "'abc'", "number",
        edit=replace_cell(POSES, 4, 2, "abc"),
    ),
    bad(
        "blank-pose", f"{POSES}: line 4", "column y_m", "number",
        edit=replace_cell(POSES, 4, 2, ""),
    ),
    bad(
        "quaternion-not-unit", f"{POSES}: line 5", "t_s = 0.03", "norm 0.5", "x, y, z, w",
        edit=replace_cell(POSES, 5, 7, "0.5"),
    ),
    bad(
        "one-pose-of-a-motion", f"{POSES}: found only one pose", "0 s to 0.08 s", "the same pose at",
        edit=keep_lines(POSES, 2),
    ),
    bad(
        "poses-over-half-the-recording", f"{POSES}: the poses run from 0 s to 0.03 s",
        "the recording lasts from 0 s to 0.08 s", "add rows", "window_s = [0, 0.03]",
        edit=keep_lines(POSES, 5),
    ),
    bad(
        "noise-in-millimetres", "markers.sigma_m", "0.5 m", "0.5 mm are 0.0005",
        options=["--set", "experiment.swing.markers.sigma_m=0.5"],
    ),
    bad(
        "bound-of-no-material", "parameters.mu_pa", "lower = 0.0001 Pa", "from 0.001 to 1e+13",
        options=["--set", "parameters.mu_pa.lower=1e-4"],
    ),
    bad(
        "poses-that-begin-late", f"{POSES}: the poses run from 0.03 s", "window_s = [0.03, 0.08]",
        edit=cut_start(POSES, 3),
    ),
    bad(
        "poses-in-milliseconds", f"{POSES}: the poses move and are 10 s apart", "milliseconds",
        edit=times_1000(POSES),
    ),
    bad(
        "a-recording-in-milliseconds", f"{POSES}: the poses move and are 10 s apart",
        edit=both(times_1000(POSES), times_1000(MARKERS)),
    ),
    bad(
        "time-runs-backwards", f"{POSES}: line 5", "0.01 follows 0.02", "increase",
        edit=replace_cell(POSES, 5, 0, "0.01"),
    ),
]  # fmt: skip

MARKER_FILES = [
    bad(
        "markers-missing", "markers.file", f"{MARKERS} does not exist", edit=remove(MARKERS)
    ),
    bad(
        "markers-not-named", "markers.file", "missing",
        edit=replace_text(f'file = "{MARKERS}"', ""),
    ),
    bad(
        "marker-without-an-axis", f"{MARKERS}: line 1", "unknown low_q", "missing low_y",
        edit=replace_text("low_y", "low_q", MARKERS),
    ),
    bad(
        "underscore-in-a-marker", f"{MARKERS}: line 4", "column low_y", "'1_000'",
        edit=replace_cell(MARKERS, 4, 2, "1_000"),
    ),
    bad(
        "word-in-a-marker", f"{MARKERS}: line 4", "column low_y", "'abc'", "blank",
        edit=replace_cell(MARKERS, 4, 2, "abc"),
    ),
    bad(
        "marker-time-stands-still", f"{MARKERS}: line 4", "0.01 follows 0.01", "increase",
        edit=replace_cell(MARKERS, 4, 0, "0.01"),
    ),
    bad(
        "lost-frames", "experiment 'swing'", MARKERS, "jumps by 0.05 s", "30% of them lost",
        "resample_hz = 100",
        edit=lambda folder: (folder / MARKERS).write_text(
            "".join(
                line
                for k, line in enumerate((folder / MARKERS).read_text().splitlines(True))
                if k not in range(4, 8)
            )
        ),
    ),
    bad("nothing-seen", "there is no marker sample", "window_s", edit=blank_markers),
    bad(
        "poses-end-at-once", POSES, MARKERS, "0 s to 0.01 s", "0 s to 0.08 s", "share 2", "clock",
        edit=keep_lines(POSES, 3),
    ),
    bad(
        "gripper-to-body-without-poses", "grasp", "found gripper_to_body without poses",
        edit=replace_text(
            'poses = "swing_motion.csv"', "gripper_to_body = { position_m = [0, 0, 0.1] }"
        ),
    ),
    bad(
        "gripper-to-body-with-markers", "found gripper_to_body and markers", "undeformed body",
        edit=replace_text(
            'poses = "swing_motion.csv"',
            "gripper_to_body = {}, markers = { a = [0, 0, 0], b = [1, 0, 0], c = [0, 1, 0] }",
        ),
    ),
    bad(
        "gripper-to-body-not-unit", "gripper_to_body", "norm 1.41421", "order x, y, z, w",
        options=settings("experiment.0.grasp.gripper_to_body={ quaternion_xyzw = [1, 0, 0, 1] }"),
    ),
    bad(
        "window-outside", "window_s = [5, 6]", "0 s to 0.08 s",
        options=settings("experiment.0.window_s=[5, 6]"),
    ),
    bad(
        "window-backwards", "found window_s = [0.06, 0.01]", "start < end",
        options=settings("experiment.0.window_s=[0.06, 0.01]"),
    ),
    bad(
        "window-too-short", "2 sample times", "at least 3", "window_s",
        options=settings("experiment.0.window_s=[0, 0.01]"),
    ),
    bad(
        "unknown-unit", "markers.length_unit", "found 'km'", "'mm'",
        options=settings("experiment.0.markers.length_unit=km"),
    ),
    bad(
        "wrong-unit", "markers span 8.99e-05 m", "body 0.124 m", "length_unit",
        options=settings("experiment.0.markers.length_unit=mm"),
    ),
    bad(
        "other-frame", "marker 'side'", "measured at (0.", "2 m away from", "undeformed to current",
        edit=raised_markers,
    ),
    bad(
        "marker-far-away", "marker 'low'", "(0, 0, -1) m", "1 m away", "max_distance_m",
        options=settings("experiment.0.markers.reference_m.low=[0, 0, -1]"),
    ),
    bad(
        "unknown-reference", "markers.reference_m", "'lwo'", "did you mean 'low'?",
        options=settings("experiment.0.markers.reference_m.lwo=[0, 0, 0]"),
    ),
    bad(
        "reference-in-the-plane", "markers.reference_m.low", "found [0, 0]", "[x, y, z]",
        options=settings("experiment.0.markers.reference_m.low=[0, 0]"),
    ),
    bad(
        "unknown-marker", MARKERS, "no marker 'sid'", "did you mean 'side'?",
        options=settings('experiment.0.markers.names=["sid"]'),
    ),
    bad(
        "never-seen-and-no-reference", "marker 'low'", "reference_m",
        edit=both(
            replace_text(REFERENCES, "{ mid = [0.03, 0.02, 0.03] }"),
            *(replace_cell(MARKERS, line, 1, "") for line in range(2, 11)),
        ),
    ),
    bad(
        "sigma-zero", "experiment 'swing': markers.sigma_m", "found 0", "above 0",
        options=settings("experiment.0.markers.sigma_m=0"),
    ),
    bad(
        "sigma-of-one-marker-zero", "markers.sigma_m.mid", "found 0.0", "above 0",
        options=settings("experiment.0.markers.sigma_m={ low = 1e-3, mid = 0.0, side = 1e-3 }"),
    ),
    bad(
        "sigma-of-one-marker-missing", "markers.sigma_m", "no value for the marker 'mid'",
        options=settings("experiment.0.markers.sigma_m={ low = 1e-3, side = 1e-3 }"),
    ),
    bad(
        "gravity-in-the-plane", "gravity_m_s2", "found [0, -9.81]", "[x, y, z]",
        options=settings("experiment.0.gravity_m_s2=[0, -9.81]"),
    ),
]  # fmt: skip

SOLVING = [
    bad(
        "unknown-scheme", "transcription.scheme", "found 'midpont'", "did you mean 'midpoint'?",
        options=settings("transcription.scheme=midpont"),
    ),
    bad(
        "half-a-substep", "transcription.substeps", "found 1.5", "whole number",
        options=settings("transcription.substeps=1.5"),
    ),
    bad(
        "no-substep", "transcription.substeps", "found 0", "at least 1",
        options=settings("transcription.substeps=0"),
    ),
    bad(
        "start-rule-of-another-scheme", "'paper'", "'midpoint'", "'backward-euler'",
        options=settings("experiment.0.start_rule=paper"),
    ),
    bad(
        "unknown-method", "solver.method", "found 'interor-point'", "mean 'interior-point'?",
        options=settings("solver.method=interor-point"),
    ),
    bad(
        "unknown-method-as-option", "--method", "found 'newton'", "interior-point",
        options=["--method", "newton"],
    ),
    bad(
        "unknown-option", "solver.interior-point", "no option 'tol'", "did you mean 'tolerance'?",
        options=settings("solver.interior-point.tol=1e-6"),
    ),
    bad(
        "unknown-ipopt-option", "problem.toml: solver", "mu_strateg",
        options=settings("solver.interior-point.ipopt.mu_strateg=adaptive"),
    ),
    bad(
        "unknown-ipopt-setting", "problem.toml: solver", "mu_strategy", '"foo"',
        options=settings("solver.interior-point.ipopt.mu_strategy=foo"),
    ),
    bad(
        "truth-for-an-ipopt-switch", "ipopt.expect_infeasible", "found true", '"yes"',
        options=settings("solver.interior-point.ipopt.expect_infeasible=true"),
    ),
    bad(
        "unknown-linear-solver", "problem.toml: solver", "linear_solver", '"fast"',
        options=settings("solver.interior-point.linear_solver=fast"),
    ),
    bad(
        "linear-solver-not-installed", "problem.toml: solver", "ma57", "not installed", "mumps",
        options=settings("solver.interior-point.linear_solver=ma57"),
    ),
]  # fmt: skip

OPTIONS = [
    bad("set-without-value", "--set", "found 'mu'", "key=value", options=settings("mu")),
    bad("set-without-key", "--set", "found '=3'", "key=value", options=settings("=3")),
    bad(
        "set-in-a-plain-value", "--set", "title.a", "'A tiny foam bar'", "table",
        options=settings("title.a=3"),
    ),
    bad(
        "set-in-an-item-that-is-not-there", "--set", "found '4'", "0 to 0, or its name swing",
        options=settings("experiment.4.start=undeformed"),
    ),
    bad(
        "set-to-half-a-list", "--set", "found [0, 0", "experiment.0.gravity_m_s2", "TOML",
        options=settings("experiment.0.gravity_m_s2=[0, 0"),
    ),
    bad(
        "set-to-a-word", "parameters.mu_pa.guess", "found 'soft'", "number",
        options=settings("parameters.mu_pa.guess=soft"),
    ),
    bad(
        "folder-of-something-else", "thesis", "not an earlier run", "another folder",
        edit=thesis, options=["--out", "thesis"],
    ),
    bad("endless-substeps", "transcription.substeps", "10000",
        options=settings("transcription.substeps=1000000000")),
    bad("endless-roll-out", "experiment 'swing'", "found a time step of 1e-90 s", "at most 10000",
        options=settings("rollout.timestep_s=1e-90")),
    bad("name-with-nul", "name", "expected a valid file name",
        options=settings('experiment.swing.name="a\\u0000b"')),
    bad("output-is-a-file", POSES, "is a file", "folder", options=["--out", POSES]),
    bad("output-in-a-file", POSES, "is a file", "folder", options=["--out", f"{POSES}/run"]),
]  # fmt: skip

ALL = [
    *PROBLEM_FILE, *OBJECT, *PARAMETERS, *GRASPS, *POSE_FILES, *MARKER_FILES, *SOLVING, *OPTIONS
]  # fmt: skip


JARGON = ("Traceback", "Input should", "pydantic", "errno", "tuple", "dict", "None")


def assert_refused(tiny: Path, words: tuple[str, ...], *command: str) -> None:
    before = contents(tiny)
    outcome = run_command(*command)
    assert outcome.code == 2, outcome
    assert outcome.out == ""
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1, outcome.err
    for word in words:
        assert word in outcome.err
    assert not [jargon for jargon in JARGON if jargon in outcome.err]
    assert contents(tiny) == before


@pytest.mark.parametrize(("edit", "options", "words"), ALL)
def test_a_slip_is_explained_and_nothing_is_written(tiny, edit, options, words):
    edit(tiny)
    out = [] if "--out" in options else ["--out", "run"]
    assert_refused(tiny, words, "solve", "problem.toml", *out, *options)


@pytest.mark.parametrize(
    ("words", "command"),
    [
        pytest.param(words, command.split(), id=command)
        for command, *words in [
            ("check nowhere.toml", "nowhere.toml", "no such file"),
            ("check .", "is a folder"),
            ("check problem.toml --set object.mass_kg=1", "exactly one"),
            ("simulate problem.toml --out swing_motion.csv", "swing_motion.csv", "is a file"),
            ("simulate problem.toml --out .", "swing_markers.csv", "reads this file"),
            ("simulate problem.toml --out s --integrator rk4", "--integrator", "'rk4'", "newmark"),
            ("simulate problem.toml --out s --timestep-s 0", "--timestep-s", "found 0", "above 0"),
            (
                "simulate problem.toml --out s --timestep-s 1e-60",
                "found a time step of",
                "at most 10000",
            ),
            (
                "simulate problem.toml --out s --noise-m=-1",
                "--noise-m",
                "found -1",
                "of at least 0",
            ),
            ("simulate problem.toml --out s --seed=-1", "--seed", "found -1", "of at least 0"),
            ("plot nowhere", "nowhere", "not a run folder", "result.json"),
            ("plot .", "not a run folder", "result.json"),
            ("new .", "problem.toml", "exists already"),
            ("new problem.toml/mine", "problem.toml", "is a file"),
        ]
    ],
)
def test_other_commands_refuse_alike(tiny, words, command):
    assert_refused(tiny, tuple(words), *command)


def test_simulation_without_a_marker_file_needs_places(tiny):
    both(remove(MARKERS), replace_text("mid = [0.03, 0.02, 0.03], ", ""))(tiny)
    names = settings('experiment.swing.markers.names=["low", "mid"]')
    words = (MARKERS, "no position of mid", "markers.reference_m")
    assert_refused(tiny, words, "simulate", "problem.toml", "--out", "s", *names)


def test_a_damaged_run_cannot_be_drawn(tiny):
    (tiny / "result.json").write_text('{"history": [')
    np.savez(tiny / "trajectory.npz", t_s=np.zeros(3))
    assert_refused(tiny, ("damaged", "run the command that wrote it again"), "plot", ".")
    (tiny / "result.json").write_text('{"schema": 6}')
    assert_refused(tiny, ("damaged", "solve the problem again"), "plot", ".")


@pytest.mark.parametrize("command", ["solve", "solve problem.toml --colour red", "identify", ""])
def test_a_command_that_is_none_shows_how_to_ask(tiny, command):
    before = contents(tiny)
    outcome = run_command(*command.split())
    assert outcome.code == 2
    assert "Usage: collocation-sysid" in outcome.out + outcome.err
    assert contents(tiny) == before


@pytest.mark.parametrize(
    ("word", "hint"),
    [("slove", "; did you mean 'solve'?"), ("repot", "; did you mean 'report'?"), ("xyzzy", ".")],
)
def test_an_unknown_command_is_refused_with_the_likely_one(word, hint):
    outcome = run_command(word, "problem.toml")
    assert outcome.code == 2
    assert f"No such command {word!r}{hint}\n" in outcome.err


@pytest.mark.parametrize("command", ["report", "plot", "export", "animate", "refine"])
def test_the_result_in_place_of_its_run_folder_leads_to_the_folder(tiny, command):
    (tiny / "run").mkdir()
    (tiny / "run" / "result.json").write_text("{}")
    words = ("run/result.json: this is a file; expected a run folder, likely run",)
    options = ("--to", "json") if command == "export" else ()
    assert_refused(tiny, words, command, "run/result.json", *options)


def test_another_file_in_place_of_a_run_folder_is_refused(tiny):
    words = ("problem.toml: this is a file; expected a run folder",)
    assert_refused(tiny, words, "report", "problem.toml")


def test_a_missing_file_leads_to_the_instructions_in_its_folder(tiny):
    both(remove(MARKERS), write("README.md", "Ask the laboratory."))(tiny)
    assert_refused(tiny, ("README.md", "how to get it"), "check", "problem.toml")


def keys_in(content: object, above: str = "") -> list[str]:
    items = content.items() if isinstance(content, dict) else ()
    items = enumerate(content) if isinstance(content, list) else items
    inside = [(f"{above}.{key}".lstrip("."), value) for key, value in items]
    return [key for name, value in inside for key in (name, *keys_in(value, name))]


@pytest.mark.parametrize("value", ["1979-05-27", "true", "{ a = 1 }", '[["x"]]'])
def test_every_key_refuses_invalid_values(tiny_problem, value):
    file = tiny_problem / "problem.toml"
    keys = keys_in(tomllib.loads(file.read_text()))
    assert len(keys) > 40
    for key in keys:
        with pytest.raises(InputError) as caught:
            Problem.read(file, [f"{key}={value}"])
        assert str(caught.value).startswith(f"{file}: ")
        assert not [word for word in JARGON if word in str(caught.value)], caught.value
