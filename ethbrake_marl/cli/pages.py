"""Registry of the pages and pictures that commands write. The core draws none; extensions register them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.registry import Registry


def register_page(shows: str, write: Callable[..., None]) -> None:
    """Register the function that writes a page or picture, to be called by a command with an option for it.

    An installed package does the same with an entry point of the group ``ethbrake_marl.pages``.

    Args:
        shows: what the page is about: ``"evaluation"`` (``evaluate --report``) or ``"worlds"`` (``scenario sample``).
        write: the function. For ``"evaluation"`` it takes the file, the evaluation, its results table and the agents by
            name; for ``"worlds"`` the file, the scenario and the sample. ``cli.evaluate`` and ``cli.scenario`` show the
            keyword arguments.

    """
    PAGES.add(shows, write, lambda other: other is write)


PAGES: Registry[Callable[..., Any]] = Registry("page", "pages", register_page)


def page_of(shows: str, option: str) -> Callable[..., None]:
    """Return the function that was registered to write the page about ``shows``.

    Raises ``InvalidInput``, naming the command's ``option``, if no installed extension registered one.
    """
    if shows not in PAGES:
        raise InvalidInput(f"{option}: nothing draws {shows}: the extension that does is not installed")
    return PAGES[shows]
