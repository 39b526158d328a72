"""The documentation site: `make docs` builds it into docs/_build/html, and any warning
is an error.
"""

import re
import shutil
import sys
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
sys.path.insert(0, str(HERE))  # programs beside the pages
# a copy of the pages of results, so that links lead to them
RESULTS = HERE / "measured"
TO_RESULTS = re.compile(r"\]\((?:\.\./)*experiments/results/")
TO_PAGES = re.compile(r"\]\((?:\.\./)*docs/")
# the site's page of the effects is made here; on GitHub the links lead to their files
EFFECTS = HERE / "generated" / "effects.md"
TO_EFFECTS = re.compile(r"\]\((?:\.\./)+src/openjax/vehicle/effects\)")


def setup(app):
    """Bring in the pages of results and make that of the effects. Links that lead there
    from outside lead into the site.
    """
    from make_effects import page

    shutil.rmtree(RESULTS, ignore_errors=True)
    shutil.copytree(HERE.parent / "experiments" / "results", RESULTS)
    EFFECTS.parent.mkdir(exist_ok=True)
    EFFECTS.write_text(page(), encoding="utf-8")
    app.connect("source-read", lambda app, name, source: _lead_inside(source))
    app.connect("include-read", lambda app, path, name, source: _lead_inside(source))


def _lead_inside(source):
    text = TO_RESULTS.sub("](/measured/", source[0])
    text = TO_EFFECTS.sub("](/generated/effects.md)", text)
    source[0] = TO_PAGES.sub("](/", text)
