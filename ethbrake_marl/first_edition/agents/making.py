"""Make agents from specifications: ``make_agent`` makes any agent, ``make_role`` the script of a vehicle."""

from __future__ import annotations

import inspect
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.errors import RENAMED, EthBrakeError, InvalidInput, describe_error, unknown_name
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.first_edition.agents.protocol import Agent, Driver, Source, Team, check_agent
from ethbrake_marl.first_edition.agents.registry import (
    AGENTS,
    PROFILE,
    Entry,
    agent_names,
    around_entry,
    group_names,
    variants_of,
)
from ethbrake_marl.first_edition.agents.settings import HORIZON_S, AgentSettings
from ethbrake_marl.first_edition.agents.spec import AgentSpec, parse_spec
from ethbrake_marl.first_edition.game.harm import HarmCount, check_harm_count
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario


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
    """Make a new agent, which drives one vehicle, or the team of agents that one training run has trained.

    Args:
        spec: ``name[:argument][@policy]``, followed by wrappers, for example ``constant:3.5`` or
            ``ppo+search+step``. ``ethbrake agent list`` lists all agents and wrappers. ``my_file.py:make_agent`` runs
            ``my_file.py`` with all your rights, and calls its function ``make_agent`` with the arguments of a factory
            (see ``register_agent``), or without arguments if the function has no parameters.
        scenario: scenario, its name, or the path of its file; teams and wrappers need a scenario.
        harm_count: harm that an optimising agent minimises: ``first`` (first-impact harm) or ``total`` (total harm).
        horizon_s: time after the alert until which an agent looks ahead, s; None: the scenario's horizon, or 8 s.
        most_candidates: a search tries at most this number of plans; a small number makes a quick trial possible. None:
            no limit.
        uncertainty: how far gaps, speeds and other quantities may differ from their stated values, for example
            ``"gaps_m=0.5"``; some shields require this argument.
        time_step_s: time between two decisions of agents that search or follow a control law, s; None: the scenario's
            time step, or 0.1 s.

    Raises ``UnknownName`` for an unknown name, with a similar name as a suggestion. Raises ``InvalidInput`` for an
    invalid argument, harm count or horizon, or if the agent needs a scenario but no scenario is passed.

    >>> import ethbrake_marl.first_edition as eb
    >>> eb.make_agent("ppo+step", scenario="paper-random").name
    'ppo+step'

    """
    check_harm_count(harm_count)
    scenario = None if scenario is None else load_scenario(scenario)
    if horizon_s is None:
        horizon_s = HORIZON_S if scenario is None else scenario.horizon_s
    if not isinstance(horizon_s, int | float | np.number) or not 0.0 < horizon_s < float("inf"):
        raise InvalidInput(f"horizon_s = {horizon_s!r}: must be a finite number of seconds above 0")
    written = parse_spec(spec)
    if written.name == PROFILE:
        raise InvalidInput(
            f"agent {spec!r}: a braking profile can only be the role of a vehicle; write it under roles in the scenario"
        )
    settings = AgentSettings(
        written.core, written.policy, scenario, harm_count, float(horizon_s), most_candidates, uncertainty,
        time_step_s or (0.1 if scenario is None else scenario.time_step_s),
    )  # fmt: skip
    return _make_driver(written, settings)


def _make_driver(written: AgentSpec, settings: AgentSettings) -> Driver:
    driver = _make(find_entry(written), written.argument, settings)
    for each in written.around:
        settings, entry = replace(settings, spec=f"{settings.spec}+{each}"), around_entry(each)
        if isinstance(driver, Team) and not entry.teams:
            raise InvalidInput(
                f"agent {settings.spec!r}: +{each} works for one controlled vehicle only, not for a team; use +step, or"
                " one policy of the team (ppo@RUN/policy/vehicle_2) and scripts for the other vehicles"
                " (--set roles.vehicle_3=full_brake)"
            )
        driver = _make(entry, each.partition(":")[2] or None, settings, driver)
    return driver


def make_role(scenario: Scenario, vehicle: int, *, most_candidates: int | None = None) -> Agent:
    """Make the script of ``vehicle`` (index, 0 = front) in ``scenario``.

    A script that optimises harm minimises first-impact harm. A script that searches tries at most ``most_candidates``
    plans; None: no limit. Raises the same errors as ``make_agent``. Also raises ``InvalidInput`` for a script with a
    shield or search around it, and for a team that does not drive exactly ``vehicle``.
    """
    spec = scenario.scripts[vehicle]
    name, _, argument = spec.partition(":")
    written = AgentSpec(PROFILE, argument, None, ()) if name == PROFILE else parse_spec(spec)
    settings = AgentSettings(
        written.core, written.policy, scenario, horizon_s=scenario.horizon_s, most_candidates=most_candidates,
        time_step_s=scenario.time_step_s, role=vehicle,
    )  # fmt: skip
    team = None if written.around else Team.of(_make_driver(written, settings), (vehicle,))
    if team is None or team.shield is not None:
        raise InvalidInput(
            f"agent {spec!r}: a vehicle that does not learn cannot have a search or a shield; give"
            f" {scenario.vehicle_names[vehicle]} the role {written.core}, or make it a learner"
        )
    return team.drivers[vehicle]


def find_entry(spec: AgentSpec | str) -> Entry:
    """Return the registry entry of an agent, such as ``constant:3.5`` or ``ppo``.

    Raises ``UnknownName`` for an unknown agent, with a similar name as a suggestion. Raises ``InvalidInput`` for an
    argument or policy that the agent does not accept.
    """
    written = parse_spec(spec) if isinstance(spec, str) else spec
    if written.file is not None:
        form = f"{written.name}[:ARGUMENT][@POLICY]"
        return Entry(written.name, form, "your own", Source.UNSTATED, make_from_file)
    if written.name not in AGENTS:
        if written.name in group_names():
            raise InvalidInput(f"agent {written.core!r}: is the name of a group of agents; write the name of one agent")
        raise AGENTS.unknown(written.name, {*agent_names(), *group_names()})
    entry = AGENTS[written.name]
    if written.argument is not None and ":" not in entry.whole_form:
        raise InvalidInput(f"agent {written.core!r}: {written.name} takes no argument")
    word = (written.argument or "").rpartition(":")[2]
    if RENAMED.get(word) in variants_of(written.name):
        raise unknown_name(f"variant of {written.name}", word, variants_of(written.name))
    if written.policy is not None and "@" not in entry.form:
        own = "" if entry.is_ours else "; to allow one, register the agent with register_agent(..., takes_policy=True)"
        raise InvalidInput(
            f"agent {written.core!r}: {written.name} does not use a policy; leave out @ and what follows{own}"
        )
    return entry


def _make(entry: Entry, argument: str | None, settings: AgentSettings, *inside: Driver) -> Driver:
    """Make an agent or a team from its registry entry, and check the result.

    The arguments are as in ``Entry.call``. If a factory from outside this package raises an error, ``_make`` raises
    ``InvalidInput`` in its place.
    """
    try:
        driver = entry.call(argument, settings, *inside)
    except Exception as error:
        if entry.is_ours or isinstance(error, EthBrakeError):
            raise
        raise InvalidInput(f"agent {settings.spec!r}: {describe_error(error)}") from error
    if not isinstance(driver, Team):
        check_agent(driver, f"agent {settings.spec!r}", alone=not inside)
    return driver


def make_from_file(argument: str | None, settings: AgentSettings) -> Driver:
    """Call the function in a Python file that ``settings.spec`` names (``FILE.py:FUNCTION``), and return its result.

    The function is called with ``argument`` (the text after the second colon, or None) and ``settings``. A function
    without parameters is called without arguments. Raises ``InvalidInput`` if the file cannot be loaded, or if the
    function has no parameters but the specification contains an argument or a policy.
    """
    named = parse_spec(settings.spec).file
    assert named is not None
    function = load_from_file(*named, reads=settings.policy)
    if not callable(function):
        raise InvalidInput(
            f"file {named[0]!r}: {named[1]!r} is not a function; write FILE.py:FUNCTION, where FUNCTION makes the agent"
        )
    arguments: tuple[Any, ...] = (argument, settings)
    with suppress(TypeError, ValueError):  # a built-in function may have no signature
        if not inspect.signature(function).parameters:
            arguments = ()
    if not arguments and (argument, settings.policy) != (None, None):
        raise InvalidInput(
            f"agent {settings.spec!r}: the function {named[1]} has no parameters; write the name without an"
            " argument and without a policy"
        )
    driver: Driver = function(*arguments)
    return driver
