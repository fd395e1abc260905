"""Try a scenario before use: check that its scripts run without errors, and count worlds in which something unusual
happens.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from ethbrake_marl.errors import AgentFailed, InvalidInput, check_one_learner
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.files.yaml import read_yaml
from ethbrake_marl.first_edition.agents.driving import Episodes, script_agents
from ethbrake_marl.first_edition.agents.making import find_entry, make_agent, make_role
from ethbrake_marl.first_edition.agents.registry import agents_of_group, settings_needed, shield_forms
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.engine.memory import ask_script, begin_script
from ethbrake_marl.first_edition.evaluation.identity import LIST_SEED
from ethbrake_marl.first_edition.evaluation.lineup import check_agents
from ethbrake_marl.first_edition.physics.state import Ints, Worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario, scenario_path
from ethbrake_marl.first_edition.scenario.roles import ScriptSpec
from ethbrake_marl.first_edition.scenario.schema import Scenario

TRIED_CANDIDATES = 16  # number of candidates of a searching script while a scenario is checked


def load_runnable(
    name_or_path: str, settings: Sequence[Override] = (), *, drives: Literal["nobody", "one", "some"] = "nobody"
) -> Scenario:
    """Load a scenario, and find errors in its scripts by letting each script decide once in one world.

    ``settings`` override values of the file. ``drives`` says how many learners the scenario must have: ``one`` (exactly
    one), ``some`` (at least one) or ``nobody`` (any number, because no agent is to drive). Raises ``InvalidInput`` if a
    script does not work (the message names file, line, vehicle and script), or if the number of learners does not fit.
    """
    scenario = load_scenario(name_or_path)
    if settings:
        content = {**scenario.model_dump(mode="json", exclude_none=True), **scenario.declared()}
        scenario = scenario.replace(**Override.put(content, settings))
    worlds = scenario.replace(early_impacts="keep").sample(1, LIST_SEED).worlds
    for i, script in scenario.scripts.items():
        try:
            agent = make_role(scenario, i, most_candidates=TRIED_CANDIDATES)
            ask_script(agent, worlds, begin_script(agent, worlds, i, {}), i)
        except InvalidInput as error:
            role = scenario.vehicle_names[i]
            where = f"scenario {name_or_path!r}"
            if not any(setting.top == "roles" for setting in settings):
                where = read_yaml(scenario_path(name_or_path)).where(("roles", role))
            raise InvalidInput(f"{where}: roles.{role} = {script}: {error}") from None
    learners = [scenario.vehicle_names[i] for i in scenario.learners]
    if drives == "one":
        check_one_learner(
            scenario.name, learners, "exactly one is needed; set roles, for instance --set roles.vehicle_3=full_brake"
        )
    elif drives == "some" and not learners:
        raise InvalidInput(
            f"scenario {scenario.name!r} has no learner that the agents could drive; choose the scenario that the"
            " agents were trained for (--scenario), or make a vehicle a learner, for instance"
            " --set roles.vehicle_2=learner"
        )
    return scenario


def try_scenario(scenario: Scenario, worlds: Worlds) -> dict[str, Any]:
    """Simulate ``worlds`` of a scenario, and count the worlds in which something unusual happens.

    Learners brake fully; the other vehicles follow their scripts. To save time, scripts that search for good commands
    try only a few commands. The result is a dictionary with these keys:

    - ``early_impacts``: number of worlds with an impact before a learner may act;
    - ``moving_at_horizon``: number of worlds in which a vehicle still moves at the horizon;
    - ``vehicle_1_late``: number of worlds in which Vehicle 1 has a latency;
    - ``commands_out_of_range``: name of a vehicle -> (row number of a world -> error message), for worlds in which the
      vehicle's script commanded more than the vehicle's capacity;
    - ``not_state_free``: name of a vehicle -> its script, for scripts that react to the state of the world;
    - ``refused_by``: name of an agent, shield or setting that refuses scripts that react to the state of the world ->
      error message.

    Raises ``InvalidInput`` if a script has an error, and ``PhysicsError`` if the simulation of a world fails.
    """
    searches = {
        scenario.vehicle_names[i]: f"{ScriptSpec.parse(script).name}:{TRIED_CANDIDATES}"
        for i, script in scenario.scripts.items()
        if "CANDIDATES" in find_entry(script).form
    }
    tried = scenario.replace(roles={**scenario.roles, **searches})
    braking = {scenario.vehicle_names[i]: "full_brake" for i in scenario.learners}
    scripts = script_agents(tried.replace(roles={**tried.roles, **braking}))
    early, moving = np.zeros((2, worlds.n), np.bool_)
    beyond: dict[str, dict[int, str]] = {}

    def drive_rows(rows: Ints) -> None:
        some = worlds.take(rows)
        engine = Engine(scenario, some.n, learners=(), scripts=scripts, deciders=scenario.learners, worlds=some)
        engine.roster.warns = False  # ``Episodes`` reports failed worlds
        early[rows] = engine.ledger.count.any(axis=1) | (engine.ledger.obstacle_count > 0)
        moving[rows] = ~Episodes.of(engine, some).at_rest

    try:
        drive_rows(np.arange(worlds.n))
    except AgentFailed:
        for row in range(worlds.n):
            try:
                drive_rows(np.array([row]))
            except AgentFailed as error:
                beyond.setdefault(error.reason.partition(" ")[0], {})[row] = str(error.renumbered([row]))
    odd = {
        scenario.vehicle_names[i]: script
        for i, script in scenario.scripts.items()
        if not ScriptSpec.parse(script).is_state_free()
    }
    usual = scenario.replace(roles={**scenario.roles, **dict.fromkeys(odd, "full_brake")})
    refused, anyway = (_refusals(each, worlds.take([0])) if odd else {} for each in (tried, usual))
    return {
        "early_impacts": int(early.sum()),
        "moving_at_horizon": int(moving.sum()),
        "vehicle_1_late": int((worlds.vehicles.latency_s[:, 0] > 0.0).sum()),
        "commands_out_of_range": beyond,
        "not_state_free": odd,
        "refused_by": {what: why for what, why in refused.items() if what not in anyway},
    }


def _refusals(scenario: Scenario, worlds: Worlds) -> dict[str, str]:
    """Return what refuses the scenario (agents, shields as ``+NAME``, ``early_impacts: reject``), and the messages."""

    def drive_by(spec: str, needs: Mapping[str, Any]) -> None:
        check_agents(
            {spec: make_agent(spec, scenario=scenario, most_candidates=TRIED_CANDIDATES, **needs)}, worlds, scenario
        )

    asked: dict[str, Callable[[], object]] = {spec: partial(drive_by, spec, {}) for spec in agents_of_group("ladder")}
    for shield in shield_forms():
        asked[f"+{shield}"] = partial(drive_by, f"full_brake+{shield}", settings_needed(shield))
    asked["early_impacts: reject"] = lambda: scenario.replace(early_impacts="reject")
    refused = {}
    for what, ask in asked.items():
        try:
            ask()
        except InvalidInput as error:
            refused[what] = str(error)
    return refused
