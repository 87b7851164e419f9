"""Folders of the data sets: problem files with their tables.

Measured rubber is part of the package. Simulated recordings are in the repository's `problems/`,
which a wheel contains beside them (`force-include` in pyproject.toml).
"""

from __future__ import annotations

import shutil
from pathlib import Path

from ..errors import InputError, hint_at
from ..files import replaced_file, require_possible
from ..problem import Problem

# Problem file of each data set.
DATASETS = {
    "kawabata_1981": "problem.toml",
    "treloar_1944": "problem.toml",
    "diani": "problem.toml",
    "foam_cylinder": "recording.toml",
    "laid_block": "problem.toml",
    "noisy_cylinder": "problem.toml",
    "poked_block": "problem.toml",
    "table1": "problem.toml",
    "wrist_sensor": "problem.toml",
}
_IN_PACKAGE = Path(__file__).parent
_IN_CHECKOUT = Path(__file__).parents[2] / "problems"


def dataset_folder(name: str) -> Path:
    """Return the folder of a data set.

    Raises
    ------
    InputError
        If there is no data set of this name, or it is not installed.
    """
    if name not in DATASETS:
        raise InputError(
            f"found {name!r}; expected one of {', '.join(DATASETS)}{hint_at(name, DATASETS)}",
            where="dataset",
        )
    for parent in (_IN_PACKAGE, _IN_CHECKOUT):
        if (parent / name / DATASETS[name]).is_file():
            return parent / name
    raise InputError(
        f"the data set {name!r} is not part of this installation; expected its folder in "
        f"{_IN_PACKAGE} or {_IN_CHECKOUT}",
        where="dataset",
    )


def dataset_file(name: str, file: str) -> Path:
    """Return a file of a data set; raise `InputError` if there is no such data set."""
    return dataset_folder(name) / file


def read_problem(name: str) -> Problem:
    """Return the problem of a data set, one of `DATASETS`, with experiments and parameters.

    Raises
    ------
    InputError
        If there is no data set of this name, or it is not installed.
    """
    folder = dataset_folder(name)
    return Problem.read(folder / DATASETS[name])


def copy_dataset(name: str, folder: Path) -> list[Path]:
    """Copy the files of a data set into a folder, which is created if necessary.

    Returns
    -------
    list of Path
        The problem file, followed by the other files.

    Raises
    ------
    InputError
        If there is no data set of this name, one of the files exists, or the folder cannot be
        created.
    """
    source = dataset_folder(name)
    problem_file = source / DATASETS[name]
    others = sorted(file for file in source.iterdir() if file.is_file() and file != problem_file)
    require_possible(folder)
    copies = {file: folder / file.name for file in (problem_file, *others)}
    for copy in copies.values():
        if copy.exists():
            raise InputError("it is there already; choose another name", copy)
    for file, copy in copies.items():
        with replaced_file(copy) as draft:
            shutil.copyfile(file, draft)
    return list(copies.values())
