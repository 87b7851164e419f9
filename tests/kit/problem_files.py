"""A small problem on disk, edits of it, and the command line run in this process."""

from __future__ import annotations

import contextlib
import io
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from collocation_sysid import cli
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.recording import write_poses_csv
from collocation_sysid.result import run_record
from collocation_sysid.result.synthesis import Recipe, write_data
from kit.problems import smooth_poses, times

SIZE_M, DIVISIONS = (0.06, 0.06, 0.09), (2, 2, 3)
TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
AT_TRUTH = [f"parameters.{name}.guess={value}" for name, value in TRUTH.items()]

PROBLEM = """\
title = "A tiny foam bar"

[object]
mesh = "body.vtu"
density_kg_m3 = 30.0

[parameters]
lambda_pa   = { guess = 400.0, lower = 10.0, upper = 1e5 }
mu_pa       = { guess = 200.0, lower = 10.0, upper = 1e5 }
gamma_r_s   = { guess = 0.02, lower = 1e-5, upper = 1.0 }
gamma_m_1_s = { guess = 0.5, lower = 1e-3, upper = 100.0 }

[solver]
method = "interior-point"

[rollout]
integrator = "scheme"
"""
GRASP = '{ nodes = { box_m = [[-1, -1, 0.089], [1, 1, 1]] }, poses = "swing_motion.csv" }'
REFERENCES = "{ low = [0.0, 0.0, 0.0], mid = [0.03, 0.02, 0.03], side = [0.06, 0.06, 0.03] }"
EXPERIMENT = f"""
[[experiment]]
name = "swing"
nuisance = "none"
grasp = {GRASP}

[experiment.markers]
file = "swing_markers.csv"
reference_m = {REFERENCES}
"""

Edit = Callable[[Path], object]
write_pictures = run_record.write_pictures  # before the session's fixture leaves them out


# Writing ------------------------------------------------------------------------------------------


def write_problem(folder: Path, steps: dict[str, int], validation: str = "") -> Path:
    """A problem with exact data of the midpoint scheme: a motion of its own per experiment."""
    mesh = box_mesh(SIZE_M, DIVISIONS)
    top = mesh.points_m[:, 2] > SIZE_M[2] - 1e-6
    TetMesh(mesh.points_m, mesh.tetrahedra, {"top": top}).write(folder / "body.vtu")
    text = PROBLEM
    for k, (name, count) in enumerate(steps.items()):
        poses = smooth_poses(times(count), turn_rad=np.roll((0.2, -0.15, 0.3), k))
        write_poses_csv(folder / f"{name}_motion.csv", poses)
        added = EXPERIMENT.replace("swing", name)
        text += added.replace("grasp", "validation = true\ngrasp") if name == validation else added
    file = folder / "problem.toml"
    file.write_text(text)
    exact = Problem.read(file, [*AT_TRUTH, "transcription.substeps=1"], simulation=True)
    write_data(exact, folder, Recipe("midpoint"))
    return file


def state_vacuum(file: Path) -> Path:
    """State in a problem file that it has no air, for processes that have the usual default."""
    vacuum = '\n[environment]\nair_density_kg_m3 = "none"\n'
    file.write_text(file.read_text() + vacuum)
    return file


# Editing: each returns an edit of a problem's folder ----------------------------------------------


def replace_text(old: str, new: str, file: str = "problem.toml") -> Edit:
    def edit(folder: Path) -> None:
        text = (folder / file).read_text()
        assert text.count(old) == 1, f"{old!r} is there {text.count(old)} times"
        (folder / file).write_text(text.replace(old, new))

    return edit


def replace_line(file: str, number: int, change: Callable[[str], str]) -> Edit:
    def edit(folder: Path) -> None:
        lines = (folder / file).read_text().splitlines()
        lines[number - 1] = change(lines[number - 1])
        (folder / file).write_text("\n".join(lines) + "\n")

    return edit


def replace_cell(file: str, line: int, column: int, value: str) -> Edit:
    def change(row: str) -> str:
        cells = row.split(",")
        cells[column] = value
        return ",".join(cells)

    return replace_line(file, line, change)


def keep_lines(file: str, last: int) -> Edit:
    def edit(folder: Path) -> None:
        lines = (folder / file).read_text().splitlines()
        (folder / file).write_text("\n".join(lines[:last]) + "\n")

    return edit


def write(file: str, content: str | bytes) -> Edit:
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / file).write_bytes(data)


def remove(file: str) -> Edit:
    return lambda folder: (folder / file).unlink()


def both(*edits: Edit) -> Edit:
    return lambda folder: [edit(folder) for edit in edits]


def settings(*pairs: str) -> list[str]:
    """``--set`` for each of "key=value"."""
    return [word for pair in pairs for word in ("--set", pair)]


# Running ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    code: object
    out: str
    err: str


@contextlib.contextmanager
def handlers_of_signals_kept() -> Iterator[None]:
    """Set the handlers of this process again after the block."""
    hook = sys.unraisablehook
    handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in handlers.items():
            signal.signal(number, handler)


def run_command(*arguments: object) -> Outcome:
    """Run the command line in this process, as in a shell without a terminal."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["collocation-sysid", *map(str, arguments)])
        for variable in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
            patch.delenv(variable, raising=False)
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            handlers_of_signals_kept(),
            pytest.raises(SystemExit) as ended,
        ):
            cli.main()
    return Outcome(ended.value.code or 0, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def pictures_drawn() -> Iterator[None]:
    """Runs that are written in this block have their pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_record, "write_pictures", write_pictures)
        yield


def contents(folder: Path) -> dict[str, bytes | None]:
    """Every file below a folder, and what is in it."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }
