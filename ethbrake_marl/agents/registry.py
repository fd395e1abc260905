"""Agents by name: the one list of them, for command lines, scripts of scenarios and ``eb.make_agent`` alike.

An entry names the function that makes the agent, and is loaded when it is first used: so policies, searches and
shields, which stand above this folder, are in the same list without being imported here.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from importlib import import_module
from typing import Any

import numpy as np

from ethbrake_marl.agents.protocol import Agent, Driver, Knowledge, Source, Team, check_agent
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import AlreadyExists, EthBrakeError, InvalidInput, describe_error, unknown_name
from ethbrake_marl.files.plugins import load_function, note_file
from ethbrake_marl.harm import check_harm_count
from ethbrake_marl.scenario import Scenario, ScriptSpec

# The grammar of agents: ``name[:argument][@policy]``, and behind it what is put around that agent.
#
# ``+refined``, ``+refined:profile`` or, at every decision, ``+refined:50`` or ``+refined:200us`` comes first, then one
# shield: ``+episode``, ``+episode:pairwise``, ``+step`` or ``+robust``, each also with ``:believed`` behind it. A name
# may be a function of a Python file, ``my_file.py:make_agent``.

REFINED = ("refined", "refined:profile")
SHIELDS = ("episode", "episode:pairwise", "step", "robust", "robust:interior")
BELIEVED = (  # on what was received
    "episode:believed", "episode:pairwise:believed", "step:believed", "robust:believed", "robust:interior:believed",
)  # fmt: skip
AROUND = (*REFINED, *SHIELDS, *BELIEVED)  # in the order in which they are put around an agent

_WITH_BUDGET = re.compile(r"refined:[0-9]+(us)?")
_IN_FILE = re.compile(r"(?P<name>[^:]+\.py:[A-Za-z_]\w*)(:(?P<argument>[^\s@]+))?(@(?P<policy>.+))?")
_BEGINS_WITH_FILE = re.compile(r"[^:@]+\.py(:.*)?")


@dataclass(frozen=True, slots=True)
class AgentSpec:
    """An agent as it is written, in its parts."""

    name: str  # or FILE.py:FUNCTION
    argument: str | None  # after the colon
    policy: str | None  # after the @: a path, or "shipped"
    around: tuple[str, ...]  # of AROUND, innermost first

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
        return self.around[-1] if self.around and self.around[-1] in (*SHIELDS, *BELIEVED) else None

    def __str__(self) -> str:
        return "".join([self.core, *(f"+{each}" for each in self.around)])


def parse_spec(spec: str) -> AgentSpec:
    """The parts of a spec. A path may hold any character; one that ends like ``+step`` is written with a ``/`` behind.

    Raises ``InvalidInput`` for what is not written so, and for two shields or another order; ``UnknownName`` for
    something else behind a ``+``.
    """
    core, around = _split_around(spec)
    if _BEGINS_WITH_FILE.fullmatch(core):
        match = _IN_FILE.fullmatch(core)
        if match is None:
            raise InvalidInput(
                f"agent {spec!r}: one from a file is FILE.py:FUNCTION, FILE.py:FUNCTION:ARGUMENT or"
                " FILE.py:FUNCTION@POLICY, for instance my_file.py:make_agent"
            )
        return AgentSpec(match["name"], match["argument"], match["policy"], around)
    head, at, path = core.partition("@")
    name, argument = ScriptSpec.parse(head if at else core)
    if at and not path:
        raise InvalidInput(f"agent {spec!r}: a path is needed after '@'")
    return AgentSpec(name, argument, path if at else None, around)


def _split_around(spec: str) -> tuple[str, tuple[str, ...]]:
    core, around = spec if isinstance(spec, str) else "", list[str]()
    if not core:
        ScriptSpec.parse(spec)  # says what is right
    while True:
        before, plus, last = core.rpartition("+")
        if not plus or not is_around(last):
            break
        core, around = before, [last, *around]
    if plus and _is_meant_around(before, core, last):
        raise unknown_name("shield or refinement", last, AROUND)
    shields = [each for each in around if each in (*SHIELDS, *BELIEVED)]
    if len(shields) > 1 or any(each not in shields for each in around[1:]):
        raise InvalidInput(
            f"agent {spec!r}: +{REFINED[0]} comes first and once, then one shield of +{', +'.join(SHIELDS)}; for"
            " instance ppo@shipped+refined+step"
        )
    return core, tuple(around)


def is_around(word: str) -> bool:
    """Whether this stands behind a ``+``: one of ``AROUND``, or a refinement with a budget for each decision."""
    return word in AROUND or _WITH_BUDGET.fullmatch(word) is not None


def _is_meant_around(before: str, core: str, last: str) -> bool:
    """Whether a word behind a ``+`` that is none of ``AROUND`` is no part of an argument or path either."""
    if ".py" in last or _IN_FILE.fullmatch(core):
        return False  # the + is part of a file's path, or of its argument
    if ":" not in before and "@" not in before:
        return True
    if "/" in last or "\\" in last:
        return False  # the last part of a path
    path = core.partition("@")[2]
    return bool(get_close_matches(last, AROUND)) and not (path and os.path.lexists(path))


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
    uncertainty: object = None  # what a robust shield does not know, as ``shield.uncertainty`` reads it
    time_step_s: float = 0.1  # between two decisions

    def needed_scenario(self) -> Scenario:
        """The scenario, for an agent that cannot do without. Raises ``InvalidInput`` if there is none."""
        if self.scenario is None:
            raise InvalidInput(
                f"agent {self.spec!r}: needs a scenario: make_agent({self.spec!r},"
                " scenario=eb.load_scenario('paper-random')); as a vehicle's script it cannot be used"
            )
        return self.scenario


Factory = Callable[[str | None, AgentSettings], Driver]
"""Makes the agent of an argument (what stands after the colon, or None)."""

Wrapper = Callable[[Any, str | None, AgentSettings], Driver]
"""Makes the agent around an agent."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of the registry."""

    form: str  # how it is written; without ":" it takes no argument, without "@" no policy
    about: str  # one line
    knows: Knowledge  # of the line while it drives; of what goes around an agent: what is added
    make: str | Factory | Wrapper  # "module:function" is loaded at first use

    def load(self) -> Any:
        """The function that makes it."""
        if not isinstance(self.make, str):
            return self.make
        module, _, function = self.make.partition(":")
        return getattr(import_module(f"ethbrake_marl.{module}"), function)


_SCRIPTS, _POLICIES = "agents.scripts", "learning.training:make_policy_agent"
_FROM_FILE = "agents.registry:make_from_file"
_ENTRIES: dict[str, Entry] = {
    "coast": Entry("coast", "nothing at all", (Source.SENSORS,), f"{_SCRIPTS}:make_state_free"),
    "full_brake": Entry(
        "full_brake", "full braking, the paper's non-ethical strategy", (Source.SENSORS,), f"{_SCRIPTS}:make_state_free"
    ),
    "constant": Entry(
        "constant:A", "this deceleration in m/s2; negative drives", (Source.SENSORS,), f"{_SCRIPTS}:make_state_free"
    ),
    "copy_leader": Entry(
        "copy_leader", "brakes as hard as the vehicle in front can", (Source.STATE,), f"{_SCRIPTS}:make_copy_leader"
    ),
    "gentlest_front": Entry(
        "gentlest_front",
        "the smallest constant deceleration that spares the vehicle in front",
        (Source.STATE,),
        f"{_SCRIPTS}:make_gentlest_front",
    ),
    "e_v2x_bm": Entry(
        "e_v2x_bm[:pairwise][:believed]",
        "the best constant deceleration in this simulation; pairwise: the paper's closed form, from the true state;"
        " believed: on what was received, and the scenario's ranges for the rest",
        (Source.MODEL,),
        "agents.e_v2x_bm:make_e_v2x_bm",
    ),
    "planner": Entry(
        "planner[:CANDIDATES|:20ms][:believed]",
        "a search in the simulation at every decision, with this budget for each; believed: as above",
        (Source.MODEL,),
        "agents.planner:make_planner",
    ),
    "best_harm": Entry(
        "best_harm[:CANDIDATES]",
        "the best profile known; a search at the alert where none is known",
        (Source.MODEL,),
        "limits.limits:make_best_harm",
    ),
    "ppo": Entry("ppo@PATH", "a policy trained by PPO: a run, a bundle, or shipped", (Source.MESSAGES,), _POLICIES),
    "sac": Entry("sac@PATH", "a policy trained by SAC: a run, a bundle, or shipped", (Source.MESSAGES,), _POLICIES),
    "counterfactual": Entry(
        "counterfactual@PATH", "a policy trained by counterfactuals: a run or a bundle", (Source.MESSAGES,), _POLICIES
    ),
    "policy": Entry(
        "policy@PATH",
        "a policy, whatever trained it: a run, a bundle, or shipped, the best for scenario and harm",
        (Source.MESSAGES,),
        _POLICIES,
    ),
    "universal": Entry("universal@shipped", "the shipped policy for all parameters", (Source.MESSAGES,), _POLICIES),
    "team": Entry(
        "team@RUN", "the learners of a run, each as it was trained, or shipped", (Source.MESSAGES,), _POLICIES
    ),
}

_WRAPPERS: dict[str, Entry] = {
    "refined": Entry(
        "+refined[:profile|:50|:200us]",
        "plus the best deviation that a search at the alert finds; profile: compiled, it drives what that finds;"
        " with a budget: again at every decision",
        (Source.MODEL,),
        "agents.refined:refine",
    ),
    "episode": Entry(
        "+episode[:pairwise][:believed]",
        "behind Algorithm 1: it or E-V2X-BM drives the episode, whichever harms less; believed: as far as is received",
        (Source.MODEL,),
        "shield.guard:shield_episodes",
    ),
    "step": Entry(
        "+step[:believed]",
        "every action certified, or replaced; of a team together; believed: certified in the world that is believed",
        (Source.MODEL,),
        "shield.guard:shield_steps",
    ),
    "robust": Entry(
        "+robust[:interior][:believed]",
        "the same where not everything is known: in the corners of an uncertainty, interior: in all of it;"
        " believed: against all that was not received",
        (Source.MODEL,),
        "shield.guard:shield_steps_robustly",
    ),
}


def make_agent(
    spec: str,
    *,
    scenario: Scenario | None = None,
    harm_count: HarmCount = "first",
    horizon_s: float | None = None,
    most_candidates: int | None = None,
    uncertainty: object = None,
    time_step_s: float | None = None,
) -> Driver:
    """A fresh agent for one vehicle in one batch, or the team of a run.

    Args:
        spec: ``name[:argument][@policy]`` and what is put around it, for instance ``constant:3.5``, ``planner:20ms``,
            ``ppo@shipped+refined+step``; ``ethbrake agent list`` has all. ``my_file.py:make_agent`` runs that file,
            which can do whatever you can: its function gets what a factory of ``register_agent`` gets, or nothing.
        scenario: needed by teams, by what is put around an agent, and to find the shipped policy of this scenario.
        harm_count: which harm an optimising agent minimises, ``first`` or ``total``.
        horizon_s: until when it looks ahead, s; None: the scenario's horizon, or 8 s.
        most_candidates: for trying an agent out: no search of it takes more.
        uncertainty: what a robust shield does not know, such as ``"gaps_m=0.5"``.
        time_step_s: between two decisions of what searches; None: the scenario's, or 0.1 s.

    Raises ``UnknownName`` with a suggestion for an unknown name, ``InvalidInput`` for a bad argument, harm count or
    horizon, and for a scenario that is missing.

    >>> import ethbrake_marl as eb
    >>> eb.make_agent("ppo@shipped+step", scenario=eb.load_scenario("paper-random")).name
    'ppo@shipped+step'

    """
    check_harm_count(harm_count)
    if not (scenario is None or isinstance(scenario, Scenario)):
        raise InvalidInput(f"scenario = {scenario!r}: must be a Scenario; eb.load_scenario(name) loads one")
    if horizon_s is None:
        horizon_s = HORIZON_S if scenario is None else scenario.horizon_s
    if not isinstance(horizon_s, int | float | np.number) or not 0.0 < horizon_s < float("inf"):
        raise InvalidInput(f"horizon_s {horizon_s!r}: must be a positive number of seconds")
    written = parse_spec(spec)
    settings = AgentSettings(
        written.core, written.policy, scenario, harm_count, float(horizon_s), most_candidates, uncertainty,
        time_step_s or (0.1 if scenario is None else scenario.time_step_s),
    )  # fmt: skip
    driver = _make(find_entry(written), written.argument, settings)
    for each in written.around:
        settings = replace(settings, spec=f"{settings.spec}+{each}")
        driver = _put_around(driver, each, settings)
    return driver


def make_single_agent(spec: str, **settings: Any) -> Agent:
    """``make_agent`` for who drives one vehicle; raises ``InvalidInput`` for a team too."""
    agent = make_agent(spec, **settings)
    if not isinstance(agent, Agent):
        raise InvalidInput(f"agent {spec!r}: is a team, one agent is needed here: ppo@RUN/policy/vehicle_2")
    return agent


def find_entry(written: AgentSpec) -> Entry:
    """The registry's entry of an agent.

    Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for an argument or a policy that it does not take.
    """
    if written.file is not None:
        return Entry(f"{written.name}[:ARGUMENT][@POLICY]", "your own", (Source.UNSTATED,), _FROM_FILE)
    if written.name not in _ENTRIES:
        if written.name == "ladder":
            raise InvalidInput(f"agent {written.core!r}: stands for several agents in --agents; here one is needed")
        raise unknown_name("agent", written.name, {*_ENTRIES, "ladder"}, may_be_own=True)
    entry = _ENTRIES[written.name]
    if written.argument is not None and ":" not in entry.form:
        raise InvalidInput(f"agent {written.core!r}: {written.name} takes no argument")
    if written.policy is not None and "@" not in entry.form:
        own = "" if isinstance(entry.make, str) else "; register_agent(..., takes_policy=True) says that it does"
        raise InvalidInput(f"agent {written.core!r}: {written.name} takes no policy{own}")
    return entry


def agent_names() -> tuple[str, ...]:
    """Names that ``make_agent`` knows, in alphabetical order."""
    return tuple(sorted(_ENTRIES))


def agent_entries() -> tuple[Entry, ...]:
    """All agents, and then all that can be put around one, in the order in which they were registered."""
    return (*_ENTRIES.values(), *_WRAPPERS.values())


def register_agent(
    name: str,
    factory: Factory,
    *,
    about: str = "an agent of your own",
    knows: Knowledge = (Source.UNSTATED,),
    takes_policy: bool = False,
) -> None:
    """Make ``name`` and ``name:argument`` known to ``make_agent``, and so to every command.

    Args:
        name: plain, without argument.
        factory: makes the agent, from what stands after the colon (or None) and ``AgentSettings``. The same one again
            changes nothing.
        about: one line for ``ethbrake agent list``.
        knows: of the line while it drives, for ``ethbrake agent list`` too.
        takes_policy: whether ``name@policy`` is known, too; the factory finds it in ``AgentSettings.policy``.

    Raises ``AlreadyExists`` for a name that another factory has, ``InvalidInput`` for one that is not plain.

    """
    if parse_spec(name) != AgentSpec(name, None, None, ()):
        raise InvalidInput(f"agent name {name!r}: must be a plain name without argument")
    entry = Entry(f"{name}[:ARGUMENT]{'[@POLICY]' * takes_policy}", about, knows, factory)
    if _ENTRIES.setdefault(name, entry).make is not factory:
        raise AlreadyExists(f"agent {name!r} is registered already")


def _make(entry: Entry, argument: str | None, settings: AgentSettings) -> Driver:
    """The driver of an entry; of one that is not ours, what it raises becomes ``InvalidInput``, and it is looked at."""
    factory, ours = entry.load(), isinstance(entry.make, str) and entry.make != _FROM_FILE
    try:
        driver: Driver = factory(argument, settings)
    except Exception as error:
        if ours or isinstance(error, EthBrakeError):
            raise
        raise InvalidInput(f"agent {settings.spec!r}: {describe_error(error)}") from error
    if not isinstance(driver, Team):
        check_agent(driver, f"agent {settings.spec!r}")
    return driver


def _put_around(driver: Driver, around: str, settings: AgentSettings) -> Driver:
    assert is_around(around)
    if isinstance(driver, Team) and around != "step":
        raise InvalidInput(
            f"agent {settings.spec!r}: is a team, and +{around} is for one driven vehicle, the others following"
            " scripts; +step goes around a team; else name that vehicle (--vehicle vehicle_2) and one policy of the"
            " team (ppo@RUN/policy/vehicle_2)"
        )
    name, _, argument = around.partition(":")
    wrapped: Driver = _WRAPPERS[name].load()(driver, argument or None, settings)
    return wrapped


# An agent from a Python file of the user's: ``my_file.py:make_agent``, loaded only where a person names it.


def make_from_file(argument: str | None, settings: AgentSettings) -> Driver:
    """What the function of the file makes, from the argument (or None) and the settings, or from nothing.

    A function without parameters takes neither argument nor policy: ``InvalidInput`` says so, and what is wrong with
    the file.
    """
    named = parse_spec(settings.spec).file
    assert named is not None
    function = load_function(*named)
    if settings.policy is not None:
        note_file(settings.policy)
    if not _takes_nothing(function):
        made: Driver = function(argument, settings)
        return made
    if (argument, settings.policy) != (None, None):
        raise InvalidInput(f"agent {settings.spec!r}: {named[1]} has no parameters, so it takes no argument")
    made = function()
    return made


def _takes_nothing(function: Callable[..., Any]) -> bool:
    try:
        return not inspect.signature(function).parameters
    except (TypeError, ValueError):  # of something built in
        return False
