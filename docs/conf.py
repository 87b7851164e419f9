"""Sphinx configuration: `make docs` writes the pages to docs/_build/html."""

from importlib.metadata import version as version_of

project = "collocation_sysid"
author = "collocation_sysid developers"
version = release = version_of("collocation-sysid")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
]
myst_enable_extensions = ["dollarmath", "amsmath"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"collocation_sysid {release}"

autosummary_generate = True
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give shapes and units, which types cannot
napoleon_numpy_docstring = True
napoleon_use_ivar = True
napoleon_use_rtype = False
# The package exports what its modules define: a name then has two places, either will do.
suppress_warnings = ["ref.python"]


def _absolute_values(_app, _what, _name, _object, _options, lines: list[str]) -> None:
    """|φ| in a docstring is a length, not a substitution."""
    lines[:] = [line.replace("|", r"\|") for line in lines]


def setup(app) -> None:
    """Connect what the extensions leave to the project."""
    app.connect("autodoc-process-docstring", _absolute_values)
