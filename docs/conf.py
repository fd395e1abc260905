"""Configuration of the documentation site: `make docs` builds it in docs/_build/html, and any warning stops it."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from typer.cli import get_docs_for_click

from ethbrake_marl import __version__
from ethbrake_marl.cli.app import Installed, whole_command

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

project = "ethbrake_marl"
author = "ethbrake_marl contributors"
copyright = f"2026, {author}"
release = version = __version__

extensions = [
    "myst_nb",
    "sphinx_copybutton",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinxcontrib.autodoc_pydantic",
]
exclude_patterns = ["_build", "**.ipynb_checkpoints", "templates"]
templates_path = ["templates"]
highlight_language = "none"

# Links to headings are those of GitHub, so that pages read the same there.
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]

# The Python reference.
autodoc_typehints = "none"  # the signature has them
autodoc_member_order = "bysource"
autodoc_default_options = {
    "members": True,
    "inherited-members": "object, int, tuple, Exception, BaseModel, Env, VectorEnv, ParallelEnv, AECEnv, VecEnv",
}
napoleon_use_rtype = False
autodoc_pydantic_model_show_json = False
autodoc_pydantic_model_show_config_summary = False
autodoc_pydantic_model_show_field_summary = False
autodoc_pydantic_model_show_validator_summary = False
autodoc_pydantic_model_show_validator_members = False
autodoc_pydantic_model_hide_paramlist = True
autodoc_pydantic_model_member_order = "bysource"
autodoc_pydantic_field_list_validators = False
autodoc_pydantic_field_show_constraints = False

# Notebooks are committed with their outputs, and run again here, each in an empty folder. Outputs are kept from build
# to build until a cell changes; `make clean` forgets them.
nb_execution_mode = "cache"
nb_execution_timeout = 1200  # s for one cell, on a busy machine that compiles everything
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True

html_theme = "furo"
html_title = f"ethbrake_marl {__version__}"
html_favicon = "figures/favicon.svg"
html_extra_path = ["../scenarios/scenario.schema.json", "../train/recipe.schema.json"]
html_static_path = ["static"]
html_search_scorer = str(DOCS / "static/search.js")
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = True

# Pages that the site makes from other files: README, changelog, a policy's card, help texts, the reproduction.

ROW = re.compile(r"(?m)^\|.*\|$")
TOGETHER = re.compile(r" (?=%)|(?<=,) (?=[^\[\]|]*\])")  # a number and its unit, both ends of an interval

LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)\s#]+)(#[^)\s]*)?\)")


def relink(text: str, docname: str, folder: Path) -> str:
    """Text whose links are relative to ``folder``, with links that work on the page ``docname``."""

    def lead(found: re.Match[str]) -> str:
        path, anchor = Path(os.path.normpath(folder / found[1])), found[2] or ""
        if not path.exists():  # code that looks like a link
            return found[0]
        if path.name == "card.md":
            path = DOCS / "reference" / "policies.md"
        pages = {ROOT / "README.md": "index.md", ROOT / "CHANGELOG.md": "decisions/README.md"}
        return f"]({os.path.relpath(DOCS / pages.get(path, path), (DOCS / docname).parent)}{anchor})"

    return LINK.sub(lead, text)


def navigation(pages: Iterable[str], caption: str) -> str:
    """Hidden table of contents."""
    return f"\n\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n" + "\n".join(pages) + "\n```\n"


def first_page() -> str:
    """README, with the sections of docs/index.md as the site's navigation."""
    text = relink((ROOT / "README.md").read_text("utf-8"), "index", ROOT)
    for section in relink((DOCS / "index.md").read_text("utf-8"), "index", DOCS).split("\n## ")[1:]:
        caption, _, listed = section.partition("\n")
        text += navigation(re.findall(r"(?m)^- \[[^\]]*\]\(([^)\s]+)\)", listed), caption)
    return text


def commands() -> str:
    """Help of every command, as ``typer utils docs`` writes it, with the commands of extensions."""

    def imported(group: Any) -> Any:
        for name, command in group.commands.items():
            group.commands[name] = command.command() if isinstance(command, Installed) else command
            if hasattr(command, "commands"):
                imported(command)
        return group

    whole = imported(whole_command())
    context = whole.context_class(whole, info_name="ethbrake", **whole.context_settings)
    text = get_docs_for_click(obj=whole, ctx=context, name="ethbrake", indent=1)
    options = r"(?s)```.*?```|`[^`]*`|(--[a-z][a-z-]*)"  # outside code they become code, since the site changes hyphens
    return re.sub(options, lambda found: f"`{found[1]}`" if found[1] else found[0], text)


def card() -> str:
    """Card of the shipped policy ``ppo``, its headings one level lower."""
    path = ROOT / "ethbrake_marl" / "shipped" / "policies" / "ppo" / "card.md"
    return re.sub(r"(?m)^#(?=#* )", "##", relink(path.read_text("utf-8"), "reference/policies", path.parent))


PAPER_TABLES = {
    "Results": "results/reproduction/claims.csv",
    "Open quantities": "studies/paper/open-quantities.csv",
    "Equations that differ": "studies/paper/equations.csv",
}


def paper_tables() -> str:
    """Main tables of the paper's reproduction, from CSV files."""
    blocks = (
        f"## {title}\n\n```{{csv-table}}\n:file: {file}\n:header-rows: 1\n:class: dense\n```"
        for title, file in PAPER_TABLES.items()
    )
    return "\n\n".join(blocks)


def changes() -> str:
    """The changelog, its headings one level lower."""
    text = relink((ROOT / "CHANGELOG.md").read_text("utf-8"), "decisions/README", ROOT)
    return re.sub(r"(?m)^#(?=#* )", "##", text)


WORDS = json.loads(
    re.findall(r"const WORDS = (\{.*?\});", (DOCS / "static" / "search.js").read_text("utf-8"), re.DOTALL)[0]
)


def make_page(app: Sphinx, docname: str, source: list[str]) -> None:
    """Complete the pages that are made, add words of the search, and lead links that leave docs/ to their page."""
    text = relink(source[0], docname, (DOCS / docname).parent)
    if docname == "index":
        app.env.note_dependency(str(ROOT / "README.md"))
        text = first_page()
    elif docname == "reference/cli":
        text += "\n" + commands()
    elif docname == "decisions/README":
        app.env.note_dependency(str(ROOT / "CHANGELOG.md"))
        text += "\n" + changes()
    elif docname == "paper-results":
        text += "\n" + paper_tables()
    elif docname == "reference/policies":
        text += "\n" + card()
    words = (
        f"---\nmyst:\n  html_meta:\n    keywords: {', '.join(WORDS[docname].split())}\n---\n"
        if docname in WORDS
        else ""
    )
    source[0] = words + ROW.sub(lambda row: TOGETHER.sub("\u00a0", row[0]), text)


def tidy(app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Keep napoleon from taking words before a colon for a type, and drop what Python says about a named tuple."""
    if what in ("attribute", "property"):
        lines[:] = ["", *(line for line in lines if not line.startswith("Alias for field number"))]


def setup(app: Sphinx) -> None:
    """Connect to Sphinx."""
    app.connect("autodoc-process-docstring", tidy, priority=100)  # before napoleon
    app.connect("source-read", make_page)
