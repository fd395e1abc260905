"""The loop in which a team of agents drives worlds to the end of their episodes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from ethbrake_marl.episode.commands import actions_of
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.episode.game import Game, Script, Shield
from ethbrake_marl.episode.layer import KNOWLEDGE, UNSTATED
from ethbrake_marl.episode.script_calls import UserScript, ask_script, begin_script, guard_scripts, name_of
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import AgentFailed, InvalidInput, describe_error
from ethbrake_marl.motion.layout import Floats

NO_BODIES = np.zeros(0, np.int64)
PREDICTED = "predicted_harm"  # measure: harm of the line that an agent predicts at the alert
CHUNK = 2_500  # worlds of a list that are driven together, to limit memory


class Agent(Script, Protocol):
    """A ``Script`` (``episode.game``) with a name: it sees the whole state and returns commands for one vehicle.

    Optional methods: ``check(game, body)`` warns, or raises ``InvalidInput``, if the agent should not drive in a game.
    ``measures(last, memory, body)`` returns what evaluations report of the agent after the episodes, from their last
    states and its last memory: name -> a value as that of a measure (``evaluation.measures``).

    >>> import ethbrake_marl as eb
    >>> class Half:
    ...     name, knows = "half", "own sensors"
    ...     def begin(self, alert, body):
    ...         return None
    ...     def act(self, state, memory, body):
    ...         return -0.5 * state.braking_capacity_mps2[:, body - 1], memory
    >>> eb.evaluate("paper-random", {"half": Half()}, episodes=2)["half"]["total_harm"].round(1)
    array([43.5, 54.7])
    """

    @property
    def name(self) -> str:
        """Name in tables and messages."""

    @property
    def knows(self) -> str:
        """What the agent needs to know: one of the texts of ``episode.layer.KNOWLEDGE``, or ``UNSTATED``.

        Layers filter what it sees unless it claims more than its vehicle receives. An agent without it is ``UNSTATED``.
        """


class Team(NamedTuple):
    """The agents of all learners of a game, perhaps under a shield.

    >>> import ethbrake_marl as eb
    >>> team = eb.Team.of({"vehicle_2": eb.make_agent("coast"), "vehicle_3": eb.make_agent("full_brake")}, "both")
    >>> eb.evaluate("cooperation-3-pair", {"both": team}, episodes=2)["both"]["total_harm"].round(1)
    array([81.3, 64.9])

    """

    name: str  # in tables and messages
    drivers: Mapping[int, Agent]  # vehicle (1: Vehicle 1) -> agent
    shield: Shield | None = None  # it asks the drivers for proposals

    @staticmethod
    def of(drivers: Mapping[str, Agent], name: str, shield: Shield | None = None) -> Team:
        """Team of the agents ``{"vehicle_2": agent, ...}``. Raises ``InvalidInput`` for a bad vehicle name or agent."""
        bodies = {}
        for vehicle, agent in drivers.items():
            if not isinstance(vehicle, str) or re.fullmatch("vehicle_[1-9][0-9]?", vehicle) is None:
                raise InvalidInput(f"team {name!r}: {vehicle!r:.60}: must be the name of a vehicle, such as vehicle_2")
            check_agent(agent, f"team {name!r}: {vehicle} = {agent!r:.60}")
            bodies[int(vehicle.removeprefix("vehicle_"))] = agent
        return Team(name, dict(sorted(bodies.items())), shield)

    def remarks(self, count: HarmCount) -> list[str]:
        """What a table of agents that minimise ``count`` must say of this team: its other counts of harm."""
        agents = [("minimises", getattr(agent, "harm_count", None)) for agent in self.drivers.values()]
        agents += [("trained for", getattr(agent, "trained_for", None)) for agent in self.drivers.values()]
        own = [*agents, ("bounds", getattr(self.shield, "harm_count", None))]
        others = [(verb, of) for verb, of in own if isinstance(of, HarmCount | str) and of not in (count, count.name)]
        return list(dict.fromkeys(f"{verb} {getattr(of, 'words', of)}" for verb, of in others))

    def game(self, game: Game) -> Game:
        """The game with this team's shield.

        Raises ``InvalidInput`` if the team does not drive exactly the learners, or if the game has another shield.
        """
        driven, learners = sorted(self.drivers), sorted(game.settings.learners.tolist())
        if driven != learners:
            names, right = (", ".join(f"vehicle_{i}" for i in bodies) or "nobody" for bodies in (driven, learners))
            raise InvalidInput(
                f"team {self.name!r}: drives {names}; must drive exactly {right}; to change this, change which vehicles"
                " learn: learners=[...] of an environment, scenario.with_learners([...]), or on the command line --set"
                " roles.vehicle_3=learner"
            )
        if self.shield is not None and not learners:
            raise InvalidInput(
                f"team {self.name!r}: the scenario has no learner that its shield could guard; leave out the shield, or"
                " make a vehicle a learner: scenario.with_learners(['vehicle_2'])"
            )
        if game.shield not in (None, self.shield):
            raise InvalidInput(f"team {self.name!r}: the game has a shield of its own; put it around the team instead")
        for body, agent in self.drivers.items():
            if hasattr(agent, "check"):
                agent.check(game, body)
        return game._replace(shield=self.shield)


def check_agent(agent: Any, where: str) -> None:
    """Raise ``InvalidInput``, beginning with ``where``, unless an agent has all attributes of ``Agent``."""
    missing = [part for part in ("name", "begin", "act") if not hasattr(agent, part)]
    if missing:
        raise InvalidInput(
            f"{where}: has no {' and no '.join(missing)}; must be an agent, which has name, begin(alert, body) and"
            " act(state, memory, body); make one with make_agent(name), policy_agent(model) or LearnedAgent(policy)"
        )
    check_knows(getattr(agent, "knows", UNSTATED), where)


def check_knows(knows: Any, where: str) -> None:
    if not isinstance(knows, str) or knows not in (*KNOWLEDGE, UNSTATED):
        right = ", ".join(repr(text) for text in KNOWLEDGE)
        raise InvalidInput(f"{where}: knows = {knows!r:.60}: must be one of {right}, or {UNSTATED!r}")


def play(game: Game, alert: State, team: Team, *, donate: bool = False) -> Iterator[tuple[Step | None, State]]:
    """Let a team drive the worlds ``alert`` to the end; yield each state with the step that led to it (at first
    ``None``).

    Without a shield the agents' commands (m/s2) are applied directly; a shield asks its own agents for proposals.
    ``donate``: each state is overwritten when the next one is computed.
    """
    if not isinstance(team, Team):
        raise InvalidInput(f"team = {team!r:.60}: must be a Team, for instance Team.of({{'vehicle_2': agent}}, 'mine')")
    game, alert = team.game(game), game.marked(alert)
    if game.shield is None:
        drivers = guard_scripts(team.drivers, are_agents=True)
        state, actions = game.reset(alert), np.zeros((alert.n, 0))
        memories = {body: begin_script(agent, alert, body) for body, agent in game.agents(drivers).items()}
        state = state._replace(memories={**state.memories, **memories})
        # From the first decision on, the learners' agents decide as scripts do.
        game = game._replace(scripts={**game.scripts, **drivers}, settings=game.settings._replace(learners=NO_BODIES))
    else:
        state, actions = game.reset(alert), None
    yield None, state
    while not state.ended.all():
        state, step = game.step(state, actions, donate=donate)
        yield step, state


def play_to_end(game: Game, alert: State, team: Team) -> State:
    """Last state of the worlds ``alert`` driven by a team."""
    for _, state in play(game, alert, team, donate=True):
        last = state
    return last


def agents_measures(drivers: Mapping[int, Any], last: State, memories: Mapping[int, Any]) -> dict[str, Any]:
    """What agents report of themselves (their method ``measures``): name -> value, the mean if several report it.

    ``predicted_harm`` is left out if several predict, because each of them assumes what the others do. Raises
    ``AgentFailed`` if an agent's method fails.
    """
    reports: dict[str, list[Any]] = {}
    for body, driver in drivers.items():
        agent = driver.script if isinstance(driver, UserScript) else driver
        if hasattr(agent, "measures"):
            try:
                report = dict(agent.measures(last, memories.get(body), body))
            except Exception as error:
                problem = f"vehicle_{body}: measures fails: {describe_error(error)}"
                raise AgentFailed(name_of(agent), None, problem) from error
            for name, value in report.items():
                reports.setdefault(name, []).append(value)
    return {
        name: values[0] if len(values) == 1 else np.mean(values, axis=0)
        for name, values in reports.items()
        if len(values) == 1 or name != PREDICTED
    }


def propose(drivers: Mapping[int, Agent], state: State, memories: Mapping[int, Any]) -> tuple[Floats, dict[int, Any]]:
    """Actions that agents propose, [n, L] in the order of ``drivers`` (vehicle -> agent), and their new memories."""
    actions, after = np.empty((state.n, len(drivers))), dict(memories)
    for column, (body, agent) in enumerate(drivers.items()):
        commands, after[body] = ask_script(agent, state, memories[body], body)
        actions[:, column] = actions_of(state, body, commands)
    return actions, after
