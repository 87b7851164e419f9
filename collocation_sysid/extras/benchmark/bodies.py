"""Bodies of the benchmark: problem file, recordings to be predicted, and how to get the data."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from ...common.pages import documentation_folder
from ...datasets.files import dataset_folder
from ...errors import InputError, require_among
from ...problem import Problem

CATALOGUE_FILE = "catalogue.json"
CHECKOUT = Path(__file__).parents[3]
# Licence of the curves of rubber.
HYPERELASTICS_LICENCE = "collocation_sysid/datasets/LICENSE_Hyperelastics.md"


@dataclass(frozen=True, kw_only=True)
class BenchmarkBody:
    """One body of the benchmark."""

    name: str
    entry: str  # name of its entry in the catalogue, which has its constants, source and licence
    folder: str  # name of a dataset that is part of the package, or of a folder of `problems/`
    problem_file: str = "problem.toml"  # problem file in the folder
    recordings: tuple[str, ...]  # recordings to be predicted
    are_held_out: bool  # whether the constants were identified without these recordings
    # Values that replace those of the problem file, "dotted.key=value".
    overrides: tuple[str, ...] = ()
    # Files in the folder that a script fetches; empty if all data are part of the repository.
    data_files: tuple[str, ...] = ()
    script: str = ""  # name of the script that fetches the data; empty if there is none
    # Text of the licence in the repository, for recordings of others; empty if there is none.
    licence_path: str = ""
    note: str = ""  # what limits a comparison with these measurements, for the README of the body

    def find_data_folder(self) -> Path | None:
        """Return the folder with the problem file and all data of the body on this computer; None
        if files are missing.
        """
        folder = CHECKOUT / "problems" / self.folder
        if not self.script:
            try:
                folder = dataset_folder(self.folder)
            except InputError:
                return None
        needed = (self.problem_file, *self.data_files)
        is_complete = all((folder / file).is_file() for file in needed)
        return folder if is_complete else None

    def find_licence_file(self) -> Path | None:
        """Return the path of the licence of the recordings in a checkout of the repository; None if
        `licence_path` is empty. Whether the file exists is not checked.
        """
        return CHECKOUT / self.licence_path if self.licence_path else None

    def catalogue_entry(self) -> dict[str, Any]:
        """Return the entry of the body in the catalogue, as in its JSON file; not to be modified.

        Raises
        ------
        InputError
            If the catalogue is not part of the installation, or has no such entry.
        """
        entries = _catalogue()
        require_among(self.entry, entries, source=CATALOGUE_FILE)
        return entries[self.entry]

    def read_problem(self) -> Problem:
        """Return the problem of the body.

        Raises
        ------
        InputError
            If the data are not on this computer, with the script that fetches them.
        """
        folder = self.find_data_folder()
        if folder is None:
            remedy = (
                f"run python scripts {self.script} in a clone of the repository"
                if self.script
                else "install the package again"
            )
            raise InputError(
                f"the data of {self.name} are not on this computer; {remedy}, or choose other "
                "bodies",
                where="--body",
            )
        return Problem.read(folder / self.problem_file, self.overrides)


BODIES = {
    body.name: body
    for body in (
        BenchmarkBody(
            name="isoprene_rubber",
            entry="isoprene_rubber",
            folder="kawabata_1981",
            recordings=("biaxial",),
            are_held_out=True,
            licence_path=HYPERELASTICS_LICENCE,
            note="The publication states no uncertainty of the stresses: σ is an assumption.",
        ),
        BenchmarkBody(
            name="calendered_rubber",
            entry="calendered_rubber",
            folder="diani",
            recordings=("transverse",),
            are_held_out=True,
            licence_path=HYPERELASTICS_LICENCE,
            note="The rubber is anisotropic, and the constants were identified along the other "
            "direction: an isotropic law cannot predict these stresses to the noise. The source "
            "states no uncertainty of the stresses: σ is an assumption.",
        ),
        BenchmarkBody(
            name="ecoflex_cylinder",
            entry="ecoflex_00_30_sticking",
            folder="phantom_compression",
            recordings=("A2", "A4"),
            are_held_out=True,
            data_files=tuple(f"EF30_0T_A{run}.csv" for run in range(1, 6)),
            script="get_phantom_compression",
            note="σ is the deviation of five equal tests from their mean. The zero of the "
            "displacement is uncertain by 0.2 mm (standard deviation), and whether the platens "
            "stick is an assumption. E of the catalogue entry for lubricated platens is 43 % "
            "larger.",
        ),
        BenchmarkBody(
            name="silicone_beam",
            entry="dragon_skin_10_beam",
            folder="srl_beam",
            problem_file="gravity.toml",
            recordings=("gravity",),
            are_held_out=False,
            # The constants were identified on this mesh.
            overrides=("object.mesh=beam.vtu",),
            data_files=("beam_gravity_V2_a.c3d",),
            script="get_srl_beam",
            # The recordings of the arm are from the same repository.
            licence_path="problems/pneumatic_arm/LICENSE",
            note="The positions of the markers on the beam are known to 3 mm: compare the error "
            "without constant offsets of the markers, too. The time of the release is uncertain "
            "by 10 ms.",
        ),
        BenchmarkBody(
            name="simulated_foam_cylinder",
            entry="twin_foam_cylinder",
            folder="foam_cylinder",
            recordings=("swing",),
            are_held_out=False,
        ),
        BenchmarkBody(
            name="simulated_foam_block",
            entry="twin_wrist_sensor",
            folder="wrist_sensor",
            recordings=("swing",),
            are_held_out=False,
        ),
    )
}


def chosen_bodies(name: str | None) -> tuple[BenchmarkBody, ...]:
    """Return the body called `name`, also if its data are missing, or for None all bodies whose
    data are on this computer, perhaps none.

    Raises
    ------
    InputError
        If there is no body of this name.
    """
    if name is None:
        return tuple(body for body in BODIES.values() if body.find_data_folder() is not None)
    require_among(name, BODIES, where="--body")
    return (BODIES[name],)


@cache
def _catalogue() -> dict[str, dict[str, Any]]:
    """Return the entries of the catalogue by name."""
    file = documentation_folder() / CATALOGUE_FILE
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"the catalogue is not part of this installation ({error.strerror}); install the "
            "package again",
            file,
        ) from error
    return {entry["name"]: entry for entry in content["entries"]}
