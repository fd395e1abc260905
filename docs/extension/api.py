"""The page of public names, made from their docstrings."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import ethbrake_marl

TABLE = Path(ethbrake_marl.__file__)
HEADING = re.compile(r"^    # (.*)$")
ENTRY = re.compile(r"\b(\w+) as \1\b")


def read_groups(text: str) -> dict[str, list[str]]:
    """The public names by the comment above them, as the table in ``ethbrake_marl/__init__.py`` lists them."""
    groups: dict[str, list[str]] = {}
    title = ""
    for line in text.splitlines():
        if heading := HEADING.match(line):
            title = heading[1]
        elif names := ENTRY.findall(line):
            groups.setdefault(title, []).extend(names)
    return groups


def describe(name: str) -> str:
    """The directive that shows a public name. Raises ``ValueError`` where it has no docstring of its own."""
    value = getattr(ethbrake_marl, name)
    text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    if not (text or "").strip():
        raise ValueError(f"the public name {name} has no docstring")
    if inspect.isclass(value):
        return f".. autoclass:: ethbrake_marl.{name}\n   :members:\n   :exclude-members: model_config\n"
    return f".. autofunction:: ethbrake_marl.{name}\n"


def add_public_names(page: str) -> str:
    """The page, and then every public name under the heading of its group."""
    parts = [page]
    for title, names in read_groups(TABLE.read_text("utf-8")).items():
        parts += [f"## {title}\n", "```{eval-rst}", *map(describe, names), "```\n"]
    return "\n".join(parts)
