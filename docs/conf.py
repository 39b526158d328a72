"""The documentation site: `make docs` builds it into docs/_build/html, and any warning
is an error.
"""

import re
import shutil
from pathlib import Path

import openjax

project = "openjax"
author = copyright = "the openjax contributors"
release = version = openjax.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",  # the site needs nothing from elsewhere
]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "notebooks"]
suppress_warnings = ["myst.header"]  # pages of results may skip a level

# notebooks run when the site is built, and again only when they change
nb_execution_mode = "cache"
nb_execution_in_temp = True
nb_execution_timeout = 1800  # s a cell, on a busy machine
nb_execution_raise_on_error = True
nb_merge_streams = True

viewcode_follow_imported_members = False
default_role = "code"
autodoc_typehints = "none"  # docstrings say shapes and units, which types don't
autodoc_member_order = "bysource"
autodoc_default_options = {"exclude-members": "replace, tree_flatten, tree_unflatten"}

html_theme = "furo"
html_title = f"openjax {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = [
    "extra"
]  # a replay of six layouts: `openjax view --scenario all --seed 3 --html FILE`

HERE = Path(__file__).parent
# a copy of the pages of results, so that links lead to them
RESULTS = HERE / "measured"
TO_RESULTS = re.compile(r"\]\((?:\.\./)*experiments/results/")
TO_PAGES = re.compile(r"\]\((?:\.\./)*docs/")


def setup(app):
    """Bring the pages of results in, and let links that lead there from outside lead
    into the site.
    """
    shutil.rmtree(RESULTS, ignore_errors=True)
    shutil.copytree(HERE.parent / "experiments" / "results", RESULTS)
    app.connect("source-read", lambda app, name, source: _lead_inside(source))
    app.connect("include-read", lambda app, path, name, source: _lead_inside(source))


def _lead_inside(source):
    source[0] = TO_PAGES.sub("](/", TO_RESULTS.sub("](/measured/", source[0]))
