"""Journal paper: citations and sections."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAPER = (ROOT / "paper.md").read_text(encoding="utf-8")
REFERENCES = (ROOT / "paper.bib").read_text(encoding="utf-8")
# Headings that the journal expects, in this order.
SECTIONS = ("Summary", "Statement of need", "State of the field", "Software design",
            "Research impact statement", "Acknowledgements", "References")  # fmt: skip


def test_every_citation_has_a_reference_and_every_reference_is_cited():
    cited = set(re.findall(r"@([a-z]+\d{4})", PAPER.split("---", 2)[2]))
    assert cited == set(re.findall(r"^@\w+\{(\w+),", REFERENCES, flags=re.MULTILINE))


def test_every_reference_has_an_identifier():
    entries = re.split(r"^@", REFERENCES, flags=re.MULTILINE)[1:]
    assert [each for each in entries if not re.search(r"doi\s*= \{10\.\d{4,5}/\S+\}", each)] == []


def test_the_sections_are_those_of_the_journal():
    assert tuple(re.findall(r"^# (.+)$", PAPER, flags=re.MULTILINE)) == SECTIONS


@pytest.mark.parametrize("number", ["734", "183", "200.01", "300.02"])
def test_numbers_of_the_comparison_are_those_of_its_page(number: str):
    assert number in PAPER
    table = (ROOT / "docs" / "studies" / "table1.md").read_text(encoding="utf-8")
    rounded = {f"{float(each):.0f}" for each in re.findall(r"\d+\.\d+", table)}
    assert number in table or number in rounded
