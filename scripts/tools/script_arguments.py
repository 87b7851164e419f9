"""Arguments of scripts: a parser whose help text is the description of the script as it is written."""

from __future__ import annotations

import argparse
import sys
import tempfile
import urllib.request
from collections.abc import Iterator, Mapping
from pathlib import Path


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser without options, whose `--help` prints the docstring `description` of a
    script with its own line breaks.
    """
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def require_no_arguments(description: str | None) -> None:
    """Read the command line of a script without arguments.

    `--help` prints the description and ends the script; any argument ends it with a message and
    exit code 2, so that a script that writes files never runs by mistake.
    """
    make_parser(description).parse_args()


def fetched_files(description: str | None, sources: Mapping[str, str]) -> Iterator[Path]:
    """Read the command line of a script that gets measured data, and yield its files one by one.

    `sources` has the address of each file by its name; with `--from FOLDER` the files are in a folder.
    """
    parser = make_parser(description)
    text = "folder that has the files; without it, they are downloaded"
    parser.add_argument("--from", dest="source", type=Path, help=text)
    source = parser.parse_args().source
    with tempfile.TemporaryDirectory() as folder:
        for name, address in sources.items():
            file = Path(source or folder) / name
            if source is None:
                urllib.request.urlretrieve(address, file)
            elif not file.is_file():
                sys.exit(f"{source} has no {name}")
            yield file
