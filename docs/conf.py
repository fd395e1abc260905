"""Configuration of the documentation site: `make docs` builds it in docs/_build/html, and any warning stops it."""

from __future__ import annotations

import sys
from pathlib import Path

from ethbrake_marl import __version__

sys.path.insert(0, str(Path(__file__).parent))  # for the folder extension/

project = "ethbrake_marl"
author = "ethbrake_marl contributors"
copyright = f"2026, {author}"
release = version = __version__

extensions = ["myst_nb", "sphinx_copybutton", "extension"]
exclude_patterns = ["_build", "**.ipynb_checkpoints", "README.md", "extension"]
highlight_language = "none"

# Links to headings are those of GitHub, so that pages read the same there.
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]

# Notebooks are committed with their outputs, and run again here, each in an empty folder. Outputs are kept from build
# to build until a cell changes; `make clean` forgets them.
nb_execution_mode = "cache"
nb_execution_timeout = -1  # however busy the machine is
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True
nb_ipywidgets_js: dict[str, dict[str, str]] = {}  # the site loads nothing; sliders move in Jupyter alone

html_theme = "furo"
html_title = f"ethbrake_marl {__version__}"
html_favicon = "figures/favicon.svg"
html_extra_path = ["../scenarios/scenario.schema.json", "../train/recipe.schema.json"]
html_static_path = ["static"]
html_css_files = ["site.css"]
html_search_scorer = str(Path(__file__).parent / "static" / "search.js")
html_copy_source = False
html_show_sourcelink = False
copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = True
