"""Pages of the documentation, for readers who have the package and no checkout of its repository.

A wheel contains the pages (`force-include` in pyproject.toml); in a checkout they are in docs/.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np

_IN_WHEEL = Path(__file__).parents[1] / "documentation"
_IN_CHECKOUT = Path(__file__).parents[2] / "docs"
# Pages that Sphinx alone can show: lists of links and of names.
_FOR_SPHINX = ("index", "api")
# Label and topic of a link; the topic is empty where the link is to a section of the same page.
_LINK_TO_PAGE = re.compile(r"\[([^\]]*)\]\((?:(?:[\w.-]+/)*(\w+)\.md(?:#[\w-]*)?|#[\w-]+)\)")


def documentation_folder() -> Path:
    """Return the folder with the pages: that of the wheel if it exists, otherwise docs/ of the
    checkout, which need not exist.
    """
    return _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_CHECKOUT


@cache
def page_files() -> dict[str, Path]:
    """Return the file of each page by its topic, which is the file's name without its ending, in
    alphabetical order; cached.

    Pages for Sphinx alone (`_FOR_SPHINX`) are left out. The dictionary is empty where neither a
    wheel nor a checkout is installed.
    """
    folders = ("", "howto/", "studies/")
    files = [each for name in folders for each in documentation_folder().glob(f"{name}*.md")]
    return {
        file.stem: file for file in sorted(files, key=_topic) if _topic(file) not in _FOR_SPHINX
    }


def _topic(file: Path) -> str:
    return file.stem


def page_title(topic: str) -> str:
    """Return the first line of a page without the mark of a heading.

    Raises
    ------
    KeyError
        If `topic` is not a key of `page_files`.
    """
    with page_files()[topic].open(encoding="utf-8") as page:
        return page.readline().removeprefix("# ").strip()


def page_text(topic: str) -> str:
    """Return a page as Markdown in which links that a terminal cannot follow are replaced.

    A link to another page becomes its label (or that page's title) and "(`explain TOPIC`)"; a link
    to the same page becomes its label; links to anything else stay.

    Parameters
    ----------
    topic : str
        A key of `page_files`.

    Raises
    ------
    KeyError
        If there is no such page.
    """

    def named(link: re.Match[str]) -> str:
        label, other = link.groups()
        if other in page_files() and other != topic:
            return f"{label or page_title(other)} (`explain {other}`)"
        return label if other in (None, topic) else link[0]

    return _LINK_TO_PAGE.sub(named, page_files()[topic].read_text(encoding="utf-8"))


def search_pages(text: str) -> list[tuple[str, str, str]]:
    """Return topic, heading and best line of the five pages with the best sections for `text`.

    Words are compared with the beginnings of words, and a rare word counts more than a frequent one;
    a word of a heading counts three times, further ones in a section less and less, and those of a
    long section less than those of a short one (BM25).
    """
    stems = {w.removesuffix("s") for w in re.findall(r"\w+", text.lower())}
    patterns = [re.compile(rf"\b{stem}", re.IGNORECASE) for stem in sorted(stems)]
    sections = _sections()
    counts = np.array(
        [
            [3 * len(p.findall(heading)) + len(p.findall(body)) for p in patterns]
            for _, heading, body in sections
        ]
    ).reshape(len(sections), len(patterns))
    lengths = np.array([[len(body) + 1] for _, _, body in sections])
    weights = np.log((len(sections) + 1) / (np.count_nonzero(counts, axis=0) + 1))
    saturation = 0.5 + lengths / lengths.mean()
    scores = (weights * counts / (counts + saturation)).sum(axis=1)
    found = {}
    for k in np.argsort(-scores, kind="stable"):
        topic, heading, body = sections[k]
        if scores[k] > 0 and topic not in found and len(found) < 5:
            present = [[bool(p.search(line)) for p in patterns] for line in body.splitlines()]
            best = int(np.argmax(present @ weights)) if present else 0
            line = body.splitlines()[best].strip() if present else ""
            found[topic] = heading, re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line)
    return [(topic, *where) for topic, where in found.items()]


@cache
def _sections() -> list[tuple[str, str, str]]:
    """Topic, heading and text of each section of the pages, without programs and formulas."""
    sections = []
    for topic, file in page_files().items():
        text = re.sub(r"^```.*?^```", "", file.read_text(encoding="utf-8"), flags=re.M | re.DOTALL)
        for section in re.split(r"^#+ ", text, flags=re.MULTILINE)[1:]:
            heading, _, body = section.partition("\n")
            sections.append((topic, heading, body.strip()))
    return sections


def explain_command(*topics: str) -> str:
    """Return the command that shows pages in a terminal: "collocation-sysid explain TOPIC …", for
    any number of topics.
    """
    return " ".join(("collocation-sysid explain", *topics))


def page_url(topic: str) -> str | None:
    """Return the address of a page on the web, below `documentation_url`; None if the project
    states none.

    Raises
    ------
    KeyError
        If `topic` is not a key of `page_files`.
    """
    base = documentation_url()
    if base is None:
        return None
    page = page_files()[topic].relative_to(documentation_folder()).with_suffix(".html")
    return f"{base}/{page.as_posix()}"


def documentation_url() -> str | None:
    """Return the address that `project.urls` of the installed package calls "Documentation",
    without a final slash; None if it states none or is not installed.
    """
    from importlib.metadata import PackageNotFoundError, metadata  # slow

    try:
        project_urls = metadata("collocation-sysid").get_all("Project-URL") or []
    except PackageNotFoundError:
        return None
    urls = dict(each.split(", ", 1) for each in project_urls)
    return urls["Documentation"].rstrip("/") if "Documentation" in urls else None


@cache
def glossary_terms() -> dict[str, tuple[str, str]]:
    """Return meaning and topic of the page of each term of the glossary, in lower case; empty where
    neither a wheel nor a checkout is installed. A row of the glossary may have several terms.
    """
    if "glossary" not in page_files():
        return {}
    rows = re.findall(
        r"^\| (.+?) \| (.+) \| \[.+?\]\((?:\w+/)?(\w+)\.md\) \|$",
        page_files()["glossary"].read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    return {
        term.lower(): (meaning, topic)
        for terms, meaning, topic in rows
        for term in (terms, *terms.split(", "))
    }
