"""The documentation site: `make docs` builds it into docs/_build/html, and any warning is an error."""

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
exclude_patterns = ["_build"]

# notebooks run when the site is built, and again only when they change
nb_execution_mode = "cache"
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True

default_role = "code"
autodoc_typehints = "none"  # docstrings say shapes and units, which types don't
autodoc_member_order = "bysource"
autodoc_default_options = {"exclude-members": "replace, tree_flatten, tree_unflatten"}

html_theme = "furo"
html_title = f"openjax {release}"
html_static_path = []
html_extra_path = ["extra"]  # a replay of six layouts: `openjax view --scenario all --seed 3 --html FILE`
# links to files beside the site (results, examples) are offered as they are
suppress_warnings = ["myst.xref_missing"]
