"""Masks of a body in images: PNG files, and run lengths in the format of COCO, as SAM writes them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...common.files import in_counting_order, reason
from ...errors import InputError

Mask = NDArray[np.bool_]
# Values of a PNG: brighter ones are the body; more of the pixels in between show a photograph.
BRIGHT = 127
MOST_GREY = 0.05
# What the library raises for damaged files (a wrong chunk is a SyntaxError), and for more pixels than
# memory may hold.
UNREADABLE = (
    OSError,
    ValueError,
    SyntaxError,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)
EXPECTED = (
    "expected masks as .png, a folder of these, or .json with run lengths of COCO: "
    '{"size": [rows, columns], "counts": …}, or a list of these'
)


def read_masks(path: Path) -> list[Mask]:
    """Return the masks (rows, columns) of a PNG file, a folder of these in the order of their names,
    or a JSON file with run lengths.

    Raises
    ------
    InputError
        If the file has no masks.
    """
    if path.is_dir():
        files = in_counting_order(path.glob("*.png"))
        if not files:
            raise InputError(f"the folder has no .png; {EXPECTED}", path)
        return [_read_png(file) for file in files]
    if path.suffix.lower() == ".png":
        return [_read_png(path)]
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(f"cannot be read ({reason(error)}); {EXPECTED}", path) from error
    if isinstance(content, dict) and "annotations" in content:
        content = content["annotations"]
    entries = content if isinstance(content, list) else [content]
    if not entries:
        raise InputError(f"found 0 masks; {EXPECTED}", path)
    try:
        return [decoded(entry.get("segmentation", entry)) for entry in entries]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"found no run lengths ({reason(error)}); {EXPECTED}", path) from error


def _read_png(file: Path) -> Mask:
    """Use the alpha channel if that is no constant, else the brightness."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(file) as image:
                grey = np.asarray(image.convert("L"))
                if image.mode in ("LA", "RGBA"):
                    alpha = np.asarray(image.getchannel("A"))
                    grey = alpha if np.ptp(alpha) else grey
                elif image.mode in ("P", "I", "I;16") or (np.ptp(grey) and grey.max() <= BRIGHT):
                    grey = np.where(np.asarray(image) > 0, 255, 0)  # numbers of objects
    except UNREADABLE as error:
        raise InputError(f"cannot be read ({reason(error)}); {EXPECTED}", file) from error
    if np.mean((grey > 16) & (grey < 239)) > MOST_GREY:
        raise InputError(
            "found a photograph, not a mask: many pixels are neither black nor white; expected white "
            "pixels where the body is, black ones elsewhere",
            file,
        )
    return grey > BRIGHT


def decoded(run_lengths: Any) -> Mask:
    """Return the mask (rows, columns) of run lengths of COCO: a table of the size (rows, columns) and
    the counts, of pixels outside and inside in turn, column after column; compressed ones are a text.

    Raises
    ------
    ValueError
        If the counts do not have the size.
    """
    rows, columns = (int(each) for each in run_lengths["size"])
    counts = run_lengths["counts"]
    if isinstance(counts, str):
        counts = _uncompressed(counts)
    lengths = np.asarray(counts, dtype=np.int64)
    if lengths.ndim != 1 or (lengths < 0).any() or lengths.sum() != rows * columns:
        raise ValueError(f"the counts have {lengths.sum()} pixels for {rows} x {columns}")
    inside = np.arange(len(lengths)) % 2 == 1
    return np.repeat(inside, lengths).reshape(columns, rows).T


def encoded(mask: Mask) -> dict[str, Any]:
    """Return the uncompressed run lengths of a mask (rows, columns)."""
    flat = np.concatenate([[False], mask.T.ravel()])
    ends = np.append(np.flatnonzero(flat[1:] != flat[:-1]), mask.size)
    counts = np.diff(ends, prepend=0)
    return {"size": list(mask.shape), "counts": counts.tolist()}


def _uncompressed(text: str) -> Sequence[int]:
    """Return the counts of a text, in which a character has five bits of a number and one that says
    whether more follow; from the third on, numbers are differences from the last but one.
    """
    counts: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = shift = 0
    return counts
