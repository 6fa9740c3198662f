"""Build of the documentation: ``python -m sphinx -W --keep-going -b html docs docs/_build``; it needs no network."""

import sys
from pathlib import Path

import turbrestore

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "turbrestore"
author = "The turbrestore developers"
copyright = f"2026, {author}"
version = release = turbrestore.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "generated_pages",
    "mathml",
    "plain_types",
]
exclude_patterns = [
    "_build",
    "_extensions",
    "_figures",
    "_templates",
    "jupyter_execute",
    "conf.py",
    "make_figures.py",
    "README.md",
    "**/.ipynb_checkpoints",
]
source_suffix = {".md": "myst-nb", ".py": "myst-nb"}

# Notebooks are percent scripts and run at every build; `-D nb_execution_mode=off` only shows their text.
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "force"
nb_execution_timeout = 180
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_merge_streams = True

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3
# `$$` may also be used inside a line of text.
myst_dmath_double_inline = True

# Only dashes are replaced; quotation marks remain as they are written.
smartquotes_action = "D"
toc_object_entries = False

autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

# Formulas are MathML, made when the pages are built: the site needs no script for them.
html_math_renderer = "mathml"
html_theme = "pydata_sphinx_theme"
html_static_path = ["_static"]
html_css_files = ["turbrestore.css"]
html_title = f"turbrestore {release}"
html_show_sourcelink = False
# Every page shows the whole table of contents, with its captions.
html_sidebars = {"**": ["manual.html"]}
templates_path = ["_templates"]
html_theme_options = {
    "navbar_center": [],
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
