"""Masks of a body in images: PNG files, and run lengths in the format of COCO, as SAM writes them."""

from __future__ import annotations

import reprlib
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...common.array_files import require_plausible_size
from ...common.files import in_counting_order, reason
from ...common.text_files import parse_json, read_text
from ...errors import InputError, located

Mask = NDArray[np.bool_]
# Values of a PNG: brighter ones are the body; more of the pixels in between show a photograph.
BRIGHT = 127
MOST_GREY = 0.05
# Bits before the last character of a number: counts have 32.
LONGEST_SHIFT = 30
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
    "masks as .png, a folder of these, or .json with run lengths of COCO: "
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
            raise InputError(f"the folder has no .png; expected {EXPECTED}", path)
        return _within_memory(_read_png(file) for file in files)
    if path.suffix.lower() == ".png":
        return [_read_png(path)]
    text = read_text(path, EXPECTED)
    try:
        content = parse_json(text)
    except ValueError as error:
        raise InputError(f"cannot be read ({reason(error)}); expected {EXPECTED}", path) from error
    if isinstance(content, dict) and "annotations" in content:
        content = content["annotations"]
    entries = content if isinstance(content, list) else [content]
    if not entries:
        raise InputError(f"found 0 masks; expected {EXPECTED}", path)
    with located(path):
        return _within_memory(
            decoded(entry.get("segmentation", entry) if isinstance(entry, dict) else entry)
            for entry in entries
        )


def _within_memory(masks: Iterable[Mask]) -> list[Mask]:
    """Return the masks as a list, unless this machine's memory cannot take them."""
    kept: list[Mask] = []
    size_bytes = 0
    for mask in masks:
        kept.append(mask)
        size_bytes += mask.size
        require_plausible_size("of all masks", (len(kept), *mask.shape), size_bytes, size_bytes)
    return kept


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
        raise InputError(f"cannot be read ({reason(error)}); expected {EXPECTED}", file) from error
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
    InputError
        If there is no size or it is too large, or the counts do not have it.
    """
    rows, columns = _size(run_lengths)
    counts = run_lengths["counts"]
    counts = _uncompressed(counts) if isinstance(counts, str) else counts
    pixels = rows * columns
    lengths: list[int] = []
    end = 0
    for count in counts if isinstance(counts, Iterable) else ():
        if type(count) is not int or not 0 <= count <= pixels - end:
            raise InputError(
                f"found the count {reprlib.repr(count)} after {end} of {rows} x {columns} pixels; expected "
                f"whole numbers of pixels whose sum is {pixels}"
            )
        end += count
        lengths.append(count)
    if end != pixels:
        raise InputError(f"the counts have {end} pixels for {rows} x {columns}")
    inside = np.arange(len(lengths)) % 2 == 1
    return np.repeat(inside, lengths).reshape(columns, rows).T


def _size(run_lengths: Any) -> tuple[int, int]:
    """Return rows and columns of run lengths."""
    stated = isinstance(run_lengths, dict) and "counts" in run_lengths
    size = run_lengths.get("size") if stated else None
    if not (
        isinstance(size, list | tuple)
        and len(size) == 2
        and all(type(each) is int and each > 0 for each in size)
    ):
        raise InputError(f"found no run lengths; expected {EXPECTED}")
    rows, columns = size
    if rows * columns > (Image.MAX_IMAGE_PIXELS or np.inf):
        raise InputError(
            f"found a mask of {rows} x {columns} pixels; expected at most {Image.MAX_IMAGE_PIXELS}"
        )
    return rows, columns


def encoded(mask: Mask) -> dict[str, Any]:
    """Return the uncompressed run lengths of a mask (rows, columns)."""
    flat = np.concatenate([[False], mask.T.ravel()])
    ends = np.append(np.flatnonzero(flat[1:] != flat[:-1]), mask.size)
    counts = np.diff(ends, prepend=0)
    return {"size": list(mask.shape), "counts": counts.tolist()}


def _uncompressed(text: str) -> Iterator[int]:
    """Yield the counts of a text, in which a character has five bits of a number and one that says
    whether more follow; from the third on, numbers are differences from the last but one.
    """
    before = last = value = shift = index = 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64 or shift > LONGEST_SHIFT:
            raise InputError(f"found {character!r} in a text of counts; expected those of COCO")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        before, last = last, value + (before if index > 2 else 0)
        yield last
        index += 1
        value = shift = 0
    if shift:
        raise InputError("a text of counts ends within a number; expected a complete text")
