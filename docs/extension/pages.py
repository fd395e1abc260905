"""Pages made from README and CHANGELOG, and the list of all pages."""

from __future__ import annotations

import os
import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
CARDS = ROOT / "ethbrake_marl" / "_policies"
LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)\s#]+)(#[^)\s]*)?\)")
PAGE_OF = {"README.md": "index.md", "docs/README.md": "index.md", "CHANGELOG.md": "changelog.md"}


def relink(text: str, docname: str, written_in: Path | None = None) -> str:
    """The text with its relative links as they must be on the page ``docname``.

    Args:
        text: Markdown, with links relative to ``written_in``.
        docname: the page that shows it, relative to docs/, without its ending.
        written_in: folder of the file that the text comes from; by default that of the page.

    """
    shown_in = (DOCS / docname).parent

    def lead(found: re.Match[str]) -> str:
        path = Path(os.path.normpath((written_in or shown_in) / found[1]))
        if not path.exists():
            return found[0]
        anchor = found[2] or ""
        if path.is_relative_to(CARDS) and path.name == "card.md":
            path, anchor = DOCS / "reference" / "policies.md", f"#{path.parent.name}"
        target = DOCS / PAGE_OF.get(path.relative_to(ROOT).as_posix(), path)
        return f"]({os.path.relpath(target, shown_in)}{anchor})"

    return LINK.sub(lead, text)


def read_sections(listing: str) -> dict[str, list[str]]:
    """Every section of docs/README.md and the pages of docs/ that it lists, in order, as paths relative to docs/."""
    sections: dict[str, list[str]] = {}
    for part in re.split(r"(?m)^## ", listing)[1:]:
        title, _, body = part.partition("\n")
        links = re.findall(r"(?m)^- \[[^\]]*\]\(([^)#\s]+)\)", relink(body, "README"))
        sections[title.strip()] = [link for link in links if link != "index.md"]
    return sections


def make_start(_: str) -> str:
    """README, and the list of pages in docs/README.md as the site's navigation."""
    start = relink((ROOT / "README.md").read_text("utf-8"), "index", ROOT)
    sections = read_sections((DOCS / "README.md").read_text("utf-8"))
    return "\n".join([start, *(_navigation(pages, title) for title, pages in sections.items() if pages)])


def make_changelog(_: str) -> str:
    """CHANGELOG."""
    return relink((ROOT / "CHANGELOG.md").read_text("utf-8"), "changelog", ROOT)


def list_folder(text: str, docname: str) -> str:
    """The page about the other pages of its folder, with these in the navigation in the order of its links."""
    folder = (DOCS / docname).parent
    beside = {each.relative_to(folder).as_posix() for each in (*folder.glob("*.md"), *folder.glob("*/README.md"))}
    linked = dict.fromkeys(path for path, _ in LINK.findall(text) if path in beside)
    return f"{relink(text, docname)}\n{_navigation([*linked])}"


def add_interface(text: str) -> str:
    """The page about public names, with their pages in the navigation in the order of its list."""
    pages = dict.fromkeys(re.findall(r"\]\((api/[a-z-]+\.md)#", text))
    return f"{relink(text, 'reference/api')}\n{_navigation([*pages])}"


def _navigation(pages: list[str], caption: str = "") -> str:
    options = [":hidden:", *([f":caption: {caption}"] if caption else [])]
    return "\n".join(["```{toctree}", *options, "", *pages, "```", ""])
