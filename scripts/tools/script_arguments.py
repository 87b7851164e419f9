"""Arguments of scripts: a parser whose help text is the description of the script as it is written."""

from __future__ import annotations

import argparse


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
