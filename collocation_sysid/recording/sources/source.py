"""Tables and contents of files by their paths, of which one may name a topic of a log.

Readers begin here, and do not distinguish files from topics.
"""

from __future__ import annotations

from pathlib import Path

from ...common.files import require_regular, require_size
from ...errors import InputError
from .logs import TopicAddress
from .text import Table, decode, parse_table
from .topics import topic_table


def open_source(path: str | Path) -> Table | bytes:
    """Return the table of a topic of a log, or the content of a file.

    Raises
    ------
    InputError
        If it cannot be read; see `topic_table` for topics. The path is not named.
    """
    if (address := TopicAddress.from_path(path)) is not None:
        return topic_table(address)
    require_regular(path)
    require_size(path)
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"the file cannot be read: {error.strerror}") from error


def as_table(
    source: Table | bytes, header_line: int | None = None, names_required: bool = True
) -> Table:
    """Return the table of a source, whose text is parsed; arguments and errors as of `decode` and
    `parse_table`.
    """
    if isinstance(source, Table):
        return source
    return parse_table(decode(source), header_line, names_required)


def read_table(path: str | Path, header_line: int | None = None) -> Table:
    """Return the table of a file or of a topic; errors as of `open_source` and `as_table`."""
    return as_table(open_source(path), header_line)
