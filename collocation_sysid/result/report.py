"""Reports as self-contained HTML pages or Markdown."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from ..common.display import TitledParts, as_html, as_markdown, escape


def report_text(report: TitledParts, file: Path) -> str:
    """Return the text of a report for a file: Markdown if its name ends in ``.md``, else HTML."""
    return as_markdown([report]) if file.suffix == ".md" else report_html(report)


def report_html(report: TitledParts) -> str:
    """Return a report as the HTML text of one page that contains its pictures.

    Nothing is loaded from a network; pictures are embedded.
    """
    page = files("collocation_sysid.result").joinpath("report.html").read_text("utf-8")
    # A text cannot hold these places, since "<" is escaped.
    page = page.replace("<!--TITLE-->", escape(report.title))
    return page.replace("<!--BODY-->", as_html(report))
