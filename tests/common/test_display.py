"""One description rendered for a terminal, a browser, Markdown and JSON."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from markdown_it import MarkdownIt
from markdown_it.token import Token

from collocation_sysid.common.display import (
    Cards,
    Line,
    Listing,
    Picture,
    PlainConsole,
    Shown,
    Span,
    Table,
    TitledParts,
    as_html,
    as_markdown,
    on_terminal,
    plain_text,
)
from collocation_sysid.errors import printable

NUMBERS = Table(
    "Estimates", ("", "value", ""), (("E Pa", "1500", "a|b"), ("ν", "0.3", "")), texts=1
)
REPORT = TitledParts(
    "Foam & <silicone>",
    (
        Line((Span("Verdict: check", "strong"), Span(", see "), Span("why", to="#cure")), "check"),
        Cards((("E", "1500 Pa", "±3"),)),
        NUMBERS,
        TitledParts("Notes", ("one", Listing("The file", "a = 1"))),
    ),
    level=1,
)


def test_a_terminal_shows_numbers_to_the_right_and_texts_to_the_left():
    lines = plain_text(REPORT).splitlines()
    assert lines[:2] == ["Foam & <silicone>", "Verdict: check, see why"]
    assert "E Pa   1500  a|b" in lines
    assert "ν       0.3" in lines
    assert lines[-4:] == ["Notes", "one", "The file", "a = 1"]


def test_plain_text_is_returned_also_in_jupyter_and_where_colours_are_forced(
    monkeypatch: pytest.MonkeyPatch,
):
    expected = plain_text(REPORT)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert expected
    assert plain_text(REPORT) == expected


ADDRESS = "trial.mcap#/a/topic/with/a/long/name/of_its_own#a_base_frame>a_tool_frame"


def shown_in(width: int, part: Shown, *, terminal: bool) -> list[str]:
    file = io.StringIO()
    console = PlainConsole(file=file, width=width, force_terminal=terminal, color_system=None)
    console.print(on_terminal(part), crop=False)
    return [line.rstrip() for line in file.getvalue().splitlines()]


def test_a_terminal_breaks_no_word_that_is_longer_than_its_lines():
    table = Table("", ("topic", "Hz", ""), (("/tf", "100", f"write {ADDRESS} there"),), texts=1)
    for part in (f"write {ADDRESS} there", table):
        lines = shown_in(40, part, terminal=True)
        assert any(ADDRESS in line for line in lines), part
    assert shown_in(40, f"write {ADDRESS} there", terminal=True) == ["write", ADDRESS, "there"]
    assert shown_in(12, "  two words and more", terminal=True) == ["  two words", "and more"]


def test_rows_are_lines_outside_a_terminal():
    table = Table(
        "", ("", "mooney-rivlin", *"abcde"), (("solver.key", *"12345", "above 0\nWhat it is."),)
    )
    head, row = plain_text(table, width=100_000).splitlines()
    assert "mooney-rivlin" in head
    assert row.split()[0] == "solver.key"
    assert row.endswith("above 0; What it is.")
    assert len(shown_in(200, table, terminal=True)) == 4  # two lines of heads, two of the row


def test_a_page_escapes_texts_and_leads_to_names():
    page = as_html(REPORT)
    assert "<h1>Foam &amp; &lt;silicone&gt;</h1>" in page
    assert (
        '<p class="check"><strong>Verdict: check</strong>, see <a href="#cure">why</a></p>' in page
    )
    assert '<tr><td>E Pa</td><td class="n">1500</td><td>a|b</td></tr>' in page
    assert "<details><summary>The file</summary><pre>a = 1</pre></details>" in page


def test_markdown_keeps_cells_apart():
    text = as_markdown([REPORT])
    assert text.startswith(
        "# Foam & \\<silicone>\n\n**Verdict: check**, see why\n\n- E: 1500 Pa (±3)\n"
    )
    assert "## Estimates\n\n|  | value |  |\n| --- | ---: | --- |\n| E Pa | 1500 | a\\|b |" in text
    assert "## Notes\n\none\n\nThe file:\n\n```\na = 1\n```" in text


HOSTILE = [
    "<script>alert(1)</script>",
    "[click](javascript:alert(1))",
    "<javascript:alert(1)>",
    "![x](http://elsewhere/x.png)",
    "swing\n\n## Verdict: good\n\nall is well",
    "# Verdict",
    "[x]: javascript:alert(1)",
    "- forged",
    "3. forged",
    "> forged",
    "---",
    "*a* _b_ __c__ **d** ~~e~~",
    "`a` ``b``",
    "a | b \\| c \\",
    "&lt;b&gt; &#x26;",
    "```\n# out\n```",
    "    indented",
    "<!-- hidden",
    "\x1b[2J\x00\u202e",
]


def markdown_tokens(name: str) -> list[Token]:
    """What a reader of Markdown finds where one text is everywhere in a description."""
    parts = (
        Line((Span(name, "strong"), Span(f" {name} ", "quiet"), Span(name, "code"))),
        name,
        Cards(((name, name, name),)),
        Table(name, (name, "b"), ((name, "1"), (name, "2"))),
        Picture(Path(f"{name.replace('/', '')}.png"), name),
        Listing(name, name),
    )
    reader = MarkdownIt().enable(["table", "strikethrough"])
    found = reader.parse(as_markdown([TitledParts(name, parts, level=1)]))
    return [one for each in found for one in (each, *(each.children or ()))]


@pytest.mark.parametrize("name", HOSTILE)
def test_markdown_shows_names_unchanged(name: str):
    def structure(name: str) -> list[tuple[str, int]]:
        tokens = markdown_tokens(name)
        return [(each.type, each.level) for each in tokens if not each.type.startswith("text")]

    assert structure(name) == structure("a name")
    line = " ".join(printable(name).split())
    texts = [
        " ".join("".join(child.content for child in each.children or ()).split())
        for each in markdown_tokens(name)
        if each.type == "inline"
    ]
    assert texts[:3] == [line, f"{line} {line} {line}", line]
    assert all(mark.isprintable() for text in texts for mark in text)


def test_a_page_has_no_control_characters():
    assert as_html(f"a{HOSTILE[-1]}") == "<p>a␛[2J␀\ufffd</p>\n"


def test_rows_of_another_length_are_refused():
    with pytest.raises(ValueError, match="rows of another length"):
        Table("", ("a", "b"), (("1",),))
