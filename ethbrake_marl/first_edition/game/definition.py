"""``Game``: the properties of a game that the engine uses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Protocol

from ethbrake_marl.first_edition.game.objectives import Declared
from ethbrake_marl.first_edition.physics.state import Worlds


class Drawn(Protocol):
    """Result of ``Game.sample``, such as a ``Sample``."""

    @property
    def worlds(self) -> Worlds:
        """The n drawn worlds at the alert (t = 0)."""


class Game(Protocol):
    """What the engine needs to know of a game: vehicles, times, objectives, observations and worlds.

    Every ``Scenario`` is a ``Game``.
    """

    @property
    def name(self) -> str:
        """Name of the game, for error messages."""

    @property
    def vehicles(self) -> int:
        """Number of vehicles in the line, N."""

    @property
    def vehicle_names(self) -> tuple[str, ...]:
        """Names of the vehicles, front to rear: ``vehicle_1`` to ``vehicle_N``."""

    @property
    def learners(self) -> tuple[int, ...]:
        """Indices of the learning vehicles (0 = front), ascending."""

    @property
    def scripts(self) -> Mapping[int, str]:
        """Name of the agent that controls each vehicle that does not learn, by index: ``{0: "full_brake"}``."""

    @property
    def time_step_s(self) -> float:
        """Time between two decisions of a vehicle, s."""

    @property
    def horizon_s(self) -> float:
        """Time after the alert at which an episode is truncated, s."""

    @property
    def objective(self) -> Declared:
        """Objective of the vehicles: one name for all, or one name per vehicle. A reward may set another objective."""

    @property
    def observation(self) -> Any:
        """Features that vehicles observe: one list for all, or a list per vehicle name; None: the default features."""

    @property
    def has_obstacle(self) -> bool:
        """Whether a world may have an obstacle ahead of Vehicle 1."""

    @property
    def by_link(self) -> bool:
        """Whether delays, losses or contents of messages limit what vehicles know; if not, a vehicle knows everything
        after its latency.
        """

    @property
    def builds_up(self) -> bool:
        """Whether the brakes of at least one vehicle may build up gradually instead of acting at once."""

    def sample(self, n: int, seed: int, *, first: int = 0, channel: Literal["list", "training"] = "list") -> Drawn:
        """Draw the worlds with the numbers ``first`` to ``first + n - 1`` from the endless list of worlds of ``seed``.

        ``channel`` selects one of two independent lists: ``"list"`` for evaluation, ``"training"`` for training.
        """
