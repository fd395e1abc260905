"""Other kinds of physics than exact impacts, chosen by the key ``physics`` of a scenario."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from ethbrake_marl.episode.game import Game
from ethbrake_marl.registry import Registry

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario


class Physics(Protocol):
    """How vehicles move and collide in a game, instead of the exact physics."""

    def check(self, scenario: Scenario) -> None:
        """Refuse (``files.model.refuse``) a scenario that this physics cannot simulate."""

    def game(self, game: Game) -> Game:
        """The game with this physics: a subclass of ``Game`` with its own ``follow``."""


def register_physics(name: str, physics: Physics) -> None:
    """Register a physics. Entry points: ``ethbrake_marl.physics``."""
    PHYSICS.add(name, physics, lambda other: other is physics)


PHYSICS: Registry[Physics] = Registry("physics", "physics", register_physics)
