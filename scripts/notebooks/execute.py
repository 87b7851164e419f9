"""Execute the notebook's script and write the notebook beside it: pip install -e '.[notebook]'.

The script is what is edited; cell numbers as ids and no time stamps keep the notebook's diffs
small.
"""

from __future__ import annotations

from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent
NAME = "collocation_from_scratch"


def main() -> None:
    notebook = jupytext.read(HERE / f"{NAME}.py")
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
    resources = {"metadata": {"path": str(HERE)}}
    NotebookClient(notebook, timeout=600, record_timing=False, resources=resources).execute()
    nbformat.write(notebook, HERE / f"{NAME}.ipynb")


if __name__ == "__main__":
    main()
