"""C3D, the binary format of most motion-capture systems (www.c3d.org), through ezc3d."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from numpy.typing import NDArray

from ...common.isolated_process import Failed, ProcessLimits, run_isolated
from ...errors import InputError, listed
from .raw_tracks import LabelChooser, RawTracks
from .units import length_unit_of_text

# Beginnings of the parameters of all points.
_OF_POINTS = ("LABELS", "UNITS", "RATE", "TYPE_GROUPS")
# Bytes of a block, the unit of addresses in the file.
_BLOCK = 512
# Processor types with other number formats than Intel's.
_DEC = 85
# Number of the processor type SGI/MIPS.
_SGI = 86
# Largest frame number that the header's 16 bits can hold.
_COUNTER_LIMIT = 65535
# Parameters that list points which Vicon computes from a model, such as joint angles [°] and powers:
# they are no markers. POINT:TYPE_GROUPS may name others.
_OUTPUTS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "MODELED_MARKERS", "REACTIONS")
# On damaged files ezc3d may crash, which a process of its own survives.
WORKER = rf"""
import re, ezc3d
file = ezc3d.c3d(sys.argv[1])
of_points = file["parameters"]["POINT"]
groups = map(str, of_points.get("TYPE_GROUPS", {{"value": []}})["value"])
outputs = [*{_OUTPUTS!r}, *(re.escape(group.strip()) for group in groups if group.strip())]
names = rf"(LABELS|{{'|'.join(outputs)}})[0-9]{{{{0,3}}}}|UNITS|RATE|TYPE_GROUPS"
kept = [key for key in of_points if re.fullmatch(names, key)]
found = {{key: numpy.array(of_points[key]["value"]) for key in kept}}
found["points"] = numpy.asarray(file["data"]["points"], dtype=float)[:3]
"""


def read(path: str | Path, content: bytes, choose: LabelChooser) -> RawTracks:
    """Read a C3D file; points with a negative residual are missing (NaN, by ezc3d).

    Parameters
    ----------
    choose : LabelChooser
        Picks the markers.

    Raises
    ------
    InputError
        If ezc3d is not installed, or the file is damaged or inconsistent.
    """
    if find_spec("ezc3d") is None:
        raise InputError("reading C3D needs ezc3d: pip install 'collocation-sysid[c3d]'")
    header_points, header_frames = _header_counts(content)
    try:
        read = run_isolated(WORKER, str(Path(path).resolve()), limits=ProcessLimits.for_file(path))
    except Failed as error:
        raise InputError(
            f"the C3D file is damaged (message of ezc3d: '{error}'); expected a complete file: "
            "export it again"
        ) from error
    points = read.pop("points")  # (3, points, frames)
    for what, declared, count in (
        ("points", header_points, points.shape[1]),
        ("frames", header_frames, points.shape[2]),
    ):
        if declared is not None and count != declared:
            raise InputError(
                f"the header states {declared} {what}, but the file contains {count}; expected equal "
                "numbers: the file may be truncated, export it again"
            )
    labels = _labels(read)
    if len(labels) != points.shape[1]:
        raise InputError(
            f"{len(labels)} labels, but {points.shape[1]} points in every frame; "
            "expected a label for each",
            where="POINT:LABELS",
        )
    outputs = _model_outputs(read, labels)
    markers = [k for k, label in enumerate(labels) if label not in outputs]
    if outputs and not markers:
        raise InputError(
            f"all points are outputs of a model ({listed(sorted(set(outputs.values())))}), not "
            "markers; expected the trajectories of markers",
            where="POINT:LABELS",
        )
    chosen = [markers[k] for k in choose([labels[k] for k in markers])]
    units = "".join(map(str, read.get("UNITS", [])[:1]))
    rates = [float(rate) for rate in read.get("RATE", [])[:1]]
    return RawTracks(
        labels=[labels[k] for k in chosen],
        coordinates=points[:, chosen].transpose(2, 1, 0),
        unit=length_unit_of_text(units, "POINT:UNITS"),
        unit_key="POINT:UNITS",
        rate_hz=rates[0] if rates and rates[0] > 0 else None,
        rate_key="POINT:RATE",
        notes=tuple(
            f"{listed(names)} of POINT:{group} are outputs of a model, not markers: left out"
            for group in sorted(set(outputs.values()))
            if (names := [label for label in outputs if outputs[label] == group])
        ),
    )


def _model_outputs(parameters: Mapping[str, NDArray], labels: Sequence[str]) -> dict[str, str]:
    """Return the parameter that lists it by the label of each point that is computed by a model."""
    lists = {key: parameters[key] for key in parameters if not key.startswith(_OF_POINTS)}
    groups = {str(name).strip(): key for key, names in lists.items() for name in names}
    named = {label: (label, label.rpartition(":")[2]) for label in labels}  # also without subject
    return {
        label: next(groups[name] for name in names if name in groups)
        for label, names in named.items()
        if not groups.keys().isdisjoint(names)
    }


def _header_counts(content: bytes) -> tuple[int, int | None]:
    """Return the numbers of points and frames, None if the counter of frames overflowed."""
    start = _BLOCK * (content[0] - 1)
    if len(content) < max(start + 4, _BLOCK):
        raise InputError("the file is truncated: the C3D header is incomplete; export it again")
    processor = content[start + 3]
    order = ">" if processor == _SGI else "<"
    points, analog, first, last = struct.unpack_from(f"{order}4H", content, 2)
    if last >= _COUNTER_LIMIT:
        return points, None
    frames = last - first + 1
    (scale,) = struct.unpack_from(f"{order}f", content, 12)
    (data_block,) = struct.unpack_from(f"{order}H", content, 16)
    # A negative scale means floats, else integers; DEC stores the sign elsewhere, so the smaller
    # size is assumed.
    width = 4 if scale < 0 and processor != _DEC else 2
    size = _BLOCK * (data_block - 1) + frames * (4 * points + analog) * width
    if len(content) < size:
        raise InputError(
            f"the file has {len(content)} bytes, but {frames} frames of {points} points need "
            f"{size}; it may be truncated: export it again"
        )
    if frames < 1 or not points:
        raise InputError(
            f"the file contains {points} points and {frames} frames; expected at least one of each"
        )
    return points, frames


def _labels(parameters: Mapping[str, NDArray]) -> list[str]:
    """Return the stripped labels; those beyond the 255th are in LABELS2, LABELS3 …"""
    keys = [key for key in parameters if key.startswith("LABELS")]
    ordered = sorted(keys, key=lambda key: int(key.removeprefix("LABELS") or 1))
    return [str(label).strip() for key in ordered for label in parameters[key]]
