"""Step shield for uncertain worlds: it certifies plans in the corners of the box of possible worlds.

``StepShield`` certifies each plan in several possible worlds, which are called the *members* of a world. For a
``RobustShield`` the members are the reported world and the corners of an ``Uncertainty``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.uncertainty import Uncertainty
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.state import Bools, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.running import Running
from ethbrake_marl.first_edition.shields.step import StepShield


class RobustShield(StepShield):
    """``StepShield`` whose bound on harm holds in the reported world and in every corner of its box.

    The bound does not cover the worlds between the corners: there, more harm is possible. With gaps known to +- 0.5 m,
    0.29 % of a million worlds between the corners did more harm than the bound. With other intervals the share was 0 to
    5.8 % (docs/extensions/certified.md).

    Args:
        scenario: the scenario of all worlds.
        vehicle: index of the shielded vehicle, or several indices; if ``uncertainty`` is given, only one vehicle is
            possible.
        uncertainty: intervals around the reported quantities. If ``uncertainty`` is None, the caller must pass the
            possible worlds to ``begin`` (argument ``possible``).
        harm_count: ``first`` or ``total``.
        others: scripts of the other vehicles by vehicle index; None: the scripts of the scenario.
        settings: further keyword arguments of ``StepShield``.

    Raises ``InvalidInput`` if ``StepShield`` raises this error, or if an uncertainty is combined with several vehicles
    or with a cap.

    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int | Sequence[int],
        *,
        uncertainty: Uncertainty | None = None,
        harm_count: HarmCount = "first",
        others: Mapping[int, Script] | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(scenario, vehicle, harm_count=harm_count, others=others, **settings)
        if uncertainty is not None and (len(self.vehicles) > 1 or self.cap is not None):
            what = "several shielded vehicles" if self.cap is None else "a cap"
            raise InvalidInput(
                f"shield: uncertainty cannot be combined with {what}; shield one vehicle without a cap, or leave"
                " uncertainty out"
            )
        self.uncertainty = uncertainty

    @property
    def possible_are(self) -> str:  # type: ignore[override]  # a constant there
        """Text in error messages that says which worlds are the members, such as "uncertainty: gaps_m=0.5"."""
        return f"uncertainty: {self.uncertainty}"

    def members_of(self, worlds: Worlds) -> Worlds:
        """Return the members of worlds at the alert, [n * M]: each world followed by the corners of its box."""
        return worlds if self.uncertainty is None else self.uncertainty.members(worlds)

    def _leaves_range(self, running: Running) -> Bools:
        """Return a mask [n]: True for each reported world whose box may contain a world outside the range of the
        members.

        The mask is True where the method of the same name in ``StepShield`` returns True. If the friction is uncertain,
        so that one uncertain number changes several quantities, the mask is True for all worlds.
        """
        leaves = super()._leaves_range(running)
        if self.uncertainty is not None and self.uncertainty.moves_together:
            leaves[:] = True
        return leaves
