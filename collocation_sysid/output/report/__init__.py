"""Self-contained HTML pages about a run, and about a comparison."""

from .comparison_page import comparison_page
from .run_page import run_page

__all__ = ["comparison_page", "run_page"]
