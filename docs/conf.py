"""Sphinx configuration: the pages of this folder, and the API from docstrings. `make docs` builds it, offline."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from spplanes._version import __version__  # noqa: E402 - found by the line above

project = "spplanes"
author = "the spplanes authors"
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
source_suffix = {".md": "markdown"}
root_doc = "index"
exclude_patterns = ["img"]
suppress_warnings = ["ref.python"]  # a name in a docstring that two modules have is code, no link

myst_heading_anchors = 3
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "undoc-members": False, "show-inheritance": False}
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_use_ivar = False
default_role = "code"  # `x` in a docstring is code
nitpicky = False

html_theme = "alabaster"
html_title = f"spplanes {__version__}"
html_theme_options = {
    "description": "planes with honest covariances, and SLAM with them",
    "page_width": "1240px",
    "font_family": "system-ui, sans-serif",
    "head_font_family": "system-ui, sans-serif",
    "font_size": "16px",
    "code_font_size": "0.85em",
    "sidebar_width": "240px",
    "fixed_sidebar": True,
    "show_powered_by": False,
}
html_copy_source = False
html_show_sphinx = False


def setup(app):  # noqa: D103 - Sphinx's own hook
    app.connect("autodoc-process-docstring", _bars_are_bars)


def _bars_are_bars(app, what, name, obj, options, lines):
    """|x| is a norm, not a substitution of reStructuredText."""
    lines[:] = [line.replace("|", "\\|") for line in lines]
