"""Pictures of a running episode. Extensions register the classes that draw them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.registry import Registry

FRAMES_PER_SECOND = 10


class Renderer:
    """Draws the episodes of one environment. This base class draws nothing (``render_mode=None``)."""

    def began(self, state: State) -> None:
        """Called after a reset."""

    def stepped(self, state: State) -> None:
        """Called after a step."""

    def render(self) -> Any:
        """Return pictures in the form that the render mode defines; for many worlds, a list."""

    def close(self) -> None:
        """Close windows and files."""

    @staticmethod
    def check(many: bool) -> None:
        """Raise ``InvalidInput`` or ``MissingExtra`` if one world, or ``many``, cannot be drawn on this machine."""


MakeRenderer = Callable[[Any], Any]  # environment -> object with the methods of Renderer; it may have a `check`


def register_renderer(mode: str, make: MakeRenderer) -> None:
    """Register a render mode: ``make(environment)`` returns its renderer. Entry points: ``ethbrake_marl.renderers``."""
    RENDERERS.add(mode, make, lambda other: other is make)


RENDERERS: Registry[MakeRenderer] = Registry("render mode", "renderers", register_renderer)


def check_mode(mode: str, *, many: bool) -> None:
    """Raise an error of this package if a render mode cannot be used on this machine."""
    getattr(RENDERERS[mode], "check", Renderer.check)(many)


def render_metadata(*, many: bool) -> dict[str, Any]:
    """Return the entries of an environment's ``metadata`` about pictures, with the modes that work on this machine."""
    modes = []
    for mode in RENDERERS:
        with suppress(EthBrakeError):
            check_mode(mode, many=many)
            modes.append(mode)
    return {"render_modes": modes, "render_fps": FRAMES_PER_SECOND}


class Metadata:
    """The attribute ``metadata`` of an environment's class. Packages that draw are imported when it is first read."""

    def __init__(self, **other: Any) -> None:
        self.other = other

    def __get__(self, environment: Any, owner: Any) -> dict[str, Any]:
        return {**self.other, **render_metadata(many=False)}


def make_renderer(environment: Any, mode: str | None) -> Any:
    """Return the renderer for a render mode. Raises ``InvalidInput`` for an unknown mode."""
    if mode is None:
        return Renderer()
    if mode not in RENDERERS:
        known = ", ".join(RENDERERS) or "none, because no installed package draws"
        raise InvalidInput(f"render_mode = {mode!r}: must be None or one of: {known}")
    return RENDERERS[mode](environment)
