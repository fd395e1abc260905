"""A task: a scenario, the vehicles to be controlled in it, and the harm to be minimised."""

from __future__ import annotations

from dataclasses import dataclass

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.game.harm import HarmCount, check_harm_count
from ethbrake_marl.first_edition.scenario.schema import Scenario


@dataclass(frozen=True, slots=True)
class Task:
    """The task of controlling some vehicles of a scenario; all other vehicles follow the scenario's scripts.

    Raises ``InvalidInput`` for an index of a vehicle that does not exist, a repeated index, or an unknown harm count.
    """

    scenario: Scenario  # the scenario that the worlds are drawn from
    vehicles: tuple[int, ...]  # indices of the controlled vehicles (0 = front), in the order of their commands
    harm_count: HarmCount = "first"  # harm to be minimised: ``"first"``, first-impact harm; ``"total"``, total harm

    def __post_init__(self) -> None:
        check_harm_count(self.harm_count)
        known = set(range(self.scenario.vehicles))
        if len(set(self.vehicles)) != len(self.vehicles) or not set(self.vehicles) <= known:
            raise InvalidInput(
                f"task: vehicles {self.vehicles}: must be different indices from 0 to {self.scenario.vehicles - 1}"
            )

    @property
    def vehicle(self) -> int:
        """Index of the single controlled vehicle; raises ``InvalidInput`` unless there is exactly one."""
        if len(self.vehicles) != 1:
            raise InvalidInput(
                f"scenario {self.scenario.name!r}: this function needs exactly one controlled vehicle; the controlled"
                f" vehicles are: {self.names}"
            )
        return self.vehicles[0]

    @property
    def names(self) -> str:
        """Names of the controlled vehicles, separated by commas; ``none`` if there are none."""
        return ", ".join(self.scenario.vehicle_names[i] for i in self.vehicles) or "none"
