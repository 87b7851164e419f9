"""Run a script of one of the folders; scripts import those of the other folders by name.

python scripts                                # list of all scripts
python scripts study_starts --starts 20
"""

from __future__ import annotations

import ast
import os
import runpy
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
FOLDERS = [HERE / name for name in ("corpus", "data", "studies", "benchmarks", "tools")]


def main() -> None:
    """Run the script that the command line names, or list all."""
    _, *arguments = sys.argv
    files = {file.stem: file for folder in FOLDERS for file in sorted(folder.glob("*.py"))}
    if not arguments or arguments[0] not in files:
        for folder in FOLDERS:
            print(f"\n{folder.name}")
            for file in sorted(folder.glob("*.py")):
                text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
                print(f"  {file.stem:28}{text.splitlines()[0]}")
        sys.exit(f"\nunknown script: {arguments[0]}" if arguments else 0)
    paths = [str(folder) for folder in FOLDERS]
    sys.path[:1] = paths
    # For the processes that a script starts.
    os.environ["PYTHONPATH"] = os.pathsep.join([*paths, os.environ.get("PYTHONPATH", "")]).rstrip(
        os.pathsep
    )
    sys.argv = [str(files[arguments[0]]), *arguments[1:]]
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
