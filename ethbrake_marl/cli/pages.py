"""Registry of functions by which extensions draw the pages and pictures of commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.registry import Registry


def register_page(shows: str, write: Callable[..., None]) -> None:
    """Register the function that writes a command's page or picture. Packages use the entry-point group
    ``ethbrake_marl.pages`` instead.

    Args:
        shows: subject of the page: ``"evaluation"`` (``evaluate --report``), ``"worlds"`` (``scenario sample``) or
            ``"run"`` (``ethbrake run``).
        write: for ``"evaluation"``, a function of the file's path, the results (``evaluation.comparison``) and the
            command; for ``"worlds"``, of the file's path, the scenario, the number of worlds and the seed. For
            ``"run"``, a function that returns a ``training.experiment.ReportWriter``; that class says what it does.

    """
    PAGES.add(shows, write, lambda registered: registered is write)


PAGES: Registry[Callable[..., Any]] = Registry("page", "pages", register_page)


def page_function(shows: str, option: str) -> Callable[..., None]:
    """Raises ``InvalidInput``, which begins with ``option``, if there is none."""
    if shows not in PAGES:
        raise InvalidInput(f"{option}: the extension that draws this page ({shows}) is not installed")
    return PAGES[shows]
