"""The HTML pages: what they say, and that a browser shows them whole."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
from problem_files import TRUTH, pictures_drawn, run_command, settings, write_problem

from collocation_sysid.output.remedies import LAST, REMEDIES, remedies_for, remedy_for
from collocation_sysid.output.report.run_page import verdict

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
        assert run_command("solve", folder / "problem.toml", *method, "--out", out).code == 0
    return out


@pytest.fixture(scope="module")
def page(run_folder: Path) -> str:
    outcome = run_command("report", run_folder)
    assert outcome.code == 0
    assert Path(outcome.out.strip()) == run_folder / "report.html"
    return (run_folder / "report.html").read_text()


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


def test_text_is_escaped(run_folder: Path, tmp_path: Path):
    copy = tmp_path / "run"
    shutil.copytree(run_folder, copy)
    result = json.loads((copy / "result.json").read_text())
    result["title"] = "<script>alert(1)</script>"
    (copy / "result.json").write_text(json.dumps(result))
    run_command("report", copy)
    assert "<script>" not in (copy / "report.html").read_text()


def result_with(**changes) -> dict:
    parameter = {"value": 100.0, "std_error": 1.0, "fixed": False}
    return {
        "message": "Converged.",
        "converged": True,
        "parameters": {"lambda_pa": parameter | changes},
        "fit": {"rms_m": 1e-3},
        "rollout": {"rms_m": 0.8e-3, "max_m": 2e-3, "experiments": {}},
    }


def test_the_verdict_tells_how_well_parameters_are_identified():
    assert "λ is least well, but well identified: ±2 %." in verdict(result_with())
    assert "λ is weakly identified: ±39 %." in verdict(result_with(std_error=20.0))
    assert "No error bar for λ: see the notes." in verdict(result_with(std_error=None))
    assert "the roll-out misses by 0.8 mm, at most 2 mm" in verdict(result_with())[-1]


def test_the_verdict_tells_of_failures_and_predictions():
    result = result_with()
    result["rollout"]["experiments"] = {
        "a": {"failed": "no step", "fitted": True},
        "b": {"rms_m": 3e-3, "fitted": False},
    }
    said = verdict(result)
    assert "The roll-out of 'a' failed: no step." in said
    assert "'b' was predicted, not fitted: 3 mm RMS." in said


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


# Comparisons


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compared")
    write_problem(folder, {"swing": 6})
    truth = ",".join(f"{name}={value}" for name, value in TRUTH.items())
    methods = ("--methods", "reduced-space,shooting", "--truth", truth)
    out = folder / "compare"
    outcome = run_command("compare", folder / "problem.toml", *methods, "--out", out)
    assert outcome.code == 0, outcome.err
    return out


def test_a_comparison_has_a_page_too(comparison: Path):
    outcome = run_command("report", comparison)
    assert outcome.code == 0, outcome.err
    found = Elements((comparison / "report.html").read_text())
    assert len(found.images) == len(list(comparison.glob("*.png"))) > 0
    for words in ("Success", "reduced-space", "shooting", "within 1 %", "Runs"):
        assert words in found.text
    assert not found.outside


def test_a_damaged_comparison_is_refused(comparison: Path, tmp_path: Path):
    (tmp_path / "summary.json").write_text('{"schema": 2, "kind": "compare"}')
    outcome = run_command("report", tmp_path)
    assert outcome.code == 2
    assert "summary.json is damaged" in outcome.err


def test_concerns_lead_to_what_cures_them(run_folder: Path, tmp_path: Path):
    copy = tmp_path / "run"
    shutil.copytree(run_folder, copy)
    result = json.loads((copy / "result.json").read_text())
    reasons = [
        "the step moves mu_pa by 3 %, 4 standard errors: halve it",
        "mu_pa ended at its bound",
    ]
    result["trust"] = {"verdict": "check", "reasons": reasons}
    (copy / "result.json").write_text(json.dumps(result))
    run_command("report", copy)
    page = (copy / "report.html").read_text()
    for remedy in remedies_for(reasons):
        assert page.count(f'href="#{remedy.anchor}"') == page.count(f'id="{remedy.anchor}"') == 1
    assert "docs/howto/scheme.md" in page
    assert "usable after a look at the reasons" in page


def test_every_remedy_names_a_page_that_is_there():
    howto = Path(__file__).parents[1] / "docs" / "howto"
    for remedy in (*REMEDIES, LAST):
        assert (howto / f"{remedy.page}.md").is_file()
    assert remedy_for("something new") is LAST


@pytest.mark.parametrize(
    ("warning", "page"),
    [
        ("the residuals are 3 times as large as sigma_m says", "verdict"),
        ("sigma_n seems 4 times too large for these residuals", "verdict"),
        ("only the ratios of E can be told (E/ρ): …; fix a density", "forces"),
        ("the body is 120 m large; expected 0.0001 to 10 m", "wrong_description"),
        ("'swing': gravity seems to point along +y (5 times nearer)", "wrong_description"),
        ("the grasp of 'swing' cuts through elements", "wrong_description"),
        ("only about 1.0 tet4 elements lie across the body's 30 mm", "mesh"),
        ("marker 'tip' of 'swing' is never seen: leave it out of names", "motion_capture"),
        ("the first mode of 'swing' (3 Hz at the guess) has only 5.0 steps a period", "scheme"),
        ("the first mode of 'swing' (3 Hz at the guess) has only 3.0 samples a period", "trust"),
        ("interior-point will take about 40 GB, more than this machine's 24 GB", "large"),
    ],
)
def test_a_warning_leads_to_the_page_that_cures_it(warning: str, page: str):
    assert remedy_for(warning).page == page
