"""Pages and pictures that commands write, by what they show. The core draws none: an extension registers each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.registry import Registry


def register_page(shows: str, write: Callable[..., None]) -> None:
    """Make ``write`` draw what a command shows, ``"evaluation"`` or ``"worlds"``, from the arguments that it gives.

    An installed package does the same with an entry point of the group ``ethbrake_marl.pages``.
    """
    PAGES.add(shows, write, lambda other: other is write)


PAGES: Registry[Callable[..., Any]] = Registry("page", "pages", register_page)


def page_of(shows: str, option: str) -> Callable[..., None]:
    """What draws this; raises ``InvalidInput`` where nothing that is installed does."""
    if shows not in PAGES:
        raise InvalidInput(f"{option}: nothing draws {shows}: the extension that does is not installed")
    return PAGES[shows]
