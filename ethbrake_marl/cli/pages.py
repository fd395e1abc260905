"""Registry of the pages and pictures that commands write. The core draws none; extensions register them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.registry import Registry


def register_page(shows: str, write: Callable[..., None]) -> None:
    """Register a function that writes a page about ``"evaluation"`` or ``"worlds"``; a command calls it.

    An installed package does the same with an entry point of the group ``ethbrake_marl.pages``.
    """
    PAGES.add(shows, write, lambda other: other is write)


PAGES: Registry[Callable[..., Any]] = Registry("page", "pages", register_page)


def page_of(shows: str, option: str) -> Callable[..., None]:
    """Return the function that writes this page. Raise ``InvalidInput``, naming ``option``, if none is installed."""
    if shows not in PAGES:
        raise InvalidInput(f"{option}: nothing draws {shows}: the extension that does is not installed")
    return PAGES[shows]
