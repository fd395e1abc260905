"""The documentation site's own Sphinx extension: pages that are made from other files of the repository."""

from __future__ import annotations

import json
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

from extension.demo import add_demonstration
from extension.pages import add_interface, list_folder, make_changelog, make_start, relink
from extension.results import add_reproduction, add_tables
from extension.sought import SOUGHT

MADE = {
    "index": lambda text: add_demonstration(make_start(text)),
    "changelog": make_changelog,
    "reference/api": add_interface,
    "results/reproduction": add_reproduction,
}


def make_page(app: Sphinx, docname: str, source: list[str]) -> None:
    """Complete a page that is made, and lead links that leave docs/ to their page on the site."""
    try:
        text = source[0]
        folder, _, name = docname.rpartition("/")
        if docname in MADE:
            text = MADE[docname](text)
        elif name == "README":
            text = list_folder(text, docname)
        else:
            text = relink(add_tables(text, name) if folder == "results" else text, docname)
        source[0] = text
    except ValueError as error:
        raise ExtensionError(f"{docname}: {error}") from error


def made_again(app: Sphinx, env: Any, added: set[str], changed: set[str], removed: set[str]) -> list[str]:
    """The pages that may have changed although their own file has not."""
    folders = (page for page in env.found_docs if page.startswith("results/") or page.endswith("/README"))
    return [*MADE, *folders]


def add_keywords(app: Sphinx, doctree: nodes.document) -> None:
    """Let the search find a page by the words that stand for it in ``SOUGHT``."""
    if words := SOUGHT.get(app.env.docname):
        doctree.insert(0, nodes.meta(name="keywords", content=", ".join(words.split())))


def tell_search(app: Sphinx, pagename: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Give the page of the search what static/search.js ranks by."""
    if pagename == "search":
        app.add_js_file(None, body=f"const SOUGHT = {json.dumps(SOUGHT)};")


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect to Sphinx."""
    app.add_config_value("sought", SOUGHT, "env")  # pages are read again when it changes
    app.connect("env-get-outdated", made_again)
    app.connect("source-read", make_page)
    app.connect("doctree-read", add_keywords)
    app.connect("html-page-context", tell_search)
    return {"parallel_read_safe": True}
