"""``Game``: what an engine needs to know of the game that it plays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Protocol

from ethbrake_marl.game.objectives import Declared
from ethbrake_marl.physics.state import Worlds


class Drawn(Protocol):
    """What ``Game.sample`` returns: an object with the drawn worlds in ``worlds``, such as a ``Sample``."""

    @property
    def worlds(self) -> Worlds:
        """The drawn worlds [n], at the alert (time 0)."""


class Game(Protocol):
    """The definition of a game: its players, its clock, and where its worlds come from. A ``Scenario`` is one."""

    @property
    def name(self) -> str:
        """Name of the game, for messages."""

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
        """Whose harm each vehicle minimises: one name for all vehicles or one per vehicle; a reward may override it."""

    @property
    def observation(self) -> Any:
        """The features that vehicles observe: a list for all, or lists by vehicle; None: see ``observations_of``."""

    @property
    def has_obstacle(self) -> bool:
        """Whether a world may have an obstacle ahead of Vehicle 1."""

    @property
    def by_link(self) -> bool:
        """Whether messages reach each vehicle over a link of its own, with its own delay and losses."""

    @property
    def builds_up(self) -> bool:
        """Whether the brakes of a vehicle may build up gradually instead of acting at once."""

    def sample(self, n: int, seed: int, *, first: int = 0, channel: Literal["list", "training"] = "list") -> Drawn:
        """Draw worlds ``first`` to ``first + n - 1`` of the endless list of ``seed``.

        ``channel``: ``"list"`` for evaluation, ``"training"`` for training; the two lists are independent.
        """
