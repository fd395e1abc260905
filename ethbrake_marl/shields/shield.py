"""What all shields share: how a name becomes a shield, checks, reasons in the infos, and a reward term."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import IntEnum
from inspect import signature
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.team import PREDICTED, Agent, Team, agents_measures, check_agent
from ethbrake_marl.episode.game import Game, Shield
from ethbrake_marl.episode.script_calls import guard_scripts
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import Floats


class ShieldReason(IntEnum):
    """Why the step shield accepted or replaced an action.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldReason(3).name
    'NO_CERTIFICATE'

    """

    NO_DECISION = -1  # before the first step, and always for a vehicle that follows a script
    SAME_AS_PLAN = 0  # accepted: it is the plan's action
    PLAN_REMAINS = 1  # accepted: the bound holds if the rest of the plan follows
    CONSTANT = 2  # accepted: the bound holds if constant actions follow
    NO_CERTIFICATE = 3  # replaced: the bound holds for no plan that was tried
    NOT_A_NUMBER = 4  # replaced: nothing was proposed
    ENDED = 5  # the episode is over (6 is not used)
    POLICY_ROLLOUT = 7  # accepted: the bound holds if the shield's own agents drive on

    @property
    def text(self) -> str:
        """The reason in words, such as "no certificate"."""
        return self.name.lower().replace("_", " ")


class NamedShield(NamedTuple):
    """Makes a shield of one class for a team.

    In a shield's name ``NAME:TEXT``, ``TEXT`` becomes the option whose name is in the field ``argument``.
    """

    shield: Callable[..., Shield]  # (drivers, harm_count=..., **options); one called ``scenario`` is the worlds'
    argument: str | None = None  # the option that is the text after the colon

    def __call__(self, team: Team, text: str | None, settings: Any) -> Team:
        """The team with the shield. Raises ``InvalidInput`` for bad options, and for a team that already has a shield.

        ``text``: the part of the shield's name after the colon, or None. ``settings``: ``names.AgentSettings``.
        """
        if team.shield is not None:
            raise InvalidInput(f"shield: team {team.name!r} already has a shield")
        shield_signature, options = signature(self.shield), {**settings.options, "harm_count": settings.harm_count}
        if "scenario" in shield_signature.parameters:
            options["scenario"] = settings.needed_scenario()
        if text is not None:
            if self.argument is None or self.argument in options:
                raise InvalidInput(f"shield {settings.spec!r}: {text!r} cannot follow the colon; leave it out")
            options[self.argument] = text
        try:
            shield_signature.bind(team.drivers, **options)
        except TypeError as error:
            option_names = ", ".join([*shield_signature.parameters][1:])
            raise InvalidInput(f"shield {settings.spec!r}: {error}; its options: {option_names}") from None
        return team._replace(shield=self.shield(team.drivers, **options))


def checked_drivers(drivers: Mapping[int, Agent] | None) -> dict[int, Agent]:
    for body, agent in (drivers or {}).items():
        check_agent(agent, f"shield: policy of vehicle_{body} = {agent!r:.60}")
    return guard_scripts(dict(sorted((drivers or {}).items())), are_agents=True)


def check_drivers(game: Game, drivers: Mapping[int, Agent]) -> None:
    if list(drivers) != game.settings.learners.tolist():
        names, right = (", ".join(f"vehicle_{i}" for i in bodies) for bodies in (drivers, game.settings.learners))
        raise InvalidInput(f"shield: has agents for {names}; must have one for each learner, {right or 'none'}")


def report_of(drivers: Mapping[int, Agent], last: State, memories: Mapping[int, Any]) -> dict[str, Any]:
    """What the agents inside a shield report (``agents_measures``), without their prediction: the shield changes it."""
    return {name: value for name, value in agents_measures(drivers, last, memories).items() if name != PREDICTED}


def spread(game: Game, state: State, columns: Any, script_value: Any = 0) -> Any:
    """Values of all vehicles, [n, N]: ``columns`` [n, L] for the learners, ``script_value`` for the other vehicles."""
    wide = np.full((state.n, state.vehicles), script_value, columns.dtype)
    wide[:, game.settings.learners - 1] = columns
    return wide


def intervention(before: State, step: Step, after: State) -> Floats:
    """Minus 1 for each vehicle whose proposed action a shield has replaced, otherwise 0."""
    memory = after.memories.get("shield")
    if memory is None:
        raise InvalidInput(
            "this game has no shield, so the term would always be 0; give the environment a shield, eb.shield(env), or"
            " leave the term out of the reward (training by a recipe has no shield)"
        )
    return np.where(memory.intervened, -1.0, 0.0)
