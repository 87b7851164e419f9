"""Command line as ``python -m collocation_sysid``, where the command itself is not on the path."""

from .cli import main

if __name__ == "__main__":
    main()
