"""Command line as ``python -m collocation_sysid``, where the command itself is not on the path."""

import os
import sys

# With -m, Python searches the working folder for all modules; the ones of this package are found
# without it.
if not sys.flags.safe_path and sys.path and os.path.abspath(sys.path[0]) == os.getcwd():
    del sys.path[0]

from .cli import main

if __name__ == "__main__":
    main()
