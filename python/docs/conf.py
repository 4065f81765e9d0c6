"""Sphinx's configuration; `make docs` builds the pages into build/docs."""

import sys
from pathlib import Path

import manylights

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "manylights"
author = "The manylights authors"
copyright = author
version = release = manylights.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_inline_tabs",
    # Ours
    "repository_pages",
    "plugin_blocks",
    "command_line",
    "math_without_scripts",
]
exclude_patterns = ["gallery/*"]

# Quotes in commands are to be copied
smartquotes = False

# Anchors of headings as GitHub has them
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False
# Compact lists
napoleon_use_rtype = False
napoleon_use_ivar = True

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "manylights"
html_static_path = ["_static"]
html_css_files = ["manylights.css"]
# Pages are rewritten copies of files elsewhere
html_copy_source = False
html_show_sourcelink = False

# Names that Mitsuba's documentation has for words of the parameter tables
rst_prolog = "".join(
    f".. |{name}| replace:: {text}\n"
    for name, text in {
        "bool": "*boolean*",
        "float": "*float*",
        "int": "*integer*",
        "string": "*string*",
        "true": "*true*",
        "false": "*false*",
        "exposed": "P",
    }.items()
)
