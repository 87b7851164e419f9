"""Cells of the tutorial's notebooks run, and executed notebooks agree with their scripts."""

from __future__ import annotations

import ast
import json
import re
import runpy
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

import collocation_sysid

FOLDER = Path(__file__).parents[2] / "scripts" / "notebooks"
PACKAGE = collocation_sysid.__name__
# Pictures and tables of a notebook that readers on slow connections can still open [bytes].
LARGEST_BYTES = 1_500_000
FIGURES = {"1_spring_and_tetrahedron": 10, "2_cylinder": 4, "3_trust": 5, "4_plan": 1}

CELL = re.compile(r"^# %%( \[markdown\])?.*\n", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#]+)\)")

each_notebook = pytest.mark.parametrize("name", FIGURES)


def script_cells(name: str) -> list[tuple[str, str]]:
    """Return (type, source) of every cell of a script; magics and texts without comment signs."""
    _, *parts = CELL.split((FOLDER / f"{name}.py").read_text(encoding="utf-8"))
    cells = []
    for marker, text in zip(parts[::2], parts[1::2], strict=True):
        if marker:
            cells.append(("markdown", re.sub(r"^# ?", "", text, flags=re.MULTILINE).strip()))
        else:
            cells.append(("code", text.replace("# %matplotlib", "%matplotlib").strip()))
    return cells


def notebook_cells(name: str) -> list[dict]:
    """Return the cells of an executed notebook."""
    return json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]


def internal_names(source: str) -> set[str]:
    """Return what a script uses of the package other than its public names.

    That is every import except `import collocation_sysid as cs`, and every `cs.name` that is not
    in `__all__`.
    """
    found = set()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import(names=names):
                imported = {(each.name, each.asname) for each in names} - {(PACKAGE, "cs")}
                found |= {module for module, _ in imported if module.split(".")[0] == PACKAGE}
            case ast.ImportFrom(module=str(module)) if module.split(".")[0] == PACKAGE:
                found.add(module)
            case ast.Attribute(value=ast.Name(id="cs"), attr=name):
                found |= {f"cs.{name}"} - {f"cs.{public}" for public in collocation_sysid.__all__}
    return found


def test_all_notebooks_are_tested() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == sorted(FIGURES)


@pytest.mark.long
@each_notebook
def test_the_cells_run_from_top_to_bottom_in_any_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The texts state numbers; the assertions of the cells check them."""
    count = 0

    def draw() -> None:
        nonlocal count
        for number in plt.get_fignums():
            plt.figure(number).canvas.draw()
            count += 1
        plt.close("all")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", draw)
    with plt.rc_context():
        plt.switch_backend("agg")
        runpy.run_path(str(FOLDER / f"{name}.py"))
    assert count == FIGURES[name]


@each_notebook
def test_a_notebook_holds_the_cells_of_its_script(name: str) -> None:
    cells = [(cell["cell_type"], "".join(cell["source"]).strip()) for cell in notebook_cells(name)]
    assert cells == script_cells(name), f"run scripts/notebooks/execute.py {name}"


@each_notebook
def test_a_notebook_was_executed_in_order_without_errors_and_warnings(name: str) -> None:
    code = [cell for cell in notebook_cells(name) if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert "error" not in {output["output_type"] for output in outputs}
    assert not [output["text"] for output in outputs if output.get("name") == "stderr"]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == FIGURES[name]
    assert (FOLDER / f"{name}.ipynb").stat().st_size < LARGEST_BYTES


@each_notebook
def test_a_notebook_uses_public_names_only(name: str) -> None:
    assert internal_names((FOLDER / f"{name}.py").read_text(encoding="utf-8")) == set()


def test_internal_names_are_found() -> None:
    source = (
        "import collocation_sysid as cs\n"
        "import collocation_sysid.fem.laws.moduli\n"
        "from collocation_sysid.runs.check import check_problem\n"
        "cs.run(cs.compute)\n"
    )
    expected = {"collocation_sysid.fem.laws.moduli", "collocation_sysid.runs.check", "cs.compute"}
    assert internal_names(source) == expected


@each_notebook
def test_links_lead_to_files(name: str) -> None:
    texts = [text for kind, text in script_cells(name) if kind == "markdown"]
    links = [link for text in texts for link in LINK.findall(text)]
    assert links
    assert not [link for link in links if not (FOLDER / link).exists()]


@pytest.mark.slow
@each_notebook
def test_a_notebook_executes_in_a_kernel(name: str) -> None:
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    resources = {"metadata": {"path": str(FOLDER)}}
    nbclient.NotebookClient(notebook, timeout=600, resources=resources).execute()
