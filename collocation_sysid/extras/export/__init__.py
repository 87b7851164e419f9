"""Export of the identified body to other simulators.

`write_export` writes the files of a target in `TARGETS`, `verify_export` runs the target and
compares its prediction with that of this package. One module per simulator: `mujoco`, `newton`,
`usd`, `calculix`, `abaqus` and `febio`. For all of them, `identified` reads the body from a run
folder, `destination` finds format and place of the option --to, `target` describes
what a simulator can express, and `obstacle_shapes` converts obstacles. `rerun_recording` writes the
motion of a run for a viewer instead.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from ...common.array_types import Array
from ...common.display import Table
from ...common.serialisation import as_json
from ...errors import InputError, hint_at
from ...recording import write_poses_csv
from ...result.run_writers import replaced_folder
from ...runs.solved_problem import SolvedProblem
from . import abaqus, calculix, febio, mujoco, newton, rerun_recording, usd
from .destination import ExportDestination, parse_destination
from .identified import IdentifiedBody, read_draws
from .target import ExportedFiles, ExportTarget, PredictionComparison, values_as_text

IDENTIFIED_FILE = "identified.json"
SAMPLES_FILE = "samples.csv"


TARGETS: dict[str, ExportTarget] = {
    "mujoco": ExportTarget("MuJoCo", mujoco.MODEL, export=mujoco.export, verify=mujoco.verify),
    "newton": ExportTarget("Newton", newton.MODULE_FILE, export=newton.export),
    "usd": ExportTarget("OpenUSD", usd.STAGE_FILE, export=usd.export, verify=usd.verify),
    "calculix": ExportTarget(
        "CalculiX", calculix.DECK, export=calculix.export, verify=calculix.verify
    ),
    "abaqus": ExportTarget("Abaqus", abaqus.CARD, export=abaqus.export),
    "febio": ExportTarget("FEBio", febio.MODEL, export=febio.export),
    "json": ExportTarget("JSON", IDENTIFIED_FILE, export=lambda body: ExportedFiles({}, ())),
}
# Main file of each format: the targets, and the recording for a viewer.
MAIN_FILES = {
    **{name: target.main_file for name, target in TARGETS.items()},
    rerun_recording.TARGET: rerun_recording.RECORDING_FILE,
}


def write_export(body: IdentifiedBody, target_name: str, folder: str | Path) -> ExportedFiles:
    """Write a body for a target: its files, ``identified.json`` with all numbers and what the
    target cannot express, and ``poses_1.csv``, … with the poses of its grasps, followed by those of
    its obstacles.

    Parameters
    ----------
    target_name : str
        Name of a target in `TARGETS`, such as "mujoco".
    folder : str or Path
        Written completely or not at all; an earlier export there is replaced.

    Returns
    -------
    ExportedFiles
        The target's files (their text by name), and what the target cannot express.

    Raises
    ------
    InputError
        For an unknown target, a body that the target cannot express, a package that the target
        needs and that is not installed, or a folder with other files.
    """
    exported = target_named(target_name).export(body)
    with replaced_folder(folder, marker_file=IDENTIFIED_FILE, content_word="export") as place:
        for name, text in exported.files.items():
            (place / name).write_text(text, encoding="utf-8")
        content = {**body.as_dict(), "not_expressed": exported.limitations}
        (place / IDENTIFIED_FILE).write_text(as_json(content) + "\n", encoding="utf-8")
        for k, grasp in enumerate((*body.experiment.grasps, *body.obstacles), start=1):
            write_poses_csv(place / f"poses_{k}.csv", grasp.poses)
    return exported


def write_ensemble(
    run: SolvedProblem,
    target_name: str,
    folder: str | Path,
    count: int,
    seed: int = 0,
    experiment: str | None = None,
) -> ExportedFiles:
    """Write the body of a run for a target with `count` draws of its constants, for domain
    randomisation: an export in each of the folders ``sample_001``, …, and ``samples.csv`` with a
    row for each.

    Parameters
    ----------
    run : SolvedProblem
        A run with error bars, such as the value of `collocation_sysid.run`.
    target_name : str
        Name of a target in `TARGETS`, such as "mujoco".
    folder : str or Path
        Written completely or not at all; an earlier ensemble there is replaced.
    count, seed : int
        See `SolvedProblem.samples`.
    experiment : str, optional
        Name of a fitted experiment; the first by default.

    Returns
    -------
    ExportedFiles
        Files of the last sample, and what the target cannot express.

    Raises
    ------
    InputError
        As `write_export` and `SolvedProblem.samples`.
    """
    samples = run.samples(count, seed).to_dict("list")
    return write_draws(IdentifiedBody.from_run(run, experiment), samples, target_name, folder)


def write_draws(
    body: IdentifiedBody,
    draws: Mapping[str, Sequence[float] | Array],
    target_name: str,
    folder: str | Path,
) -> ExportedFiles:
    """Write a body for a target with each of some draws (count,) of its parameters and moduli, by
    name; see `write_ensemble`.
    """
    exported = target_named(target_name).export(body)  # refused before anything is written
    rows = [dict(zip(draws, row, strict=True)) for row in zip(*draws.values(), strict=True)]
    own = {*body.parameters, *body.body.field_coefficient_names}
    names = [name for name in draws if name in own]  # without derived moduli
    digits = max(3, len(str(len(rows))))
    with replaced_folder(folder, marker_file=SAMPLES_FILE, content_word="ensemble") as place:
        lines = [",".join(("sample", *draws))]
        lines += [
            f"{k},{values_as_text([*row.values()], ',')}" for k, row in enumerate(rows, start=1)
        ]
        (place / SAMPLES_FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")
        for k, row in enumerate(rows, start=1):
            draw = body.with_values({name: float(row[name]) for name in names})
            exported = write_export(draw, target_name, place / f"sample_{k:0{digits}d}")
    return exported


def verify_export(
    body: IdentifiedBody, target_name: str, folder: str | Path
) -> Sequence[PredictionComparison]:
    """Run an export in the target itself, and compare its predictions with those of this package.

    Nothing is written to `folder`.

    Parameters
    ----------
    body : IdentifiedBody
        The body that was exported.
    target_name : str
        Name of a target in `TARGETS`.
    folder : str or Path
        Folder of `write_export`; the target runs in a temporary copy.

    Returns
    -------
    sequence of PredictionComparison
        One for each compared quantity; how close they are is not judged.

    Raises
    ------
    InputError
        For an unknown target, or if the target cannot be run from here, is not installed or fails.
    SimulationError
        If an equilibrium of this package cannot be computed.
    """
    target = target_named(target_name)
    if target.verify is None:
        able = ", ".join(name for name, each in TARGETS.items() if each.verify is not None)
        raise InputError(f"{target.name} cannot be run by this program; --verify works with {able}")
    # It may leave files of its own behind.
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(shutil.copytree(folder, Path(scratch) / "export"))
        return target.verify(body, place)


def comparison_table(name: str, comparisons: Sequence[PredictionComparison]) -> Table:
    """Return the table of predictions of a simulator and of this package, a row for each quantity:
    name, both values with their unit, relative difference in percent ("+nan%" if this package
    predicts zero), and remark. `name` is the simulator's, for the heading.
    """
    rows = []
    for each in comparisons:
        values = (f"{value:.5g} {each.unit}" for value in (each.theirs, each.ours))
        rows.append((each.what, *values, f"{each.relative_difference:+.2%}", each.remark))
    return Table("", ("", name, "ours", "difference", ""), rows=tuple(rows), names=5)


def target_named(name: str) -> ExportTarget:
    """Return the target in `TARGETS` called `name`.

    Raises
    ------
    InputError
        If there is no target of that name.
    """
    if name not in TARGETS:
        known = (*TARGETS, rerun_recording.TARGET)
        raise InputError(f"no target {name!r}; available: {', '.join(known)}{hint_at(name, known)}")
    return TARGETS[name]


__all__ = [
    "IDENTIFIED_FILE",
    "MAIN_FILES",
    "TARGETS",
    "ExportDestination",
    "ExportTarget",
    "ExportedFiles",
    "IdentifiedBody",
    "PredictionComparison",
    "comparison_table",
    "parse_destination",
    "read_draws",
    "target_named",
    "verify_export",
    "write_draws",
    "write_ensemble",
    "write_export",
]
