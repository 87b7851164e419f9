"""Arguments of scripts that have none: `--help` prints their description, others are refused."""

from __future__ import annotations

import argparse


def require_no_arguments(description: str | None) -> None:
    """Read the command line of a script without arguments.

    `--help` prints the description and ends the script; any argument ends it with a message and exit
    code 2, so that a script that writes files never runs by mistake.

    Parameters
    ----------
    description : str or None
        Docstring of the script.
    """
    argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    ).parse_args()
