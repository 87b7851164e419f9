"""Tables with a name, and tables of sensors that read their own files.

A sensor that is not described by its table and a file of columns alone has a `MeasurementSection`,
a table with a function that reads it. `recording_schema.ExperimentSection` lists these tables.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator

from ..common.array_types import Array
from ..common.schema_tables import Section


def require_file_name(name: str) -> str:
    r"""Return a name unchanged if it can be part of a file name on every platform: printable, not
    empty, no leading dot, and none of / \ : * ? " < > |; raise `ValueError` otherwise.
    """
    if (
        not name.isprintable()
        or name[:1] in ("", ".")
        or any(mark in name for mark in '/\\:*?"<>|')
    ):
        raise ValueError(
            f"found {name!r}; expected a valid file name: not empty, no leading dot, none of / \\ "
            ': * ? " < > |'
        )
    return name


class NamedSection(Section):
    """Table with a name that is also part of file names."""

    name: Annotated[str, AfterValidator(require_file_name)]


@dataclass(frozen=True)
class RecordingFolder:
    """Folder of the files of one experiment, and how they are read.

    Attributes
    ----------
    path : Path
        Folder that contains the files.
    is_static : bool
        Whether the samples are equilibria.
    add_note : callable
        Called with a sentence about what was read or assumed.
    """

    path: Path
    is_static: bool
    add_note: Callable[[str], None]


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

    @abstractmethod
    def read_times_s(self, folder: RecordingFolder, where: str) -> Array:
        """Return the times of all measurements of the sensor [s]; arguments and errors as for
        `read`.
        """
