"""Pages of the documentation in a terminal, and the references of messages and reports."""

from __future__ import annotations

import io
import re
from email.message import Message
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from kit import depth
from kit.problem_files import run_command

import collocation_sysid as cs
from collocation_sysid import Problem, run
from collocation_sysid.cli.texts import TerminalPage, _key_table, _word_table
from collocation_sysid.common.display import PlainConsole, Table, plain_text
from collocation_sysid.common.pages import page_files, page_text, page_url, search_pages
from collocation_sysid.fem.laws.constants import KNOWN, constants_with_symbol
from collocation_sysid.problem.key_descriptions import all_keys, find_keys
from collocation_sysid.problem.new import create_problem
from collocation_sysid.recording.nuisance import KINDS
from collocation_sysid.result.run_sections import remedy_command, remedy_lines
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.result_content import Result
from collocation_sysid.statistics.budget.systematic_effects import ASSUMPTIONS, source_label
from collocation_sysid.statistics.concerns import REMEDIES, TOPICS, Concern

CONCERNS = (Concern("residuals/persist"), Concern("scheme/damping"), Concern("solve/no-start"))


def test_topics_are_listed_with_a_line_each():
    lines = run_command("explain").out.splitlines()
    assert len(lines) == 1 + len(page_files())
    assert next(line for line in lines if line.startswith("trust")).split(maxsplit=1)[
        1
    ].strip() == ("Trust in an answer")


def test_a_page_is_shown_with_its_links_as_topics():
    shown = run_command("explain", "trust").out
    assert shown.startswith("# Trust in an answer\n")
    assert "its estimates and their combined intervals (`explain budget`)." in " ".join(
        shown.split()
    )
    for topic in page_files():
        assert not re.search(r"\]\((?!https?:)[^)]*\.md\)", page_text(topic)), topic


def test_an_unknown_topic_is_refused_with_the_likely_one():
    outcome = run_command("explain", "trusst")
    assert outcome.code == 2
    assert "TOPIC: found 'trusst'; expected a topic that `explain` lists" in outcome.err
    assert "did you mean 'trust'?" in outcome.err


def test_other_words_are_searched_in_the_text_of_the_pages():
    best = {
        "rolling shutter": "image_tracks",
        "rope": "cables",
        "Poisson": "material",
        "tendon": "actuation",
        "phone video": "image_tracks",
        "export to MuJoCo": "simulators",
        "gravity of a scanned mesh": "mesh",
    }
    for words, page in best.items():
        pages = [topic for topic, _, _ in search_pages(words)]
        assert pages[0] == page, words
        assert len(pages) == len({*pages}) <= 5
    # Words are compared from their beginning, and programs are no text.
    assert {topic for topic, _, _ in search_pages("rope")} == {"cables"}
    (first, *_) = run_command("explain", "rolling shutter").out.splitlines()[1:]
    assert "explain image_tracks" in first


def test_a_word_of_no_page_is_refused_in_a_short_line():
    outcome = run_command("explain", "qwertz")
    assert (outcome.code, outcome.out) == (2, "")
    assert len(outcome.err) < 200


def test_keys_of_the_problem_file_are_explained():
    shown = run_command("explain", "resample_hz").out
    assert "experiment.resample_hz" in shown
    assert "number > 0" in shown
    assert "lost frames are missing samples" in shown
    several = run_command("explain", "sigma_m").out
    assert "experiment.markers.sigma_m" in several
    assert "experiment.grasp.sigma_m" in several
    one = run_command("explain", "markers.sigma_m").out
    assert "experiment.markers.sigma_m" in one
    assert "experiment.grasp.sigma_m" not in one
    outcome = run_command("explain", "resampel_hz")
    assert outcome.code == 2
    assert "a key of the problem file, or a word of the output" in outcome.err
    assert "did you mean 'resample_hz'?" in outcome.err


def test_every_key_of_the_problem_file_has_a_path_of_the_schema():
    paths = [each.path for each in all_keys()]
    assert len(paths) > 200
    for path in ("title", "experiment.nuisance.tare.prior_sigmas"):
        assert path in paths, path
    assert find_keys("igma_m") == []  # whole names only


def test_code_of_a_page_can_be_copied_from_a_narrow_terminal():
    file = io.StringIO()
    console = PlainConsole(file=file, width=40, force_terminal=True, color_system=None)
    console.print(TerminalPage(page_text("forces"), hyperlinks=False), crop=False)
    (line,) = [each for each in page_text("forces").splitlines() if each.startswith("wrench = {")]
    assert len(line) > 40
    assert line in [each.strip() for each in file.getvalue().splitlines()]
    prose = [each for each in file.getvalue().splitlines() if each.startswith("Markers alone")]
    assert all(len(each.rstrip()) <= 40 for each in prose)


def test_the_advised_command_works():
    (line,) = remedy_command(CONCERNS)
    said = plain_text(line)
    assert said == "what to do: collocation-sysid explain trust scheme"
    shown = run_command(*said.removeprefix("what to do: ").split()[1:])
    assert shown.code == 0
    assert "# Trust in an answer\n" in shown.out
    assert "# Choosing a scheme\n" in shown.out


def test_every_topic_of_concerns_has_a_page():
    assert {topic.page for topic in TOPICS.values()} <= page_files().keys()


@pytest.mark.parametrize("base", [None, "https://example.org/docs/"])
def test_reports_link_to_the_documentation_that_the_project_states(
    base: str | None, monkeypatch: pytest.MonkeyPatch
):
    stated = Message()
    stated["Project-URL"] = "Source, https://example.org/code"
    if base is not None:
        stated["Project-URL"] = f"Documentation, {base}"
    monkeypatch.setattr(metadata, "metadata", lambda name: stated)
    links = [span.to for cure in remedy_lines(CONCERNS) for span in cure.to_spans() if span.to]
    if base is None:
        assert page_url("theory") is None
        assert links == []
    else:
        assert page_url("theory") == f"{base}theory.html"
        assert links[0] == f"{base}howto/trust.html"
        assert len(links) == len(CONCERNS)


def test_every_key_has_a_table():
    for each in all_keys():
        assert _key_table(each.path).rows, each.path


def test_every_printed_constant_has_a_meaning():
    for name, constant in KNOWN.items():
        for word in (name, constant.symbol):
            assert any(row[0] == name and row[2] for row in _word_table(word).rows), word


def test_every_row_of_the_budget_is_explained():
    sources = [*REMEDIES, *(part for each in ASSUMPTIONS for part in each.components)]
    for source in sources:
        (row,) = _word_table(source_label(source)).rows[-1:]
        assert row[1] == "uncertainty", source


@pytest.mark.parametrize(
    ("word", "names"),
    [
        ("E", ["young_pa"]),
        ("nu", ["poisson"]),
        ("ν", ["poisson"]),
        ("lambda", ["lambda_pa"]),
        ("mu", ["mu_pa"]),
        ("gamma", ["gamma_r_s", "gamma_m_1_s"]),
        ("x", []),
    ],
)
def test_symbols_name_constants(word: str, names: list[str]):
    assert constants_with_symbol(word) == names


def test_labels_are_explained_by_the_command():
    shown = " ".join(run_command("explain", "grip layer", "E").out.split())
    assert "grip_layer_m" in shown
    assert "hold the body more stiffly" in shown
    assert "young_pa" in shown


def test_every_kind_of_nuisance_parameter_is_explained():
    for row in KINDS:
        said = (row.label.format(which="tip", axis="x"), row.sentence.split(":")[0], row.key)
        for word in said:
            if word and "{" not in word and word != "tip":
                names = [each[0] for each in _word_table(word).rows]
                assert (row.key or row.name) in names, word


def _problem_of_kind(folder: Path, kind: str) -> Problem:
    """A template, or a bar that a depth camera sees."""
    if kind != "depth":
        create_problem(folder / "strip", kind)
        return Problem.read(folder / "strip" / "problem.toml")
    camera = cs.DepthCamera(depth.MATRIX, pose=depth.POSE)
    image_m = depth.noisy(np.random.default_rng(3))
    seen = depth.hanging((cs.Depth.of_images("front", image_m, camera, depth.NOISE_M),))
    parameters = depth.TRUTH | {"young_pa": cs.Unknown(2e5)}
    return Problem([seen], cs.Parameters.from_mapping(parameters))


def _lines(result: Result, details: bool) -> list[str]:
    """The lines of the summary of a solve that are no tables."""
    shown = run_summary(result, details=details)
    return plain_text([e for e in shown if not isinstance(e, Table)], width=10_000).splitlines()


@pytest.mark.long
@pytest.mark.parametrize("kind", ["specimen", "compression", "swing", "depth"])
def test_every_word_that_a_solve_prints_is_explained(tmp_path, kind: str):
    """Heads and rows of tables, labels at the beginning of a line, and keys."""
    found = run(_problem_of_kind(tmp_path, kind), seek_causes=False)
    shown = run_summary(found.result, details=True, budget=True)
    tables = [each for each in shown if isinstance(each, Table)]
    assert len(tables) > 1
    words = {cell for table in tables for cell in table.heads} - {"", "value"}
    rows = [row[0] for table in tables for row in table.rows]
    words |= {
        re.sub(r"(°| (Pa|kPa|MPa|GPa|s|1/s|%|mm|ms|g|mN m|px|1/m²|m/N|1/K))$", "", row)
        for row in rows
    }
    for each in found.result.fit.experiments.values():
        words |= {re.sub(r"\d+ ", "", re.split("[:,]", note)[0]) for note in each.notes}
    for each in found.result.nuisance.values():
        words |= {label.rpartition(" [")[0] for label in each}
    words |= {"fit", "forward simulation", "reduced χ²", found.trust.verdict}
    texts = [text for each in (False, True) for text in _lines(found.result, details=each)]
    labels = {label[1] for text in texts if (label := re.match(r"([^:;.,()']{1,40}): ", text))}
    assert {"Verdict", "note"} <= labels
    words |= {label.split(" of ")[0] for label in labels}
    # Markers and files of the examples have names of the same form.
    keys = {key for text in texts for key in re.findall(r"(?<![\w/])[a-z]+(?:_[a-z0-9]+)+\b", text)}
    words |= {key for key in keys if not re.fullmatch(r"(run|end)_\d", key)}
    shown_of = {word: run_command("explain", word) for word in sorted(words)}
    # Words that are only found in the text of pages are not explained.
    unknown = [w for w, each in shown_of.items() if each.code or each.out.startswith("page ")]
    assert unknown == []


@pytest.mark.parametrize(
    ("symbol", "name"), [("E", "young_pa"), ("nu", "poisson"), ("ν", "poisson")]
)
def test_a_symbol_among_the_parameters_names_the_key(tmp_path: Path, symbol: str, name: str):
    assert run_command("new", tmp_path / "bench", "--kind", "compression").code == 0
    file = tmp_path / "bench" / "problem.toml"
    text = file.read_text()
    file.write_text(re.sub(rf"^{name} +=", f'"{symbol}" =', text, flags=re.MULTILINE))
    outcome = run_command("check", file)
    assert outcome.code == 2
    assert f"did you mean {name!r}?" in outcome.err


def test_a_key_is_shown_with_the_pages_about_it():
    shown = run_command("explain", "ipopt").out
    assert "solver.interior-point.ipopt" in shown
    assert "explain optimal_control" in shown
