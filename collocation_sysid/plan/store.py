"""Finished runs on disk: one JSON file each, there whole or not at all."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..files import write_whole
from ..tree import as_json

# What became of a run.
FINISHED, ERROR, TIMEOUT, CRASHED, STOPPED = "finished", "error", "timeout", "crashed", "stopped"

Record = dict[str, Any]


@dataclass(frozen=True)
class RunStore:
    """The folder ``runs/`` of a study."""

    folder: Path

    def save(self, record: Record) -> None:
        """Write a run's record."""
        write_whole(self._file(record["key"]), as_json(record) + "\n")

    def load(self, key: str) -> Record | None:
        """A run's record; None if there is none that can be read."""
        try:
            record = json.loads(self._file(key).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return record if isinstance(record, dict) and record.get("key") == key else None

    def finished(self, key: str, time_limit_s: float | None) -> Record | None:
        """A run's record unless it is worth another try.

        A run that crashed is, and one that ran out of less time than it has now.
        """
        record = self.load(key)
        if record is None or record["outcome"] == CRASHED:
            return None
        if record["outcome"] == TIMEOUT:
            had = record.get("time_limit_s") or 0.0
            return record if time_limit_s is not None and time_limit_s <= had else None
        return record

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}.json"
