"""Export of the identified body to other simulators.

`export_run` writes the files of a target in `TARGETS`, `verify_export` runs the target and compares
its prediction with that of this package. One module per simulator: `mujoco`, `newton`, `usd`,
`sofa`, `febio` and `calculix`. For all of them, `identified` reads the body from a run folder,
`export_target` describes what a simulator can express, and `obstacle_shapes` converts obstacles.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ...display import Table
from ...errors import InputError, hint_at
from ...recording import write_poses_csv
from ...serialisation import as_json
from ..run_writers import run_folder
from . import calculix, febio, mujoco, newton, sofa, usd
from .export_target import Comparison, Exported, Target
from .identified import Identified

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
    """Write a body for a target: its files, ``identified.json``, and the poses of its grasps and
    obstacles.

    Parameters
    ----------
    body : Identified
    to : str
        Name of a target in `TARGETS`.
    folder : str or Path
        Written completely or not at all; an earlier export there is replaced.

    Returns
    -------
    Exported
        The files, and what the target cannot express.

    Raises
    ------
    InputError
        For an unknown target, a body that the target cannot express, or a folder with other files.
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
    """Run an export in the target itself, and compare its predictions with those of this package.

    Parameters
    ----------
    body : Identified
    to : str
        Name of a target in `TARGETS`.
    folder : str or Path
        Folder of `export_run`; the target runs in a temporary copy.

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
    """Return the table of predictions of the simulator `name` and of this package."""
    rows = []
    for each in compared:
        values = (f"{value:.5g} {each.unit}" for value in (each.theirs, each.ours))
        rows.append((each.what, *values, f"{each.relative:+.2%}", each.remark))
    return Table("", ("", name, "ours", "difference", ""), tuple(rows), names=5)


def target_named(name: str) -> Target:
    """Return the target in `TARGETS` called `name`.

    Raises
    ------
    InputError
        If there is no target of that name.
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
