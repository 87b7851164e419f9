"""The identified body for other simulators: a table of targets, and folders that hold it."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ...display import Table
from ...errors import InputError, hint_at
from ...recording import write_poses_csv
from ...tree import as_json
from ..writers import run_folder
from . import calculix, febio, mujoco, newton, sofa, usd
from .identified import Identified
from .target import Comparison, Exported, Target

NUMBERS = "identified.json"


TARGETS: dict[str, Target] = {
    "mujoco": Target("MuJoCo", mujoco.export, mujoco.verify),
    "newton": Target("Newton", newton.export),
    "usd": Target("OpenUSD", usd.export, usd.verify),
    "sofa": Target("SOFA", sofa.export),
    "febio": Target("FEBio", febio.export),
    "calculix": Target("CalculiX", calculix.export, calculix.verify),
    "json": Target("JSON", lambda body: Exported({}, ())),
}


def export_run(body: Identified, to: str, folder: str | Path) -> Exported:
    """Write a body for a target: its files, ``identified.json``, and the poses of its grasps.

    Parameters
    ----------
    body : Identified
    to : str
        A name in `TARGETS`.
    folder : str or Path
        Appears whole or not at all; an earlier export there is replaced.

    Raises
    ------
    InputError
        For an unknown target, a body that it cannot express, or a folder with other files.
    """
    exported = target_named(to).export(body)
    with run_folder(folder, mark=NUMBERS, what="export") as place:
        for name, text in exported.files.items():
            (place / name).write_text(text, encoding="utf-8")
        content = {**body.as_dict(), "not_expressed": exported.limits}
        (place / NUMBERS).write_text(as_json(content) + "\n", encoding="utf-8")
        for k, grasp in enumerate((*body.experiment.grasps, *body.obstacles), start=1):
            write_poses_csv(place / f"poses_{k}.csv", grasp.poses)
    return exported


def verify_export(body: Identified, to: str, folder: str | Path) -> Sequence[Comparison]:
    """Predict in the target itself what was exported, and compare with our prediction.

    Raises
    ------
    InputError
        If the target cannot be run from here, or is not installed.
    """
    target = target_named(to)
    if target.verify is None:
        able = ", ".join(name for name, each in TARGETS.items() if each.verify is not None)
        raise InputError(f"{target.name} is not run from here; --verify works with {able}")
    # It may leave files of its own behind.
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(shutil.copytree(folder, Path(scratch) / "export"))
        return target.verify(body, place)


def comparison_table(name: str, compared: Sequence[Comparison]) -> Table:
    """What a simulator predicts beside what we do."""
    rows = []
    for each in compared:
        values = (f"{value:.5g} {each.unit}" for value in (each.theirs, each.ours))
        rows.append((each.what, *values, f"{each.relative:+.2%}", each.remark))
    return Table("", ("", name, "ours", "difference", ""), tuple(rows), names=5)


def target_named(name: str) -> Target:
    """A target of the table.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    if name not in TARGETS:
        known = ", ".join(TARGETS)
        raise InputError(f"no target {name!r}; available: {known}{hint_at(name, TARGETS)}")
    return TARGETS[name]


__all__ = [
    "NUMBERS",
    "TARGETS",
    "Comparison",
    "Exported",
    "Identified",
    "Target",
    "comparison_table",
    "export_run",
    "target_named",
    "verify_export",
]
