"""Recordings for the Rerun viewer, read by its library."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def read_back(file: Path) -> dict[str, dict[str, list]]:
    """Values of each component by entity, with times [s]; those of static data under "static"."""
    from rerun.chunk import RrdReader

    entities: dict[str, dict[str, list]] = {}
    for chunk in RrdReader(str(file)).stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = {
            name: batch.column(name).to_pylist()
            for name in batch.schema.names
            if name not in ("log_time", "log_tick")  # of the computer
        }
        known = entities.setdefault(chunk.entity_path.strip("/"), {})
        for name, values in columns.items():
            key = name.rpartition(":")[2]
            known.setdefault(f"static {key}" if chunk.is_static else key, []).extend(values)
    return entities


def seconds(times: list) -> np.ndarray:
    return np.array([each.total_seconds() for each in times])
