"""Shields by name, such as ``step`` in the agent ``ppo+step`` or in ``eb.shield(env, mode="step")``."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from typing import Any, NamedTuple

from ethbrake_marl.agents.drive import Team
from ethbrake_marl.episode.game import Shield
from ethbrake_marl.errors import InvalidInput


class NamedShield(NamedTuple):
    """Makes a shield of one class for a team. Text after the colon of its name sets the option ``argument``."""

    shield: Callable[..., Shield]  # (drivers, harm_count=..., **options); one called ``scenario`` is the worlds'
    argument: str | None = None  # the option that is the text after the colon

    def __call__(self, team: Team, text: str | None, settings: Any) -> Team:
        """Team with the shield. Raises ``InvalidInput`` for bad options, and for a team that has a shield.

        ``text`` follows the colon of the shield's name; ``settings`` are ``names.AgentSettings``.
        """
        if team.shield is not None:
            raise InvalidInput(f"shield: team {team.name!r} already has a shield")
        wanted, options = signature(self.shield), {**settings.options, "harm_count": settings.harm_count}
        if "scenario" in wanted.parameters:
            options["scenario"] = settings.needed_scenario()
        if text is not None:
            if self.argument is None or self.argument in options:
                raise InvalidInput(f"shield {settings.spec!r}: {text!r} cannot follow the colon; leave it out")
            options[self.argument] = text
        try:
            wanted.bind(team.drivers, **options)
        except TypeError as error:
            known = ", ".join([*wanted.parameters][1:])
            raise InvalidInput(f"shield {settings.spec!r}: {error}; its options: {known}") from None
        return team._replace(shield=self.shield(team.drivers, **options))
