"""The pages of public names: each name on one page, described by its docstring."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import ethbrake_marl

PAGES = Path(__file__).resolve().parents[1] / "api"
BLOCK = re.compile(r"^```\{public\}\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def check_pages() -> None:
    """Raise ``ValueError`` for a public name that is on no page, or on two, or a name there that is not public."""
    listed = [
        name
        for path in PAGES.glob("*.md")
        for block in BLOCK.findall(path.read_text("utf-8"))
        for name in block.split()
    ]
    public = {name for name in ethbrake_marl.__all__ if name != "__version__"}
    wrong = sorted(public.symmetric_difference(listed) | {name for name in listed if listed.count(name) > 1})
    if wrong:
        raise ValueError(f"each public name belongs on one page of docs/api: {', '.join(wrong)}")


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
    """The page with the names that it lists described in their place."""

    def shown(block: re.Match[str]) -> str:
        return "\n".join(["```{eval-rst}", *map(describe, block[1].split()), "```"])

    return BLOCK.sub(shown, page)
