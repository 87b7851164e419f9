"""Tables with a name, and tables of sensors that read their own files.

A sensor that is not described by its table and a file of columns alone has a `MeasurementSection`,
a table with a function that reads it. `recording_schema.ExperimentSection` lists these tables; those
of other packages are the entry points `ENTRY_POINTS`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, create_model

from ..common.array_types import Array
from ..common.files import require_regular
from ..common.schema_tables import Section
from ..common.validated_types import FileName
from ..errors import InputError, hint_at, located
from ..fem.body import Body
from ..kinds.registry import KINDS
from ..kinds.rod.element import RodMesh
from ..recording.sources.logs import stored_files
from ..recording.time_tables import is_within_experiment, read_custom_sensor

# Group of the entry points of other packages: the key of a list of tables within
# [[experiment]], and the class of the tables, a `MeasurementSection`.
ENTRY_POINTS = "collocation_sysid.measurements"


class NamedSection(Section):
    """Table with a name that is also part of file names."""

    name: FileName


@dataclass(frozen=True)
class RecordingFolder:
    """Folder of the files of one experiment, and how they are read."""

    path: Path  # folder that contains the files
    body: Body
    is_static: bool  # whether the samples are equilibria
    is_simulation: bool  # whether measurements are simulated, so that their files need not exist
    add_note: Callable[[str], None]  # called with a sentence about what was read or assumed

    def places_on_rod(self, s_m: Mapping[str, float], where: str) -> dict[str, list[float]]:
        """Return the places [m] on the undeformed body that are stated by arc length, by name."""
        mesh = self.body.mesh
        if not s_m:
            return {}
        if not isinstance(mesh, RodMesh):
            raise InputError(
                "found arc lengths for a body that is not a rod; expected positions", where=where
            )
        with located(where=where):
            return {name: mesh.place_m(s).tolist() for name, s in s_m.items()}

    def must_read(self, name: str | None) -> bool:
        """Return whether a file must be read: in a solve always, also without a name (None); in a
        simulation if it is named and exists.
        """
        return not self.is_simulation or bool(name and stored_files(self.path / name))

    def require_existing(self, name: str | None, key: str, what: str = "a file") -> Path:
        """Return the path of a file; raise `InputError` at `key` if none is named (None) or it does
        not exist. `what` is the expected kind of file, for the message.
        """
        if name is None:
            raise InputError(f"missing; expected {what}", where=key)
        return existing_file(self.path, name, key=key)

    def read_samples(
        self, name: str | None, where: str, t_s: Array, columns: Sequence[str] = ()
    ) -> tuple[Array, Array | None, list[str]]:
        """Return times (S,) [s], numbers (S, m) and the names of their columns of the samples of a
        custom sensor within the times t_s [s], and note how many are used.

        Parameters
        ----------
        name : str or None
            Table with a column t_s and one for each number. A simulation does without; then the
            values are None, and the times are t_s.
        where : str
            Location of the sensor's table, whose key "file" is the name.
        t_s : (T,) array
            Times of the experiment [s].
        columns : sequence of str
            Columns of the numbers; all but t_s by default.
        """
        if not self.must_read(name):
            return t_s, None, [*columns]
        file = self.require_existing(name, f"{where}.file")
        with located(where=where):
            at_s, values, names = read_custom_sensor(file, columns)
            is_used = is_within_experiment(at_s, t_s, name=str(name), is_static=self.is_static)
        self.add_note(f"{name}: {is_used.sum()} of {len(at_s)} samples are used")
        return at_s[is_used], values[is_used], names


class MeasurementSection(NamedSection):
    """Measurements of one sensor, with times of their own."""

    @abstractmethod
    def read(self, folder: RecordingFolder, where: str, t_s: Array) -> Any:
        """Return the measurements within the times of the experiment, as `Experiment` expects
        them, and note how many are used.

        Parameters
        ----------
        folder : RecordingFolder
            Folder of the experiment's files.
        where : str
            Location of the table within that of the experiment, for messages.
        t_s : (T,) array
            Times of the experiment [s].

        Raises
        ------
        InputError
            If a file is missing or unusable, or nothing is within the times.
        """

    def read_times_s(self, folder: RecordingFolder, where: str) -> Array:
        """Return the times of those measurements of the sensor that determine the samples of
        equilibria, if nothing else does [s]; here none. Arguments and errors as for `read`.
        """
        return np.zeros(0)


@cache
def registered_tables() -> type[Section]:
    """Return a table of the lists of tables of features and of other packages, by their keys."""
    lists: dict[str, Any] = {name: (list[table], []) for name, table in own_tables().items()}
    lists |= {entry.name: (_type_of(entry), []) for entry in entry_points(group=ENTRY_POINTS)}
    return create_model("RegisteredTables", __base__=Section, **lists)


def own_tables() -> dict[str, type[MeasurementSection]]:
    """Return the classes of the tables of features of this package by their keys."""
    return {kind.name: table for kind in KINDS if (table := kind.table)}


def _type_of(entry: EntryPoint) -> Any:
    """Return a type; of a class that cannot be imported, one that refuses every value."""
    try:
        kind = entry.load()
        if issubclass(kind, MeasurementSection):
            return list[kind]
        reason = "it is no MeasurementSection"
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".partition("\n")[0].rstrip(": ")
    package = f" of the package {entry.dist.name!r}" if entry.dist else ""
    message = f"the table {entry.value!r}{package} cannot be used ({reason}); repair or remove the package"

    def refuse(_: Any) -> Any:
        raise ValueError(message)

    return Annotated[Any, BeforeValidator(refuse)]


def existing_file(folder: Path, name: str, key: str) -> Path:
    """Return the path of a file that a key of the problem file names, relative to `folder`; `name`
    may also be a topic of a log, as "log#topic", or an absolute path.

    Raises
    ------
    InputError
        At `key`, if it does not exist, is a folder or no regular file.
    """
    file = folder / name
    require_regular(file, key)
    if not stored_files(file):
        fault = "is a folder" if file.is_dir() else "does not exist"
        hint = folder / "README.md"
        see = f"; {hint} may explain how to get it" if hint.is_file() else ""
        beside = [each.name for each in file.parent.iterdir()] if file.parent.is_dir() else []
        similar = hint_at(file.name, sorted(beside)) if not file.exists() else ""
        message = (
            f"{file} {fault}; expected a file: the path is relative to the folder of the problem "
            f"file{similar}{see}"
        )
        raise InputError(message, where=key)
    return file
