"""Sphinx configuration: `make docs` writes the pages to docs/_build/html."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.ext.napoleon import NumpyDocstring

sys.path.insert(0, str(Path(__file__).parent))
from reference import PUBLISHED, write_pages

from collocation_sysid.datasets.public_data import data_folder

project = "collocation_sysid"
author = "collocation_sysid developers"
version = release = version_of("collocation-sysid")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
myst_enable_extensions = ["dollarmath", "amsmath", "substitution"]
myst_substitutions = {"release": release}
myst_heading_anchors = 3
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "gallery"]
html_theme = "furo"
html_static_path, html_css_files = ["_static"], ["pages.css"]
# The schema of the problem file, and the catalogue of identified materials.
html_extra_path = [f"generated/{PUBLISHED}", "catalogue.json"]

# Scripts with a recorded object in them run where its data have been fetched.
_measured = {
    "measured_beam": "srl_beam/beam_gravity_V2_a.c3d",
    "measured_cylinders": "phantom_compression/EF30_0T_A1.csv",
    "measured_tentacle": "soft_tentacle/m1_u01_markers.csv",
}
_here = Path(__file__).parent
_fetched = [name for name, file in _measured.items() if (_here / "../problems" / file).is_file()]
if (data_folder() / "hyperelastic_curves" / "data.h5").is_file():
    _fetched += ["measured_brain", "measured_silicone"]
else:
    print(
        "measured_brain and measured_silicone are shown without results: "
        "cs.datasets.fetch('hyperelastic_curves') says where their data belong"
    )
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "generated/gallery",
    "filename_pattern": "/(" + "|".join([r"\d_\w+\.py", *_fetched]) + ")",
    "image_scrapers": ("matplotlib", "gallery_pictures.last_figure"),
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "write_computation_times": False,
}
html_math_renderer = "mathml"  # which browsers draw themselves, without a network
html_title = f"collocation_sysid {release}"
html_show_copyright = False

templates_path = ["_templates"]  # of a page for each name
autosummary_generate = True
autosummary_filename_map = {"collocation_sysid.Run": "collocation_sysid.run-class"}  # beside `run`
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give shapes and units, which types cannot
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
# A colon in the sentence of a property parts no type from it.
NumpyDocstring._parse_attribute_docstring = lambda self: list(self._lines)
# The package exports what its modules define: a name then has two places, either will do.
suppress_warnings = ["ref.python"]


def _absolute_values(_app, _what, _name, _object, _options, lines: list[str]) -> None:
    """|φ| in a docstring is a length, not a substitution."""
    lines[:] = [line.replace("|", r"\|") for line in lines]


def _inline(translator, node) -> None:
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _displayed(translator, node) -> None:
    formula = convert(node.astext(), display="block")
    translator.body.append(f'<div class="math">{formula}</div>')
    raise nodes.SkipNode


def setup(app) -> None:
    """Connect what the extensions leave to the project."""
    write_pages(Path(__file__).parent / "generated")
    app.add_html_math_renderer("mathml", (_inline, None), (_displayed, None))
    app.connect("autodoc-process-docstring", _absolute_values)
