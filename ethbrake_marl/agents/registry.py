"""The registry of agents, shields and variants by name, and how an agent is written: ``ppo@shipped+search+step``.

Names are entry points (``ethbrake_marl.registry``), loaded when they are first used. So policies, searches and shields,
which belong to layers above this folder, have names without being imported here.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.protocol import Agent, Driver, Source, Team, check_agent
from ethbrake_marl.errors import AlreadyExists, EthBrakeError, InvalidInput, describe_error, unknown_name
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.game.harm import HarmCount, check_harm_count
from ethbrake_marl.registry import Registry
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.roles import ScriptSpec
from ethbrake_marl.scenario.schema import Scenario

# Syntax of an agent: ``name[:argument][:variant][@policy]``, followed by the wrappers around it.
#
# ``+search`` comes first, then one shield, for example ``+episode:pairwise`` or ``+step``. Shields have variants too.
# A name may be a function in a Python file, ``my_file.py:make_agent``.
#
# The separators ``, + @ :`` may occur in a path. If such a path exists, they do not separate anything there.

_IN_FILE = re.compile(r":(?P<function>[A-Za-z_]\w*)(:(?P<argument>[^\s@]+))?(@(?P<policy>.+))?")

_BEGINS_WITH_FILE = re.compile(r"[^:@]+\.py(:.*)?")


@dataclass(frozen=True, slots=True)
class AgentSpec:
    """A parsed agent specification."""

    name: str  # or FILE.py:FUNCTION
    argument: str | None  # after the colon
    policy: str | None  # after the @: a path, or "shipped"
    around: tuple[str, ...]  # wrappers with their arguments, innermost first

    @property
    def core(self) -> str:
        """The agent without its wrappers."""
        argument = "" if self.argument is None else f":{self.argument}"
        return f"{self.name}{argument}" + ("" if self.policy is None else f"@{self.policy}")

    @property
    def file(self) -> tuple[str, str] | None:
        """The Python file and the function in it that makes the agent; None for any other agent."""
        file, _, function = self.name.rpartition(":")
        return (file, function) if file else None

    @property
    def shield(self) -> str | None:
        """The outermost wrapper if it is a shield; otherwise None."""
        return self.around[-1] if self.around and not _around(self.around[-1]).inner else None

    def __str__(self) -> str:
        return "".join([self.core, *(f"+{each}" for each in self.around)])


def parse_spec(spec: str) -> AgentSpec:
    """Parse an agent specification. A path in it may contain any character.

    ``ppo@c+step`` is the folder ``c+step`` if it exists, otherwise the folder ``c`` behind the shield; ``ppo@c/+step``
    is always the latter. Raises ``InvalidInput`` for invalid syntax, two shields or another order; ``UnknownName`` for
    an unknown wrapper.
    """
    core, around = _split_around(spec)
    if file := _python_file(core):
        match = _IN_FILE.fullmatch(core, len(file))
        if match is None:
            raise InvalidInput(
                f"agent {spec!r}: one from a file is FILE.py:FUNCTION, FILE.py:FUNCTION:ARGUMENT or"
                " FILE.py:FUNCTION@POLICY, for instance my_file.py:make_agent"
            )
        return AgentSpec(f"{file}:{match['function']}", match["argument"], match["policy"], around)
    head, at, path = core.partition("@")
    name, argument = ScriptSpec.parse(head if at else core)
    if at and not path:
        raise InvalidInput(f"agent {spec!r}: a path is needed after '@'")
    return AgentSpec(name, argument, path if at else None, around)


def split_names(text: str, is_one: Callable[[str], bool] = os.path.lexists) -> list[str]:
    """Split a comma-separated list of names; commas inside a name are kept if ``is_one`` accepts the longer text."""
    parts, names = text.split(","), list[str]()
    while parts:
        joined = (k for k in range(len(parts), 1, -1) if is_one(",".join(parts[:k])))
        count = next(joined, 1)
        names.append(",".join(parts[:count]))
        parts = parts[count:]
    return names


def split_specs(text: str) -> list[str]:
    """Split a comma-separated list of agent specifications; commas in paths that exist are kept."""
    return split_names(text, _is_one_spec)


def _is_one_spec(text: str) -> bool:
    core, around = _strip_around(text)
    head, _, path = core[len(_existing_file(core)) :].partition("@")
    return "," not in "".join([head, *around]) and ("," not in path or os.path.lexists(path))


def _existing_file(core: str) -> str:
    """Return the longest existing Python file with which a specification begins; empty without one."""
    ends = (match.start() for match in re.finditer(r"(?<=\.py):", core))
    return max((core[:end] for end in ends if os.path.isfile(core[:end])), key=len, default="")


def _python_file(core: str) -> str:
    """Return the Python file with which a specification begins, whether it exists or not; empty without one."""
    return _existing_file(core) or (core.partition(":")[0] if _BEGINS_WITH_FILE.fullmatch(core) else "")


def _policy_path(core: str) -> str:
    return core[len(_python_file(core)) :].partition("@")[2]


def _strip_around(spec: str) -> tuple[str, list[str]]:
    """Split a specification into the agent and its wrappers; a path of an existing policy is kept whole."""
    core, around = spec, list[str]()
    while True:
        before, plus, last = core.rpartition("+")
        if not (plus and last.partition(":")[0] in _SHIELDS) or os.path.lexists(_policy_path(core)):
            return core, around
        core, around = before, [last, *around]


def _split_around(spec: str) -> tuple[str, tuple[str, ...]]:
    core, around = _strip_around(spec if isinstance(spec, str) else "")
    if not core:
        ScriptSpec.parse(spec)  # raises the error
    before, plus, last = core.rpartition("+")
    if plus and _is_meant_around(before, core, last):
        raise unknown_name("shield or search", last, around_forms())
    for each in around:
        if not _around(each).takes(each.partition(":")[2]):
            raise unknown_name("shield or search", each, around_forms())
    shields = [each for each in around if not _around(each).inner]
    if len(shields) > 1 or any(each not in shields for each in around[1:]):
        searches = [each for each in around_forms() if _around(each).inner]
        raise InvalidInput(
            f"agent {spec!r}: +{', +'.join(searches)} comes first and once, then one shield of"
            f" +{', +'.join(shield_forms())}; for instance ppo@shipped+search+step"
        )
    return core, tuple(around)


def _is_meant_around(before: str, core: str, last: str) -> bool:
    """Return whether an unknown word after a ``+`` is a misspelt wrapper, rather than part of an argument or a path."""
    file = _python_file(core)
    if ".py" in last or (file and _IN_FILE.fullmatch(core, len(file))):
        return False  # the + belongs to the path of a Python file, or to its argument
    if ":" not in before and "@" not in before:
        return True
    if "/" in last or "\\" in last:
        return False  # the last part of a path
    return not os.path.lexists(_policy_path(core)) and bool(get_close_matches(last.partition(":")[0], _SHIELDS))


HORIZON_S = 8.0  # horizon of agents that look ahead, if there is no scenario


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """Settings for making an agent, beyond its own argument.

    >>> import ethbrake_marl as eb
    >>> eb.AgentSettings("planner:64", scenario=eb.load_scenario("paper-random")).needed_scenario().name
    'paper-random'

    """

    spec: str  # the specification, with the wrappers so far
    policy: str | None = None  # text after the @
    scenario: Scenario | None = None  # scenario of the agent, if known
    harm_count: HarmCount = "first"  # harm that an optimising agent minimises
    horizon_s: float = HORIZON_S  # time until which it looks ahead (s)
    most_candidates: int | None = None  # upper limit for a search, stricter than its argument; None: no limit
    uncertainty: object = None  # what a shield does not know about the worlds, in that shield's format
    time_step_s: float = 0.1  # time between two decisions
    role: int | None = None  # index of the vehicle, if the agent is its role in the scenario; otherwise None

    def needed_scenario(self) -> Scenario:
        """Return the scenario; raise ``InvalidInput`` if there is none."""
        if self.scenario is None:
            raise InvalidInput(
                f"agent {self.spec!r}: needs a scenario: make_agent({self.spec!r}, scenario='paper-random')"
            )
        return self.scenario


Factory = Callable[[str | None, AgentSettings], Driver]
"""Makes the agent of an argument (what stands after the colon, or None)."""

Wrapper = Callable[[Any, str | None, AgentSettings], Driver]
"""Makes the agent around an agent."""


@dataclass(frozen=True, slots=True)
class Entry:
    """An entry of the registry: an agent, or a wrapper (a shield or search)."""

    name: str
    form: str  # how it is written; no argument if there is no ":", no policy if there is no "@"
    about: str  # description in one line
    knows: Source | Sequence[Source]  # knowledge while driving; for a wrapper: knowledge that it adds
    make: Factory | Wrapper
    inner: bool = False  # for a wrapper: it goes directly around the agent, inside a shield
    teams: bool = False  # for a wrapper: it can go around a team too
    needs: Mapping[str, object] = field(default_factory=dict)  # required settings -> an example
    options: type | None = None  # settings class of a shield that also goes around environments

    @property
    def is_ours(self) -> bool:
        """Whether this package makes the agent; errors of other agents are reported as theirs."""
        is_from_file = ":" in self.name
        return str(getattr(self.make, "__module__", "")).startswith("ethbrake_marl.") and not is_from_file

    @property
    def whole_form(self) -> str:
        """How it is written, including its variants."""
        return self.form + "".join(f"[:{variant}]" for variant in variants_of(self.name))

    @property
    def words(self) -> tuple[str, ...]:
        """Everything that may be written after the ``+`` for a wrapper whose arguments are fixed words."""
        name, *options = re.findall(r"[^\[\]+]+", self.whole_form)
        found = [name]
        for option in options:
            found += [f"{each}{option}" for each in found]
        return tuple(found)

    def takes(self, argument: str) -> bool:
        """Return whether a wrapper takes this argument; empty: no argument."""
        name = self.words[0]
        return "[:ARGUMENT]" in self.form or (f"{name}:{argument}" if argument else name) in self.words

    def call(self, argument: str | None, settings: AgentSettings, *inside: Driver) -> Driver:
        """Make the agent; a wrapper is put around ``inside``."""
        make: Any = self.make
        before, _, last = (argument or "").rpartition(":")
        if last in variants_of(self.name):
            argument, make = before or None, _VARIANTS[f"{self.name}.{last}"].make
        made: Driver = make(*inside, argument, settings)
        return made


class Variant(NamedTuple):
    """A variant of an agent or a shield, selected by a word after its argument."""

    make: Factory | Wrapper
    about: str  # description in one line


def make_agent(
    spec: str,
    *,
    scenario: Scenario | str | Path | None = None,
    harm_count: HarmCount = "first",
    horizon_s: float | None = None,
    most_candidates: int | None = None,
    uncertainty: object = None,
    time_step_s: float | None = None,
) -> Driver:
    """Make a new agent for one vehicle in one batch, or a team of agents from one training run.

    Args:
        spec: ``name[:argument][@policy]`` and wrappers, for example ``constant:3.5``, ``planner:64``,
            ``ppo@shipped+search+step``; ``ethbrake agent list`` lists all. ``my_file.py:make_agent`` runs that file,
            which can do whatever you can: its function gets the arguments of a factory (see ``register_agent``), or
            none.
        scenario: scenario, its name or the path of its file; needed by teams, by wrappers, and to find the shipped
            policy for this scenario.
        harm_count: harm that an optimising agent minimises, ``first`` or ``total``.
        horizon_s: time until which it looks ahead, s; None: the scenario's horizon, or 8 s.
        most_candidates: upper limit for the candidates of a search, to try an agent out quickly.
        uncertainty: what a shield for uncertain worlds does not know, for example ``"gaps_m=0.5"``.
        time_step_s: time between two decisions for agents that search or follow a control law; None: the scenario's, or
            0.1 s.

    Raises ``UnknownName`` with a suggestion for an unknown name; ``InvalidInput`` for an invalid argument, harm count
    or horizon, and for a missing scenario.

    >>> import ethbrake_marl as eb
    >>> eb.make_agent("ppo@shipped+step", scenario="paper-random").name
    'ppo@shipped+step'

    """
    check_harm_count(harm_count)
    scenario = None if scenario is None else load_scenario(scenario)
    if horizon_s is None:
        horizon_s = HORIZON_S if scenario is None else scenario.horizon_s
    if not isinstance(horizon_s, int | float | np.number) or not 0.0 < horizon_s < float("inf"):
        raise InvalidInput(f"horizon_s {horizon_s!r}: must be a positive number of seconds")
    written = parse_spec(spec)
    if written.name == _PROFILE:
        raise InvalidInput(f"agent {spec!r}: a profile is a role of a scenario, fixed at the alert; it is no agent")
    settings = AgentSettings(
        written.core, written.policy, scenario, harm_count, float(horizon_s), most_candidates, uncertainty,
        time_step_s or (0.1 if scenario is None else scenario.time_step_s),
    )  # fmt: skip
    return _make_driver(written, settings)


def _make_driver(written: AgentSpec, settings: AgentSettings) -> Driver:
    driver = _make(find_entry(written), written.argument, settings)
    for each in written.around:
        settings, entry = replace(settings, spec=f"{settings.spec}+{each}"), _around(each)
        if isinstance(driver, Team) and not entry.teams:
            raise InvalidInput(
                f"agent {settings.spec!r}: is a team, and +{each} is for one driven vehicle, the others following"
                " scripts (--set roles.vehicle_3=full_brake); +step goes around a team; else name one policy of the"
                " team (ppo@RUN/policy/vehicle_2)"
            )
        driver = _make(entry, each.partition(":")[2] or None, settings, driver)
    return driver


def make_role(scenario: Scenario, vehicle: int, *, most_candidates: int | None = None) -> Agent:
    """Make the agent for the role of ``vehicle`` in the scenario, optimising first-impact harm.

    ``most_candidates`` is as in ``make_agent``. Raises what ``make_agent`` raises, and ``InvalidInput`` for a wrapper,
    and for a team without this vehicle.
    """
    spec = scenario.scripts[vehicle]
    name, _, argument = spec.partition(":")
    written = AgentSpec(_PROFILE, argument, None, ()) if name == _PROFILE else parse_spec(spec)
    settings = AgentSettings(
        written.core, written.policy, scenario, horizon_s=scenario.horizon_s, most_candidates=most_candidates,
        time_step_s=scenario.time_step_s, role=vehicle,
    )  # fmt: skip
    team = None if written.around else Team.of(_make_driver(written, settings), (vehicle,))
    if team is None or team.shield is not None:
        raise InvalidInput(
            f"agent {spec!r}: a search or a shield goes around a driver, never around a role; let"
            f" {scenario.vehicle_names[vehicle]} follow {written.core}, or drive it"
        )
    return team.drivers[vehicle]


def find_entry(spec: AgentSpec | str) -> Entry:
    """Return the registry's entry of an agent.

    Raises ``UnknownName`` with a suggestion; ``InvalidInput`` for an argument or a policy that the agent does not take.
    """
    written = parse_spec(spec) if isinstance(spec, str) else spec
    if written.file is not None:
        form = f"{written.name}[:ARGUMENT][@POLICY]"
        return Entry(written.name, form, "your own", Source.UNSTATED, make_from_file)
    if written.name not in _AGENTS:
        if written.name in group_names():
            raise InvalidInput(f"agent {written.core!r}: stands for several agents in --agents; here one is needed")
        raise _AGENTS.unknown(written.name, {*agent_names(), *group_names()})
    entry = _AGENTS[written.name]
    if written.argument is not None and ":" not in entry.whole_form:
        raise InvalidInput(f"agent {written.core!r}: {written.name} takes no argument")
    if written.policy is not None and "@" not in entry.form:
        own = "" if entry.is_ours else "; register_agent(..., takes_policy=True) says that it does"
        raise InvalidInput(f"agent {written.core!r}: {written.name} takes no policy{own}")
    return entry


def _around(each: str) -> Entry:
    """Return the entry of a wrapper as written after a ``+``."""
    return _SHIELDS[each.partition(":")[0]]


def agent_names() -> tuple[str, ...]:
    """Return the names that ``make_agent`` knows, in alphabetical order."""
    return tuple(sorted({*_AGENTS} - {_PROFILE}))


def agent_entries() -> tuple[Entry, ...]:
    """Return the entries of all agents and then of all wrappers that can be loaded, each with its variants."""
    agents = [entry for name, entry in _AGENTS.usable().items() if name != _PROFILE]
    return tuple(_with_variants(entry) for entry in (*agents, *_SHIELDS.usable().values()))


def _with_variants(entry: Entry) -> Entry:
    """Return the entry with the forms and descriptions of its variants that can be loaded, for a list."""
    usable = _VARIANTS.usable()
    for word in variants_of(entry.name):
        if variant := usable.get(f"{entry.name}.{word}"):
            entry = replace(entry, form=f"{entry.form}[:{word}]", about=f"{entry.about}; {word}: {variant.about}")
    return entry


def agents_refused() -> list[str]:
    """Return why some of the installed agents, shields and variants cannot be loaded."""
    found = [each.why_not(name) for each in (_AGENTS, _SHIELDS, _VARIANTS) for name in each]
    return [reason for reason in found if reason is not None]


def around_forms() -> tuple[str, ...]:
    """Return everything that may follow a ``+``."""
    return tuple(word for entry in _SHIELDS.usable().values() for word in entry.words)


def shield_forms() -> tuple[str, ...]:
    """Return the shields that may follow a ``+``, without their variants."""
    return tuple(each for each in around_forms() if not (_around(each).inner or is_variant(each)))


def around_one_vehicle() -> list[str]:
    """Return the names of the wrappers that cannot go around a team; those that go inside a shield come first."""
    return [entry.name for inner in (True, False) for entry in _SHIELDS.usable().values()
            if entry.inner is inner and not entry.teams]  # fmt: skip


def shield_settings(name: object) -> Any:
    """Return the settings class of a shield that also goes around environments; None for any other name."""
    return _SHIELDS[name].options if isinstance(name, str) and name in _SHIELDS else None


def shield_modes() -> dict[str, Any]:
    """Return name -> settings class of every loadable shield that also goes around environments."""
    return {name: entry.options for name, entry in _SHIELDS.usable().items() if entry.options is not None}


def variants_of(name: str) -> tuple[str, ...]:
    """Return the variants of an agent or a shield: words that may follow its argument."""
    keys = (key.rpartition(".") for key in _VARIANTS)
    return tuple(variant for of, _, variant in keys if of == name)


def is_variant(form: str) -> bool:
    """Return whether the last word of ``NAME:WORD`` is a variant."""
    return form.rpartition(":")[2] in variants_of(form.partition(":")[0])


def settings_needed(shield: str | None) -> Mapping[str, object]:
    """Return the settings that a shield requires, each with an example; a variant requires none."""
    return {} if shield is None or is_variant(shield) else _around(shield).needs


def shields_with(setting: str) -> tuple[str, ...]:
    """Return the installed shields that require a setting."""
    return tuple(entry.words[0] for entry in _SHIELDS.usable().values() if setting in entry.needs)


def group_names() -> tuple[str, ...]:
    """Return the names that stand for several agents in ``--agents``."""
    return tuple(dict.fromkeys(name.partition(".")[0] for name in _GROUPS))


def agents_of_group(group: str) -> tuple[str, ...]:
    """Return the agents of a group: first its own, then those of ``GROUP.MORE``, sorted by name."""
    return tuple(spec for name in sorted(_GROUPS) if name.partition(".")[0] == group for spec in _GROUPS[name])


def register_agent(
    name: str,
    factory: Factory,
    *,
    about: str = "an agent of your own",
    knows: Source | Sequence[Source] = Source.UNSTATED,
    form: str | None = None,
    takes_policy: bool = False,
) -> None:
    """Register an agent, so that ``make_agent`` and every command know ``name`` and ``name:argument``.

    An installed package registers an agent with an entry point of the group ``ethbrake_marl.agents``: its factory, or a
    ``Part`` with the factory.

    Args:
        name: plain name without argument.
        factory: ``factory(argument, settings)`` makes the agent; ``argument`` is the text after the colon, or None, and
            ``settings`` an ``AgentSettings``.
        about: description in one line, for ``ethbrake agent list``.
        knows: what the agent knows about the line while it drives, for ``ethbrake agent list``.
        form: how the agent is written, for ``ethbrake agent list``. Without ``:`` it takes no argument, without ``@``
            no policy. None: ``name[:ARGUMENT]``.
        takes_policy: whether ``name@policy`` is allowed; the factory finds the policy in ``AgentSettings.policy``.

    Registering the same factory again changes nothing. Raises ``AlreadyExists`` if the name belongs to another factory,
    ``InvalidInput`` for a name that is not plain.

    """
    if ScriptSpec.parse(name) != ScriptSpec(name, None) or "@" in name:
        raise InvalidInput(f"agent name {name!r}: must be a plain name without argument")
    if name in group_names():
        raise AlreadyExists(f"agent {name!r}: stands for several agents in --agents; give another name")
    form = f"{name}[:ARGUMENT]{'[@POLICY]' * takes_policy}" if form is None else form
    _AGENTS.add(name, Entry(name, form, about, knows, factory), lambda entry: entry.make is factory)


def register_shield(
    name: str,
    wrapper: Wrapper,
    *,
    about: str = "a shield of your own",
    knows: Source | Sequence[Source] = (),
    form: str | None = None,
    inner: bool = False,
    teams: bool = False,
    needs: Mapping[str, object] | None = None,
    options: type | None = None,
) -> None:
    """Register a shield or another wrapper, so that ``+name`` may follow every agent.

    An installed package registers a shield with an entry point of the group ``ethbrake_marl.shields``: its wrapper, or
    a ``Part`` with the wrapper.

    Args:
        name: plain name without argument.
        wrapper: ``wrapper(agent, argument, settings)`` makes the agent around ``agent``; ``argument`` is the text after
            the colon, or None, and ``settings`` an ``AgentSettings``.
        about: description in one line, for ``ethbrake agent list``.
        knows: knowledge that it adds to the agent's.
        form: how it is written, ``+name[:WORD]`` with every word that it takes; None: any argument.
        inner: it is not a shield, and goes around the agent before a shield.
        teams: it can also go around a team.
        needs: required settings of ``AgentSettings``, each with an example.
        options: its settings class, ``shield.options.ShieldOptions`` or a subclass, which makes its guard. Then
            ``eb.shield(env, mode=name)`` knows it too.

    Registering the same wrapper again changes nothing. Raises ``AlreadyExists`` if the name belongs to another wrapper,
    ``InvalidInput`` for a name that is not plain.

    """
    if not isinstance(name, str) or not _PLAIN.fullmatch(name):
        raise InvalidInput(f"shield name {name!r}: must be a plain name without argument")
    form = f"+{name}[:ARGUMENT]" if form is None else form
    entry = Entry(name, form, about, knows, wrapper, inner, teams, needs or {}, options)
    _SHIELDS.add(name, entry, lambda entry: entry.make is wrapper)


def register_variant(key: str, make: Factory | Wrapper, *, about: str = "a variant of your own") -> None:
    """Register a variant of an agent or a shield: ``name:variant`` and ``name:argument:variant``.

    An installed package registers a variant with an entry point of the group ``ethbrake_marl.variants``.

    Args:
        key: ``name.variant``.
        make: replaces the factory or wrapper of that name, with the same arguments; the argument does not contain the
            variant.
        about: description in one line, for ``ethbrake agent list``.

    Raises ``AlreadyExists`` if the key belongs to another variant.

    """
    _VARIANTS.add(key, Variant(make, about), lambda variant: variant.make is make)


_PLAIN = re.compile(r"[a-z][a-z0-9_.-]*")

_PROFILE = "profile"  # allowed only as a role in a scenario

_AGENTS: Registry[Entry] = Registry("agent", "agents", register_agent)

_SHIELDS: Registry[Entry] = Registry("shield or search", "shields", register_shield)

_VARIANTS: Registry[Variant] = Registry("variant of an agent", "variants", register_variant)


def _register_group(name: str, specs: tuple[str, ...]) -> None:
    _GROUPS.add(name, specs, lambda other: other == specs)


_GROUPS: Registry[tuple[str, ...]] = Registry("group of agents", "agent_groups", _register_group)


def _make(entry: Entry, argument: str | None, settings: AgentSettings, *inside: Driver) -> Driver:
    """Make the driver of an entry; check it, and turn errors of other people's agents into ``InvalidInput``."""
    try:
        driver = entry.call(argument, settings, *inside)
    except Exception as error:
        if entry.is_ours or isinstance(error, EthBrakeError):
            raise
        raise InvalidInput(f"agent {settings.spec!r}: {describe_error(error)}") from error
    if not isinstance(driver, Team):
        check_agent(driver, f"agent {settings.spec!r}", alone=not inside)
    return driver


# An agent from the user's Python file, ``my_file.py:make_agent``; loaded only if the user names it.


def make_from_file(argument: str | None, settings: AgentSettings) -> Driver:
    """Return what the named function of a Python file makes, called with argument and settings, or without arguments.

    A function without parameters takes neither argument nor policy. Raises ``InvalidInput`` if one is given, and if
    something is wrong with the file.
    """
    named = parse_spec(settings.spec).file
    assert named is not None
    function = load_from_file(*named, reads=settings.policy)
    if not callable(function):
        raise InvalidInput(f"file {named[0]!r}: {named[1]!r} is no function; name the one that makes the agent")
    given: tuple[Any, ...] = (argument, settings)
    with suppress(TypeError, ValueError):  # a built-in function may have no signature
        if not inspect.signature(function).parameters:
            given = ()
    if not given and (argument, settings.policy) != (None, None):
        raise InvalidInput(f"agent {settings.spec!r}: {named[1]} has no parameters, so it takes no argument")
    made: Driver = function(*given)
    return made
