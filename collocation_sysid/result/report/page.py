"""What the reports share: the pictures of a folder, and the page or the text that one becomes."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from ...display import Section, as_html, as_markdown, escape
from ...files import is_own


def as_file(report: Section, file: Path) -> str:
    """The content of a file: Markdown for ``.md``, else a page."""
    return as_markdown([report]) if file.suffix == ".md" else as_page(report)


def as_page(report: Section) -> str:
    """One web page with its pictures inside."""
    page = files("collocation_sysid.result.report").joinpath("page.html").read_text("utf-8")
    page = page.replace("<!--TITLE-->", escape(report.title))
    return page.replace("<!--BODY-->", as_html(report))


def own_pictures(folder: Path) -> list[Path]:
    """The PNG of a folder; what links lead to elsewhere is not shown."""
    return sorted(file for file in folder.glob("*.png") if is_own(folder, file))
