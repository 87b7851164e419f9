"""HTML reports: content, and complete display in a browser."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from kit.problem_files import pictures_drawn, run_command, settings, write_problem
from kit.results import ROLLOUT, a_result

from collocation_sysid.common.display import plain_text
from collocation_sysid.common.serialisation import as_json
from collocation_sysid.features.measurements import SimulatedExperiment
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.result_content import Result
from collocation_sysid.statistics.assessment import Assessment
from collocation_sysid.statistics.concerns import TOPICS, Concern

pytestmark = pytest.mark.long

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WIDTHS = {"narrow": 380, "wide": 1280}


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reported")
    write_problem(folder, {"swing": 8, "turn": 6})
    out = folder / "run"
    method = settings("solver.method=reduced-space")
    with pictures_drawn():
        solved = run_command("solve", folder / "problem.toml", *method, "--out", out)
    assert solved.code == 0
    (folder / "printed.txt").write_text(solved.out)
    return out


@pytest.fixture(scope="module")
def page(run_folder: Path) -> str:
    outcome = run_command("report", run_folder)
    assert outcome.code == 0
    assert Path(outcome.out.strip()) == run_folder / "report.html"
    return (run_folder / "report.html").read_text()


def test_a_report_may_be_markdown(run_folder: Path, page: str):
    assert run_command("report", run_folder, "--to", run_folder / "report.md").code == 0
    text = (run_folder / "report.md").read_text()
    assert text.count("![") == len(Elements(page).images)
    for line in ("## Parameters", "## Residuals", "| marker | RMS | samples | diagnosis |"):
        assert line in text.splitlines()
    assert all((run_folder / name).is_file() for name in re.findall(r"\]\((.*?\.png)\)", text))


class Elements(HTMLParser):
    """Sources of images, text, and addresses that lead outside."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.images: list[str] = []
        self.outside: list[str] = []
        self.words: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attributes: list) -> None:
        given = dict(attributes)
        if tag == "img":
            assert given.get("alt")
            self.images.append(given["src"])
        for key in ("src", "href"):
            if (given.get(key) or "").startswith(("http", "//", "file")):
                self.outside.append(given[key])

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


def test_the_page_holds_everything(page: str, run_folder: Path):
    found = Elements(page)
    assert len(found.images) == len(list(run_folder.glob("*.png"))) >= 4
    assert all(image.startswith("data:image/png;base64,") for image in found.images)
    assert not found.outside
    result = json.loads((run_folder / "result.json").read_text())
    for words in (
        "E Pa",
        "λ Pa",
        "γ_r s",
        "95 % interval",
        "swing/low",
        result["provenance"]["casadi"],
    ):
        assert words in found.text
    assert "The problem file as run" in found.text


def test_a_figure_of_measurement_and_fit_stands_before_the_tables(page: str):
    first, *others = (match.start() for match in re.finditer("<figure", page))
    assert first < page.index("<table")
    assert first < page.index("<h2")
    assert page.index("Measured, fitted and simulated markers") < others[0]


def test_text_is_escaped(run_folder: Path, tmp_path: Path):
    copy = tmp_path / "run"
    shutil.copytree(run_folder, copy)
    result = json.loads((copy / "result.json").read_text())
    result["title"] = "<script>alert(1)</script>"
    (copy / "result.json").write_text(json.dumps(result))
    run_command("report", copy)
    assert "<script>" not in (copy / "report.html").read_text()


def test_the_page_contains_the_output_of_the_terminal(page: str, run_folder: Path):
    result = Result.read(run_folder)
    shown = plain_text(run_summary(result, run_folder, details=True)).splitlines()
    text = Elements(page).text
    assert sum("forward simulation 'swing': " in line for line in shown) == 1
    for line in shown[:-1]:  # which names the folder
        if not line.startswith(("residuals: ", "what to do: ")):  # a table and a section there
            assert all(word in text for word in line.split())


def test_a_result_read_back_is_shown_unchanged(run_folder: Path):
    """Nothing but the file is needed for what the terminal showed after the solve."""
    printed = (run_folder.parent / "printed.txt").read_text()
    shown = plain_text(run_summary(Result.read(run_folder), run_folder)).split()
    assert printed.split()[: len(shown)] == shown
    assert printed.split()[len(shown)] == "next:"


def test_failures_and_predictions_are_reported():
    experiments = {
        "a": SimulatedExperiment(fitted=True, failed="no step"),
        "b": SimulatedExperiment(fitted=False, rms_m=3e-3, max_m=4e-3),
    }
    told = a_result(rollout=replace(ROLLOUT, experiments=experiments))
    said = plain_text(run_summary(told, Path("run"))).splitlines()
    rows = [line.split(maxsplit=2) for line in said]
    assert ["a", "validation", "failed: no step"] in rows
    assert ["b", "validation", "3.000 mm RMS, at most 4.00 mm"] in rows
    said = plain_text(run_summary(told, Path("run"), details=True)).splitlines()
    assert "forward simulation 'a': failed: no step" in said
    assert "validation 'b': 3.000 mm RMS, at most 4.00 mm" in said


def test_folders_without_a_run_are_refused(tmp_path: Path):
    outcome = run_command("report", tmp_path)
    assert outcome.code == 2
    assert "this is not a run folder: it has no result.json" in outcome.err
    (tmp_path / "result.json").write_text("{")
    assert "result.json is damaged" in run_command("report", tmp_path).err
    assert not (tmp_path / "report.html").exists()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.parametrize("width", WIDTHS.values(), ids=WIDTHS)
def test_a_browser_shows_the_page_whole(page: str, run_folder: Path, tmp_path: Path, width: int):
    """No missing picture, no script error, and nothing but tables wider than the window."""
    assert CHROMIUM is not None
    probe = """<script>window.onload = () => {
      const broken = [...document.images].filter(i => !i.complete || !i.naturalWidth).length;
      const wide = [...document.body.querySelectorAll("*")].filter(e => !e.closest(".scroll, pre")
        && e.getBoundingClientRect().right > innerWidth + 1).length;
      document.title = `broken ${broken} wide ${wide} images ${document.images.length}`;
    };</script>"""
    file = tmp_path / "probe.html"
    file.write_text(page.replace("</body>", f"{probe}</body>"))
    done = subprocess.run(
        [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
            "--disable-background-networking", f"--user-data-dir={tmp_path / 'profile'}",
            f"--window-size={width},900", "--virtual-time-budget=4000", "--dump-dom", file.as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    title = re.search(r"<title>(.*?)</title>", done.stdout)
    assert title is not None
    count = len(list(run_folder.glob("*.png")))
    assert title.group(1) == f"broken 0 wide 0 images {count}"


def test_concerns_name_their_remedy(run_folder: Path, tmp_path: Path):
    copy = tmp_path / "run"
    shutil.copytree(run_folder, copy)
    whole = Result.read(copy)
    data = {"name": "mu_pa", "change": "+3 %", "errors": 4.0}
    concerns = (
        Concern(
            "scheme/damping", data=data | {"added": 0.1, "damping": 0.1, "experiment": "swing"}
        ),
        Concern("information/bound", data=data | {"names": ["mu_pa"]}),
    )
    (copy / "result.json").write_text(
        as_json(replace(whole, trust=Assessment.from_concerns(concerns)))
    )
    run_command("report", copy)
    page = (copy / "report.html").read_text()
    for topic in ("scheme", "information"):
        assert page.count(f'href="#cure-{topic}"') == page.count(f'id="cure-{topic}"') == 1
    assert "<code>collocation-sysid explain scheme</code>" in page
    assert "mu_pa ended at a bound" in page
    assert "usable after checking the reasons below" in page


def test_every_remedy_names_a_page_that_is_there():
    howto = Path(__file__).parents[2] / "docs" / "howto"
    assert all((howto / f"{topic.page}.md").is_file() for topic in TOPICS.values())
