"""The pages of public names: each name on one page, described by its docstring."""

from __future__ import annotations

import inspect
import re
from importlib import import_module
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
    public = {name for name in ethbrake_marl.__all__ if name != "__version__"} | names_of_extensions()
    wrong = sorted(public.symmetric_difference(listed) | {name for name in listed if listed.count(name) > 1})
    if wrong:
        raise ValueError(f"each public name belongs on one page of docs/api: {', '.join(wrong)}")


def names_of_extensions() -> set[str]:
    """What the ``__init__`` of each extension offers: ``extensions.hosts.drive_host``."""
    folders = (Path(ethbrake_marl.__file__).parent / "extensions").glob("*/__init__.py")
    each = {file.parent.name: re.findall(r"\b(\w+) as \1\b", file.read_text("utf-8")) for file in folders}
    return {f"extensions.{folder}.{name}" for folder, names in each.items() for name in names}


def describe(name: str) -> str:
    """The directive that shows a public name. Raises ``ValueError`` where it has no docstring of its own."""
    module, _, last = f"ethbrake_marl.{name}".rpartition(".")
    value = getattr(import_module(module), last)
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
