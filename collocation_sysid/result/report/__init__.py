"""Reports about a run, and about a comparison: self-contained HTML pages, or Markdown."""

from .comparison_page import comparison_report
from .page import as_file, as_page
from .run_page import run_report

__all__ = ["as_file", "as_page", "comparison_report", "run_report"]
