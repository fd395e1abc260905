"""Agents: what one is and what it knows, the list of them by name, and the loop that lets them drive episodes.

Names are those of entry points (``ethbrake_marl.registry``), which are loaded when they are first used: so policies,
searches and shields, which stand above this folder, have names without being imported here.
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

# The grammar of agents: ``name[:argument][:variant][@policy]``, and behind it what is put around that agent.
#
# ``+search`` comes first, then one shield, for instance ``+episode:pairwise`` or ``+step``. A shield has variants, too.
# A name may be a function of a Python file, ``my_file.py:make_agent``.
#
# Each of ``, + @ :`` may stand in a path, too. A path that exists wins: what stands in it separates nothing.

_IN_FILE = re.compile(r":(?P<function>[A-Za-z_]\w*)(:(?P<argument>[^\s@]+))?(@(?P<policy>.+))?")

_BEGINS_WITH_FILE = re.compile(r"[^:@]+\.py(:.*)?")


@dataclass(frozen=True, slots=True)
class AgentSpec:
    """An agent as it is written, in its parts."""

    name: str  # or FILE.py:FUNCTION
    argument: str | None  # after the colon
    policy: str | None  # after the @: a path, or "shipped"
    around: tuple[str, ...]  # names with their arguments, innermost first

    @property
    def core(self) -> str:
        """The agent without what is around it."""
        argument = "" if self.argument is None else f":{self.argument}"
        return f"{self.name}{argument}" + ("" if self.policy is None else f"@{self.policy}")

    @property
    def file(self) -> tuple[str, str] | None:
        """The Python file and its function that makes the agent, where the name is one of those."""
        file, _, function = self.name.rpartition(":")
        return (file, function) if file else None

    @property
    def shield(self) -> str | None:
        """The shield around it, if there is one."""
        return self.around[-1] if self.around and not _around(self.around[-1]).inner else None

    def __str__(self) -> str:
        return "".join([self.core, *(f"+{each}" for each in self.around)])


def parse_spec(spec: str) -> AgentSpec:
    """The parts of a spec. A path may hold any character.

    ``ppo@c+step`` is the folder ``c+step`` where that exists, and else the folder ``c`` behind the shield;
    ``ppo@c/+step`` is always the latter. Raises ``InvalidInput`` for what is not written so, and for two shields or
    another order; ``UnknownName`` for something else behind a ``+``.
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
    """The names in a list with commas between them: as many parts as possible are one name where ``is_one`` says so."""
    parts, names = text.split(","), list[str]()
    while parts:
        joined = (k for k in range(len(parts), 1, -1) if is_one(",".join(parts[:k])))
        count = next(joined, 1)
        names.append(",".join(parts[:count]))
        parts = parts[count:]
    return names


def split_specs(text: str) -> list[str]:
    """The specs in a list with commas between them, which may stand in paths that exist."""
    return split_names(text, _is_one_spec)


def _is_one_spec(text: str) -> bool:
    core, around = _strip_around(text)
    head, _, path = core[len(_existing_file(core)) :].partition("@")
    return "," not in "".join([head, *around]) and ("," not in path or os.path.lexists(path))


def _existing_file(core: str) -> str:
    """The longest Python file that exists and with which a spec begins; empty without one."""
    ends = (match.start() for match in re.finditer(r"(?<=\.py):", core))
    return max((core[:end] for end in ends if os.path.isfile(core[:end])), key=len, default="")


def _python_file(core: str) -> str:
    """The Python file with which a spec begins, whether it exists or not; empty without one."""
    return _existing_file(core) or (core.partition(":")[0] if _BEGINS_WITH_FILE.fullmatch(core) else "")


def _policy_path(core: str) -> str:
    return core[len(_python_file(core)) :].partition("@")[2]


def _strip_around(spec: str) -> tuple[str, list[str]]:
    """What stands before all that is around it, and that; the path of an existing policy is left whole."""
    core, around = spec, list[str]()
    while True:
        before, plus, last = core.rpartition("+")
        if not (plus and last.partition(":")[0] in _SHIELDS) or os.path.lexists(_policy_path(core)):
            return core, around
        core, around = before, [last, *around]


def _split_around(spec: str) -> tuple[str, tuple[str, ...]]:
    core, around = _strip_around(spec if isinstance(spec, str) else "")
    if not core:
        ScriptSpec.parse(spec)  # says what is right
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
    """Whether a word behind a ``+`` that is no name of ``_SHIELDS`` is no part of an argument or path either."""
    file = _python_file(core)
    if ".py" in last or (file and _IN_FILE.fullmatch(core, len(file))):
        return False  # the + is part of a file's path, or of its argument
    if ":" not in before and "@" not in before:
        return True
    if "/" in last or "\\" in last:
        return False  # the last part of a path
    return not os.path.lexists(_policy_path(core)) and bool(get_close_matches(last.partition(":")[0], _SHIELDS))


HORIZON_S = 8.0  # until when an agent looks ahead that knows no scenario


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """What an agent may need beyond its own argument.

    >>> import ethbrake_marl as eb
    >>> eb.AgentSettings("planner:64", scenario=eb.load_scenario("paper-random")).needed_scenario().name
    'paper-random'

    """

    spec: str  # as it is written, with what is around it so far
    policy: str | None = None  # what stands after the @
    scenario: Scenario | None = None  # in which it drives, where that is known
    harm_count: HarmCount = "first"  # which harm an optimising agent minimises
    horizon_s: float = HORIZON_S  # until when it looks ahead
    most_candidates: int | None = None  # of a search, whatever its argument says; None: what that says
    uncertainty: object = None  # what a shield around it does not know of the worlds, as that shield reads it
    time_step_s: float = 0.1  # between two decisions
    role: int | None = None  # index of the vehicle whose role it is; None: a driver, whichever vehicles it drives

    def needed_scenario(self) -> Scenario:
        """The scenario, for an agent that cannot do without. Raises ``InvalidInput`` if there is none."""
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
    """One line of the registry."""

    name: str
    form: str  # how it is written; without ":" it takes no argument, without "@" no policy
    about: str  # one line
    knows: Source | Sequence[Source]  # while it drives; of what goes around an agent: what is added
    make: Factory | Wrapper
    inner: bool = False  # of what goes around an agent: directly, inside a shield
    teams: bool = False  # likewise: around a team, too
    needs: Mapping[str, object] = field(default_factory=dict)  # settings that it cannot do without -> an example
    options: type | None = None  # of a shield that also goes around environments: the class of its settings

    @property
    def is_ours(self) -> bool:
        """Whether this package makes it; of others' errors are told as such."""
        return str(getattr(self.make, "__module__", "")).startswith("ethbrake_marl.") and self.make != make_from_file

    @property
    def whole_form(self) -> str:
        """How it is written, its variants included."""
        return self.form + "".join(f"[:{variant}]" for variant in variants_of(self.name))

    @property
    def words(self) -> tuple[str, ...]:
        """How what goes around an agent may be written behind the ``+``, where that is a list of words."""
        name, *options = re.findall(r"[^\[\]+]+", self.whole_form)
        found = [name]
        for option in options:
            found += [f"{each}{option}" for each in found]
        return tuple(found)

    def takes(self, argument: str) -> bool:
        """Whether what goes around an agent takes this argument; empty for none."""
        name = self.words[0]
        return "[:ARGUMENT]" in self.form or (f"{name}:{argument}" if argument else name) in self.words

    def call(self, argument: str | None, settings: AgentSettings, *inside: Driver) -> Driver:
        """What its function makes, of a wrapper around what is ``inside``."""
        make: Any = self.make
        before, _, last = (argument or "").rpartition(":")
        if last in variants_of(self.name):
            argument, make = before or None, _VARIANTS[f"{self.name}.{last}"].make
        made: Driver = make(*inside, argument, settings)
        return made


class Variant(NamedTuple):
    """A word behind an agent or a shield, after its argument, that makes another one of it."""

    make: Factory | Wrapper
    about: str  # one line


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
    """A fresh agent for one vehicle in one batch, or the team of a run.

    Args:
        spec: ``name[:argument][@policy]`` and what is put around it, for instance ``constant:3.5``, ``planner:64``,
            ``ppo@shipped+search+step``; ``ethbrake agent list`` has all. ``my_file.py:make_agent`` runs that file,
            which can do whatever you can: its function gets what a factory of ``register_agent`` gets, or nothing.
        scenario: also its name or the path of its file; needed by teams, by what is put around an agent, and to find
            the shipped policy of this scenario.
        harm_count: which harm an optimising agent minimises, ``first`` or ``total``.
        horizon_s: until when it looks ahead, s; None: the scenario's horizon, or 8 s.
        most_candidates: for trying an agent out: no search of it takes more.
        uncertainty: what a shield that certifies uncertain worlds does not know, such as ``"gaps_m=0.5"``.
        time_step_s: between two decisions of what searches or follows a law; None: the scenario's, or 0.1 s.

    Raises ``UnknownName`` with a suggestion for an unknown name, ``InvalidInput`` for a bad argument, harm count or
    horizon, and for a scenario that is missing.

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
    """The agent that ``vehicle`` follows as its role: the one that would drive it, made for first-impact harm.

    ``most_candidates`` is as in ``make_agent``. Raises what that raises, and ``InvalidInput`` for what goes around an
    agent, and for a team without this vehicle.
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
    """The registry's entry of an agent.

    Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for an argument or a policy that it does not take.
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
    """The entry of what is written behind a ``+``."""
    return _SHIELDS[each.partition(":")[0]]


def agent_names() -> tuple[str, ...]:
    """Names that ``make_agent`` knows, in alphabetical order."""
    return tuple(sorted({*_AGENTS} - {_PROFILE}))


def agent_entries() -> tuple[Entry, ...]:
    """All agents, and then all that can be put around one, each with its variants: those that can be loaded."""
    agents = [entry for name, entry in _AGENTS.usable().items() if name != _PROFILE]
    return tuple(_with_variants(entry) for entry in (*agents, *_SHIELDS.usable().values()))


def _with_variants(entry: Entry) -> Entry:
    """The entry with the forms and texts of its variants, of those that can be loaded, for a list."""
    usable = _VARIANTS.usable()
    for word in variants_of(entry.name):
        if variant := usable.get(f"{entry.name}.{word}"):
            entry = replace(entry, form=f"{entry.form}[:{word}]", about=f"{entry.about}; {word}: {variant.about}")
    return entry


def agents_refused() -> list[str]:
    """Why some of the installed agents, shields and variants cannot be loaded."""
    found = [each.why_not(name) for each in (_AGENTS, _SHIELDS, _VARIANTS) for name in each]
    return [reason for reason in found if reason is not None]


def around_forms() -> tuple[str, ...]:
    """All that may stand behind a ``+``."""
    return tuple(word for entry in _SHIELDS.usable().values() for word in entry.words)


def shield_forms() -> tuple[str, ...]:
    """The shields among that, without their variants."""
    return tuple(each for each in around_forms() if not (_around(each).inner or is_variant(each)))


def around_one_vehicle() -> list[str]:
    """The names of all that goes around an agent but not around a team: first what goes inside a shield."""
    return [entry.name for inner in (True, False) for entry in _SHIELDS.usable().values()
            if entry.inner is inner and not entry.teams]  # fmt: skip


def shield_settings(name: object) -> Any:
    """The class of settings of a shield that also goes around environments; None for any other name."""
    return _SHIELDS[name].options if isinstance(name, str) and name in _SHIELDS else None


def shield_modes() -> dict[str, Any]:
    """Name -> class of settings of every shield that also goes around environments, and can be loaded."""
    return {name: entry.options for name, entry in _SHIELDS.usable().items() if entry.options is not None}


def variants_of(name: str) -> tuple[str, ...]:
    """The words that may stand behind an agent or a shield, after its argument, and make another one of it."""
    keys = (key.rpartition(".") for key in _VARIANTS)
    return tuple(variant for of, _, variant in keys if of == name)


def is_variant(form: str) -> bool:
    """Whether the last word of ``NAME:WORD`` makes another agent or shield of it."""
    return form.rpartition(":")[2] in variants_of(form.partition(":")[0])


def settings_needed(shield: str | None) -> Mapping[str, object]:
    """Settings that a shield cannot do without, each with an example; a variant of it needs none."""
    return {} if shield is None or is_variant(shield) else _around(shield).needs


def shields_with(setting: str) -> tuple[str, ...]:
    """The installed shields that cannot do without a setting."""
    return tuple(entry.words[0] for entry in _SHIELDS.usable().values() if setting in entry.needs)


def group_names() -> tuple[str, ...]:
    """Names that stand for several agents in ``--agents``."""
    return tuple(dict.fromkeys(name.partition(".")[0] for name in _GROUPS))


def agents_of_group(group: str) -> tuple[str, ...]:
    """The agents for which a group's name stands; its own come first, then those of ``GROUP.MORE``, by name."""
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
    """Make ``name`` and ``name:argument`` known to ``make_agent``, and so to every command.

    An installed package does the same with an entry point of the group ``ethbrake_marl.agents``: its factory, or a
    ``Part`` of it.

    Args:
        name: plain, without argument.
        factory: makes the agent, from what stands after the colon (or None) and ``AgentSettings``. The same one again
            changes nothing.
        about: one line for ``ethbrake agent list``.
        knows: of the line while it drives, for ``ethbrake agent list`` too.
        form: how it is written, for ``ethbrake agent list`` too; without ``:`` in it, it takes no argument, without
            ``@`` no policy. None: ``name[:ARGUMENT]``.
        takes_policy: whether ``name@policy`` is known, too; the factory finds it in ``AgentSettings.policy``.

    Raises ``AlreadyExists`` for a name that another factory has, ``InvalidInput`` for one that is not plain.

    """
    if parse_spec(name) != AgentSpec(name, None, None, ()):
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
    """Make ``+name`` known behind every agent.

    An installed package does the same with an entry point of the group ``ethbrake_marl.shields``: its wrapper, or a
    ``Part`` of it.

    Args:
        name: plain, without argument.
        wrapper: makes the agent around an agent, from that, what stands after the colon (or None) and
            ``AgentSettings``. The same one again changes nothing.
        about: one line for ``ethbrake agent list``.
        knows: what it adds to what the agent knows.
        form: how it is written, ``+name[:WORD]`` with every word that it takes; None: with any argument.
        inner: it is no shield, and goes around the agent before one.
        teams: it also goes around a team.
        needs: settings of ``AgentSettings`` that it cannot do without, each with an example.
        options: the class of its settings, ``shield.options.ShieldOptions`` or one derived from it, which makes its
            guard: then ``eb.shield(env, mode=name)`` knows it, too.

    Raises ``AlreadyExists`` for a name that another one has, ``InvalidInput`` for one that is not plain.

    """
    if not isinstance(name, str) or not _PLAIN.fullmatch(name):
        raise InvalidInput(f"shield name {name!r}: must be a plain name without argument")
    form = f"+{name}[:ARGUMENT]" if form is None else form
    entry = Entry(name, form, about, knows, wrapper, inner, teams, needs or {}, options)
    _SHIELDS.add(name, entry, lambda entry: entry.make is wrapper)


def register_variant(key: str, make: Factory | Wrapper, *, about: str = "a variant of your own") -> None:
    """Make ``name:variant`` and ``name:argument:variant`` known, of an agent or a shield that has a name already.

    An installed package does the same with an entry point of the group ``ethbrake_marl.variants``.

    Args:
        key: ``name.variant``.
        make: makes it in the place of the factory, or wrapper, of that name, from the same arguments; the variant is
            not in the argument.
        about: one line for ``ethbrake agent list``.

    Raises ``AlreadyExists`` for a variant that another one has.

    """
    _VARIANTS.add(key, Variant(make, about), lambda variant: variant.make is make)


_PLAIN = re.compile(r"[a-z][a-z0-9_.-]*")

_PROFILE = "profile"  # a role of scenarios alone

_AGENTS: Registry[Entry] = Registry("agent", "agents", register_agent)

_SHIELDS: Registry[Entry] = Registry("shield or search", "shields", register_shield)

_VARIANTS: Registry[Variant] = Registry("variant of an agent", "variants", register_variant)


def _register_group(name: str, specs: tuple[str, ...]) -> None:
    _GROUPS.add(name, specs, lambda other: other == specs)


_GROUPS: Registry[tuple[str, ...]] = Registry("group of agents", "agent_groups", _register_group)


def _make(entry: Entry, argument: str | None, settings: AgentSettings, *inside: Driver) -> Driver:
    """The driver of an entry; of one that is not ours, what it raises becomes ``InvalidInput``, and it is looked at."""
    try:
        driver = entry.call(argument, settings, *inside)
    except Exception as error:
        if entry.is_ours or isinstance(error, EthBrakeError):
            raise
        raise InvalidInput(f"agent {settings.spec!r}: {describe_error(error)}") from error
    if not isinstance(driver, Team):
        check_agent(driver, f"agent {settings.spec!r}", alone=not inside)
    return driver


# An agent from a Python file of the user's: ``my_file.py:make_agent``, loaded only where a person names it.


def make_from_file(argument: str | None, settings: AgentSettings) -> Driver:
    """What the function of the file makes, from the argument (or None) and the settings, or from nothing.

    A function without parameters takes neither argument nor policy: ``InvalidInput`` says so, and what is wrong with
    the file.
    """
    named = parse_spec(settings.spec).file
    assert named is not None
    function = load_from_file(*named, reads=settings.policy)
    if not callable(function):
        raise InvalidInput(f"file {named[0]!r}: {named[1]!r} is no function; name the one that makes the agent")
    given: tuple[Any, ...] = (argument, settings)
    with suppress(TypeError, ValueError):  # of something built in there is no signature
        if not inspect.signature(function).parameters:
            given = ()
    if not given and (argument, settings.policy) != (None, None):
        raise InvalidInput(f"agent {settings.spec!r}: {named[1]} has no parameters, so it takes no argument")
    made: Driver = function(*given)
    return made
