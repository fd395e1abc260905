"""Inputs of an evaluation: agents from their specs, trained policies among them, and worlds."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.registry import make_agent, make_single_agent
from ethbrake_marl.agents.rollout import script_agents, set_others
from ethbrake_marl.agents.spelling import parse_spec
from ethbrake_marl.agents.team import Driver, Team, team_of
from ethbrake_marl.defaults import EPISODES, LIST_SEED, HarmCount
from ethbrake_marl.engine.stream import ask_script, begin_script
from ethbrake_marl.errors import InvalidInput, check_one_learner, naming_agent
from ethbrake_marl.evaluation.named_worlds import read_named_worlds
from ethbrake_marl.files.overrides import Override, changed_parts
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Sample, Scenario, load_scenario, read_initial_states, read_yaml
from ethbrake_marl.shield.uncertainty import Uncertainty

PROGRESS_EVERY = 2_500  # worlds between two signs of life
TRIED_CANDIDATES = 16  # of a script that searches, when a scenario is only checked

LADDER = (  # from no decision at all up to the best that is known
    "coast",
    "copy_leader",
    "full_brake",
    "gentlest_front",
    "e_v2x_bm:pairwise",
    "e_v2x_bm",
    "planner",
    "best_harm",
)
_LADDER_SPEC = "ladder"


def load_runnable(name_or_path: str, settings: Sequence[Override] = ()) -> Scenario:
    """Load a scenario as ``load_scenario`` does, and try its scripts, which the file's own check cannot know.

    ``settings`` are put in the place of what the file says.

    Raises ``InvalidInput`` naming the file, line, role and script that no agent of that name and argument can play.
    """
    scenario = load_scenario(name_or_path)
    if settings:
        content = {**scenario.model_dump(mode="json", exclude_none=True), **scenario.declared()}
        scenario = scenario.replace(**changed_parts(content, settings))
    worlds = scenario.replace(early_impacts="keep").sample(1, LIST_SEED).worlds
    for vehicle, script in scenario.scripts.items():
        try:
            agent = make_single_agent(script, horizon_s=scenario.horizon_s, most_candidates=TRIED_CANDIDATES)
            _try_out(agent, worlds, vehicle)
        except InvalidInput as error:
            role = scenario.vehicle_names[vehicle]
            where = _place_of_role(name_or_path, role)
            raise InvalidInput(f"{where}: roles.{role} = {script}: {error}") from None
    return scenario


def load_driven(name_or_path: str, vehicle: str | None, settings: Sequence[Override] = ()) -> Scenario:
    """A runnable scenario with one learner, the vehicle to drive: ``vehicle``, by default the only learner.

    Raises ``InvalidInput`` when there is no such vehicle, or nothing says which one it is.
    """
    scenario = load_runnable(name_or_path, settings)
    if vehicle is not None:
        return scenario.with_learners([vehicle])
    learners = [scenario.vehicle_names[i] for i in scenario.learners]
    check_one_learner(scenario.name, learners, "say which vehicle is driven, for instance --vehicle vehicle_2")
    return scenario


def load_evaluated(name_or_path: str, vehicle: str | None, settings: Sequence[Override] = ()) -> Scenario:
    """A runnable scenario whose learners are to be driven: ``vehicle`` alone, by default all learners there are.

    Raises ``InvalidInput`` when there is no such vehicle, or no learner.
    """
    scenario = load_runnable(name_or_path, settings)
    if vehicle is not None:
        return scenario.with_learners([vehicle])
    if not scenario.learners:
        raise InvalidInput(
            f"scenario {scenario.name!r} has no learner to drive; give the scenario that the agents were trained for"
            " (--scenario), or say which vehicle is driven, for instance --vehicle vehicle_2"
        )
    return scenario


def check_agents(agents: Mapping[str, Driver], worlds: Worlds, scenario: Scenario) -> None:
    """Try every agent before the first of them starts a long evaluation; raises what it would raise then.

    Scripts that need no state are tried on all worlds, which takes no time; all others on the first.
    """
    for name, agent in agents.items():
        team = team_of(agent, scenario.learners)
        scripts = script_agents(scenario, except_for=team.drivers)
        for vehicle, driver in team.drivers.items():
            set_others(driver, vehicle, scripts)
            with naming_agent(name, [script.name for script in scripts.values()]):
                _try_out(driver, worlds if getattr(driver, "state_free", False) else worlds.take([0]), vehicle)


def make_lineup(
    specs: Sequence[str],
    scenario: Scenario,
    *,
    harm_count: HarmCount = "first",
    uncertainty: Uncertainty | None = None,
) -> dict[str, Driver]:
    """One fresh agent per spec of ``make_agent``, by its spec, to drive the scenario's learners.

    ``ladder`` stands for every agent of ``LADDER``. ``harm_count`` is the harm that optimising and choosing agents
    minimise. ``uncertainty`` is what agents with ``+robust`` certify against. Raises ``InvalidInput`` for a spec given
    twice, an uncertainty that is missing or that nobody uses, and what ``make_agent`` raises.
    """
    specs = [each for spec in specs for each in (LADDER if spec == _LADDER_SPEC else [spec])]
    written = [parse_spec(spec) for spec in specs]
    for k, each in enumerate(written):
        if each in written[:k]:
            raise InvalidInput(f"agent {str(each)!r} is given twice; each agent drives every world once")
    if uncertainty is not None and not any(each.shield in ("robust", "robust:interior") for each in written):
        raise InvalidInput(f"uncertainty {uncertainty}: nobody uses it; an agent with +robust does: ppo@PATH+robust")
    return {
        str(each): make_agent(str(each), scenario=scenario, harm_count=harm_count, uncertainty=uncertainty)
        for each in written
    }


def make_agents(specs: Sequence[str], scenario: Scenario, *, harm_count: HarmCount = "first") -> dict[str, Agent]:
    """``make_lineup`` where one vehicle is driven; raises ``InvalidInput`` for a team too."""
    alone: dict[str, Agent] = {}
    for spec, agent in make_lineup(specs, scenario, harm_count=harm_count).items():
        if isinstance(agent, Team):
            raise InvalidInput(f"agent {spec!r}: is a team, one agent is needed here: ppo@RUN/policy/vehicle_2")
        alone[spec] = agent
    return alone


def make_proposers(specs: Sequence[str], scenario: Scenario, *, harm_count: HarmCount = "first") -> dict[str, Driver]:
    """What goes behind a shield: ``make_lineup`` where several vehicles learn, else ``make_agents``.

    Raises ``InvalidInput`` for a spec that has a shield already.
    """
    make = make_lineup if len(scenario.learners) > 1 else make_agents
    agents: Mapping[str, Driver] = make(specs, scenario, harm_count=harm_count)
    for spec in agents:
        if parse_spec(spec).shield is not None:
            raise InvalidInput(
                f"agent {spec!r}: has a shield already; here the shields are put around what proposes: ppo@PATH"
            )
    return dict(agents)


def choose_worlds(
    scenario: Scenario, *, initial_states: Path | None = None, episodes: int | None = None, seed: int | None = None
) -> tuple[Sample, int | None]:
    """The user's own worlds, or the first ``episodes`` of the list of ``seed``; and that seed, None for own worlds.

    Raises ``InvalidInput`` when worlds are given and drawn at once, and what reading or drawing them raises.
    """
    if initial_states is None:
        list_seed = LIST_SEED if seed is None else seed
        return scenario.sample(EPISODES if episodes is None else episodes, list_seed), list_seed
    if episodes is not None or seed is not None:
        raise InvalidInput(
            f"{initial_states}: gives the worlds, and a number of episodes or a seed draws them; use one"
        )
    if initial_states.suffix.lower() in (".yaml", ".yml"):
        worlds = read_named_worlds(initial_states).worlds_of(scenario, str(initial_states))
    else:
        worlds = read_initial_states(initial_states, scenario)
    return Sample(worlds, np.arange(worlds.n, dtype=np.int64), 0), None


def _try_out(agent: Agent, worlds: Worlds, vehicle: int) -> None:
    """Let a copy of the agent begin and act once."""
    driver = copy.deepcopy(agent)
    begin_script(driver, worlds, vehicle, np.arange(worlds.n))
    ask_script(driver, worlds, vehicle)


def _place_of_role(name_or_path: str, role: str) -> str:
    """File and line of a role, or the name of a shipped scenario."""
    if not Path(name_or_path).is_file():
        return f"scenario {name_or_path!r}"
    return read_yaml(name_or_path).where(("roles", role))
