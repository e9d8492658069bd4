"""How Sphinx builds the pages: `make docs`."""

from importlib.metadata import version as version_of

project = "pcr_mpc"
author = "the pcr_mpc authors"
project_copyright = "the pcr_mpc authors"
version = release = version_of("pcr_mpc")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_copybutton",
    "sphinxarg.ext",
]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

autosummary_generate = True
autodoc_typehints = "none"  # numpydoc's sections say the types, with shapes and units
autodoc_member_order = "bysource"
numpydoc_show_class_members = False  # no page for every attribute: the class's own docstring lists them
default_role = "code"

exclude_patterns = ["_build"]
html_theme = "pydata_sphinx_theme"
html_title = "pcr_mpc"
html_theme_options = {"show_toc_level": 2, "navigation_with_keys": False, "secondary_sidebar_items": ["page-toc"]}
html_show_sourcelink = False
