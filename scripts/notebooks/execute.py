"""Execute the scripts of the tutorial and write the notebooks: pip install -e '.[notebook]'.

Edit the scripts, not the notebooks. The ids of cells are their numbers and time stamps are left
out, so that the notebooks change little from one version to the next. Names of notebooks as
arguments restrict the execution to these; by default all are executed.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent
NAMES = ("1_spring_and_tetrahedron", "2_cylinder", "3_trust", "4_plan")
CELL_TIMEOUT_S = 600  # on slow machines the first run also compiles kernels


def execute(name: str) -> None:
    """Execute the script of a notebook, and write the notebook beside it."""
    notebook = jupytext.read(HERE / f"{name}.py")
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
    resources = {"metadata": {"path": str(HERE)}}
    client = NotebookClient(
        notebook, timeout=CELL_TIMEOUT_S, record_timing=False, resources=resources
    )
    start_s = time.perf_counter()
    client.execute()
    print(f"{name}: {time.perf_counter() - start_s:.0f} s")
    nbformat.write(notebook, HERE / f"{name}.ipynb")


def main() -> None:
    """Execute the notebooks named on the command line, or all."""
    for name in sys.argv[1:] or NAMES:
        execute(name)


if __name__ == "__main__":
    main()
