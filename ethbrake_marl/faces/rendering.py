"""Pictures of a running episode. Extensions register the classes that draw them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.registry import Registry

FRAMES_PER_SECOND = 10


class Renderer:
    """The base class draws nothing (``render_mode=None``)."""

    def began(self, state: State) -> None:
        """Called after a reset."""

    def stepped(self, state: State) -> None:
        """Called after a step."""

    def render(self) -> Any:
        """For many worlds, a list."""

    def close(self) -> None:
        """Close windows and files."""


# environment -> object with the methods of Renderer; its function `check(many)`, if it has one, raises an error if it
# cannot draw one world, or many, on this machine
MakeRenderer = Callable[[Any], Any]


def register_renderer(mode: str, make: MakeRenderer) -> None:
    """``make(environment)`` returns its renderer. Entry points: ``ethbrake_marl.renderers``."""
    RENDERERS.add(mode, make, lambda registered: registered is make)


RENDERERS: Registry[MakeRenderer] = Registry("render mode", "renderers", register_renderer)


def why_not(mode: str, many: bool = False) -> str | None:
    """None if this machine can draw one world (``many``: many worlds) in the mode."""
    try:
        getattr(RENDERERS[mode], "check", bool)(many)
    except EthBrakeError as error:
        return str(error)
    return None


def render_metadata(many: bool = False) -> dict[str, Any]:
    return {
        "render_modes": [mode for mode in RENDERERS if why_not(mode, many) is None],
        "render_fps": FRAMES_PER_SECOND,
    }


class Metadata:
    """Reading it imports the packages that draw."""

    def __init__(self, **entries: Any) -> None:
        self.other = entries

    def __get__(self, environment: Any, owner: Any) -> dict[str, Any]:
        return {**self.other, **render_metadata()}


def make_renderer(environment: Any, mode: str | None) -> Any:
    """Raises ``InvalidInput`` for an unknown mode."""
    if mode is None:
        return Renderer()
    if mode not in RENDERERS:
        known_modes = ", ".join(RENDERERS) or "none, because no installed package draws"
        raise InvalidInput(f"render_mode = {mode!r}: must be None or one of: {known_modes}")
    return RENDERERS[mode](environment)
