"""The task of whoever drives: a scenario, the vehicles that are driven in it, and the harm that counts."""

from __future__ import annotations

from dataclasses import dataclass

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.game.harm import HarmCount, check_harm_count
from ethbrake_marl.scenario.schema import Scenario


@dataclass(frozen=True, slots=True)
class Task:
    """Drive these vehicles of a scenario; all others follow its scripts.

    Raises ``InvalidInput`` for an index that the scenario has no vehicle for, one given twice, or an unknown count.
    """

    scenario: Scenario
    vehicles: tuple[int, ...]  # indices (0 = front), in the order in which they are driven
    harm_count: HarmCount = "first"  # harm that is minimised; what is told under both counts ignores it

    def __post_init__(self) -> None:
        check_harm_count(self.harm_count)
        known = set(range(self.scenario.vehicles))
        if len(set(self.vehicles)) != len(self.vehicles) or not set(self.vehicles) <= known:
            raise InvalidInput(
                f"task: vehicles {self.vehicles}: must be indices from 0 to {self.scenario.vehicles - 1}, each once"
            )

    @property
    def vehicle(self) -> int:
        """The vehicle that is driven; raises ``InvalidInput`` if it is not exactly one."""
        if len(self.vehicles) != 1:
            raise InvalidInput(f"scenario {self.scenario.name!r}: needs one driven vehicle; driven are: {self.names}")
        return self.vehicles[0]

    @property
    def names(self) -> str:
        """The driven vehicles by name, with commas between them; ``none`` where nobody is driven."""
        return ", ".join(self.scenario.vehicle_names[i] for i in self.vehicles) or "none"
