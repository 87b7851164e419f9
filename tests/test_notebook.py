"""The teaching notebook: its cells run, and the executed notebook is that of the script."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path

import IPython.display
import pytest
from matplotlib.figure import Figure

FOLDER = Path(__file__).parents[1] / "scripts" / "notebooks"
SCRIPT = FOLDER / "collocation_from_scratch.py"
NOTEBOOK = SCRIPT.with_suffix(".ipynb")
LARGEST_BYTES = 1_500_000
FIGURES = 17

CELL = re.compile(r"^# %%( \[markdown\])?.*\n", re.MULTILINE)


def script_cells() -> list[tuple[str, str]]:
    """(type, source) of every cell of the script; magics and prose without their comment signs."""
    _, *parts = CELL.split(SCRIPT.read_text())
    cells = []
    for marker, text in zip(parts[::2], parts[1::2], strict=True):
        if marker:
            cells.append(("markdown", re.sub(r"^# ?", "", text, flags=re.MULTILINE).strip()))
        else:
            cells.append(("code", text.replace("# %matplotlib", "%matplotlib").strip()))
    return cells


def notebook_cells() -> list[dict]:
    return json.loads(NOTEBOOK.read_text())["cells"]


@pytest.mark.long
def test_the_cells_run_from_top_to_bottom(monkeypatch: pytest.MonkeyPatch) -> None:
    """The notebook states numbers; its own assertions check them."""
    drawn: list[Figure] = []

    def draw(figure: Figure) -> None:
        figure.draw_without_rendering()
        drawn.append(figure)

    monkeypatch.chdir(FOLDER)
    monkeypatch.setattr(IPython.display, "display", draw)
    runpy.run_path(str(SCRIPT))
    assert len(drawn) == FIGURES


def test_the_notebook_holds_the_cells_of_the_script() -> None:
    found = [(cell["cell_type"], "".join(cell["source"]).strip()) for cell in notebook_cells()]
    assert found == script_cells(), "run scripts/notebooks/execute.py"


def test_the_notebook_was_executed_in_order_without_errors() -> None:
    code = [cell for cell in notebook_cells() if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    kinds = {output["output_type"] for cell in code for output in cell["outputs"]}
    assert "error" not in kinds
    pictures = [o for cell in code for o in cell["outputs"] if "image/png" in o.get("data", {})]
    assert len(pictures) == FIGURES
    assert NOTEBOOK.stat().st_size < LARGEST_BYTES


@pytest.mark.slow
def test_the_notebook_executes_in_a_kernel() -> None:
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    resources = {"metadata": {"path": str(FOLDER)}}
    nbclient.NotebookClient(notebook, timeout=600, resources=resources).execute()
