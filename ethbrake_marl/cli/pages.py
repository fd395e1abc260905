"""Registry of the functions with which extensions draw pages and pictures for commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.registry import Registry


def register_page(shows: str, write: Callable[..., None]) -> None:
    """Register the function that a command calls to write its page (a report) or its picture.

    Entry points: ``ethbrake_marl.pages``.

    Args:
        shows: subject of the page: ``"evaluation"`` (``evaluate --report``), ``"worlds"`` (``scenario sample``) or
            ``"run"`` (``ethbrake run``).
        write: function that writes the page. Its arguments are, for ``"evaluation"``, the path of the file, what was
            compared (``evaluation.compared``), and the command; for ``"worlds"``, the path of the file, the scenario,
            the number of worlds and the seed. For ``"run"`` it returns a ``training.experiment.Report``.

    """
    PAGES.add(shows, write, lambda other: other is write)


PAGES: Registry[Callable[..., Any]] = Registry("page", "pages", register_page)


def page_of(shows: str, option: str) -> Callable[..., None]:
    """Return the function that writes a page. Without one, raise ``InvalidInput``, which begins with ``option``."""
    if shows not in PAGES:
        raise InvalidInput(f"{option}: the extension that draws this page ({shows}) is not installed")
    return PAGES[shows]
