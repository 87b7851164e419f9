"""Folders of the datasets: problem files with their tables.

Measured rubber is part of the package. Simulated recordings are in the repository's `problems/`,
which a wheel contains beside them (`force-include` in pyproject.toml).
"""

from __future__ import annotations

from pathlib import Path

from ..common.files import write_new_files
from ..common.validated_classes import validated
from ..errors import InputError, hint_at
from ..problem import Problem
from ..problem.editor_schema import SCHEMA_FILE, schema_text, schema_url, with_schema_reference

# Problem file of each dataset.
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
# Licence of the datasets of others; the other datasets have the licence of this project.
THIRD_PARTY_LICENCES = dict.fromkeys(
    ("kawabata_1981", "treloar_1944", "diani"), "LICENSE_Hyperelastics.md"
)
# First line of problem files that name a JSON schema for editors.
_SCHEMA_COMMENT = "#:schema "
_IN_PACKAGE = Path(__file__).parent
_IN_CHECKOUT = Path(__file__).parents[2] / "problems"


def dataset_folder(name: str) -> Path:
    """Return the folder of a dataset, which contains its problem file: that of the package, else
    that of the repository.

    Raises
    ------
    InputError
        If there is no dataset of this name, or it is not installed.
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
        f"the dataset {name!r} is not part of this installation; expected its folder in "
        f"{_IN_PACKAGE} or {_IN_CHECKOUT}",
        where="dataset",
    )


def dataset_file(name: str, file: str) -> Path:
    """Return the path of a file in the folder of a dataset; the file need not exist.

    Raises
    ------
    InputError
        If there is no dataset of this name, or it is not installed.
    """
    return dataset_folder(name) / file


@validated
def read_problem(name: str) -> Problem:
    """Return the problem of a dataset, one of `DATASETS`, with experiments and parameters.

    Raises
    ------
    InputError
        If there is no dataset of this name, or it is not installed.
    """
    folder = dataset_folder(name)
    return Problem.read(folder / DATASETS[name])


def copy_dataset(name: str, folder: Path) -> list[Path]:
    """Copy the files of a dataset into a folder, which is created if necessary; subfolders are not
    copied.

    Problem files name the JSON schema for editors like those of `create_problem`: by its address if
    it has one, else the schema is written to the folder, too. Measured data of others come with
    their licence.

    Returns
    -------
    list of Path
        The problem file, followed by the other files by name, the licence and the schema, if there
        is one.

    Raises
    ------
    InputError
        If there is no dataset of this name, or one of the files exists or cannot be written;
        nothing is copied then.
    """
    source = dataset_folder(name)
    problem_file = source / DATASETS[name]
    others = sorted(file for file in source.iterdir() if file.is_file() and file != problem_file)
    if name in THIRD_PARTY_LICENCES:
        others.append(_IN_PACKAGE / THIRD_PARTY_LICENCES[name])
    url = schema_url()
    contents: dict[Path, str | Path] = {}
    for file in (problem_file, *others):
        text = file.read_text(encoding="utf-8") if file.suffix == ".toml" else ""
        has_schema = text.startswith(_SCHEMA_COMMENT)
        content = with_schema_reference(text, url or SCHEMA_FILE) if has_schema else file
        contents[folder / file.name] = content
    contents |= {} if url else {folder / SCHEMA_FILE: schema_text()}
    return write_new_files(contents)
