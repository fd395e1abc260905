"""Agents and shields by name: ``full_brake``, ``constant:3``, ``policy@runs/mine``, ``mine.py:make``, ``ppo+step``.

::

    spec    = agent, then any number of "+" wrapper
    agent   = NAME[:ARGUMENT][@PATH], or FILE.py:FUNCTION[:ARGUMENT][@PATH]
    wrapper = NAME[:ARGUMENT], a shield around what stands before it

The tables ``AGENTS`` and ``WRAPPERS`` contain the names. An entry called ``NAME.ARGUMENT`` replaces the entry ``NAME``
for this argument. An agent's entry may also be a group: a list of specs, such as ``ladder``. Lists are split at commas,
and specs at ``+``, so no path may contain a comma or a plus.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from inspect import signature
from itertools import product
from typing import Any

from ethbrake_marl.agents.team import Agent, Team, check_agent, check_knows
from ethbrake_marl.episode.counts import HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.game import Game, Script
from ethbrake_marl.episode.layer import UNSTATED
from ethbrake_marl.errors import EthBrakeError, InvalidInput, UnknownName, describe_error
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.registry import Registry
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.open_game import AnyScenario, game_of
from ethbrake_marl.worlds.roles import HOLDING_SCRIPTS, LEARNER, check_role
from ethbrake_marl.worlds.scenario import Scenario

AGENT_NAME_PATTERN = re.compile(r"[a-z][a-z0-9_-]*(\.[a-z0-9_-]+)*")
IN_FILE = re.compile(r"(?P<file>.+?\.py):(?P<name>[A-Za-z_]\w*)(:(?P<argument>[^@]+))?(@(?P<policy>.+))?")
MODEL_FILE = re.compile(r"[^:@]+\.(zip|pt|pth|onnx|safetensors)")
PLAIN = re.compile(r"(?P<name>[^:@+]*)(:(?P<argument>[^@]*))?(@(?P<policy>.*))?")

AgentOrTeam = Agent | Team


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """Settings for a function that makes an agent, in addition to the argument in the agent's name.

    >>> import ethbrake_marl as eb
    >>> def make_mine(argument, settings):
    ...     return eb.make_agent("e_v2x_bm", scenario=settings.needed_scenario(), harm_count=settings.harm_count)
    >>> make_mine(None, eb.AgentSettings("mine", scenario=eb.load_scenario("paper-random"))).name
    'e_v2x_bm'

    """

    spec: str  # as the user has written it
    policy: str | None = None  # path after the @
    scenario: Scenario | None = None  # in which the agent drives; None: not known
    harm_count: HarmCount = HONEST  # what optimising agents minimise
    options: Mapping[str, Any] = field(default_factory=dict)  # of ``eb.shield``; a name has none

    def needed_scenario(self) -> Scenario:
        """Raises ``InvalidInput`` if it is unknown."""
        if self.scenario is None:
            raise InvalidInput(
                f"agent {self.spec!r}: needs a scenario, for instance make_agent({self.spec!r},"
                " scenario='paper-random')"
            )
        return self.scenario


@dataclass(frozen=True, slots=True)
class AgentEntry:
    make: Callable[..., Any]  # (argument, settings) -> agent or team; of a wrapper: (team, argument, settings) -> team
    about: str
    knows: str
    form: str  # how the name is written, such as ``constant:A``; without a colon it takes no argument


def register_agent(
    name: str,
    make: Callable[[str | None, AgentSettings], AgentOrTeam] | Sequence[str],
    *,
    about: str = "an agent of your own",
    knows: str = UNSTATED,
    form: str | None = None,
) -> None:
    """Register an agent under a name, for use wherever agents are named. Entry points: ``ethbrake_marl.agents``.

    Raises ``AlreadyExists`` for a name in use, and ``InvalidInput`` for an invalid one.

    Args:
        name: characters ``a-z``, ``0-9``, ``_``, ``-``, beginning with a letter.
        make: ``make(argument, settings)`` returns the agent or a team; ``argument`` is the text after the colon, or
            None. For a group: a list of specs.
        about: description in one line.
        knows: what the agent needs to know: one of ``episode.layer.KNOWLEDGE``.
        form: how the name is written, as ``NAME[:ARGUMENT][@PATH]``; None: the name, with or without an argument.

    """
    _add(AGENTS, name, make, about, knows, form)


def register_shield(
    name: str,
    make: Callable[[Team, str | None, AgentSettings], Team],
    *,
    about: str = "a wrapper of your own",
    knows: str = UNSTATED,
    form: str | None = None,
) -> None:
    """Register a shield under a name that can follow a ``+``. Entry points: ``ethbrake_marl.shields``.

    ``make(team, argument, settings)`` returns the team with the shield around it; the other arguments are as in
    ``register_agent``. A shield's name is also a ``mode`` of ``eb.shield``, which passes further keywords as
    ``settings.options``.
    """
    _add(WRAPPERS, name, make, about, knows, form)


def _add(table: Registry[AgentEntry], name: str, make: Any, about: str, knows: str, form: str | None) -> None:
    if not isinstance(name, str) or AGENT_NAME_PATTERN.fullmatch(name) is None:
        raise InvalidInput(
            f"{table.kind} {name!r:.80}: the name must have the characters a-z, 0-9, _ and -, beginning with a letter"
        )
    check_knows(knows, f"{table.kind} {name!r}")
    table.add(
        name, AgentEntry(make, about, knows, form or f"{name}[:ARGUMENT]"), lambda registered: registered.make == make
    )


AGENTS: Registry[AgentEntry] = Registry("agent", "agents", register_agent)
WRAPPERS: Registry[AgentEntry] = Registry("shield", "shields", register_shield)


def make_agent(spec: str, *, scenario: AnyScenario | None = None, harm_count: AnyCount = HONEST) -> AgentOrTeam:
    """Agent or team for a name such as ``"constant:3.5"`` or ``"ppo+step"`` (syntax: top of this file).

    Teams, wrappers and agents that look ahead need ``scenario``. ``harm_count``: harm that optimising agents minimise
    (``episode.counts``). A Python file in the name runs with all your rights. Raises ``UnknownName``, and
    ``InvalidInput`` for a bad argument.

    >>> import ethbrake_marl as eb
    >>> eb.make_agent("constant:3.5").name
    'constant:3.5'

    """
    loaded = None if scenario is None else load_scenario(scenario)
    if not isinstance(spec, str) or not spec:
        raise InvalidInput(f"agent {spec!r:.80}: must be a name, for instance full_brake, policy@runs/mine or ppo+step")
    split_specs(spec)
    core, *wrappers = spec.split("+")
    settings = AgentSettings(core, None, loaded, HarmCount.of(harm_count))
    driver = _make(core, settings)
    for wrapper in wrappers:
        settings = replace(settings, spec=f"{settings.spec}+{wrapper}")
        driver = wrap_team(team_of(driver, settings.needed_scenario()), wrapper, settings)
    return driver


def wrap_team(team: Team, wrapper: str, settings: AgentSettings) -> Team:
    entry, argument = _look_up(WRAPPERS, *wrapper.partition(":")[::2])
    result: Team = _call_maker(settings.spec, entry.make, team, argument, settings)
    return result._replace(name=settings.spec)


def team_of(driver: AgentOrTeam, scenario: Scenario) -> Team:
    """A single agent drives every learner, with a separate memory for each."""
    if isinstance(driver, Team):
        return driver
    return Team(driver.name, dict.fromkeys(scenario.learners, driver))


def make_teams(specs: str | Iterable[str], scenario: Scenario, *, harm_count: AnyCount = HONEST) -> dict[str, Team]:
    """A group of agents is replaced by its specs.

    ``specs``: a list, or a text with commas. Raises the errors of ``make_agent``, and ``InvalidInput`` for a repeated
    spec.
    """
    teams: dict[str, Team] = {}
    for name in split_specs(specs) if isinstance(specs, str) else specs:
        for spec in group(name) or [name]:
            if spec in teams:
                raise InvalidInput(f"agent {spec!r} is listed twice; list each agent once")
            teams[spec] = team_of(make_agent(spec, scenario=scenario, harm_count=harm_count), scenario)
    return teams


def teams_of(agents: Any, scenario: Scenario, *, harm_count: AnyCount = HONEST) -> dict[str, Team]:
    """``agents`` is a text or list as in ``make_teams``; or a mapping from names to specs, agents, teams, or mappings
    from vehicles to specs and agents: ``{"mine": {"vehicle_2": agent, "vehicle_3": "coast"}}``.
    """
    if isinstance(agents, str) or (isinstance(agents, Iterable) and not isinstance(agents, Mapping)):
        return make_teams(agents, scenario, harm_count=harm_count)
    if not isinstance(agents, Mapping) or not agents:
        raise InvalidInput(
            f"agents = {agents!r:.80}: must be names, such as 'ppo,full_brake', or a mapping, such as {{'mine': agent}}"
        )
    teams = {}
    for name, description in agents.items():
        if not isinstance(name, str) or not name or not name.isprintable():
            raise InvalidInput(
                f"agents: the name {name!r:.60} must be a text without line breaks and control characters"
            )
        if isinstance(description, Mapping):
            drivers = {vehicle: _driver(entry, scenario, harm_count) for vehicle, entry in description.items()}
            teams[name] = Team.of(drivers, name)
        else:
            driver = _driver(description, scenario, harm_count)
            if not isinstance(driver, Team):
                check_agent(driver, f"agent {name!r} = {driver!r:.60}")
            teams[name] = team_of(driver, scenario)._replace(name=name)
    return teams


def _driver(agent: Any, scenario: Scenario, harm_count: AnyCount) -> Any:
    return make_agent(agent, scenario=scenario, harm_count=harm_count) if isinstance(agent, str) else agent


def group(name: str) -> list[str]:
    if name not in AGENTS or callable(AGENTS[name].make):
        return []
    spec_lists: list[Any] = [AGENTS[entry].make for entry in AGENTS if entry == name or entry.startswith(f"{name}.")]
    return [spec for specs in spec_lists for spec in specs]


def split_specs(text: str) -> list[str]:
    """At commas. An existing path with a comma or plus is refused."""
    begins = [match.end() for match in re.finditer(r"^|[,@]", text)]
    ends = [match.end() for match in re.finditer(r"(?=[,+]|$)|\.py(?=:)", text)]
    for begin, end in product(begins, ends):
        path = text[begin:end]
        if (text[:begin].endswith("@") or path.endswith(".py")) and os.path.lexists(os.path.expanduser(path)):
            check_path(path)
    return text.split(",")


def check_path(path: str | os.PathLike[str]) -> None:
    if {",", "+"} & {*str(path)}:
        raise InvalidInput(
            f"{path}: a path in the name of an agent must have no comma and no plus; rename it, or make a link to it"
        )


def _make(core: str, settings: AgentSettings) -> AgentOrTeam:
    if MODEL_FILE.fullmatch(core):
        raise InvalidInput(
            f"agent {core!r}: is a file; load it: {{'mine': eb.policy_agent(MODEL)}}, where MODEL is PPO.load({core!r})"
            " or another loaded model; on the command line FILE.py:FUNCTION, a function that returns this agent"
        )
    in_file = IN_FILE.fullmatch(core)
    match = in_file or PLAIN.fullmatch(core)
    if match is None:
        raise InvalidInput(f"agent {core!r}: must be NAME[:ARGUMENT][@PATH] or FILE.py:FUNCTION[:ARGUMENT][@PATH]")
    name, argument, policy = match["name"], match["argument"], match["policy"]
    if policy is not None:
        if not policy:
            raise InvalidInput(f"agent {core!r}: a path must follow '@'")
        settings = replace(settings, policy=os.path.expanduser(policy))
    if in_file:
        make = _in_file(in_file, settings)
    else:
        entry, argument = _look_up(AGENTS, name, argument or "", policy)
        make = entry.make
        if not callable(make):
            raise InvalidInput(f"agent {core!r}: is the name of a group of agents; write the name of one agent")
    driver: AgentOrTeam = _call_maker(core, make, argument or None, settings)
    if not isinstance(driver, Team):
        check_agent(driver, f"agent {core!r} = {driver!r:.60}")
    return driver


def _look_up(
    table: Registry[AgentEntry], name: str, argument: str, policy: str | None = None
) -> tuple[AgentEntry, str | None]:
    """With a policy's path, a name that is no agent is taken for the algorithm that trained the policy."""
    rest, _, last = argument.rpartition(":")
    if argument and f"{name}.{last}" in table:
        return table[f"{name}.{last}"], rest or None
    if name not in table and policy is not None and table is AGENTS:
        return AGENTS["policy"], name  # ppo@PATH: the algorithm that trained the policy
    if name not in table:
        raise table.unknown(name)
    entry = table[name]
    if argument and ":" not in entry.form:
        raise InvalidInput(f"{table.kind} {f'{name}:{argument}'!r}: {name} takes no argument")
    if policy is not None and "@" not in entry.form:
        raise InvalidInput(f"agent {f'{name}@{policy}'!r}: {name} uses no policy; leave out @ and what follows")
    return entry, argument or None


def _in_file(match: re.Match[str], settings: AgentSettings) -> Callable[..., Any]:
    function = load_from_file(match["file"], match["name"], reads=settings.policy)
    if not callable(function):
        raise InvalidInput(
            f"file {match['file']!r}: {match['name']!r} is not a function; write FILE.py:FUNCTION, where FUNCTION makes"
            " the agent"
        )
    if not signature(function).parameters:
        if match["argument"] or match["policy"]:
            raise InvalidInput(
                f"agent {settings.spec!r}: the function {match['name']} has no parameters; write the name without an"
                " argument and without a policy"
            )
        return lambda argument, settings: function()
    return function  # type: ignore[no-any-return]  # checked by its call


def _call_maker(spec: str, make: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return make(*arguments)
    except EthBrakeError:
        raise
    except Exception as error:
        raise InvalidInput(f"agent {spec!r}: {describe_error(error)}") from error


def open_game(
    scenario: AnyScenario,
    learners: Iterable[str] | None = None,
    reward: Any = "honest",
    observation: Any = None,
    reward_vector: Any = None,
    report: Sequence[str] = (),
) -> tuple[Scenario, Game]:
    """The scenario with these learners and observations, and its game. Arguments: see ``EthBrakeParallelEnv``.

    A vehicle whose role is the name of an agent is driven by that agent.
    """
    loaded = load_scenario(scenario)
    if learners is not None:
        loaded = loaded.with_learners(learners)
    return game_of(loaded, scripts_of(loaded), reward, observation, reward_vector, report)


def require_learner(scenario: Scenario) -> None:
    if not scenario.learners:
        raise InvalidInput(
            f"scenario {scenario.name!r} has no learner that the agents could drive; choose the scenario that the"
            " agents were trained for, or make a vehicle a learner: scenario.with_learners(['vehicle_2']), on the"
            " command line --set roles.vehicle_2=learner"
        )


def scripts_of(scenario: Scenario) -> Mapping[int, Script]:
    """By the vehicle's number (1: Vehicle 1)."""
    scripts = {}
    for body, (vehicle, role) in enumerate(scenario.roles.items(), 1):
        if role.partition(":")[0] not in (LEARNER, *HOLDING_SCRIPTS):
            where = f"scenario {scenario.name!r}: roles.{vehicle} = {role}"
            check_role(role)
            try:
                agent = make_agent(role, scenario=scenario)
            except InvalidInput as error:
                kind = UnknownName if isinstance(error, UnknownName) else InvalidInput
                raise kind(f"{where}: {error}") from None
            if isinstance(agent, Team):
                raise InvalidInput(
                    f"{where}: is a team, or has a shield; a vehicle that does not learn must be driven by a single"
                    " agent"
                )
            scripts[body] = agent
    return scripts


def listed_agents() -> list[AgentEntry]:
    """Without groups."""
    agents = [entry for entry in AGENTS.usable().values() if callable(entry.make)]
    return agents + [replace(entry, form=f"+{entry.form}") for entry in WRAPPERS.usable().values()]


def why_not_listed() -> list[str]:
    reasons = (table.why_not(name) for table in (AGENTS, WRAPPERS) for name in table)
    return [reason for reason in reasons if reason is not None]
