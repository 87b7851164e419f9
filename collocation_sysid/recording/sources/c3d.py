"""C3D, the binary format of most motion-capture systems (www.c3d.org), through ezc3d."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...common.isolated_process import Failed, ProcessLimits, run_isolated
from ...errors import InputError, listed
from .raw_tracks import LabelChooser, RawTracks
from .units import length_unit_of_text

# Beginnings of the parameters of all points.
_OF_POINTS = ("LABELS", "UNITS", "RATE", "TYPE_GROUPS", "SCALE")
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
path, frames, begin, size = sys.argv[1], *map(int, sys.argv[2:])
with open(path, "rb") as whole:
    content = whole.read()
def parsed(content):
    with open("part.c3d", "wb") as part:
        part.write(content)
    return ezc3d.c3d("part.c3d")
def coordinates(file):
    return numpy.asarray(file["data"]["points"], dtype=float)[:3]
# ezc3d refuses a POINT:FRAMES that is a float: it becomes an integer and two letters more in its
# description.
record = re.search(rb"(?s)[\x06\xfa].FRAMES..\x04(\x00|\x01\x01)(.{{4}})(.)", content[:begin])
count = int(numpy.frombuffer(record[2], "<f4")[0]) if record else 0
if record:
    words = min(count, {_COUNTER_LIMIT}).to_bytes(2, "little") + bytes([record[3][0] + 2]) + b"  "
    content = content[: record.start(1) - 1] + b"\2" + record[1] + words + content[record.end() :]
file = parsed(content) if record else ezc3d.c3d(path)
of_points = file["parameters"]["POINT"]
groups = map(str, of_points.get("TYPE_GROUPS", {{"value": []}})["value"])
outputs = [*{_OUTPUTS!r}, *(re.escape(group.strip()) for group in groups if group.strip())]
names = rf"(LABELS|{{'|'.join(outputs)}})[0-9]{{{{0,3}}}}|UNITS|RATE|TYPE_GROUPS|SCALE"
kept = [key for key in of_points if re.fullmatch(names, key)]
found = {{key: numpy.array(of_points[key]["value"]) for key in kept}}
points = coordinates(file)
# First frame and number of frames, 0 if they are not stated. ezc3d may read fewer frames: as many
# as 16 bits can count.
trial = file["parameters"].get("TRIAL", {{}})
blank = {{"value": []}}
ends = [trial.get(f"ACTUAL_{{end}}_FIELD", blank)["value"] for end in ("START", "END")]
first, last = [sum(int(n) % 65536 << 16 * k for k, n in enumerate(end)) for end in ends]
if frames:
    count = frames
elif all(map(len, ends)):
    count = last - first + 1
else:
    count = sum(map(int, of_points.get("LONG_FRAMES", blank)["value"])) or count
there = min(count, (len(content) - begin) // size)
while points.shape[2] < there:
    more = coordinates(parsed(content[:begin] + content[begin + size * points.shape[2] :]))
    points = numpy.concatenate([points, more], axis=2)[:, :, :there]
found["stated"] = [first, count]
found["points"] = points
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
    header_points, first, *counts = _header(content)
    try:
        words = [str(Path(path).resolve()), *map(str, counts)]
        read = run_isolated(WORKER, *words, limits=ProcessLimits.for_file(path))
    except Failed as error:
        raise InputError(
            f"the C3D file is damaged (message of ezc3d: '{error}'); expected a complete file: "
            "export it again"
        ) from error
    points = read.pop("points")  # (3, points, frames)
    stated_first, frames = read.pop("stated").tolist()
    if not counts[0]:
        first = stated_first or first
    if 0 in read.get("SCALE", ()):
        raise InputError(
            "the factor of all coordinates is 0; expected another, below 0 if they are stored as "
            "floats: export the file again",
            where="POINT:SCALE",
        )
    for what, declared, count in (
        ("points", header_points, points.shape[1]),
        ("frames", frames, points.shape[2]),
    ):
        if declared and count != declared:
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
        frames=first + np.arange(float(points.shape[2])),
        rate_hz=rates[0] if rates and rates[0] > 0 else None,
        rate_key="POINT:RATE",
        notes=(f"frames after the first {_COUNTER_LIMIT}, if any, were not read",)
        * (not frames and points.shape[2] == _COUNTER_LIMIT)
        + tuple(
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


def _header(content: bytes) -> tuple[int, int, int, int, int]:
    """Return the number of points, the first frame and the number of frames, 0 if the counter
    overflowed; and the place of the first frame and the size of a frame [bytes].
    """
    start = _BLOCK * (content[0] - 1)
    if len(content) < max(start + 4, _BLOCK):
        raise InputError("the file is truncated: the C3D header is incomplete; export it again")
    processor = content[start + 3]
    order = ">" if processor == _SGI else "<"
    points, analog, first, last = struct.unpack_from(f"{order}4H", content, 2)
    frames = last - first + 1
    (scale,) = struct.unpack_from(f"{order}f", content, 12)
    (data_block,) = struct.unpack_from(f"{order}H", content, 16)
    # A negative scale means floats, else integers; DEC stores the sign elsewhere, so the smaller
    # size is assumed.
    width = 4 if scale < 0 and processor != _DEC else 2
    begin, frame_size = _BLOCK * (data_block - 1), (4 * points + analog) * width
    if last >= _COUNTER_LIMIT:
        return points, first, 0, begin, frame_size
    size = begin + frames * frame_size
    if len(content) < size:
        raise InputError(
            f"the file has {len(content)} bytes, but {frames} frames of {points} points need "
            f"{size}; it may be truncated: export it again"
        )
    if frames < 1 or not points:
        raise InputError(
            f"the file contains {points} points and {frames} frames; expected at least one of each"
        )
    return points, first, frames, begin, frame_size


def _labels(parameters: Mapping[str, NDArray]) -> list[str]:
    """Return the stripped labels; those beyond the 255th are in LABELS2, LABELS3 …"""
    keys = [key for key in parameters if key.startswith("LABELS")]
    ordered = sorted(keys, key=lambda key: int(key.removeprefix("LABELS") or 1))
    return [str(label).strip() for key in ordered for label in parameters[key]]
