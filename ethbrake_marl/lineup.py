"""Who drives in an evaluation (agents from their specs, trained policies among them), and in which worlds."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.refined import Rehearsed
from ethbrake_marl.agents.registry import Factory, agent_names, register_agent
from ethbrake_marl.agents.registry import make_agent as make_agent  # the public one: here all agents are registered
from ethbrake_marl.agents.rollout import introduce, scripted
from ethbrake_marl.agents.team import Driver, Team, team_of
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.learning.team_file import is_team, load_driver, load_team
from ethbrake_marl.limits.shipped import make_best_harm
from ethbrake_marl.physics import Worlds
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.shipped import SHIPPED, PolicyKind, load_named_policy
from ethbrake_marl.scenario import Sample, Scenario, load_scenario, read_initial_states, read_yaml
from ethbrake_marl.shield.agents import HybridAgent, StepShieldAgent
from ethbrake_marl.shield.uncertainty import Uncertainty, mode_uncertainty

EPISODES = 10_000
PROGRESS_EVERY = 500  # worlds between two signs of life
TRIED_CANDIDATES = 16  # of a script that searches, when a scenario is only checked
LIST_SEED = 7  # of the worlds on which everything is measured; has nothing to do with the seed of a training

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

register_agent("best_harm", make_best_harm)

POLICY_KINDS: tuple[PolicyKind, ...] = ("ppo", "sac", "universal")
_WITH_SCENARIO = (
    "rehearsed",
    "hybrid",
    "hybrid:pairwise",
    "hybrid:rehearsed",
    "step",
    "step:rehearsed",
    "robust",
    "robust:rehearsed",
)  # of a policy, for one scenario
_TEAM = "team"  # of a run: every learner driven as it was trained
_OF_A_POLICY = (*POLICY_KINDS, "rehearsed", "hybrid", "step", "robust")
SHIELDS = ("none", "episode", "step", "robust")  # that ``make_lineup`` can put around whatever learned
_LADDER_SPEC = "ladder"


def load_runnable(name_or_path: str) -> Scenario:
    """Load a scenario as ``load_scenario`` does, and try its scripts, which the file's own check cannot know.

    Raises ``InvalidInput`` naming the file, line, role and script that no agent of that name and argument can play.
    """
    scenario = load_scenario(name_or_path)
    worlds = scenario.replace(early_impacts="keep").sample(1, LIST_SEED).worlds
    for vehicle, script in scenario.scripts.items():
        try:
            agent = make_agent(script, horizon_s=scenario.horizon_s, most_candidates=TRIED_CANDIDATES)
            _try_out(agent, worlds, vehicle)
        except InvalidInput as error:
            role = scenario.vehicle_names[vehicle]
            where = _place_of_role(name_or_path, role)
            raise InvalidInput(f"{where}: roles.{role} = {script}: {error}") from None
    return scenario


def load_driven(name_or_path: str, vehicle: str | None) -> Scenario:
    """A runnable scenario with one learner, the vehicle to drive: ``vehicle``, by default the only learner.

    Raises ``InvalidInput`` when there is no such vehicle, or nothing says which one it is.
    """
    scenario = load_runnable(name_or_path)
    if vehicle is not None:
        return scenario.with_learners([vehicle])
    if len(scenario.learners) != 1:
        learners = ", ".join(scenario.vehicle_names[i] for i in scenario.learners) or "none"
        raise InvalidInput(
            f"scenario {scenario.name!r} has {len(scenario.learners)} learners ({learners}); say which vehicle is"
            " driven, for instance --vehicle vehicle_2"
        )
    return scenario


def load_evaluated(name_or_path: str, vehicle: str | None) -> Scenario:
    """A runnable scenario whose learners are to be driven: ``vehicle`` alone, by default all learners there are.

    Raises ``InvalidInput`` when there is no such vehicle, or no learner.
    """
    scenario = load_runnable(name_or_path)
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
    for agent in agents.values():
        team = team_of(agent, scenario.learners)
        scripts = scripted(scenario, but=team.drivers)
        for vehicle, driver in team.drivers.items():
            introduce(driver, vehicle, scripts)
            _try_out(driver, worlds if getattr(driver, "state_free", False) else worlds.take([0]), vehicle)


def make_lineup(
    specs: Sequence[str],
    scenario: Scenario,
    *,
    count: HarmCount = "first",
    shield: str = "none",
    uncertainty: Uncertainty | None = None,
) -> dict[str, Driver]:
    """One fresh agent per spec, by its spec, to drive the learners of ``scenario``.

    Every spec of ``make_agent``, and ``ppo@PATH`` or ``sac@PATH`` (the policy of a run, or a bundle), ``hybrid@PATH``
    (Algorithm 1: that policy or coupled E-V2X-BM, whichever harms less), ``hybrid:pairwise@PATH`` (with the paper's
    closed form instead), ``rehearsed@PATH`` (``agents.refined``), ``hybrid:rehearsed@PATH``, and ``step@PATH`` or
    ``step:rehearsed@PATH`` (the step shield); ``team@PATH`` is the team of a run, as ``ppo@PATH`` and ``sac@PATH`` are
    where each learner has its own policy. PATH may be
    ``shipped``, the policy that comes with the package for this scenario and count (PPO's for all but sac@shipped), or
    ``shipped/NAME``; ``universal@shipped`` is for all scenarios. ``ladder`` stands for every agent of ``LADDER`` that
    there is. ``count`` is the harm that optimising and choosing agents minimise.
    ``shield`` (one of ``SHIELDS``) is put around every learned agent that has none, which is named ``SPEC+shield``.
    ``robust@PATH``, ``robust:rehearsed@PATH`` and the shield ``robust`` certify against an ``uncertainty``. Raises
    ``InvalidInput`` for a spec given twice, a team that is to be shielded, a shield that nobody gets, or an uncertainty
    that is missing or that nobody uses, ``UnknownName`` with a suggestion, and whatever loading a policy raises.
    """
    specs = [each for spec in specs for each in (_ladder() if spec == _LADDER_SPEC else [spec])]
    for k, spec in enumerate(specs):
        if spec in specs[:k]:
            raise InvalidInput(f"agent {spec!r} is given twice; each agent drives every world once")
    if uncertainty is not None and shield != "robust" and not any(spec.startswith("robust") for spec in specs):
        raise InvalidInput(f"uncertainty {uncertainty}: nobody uses it; shield robust or an agent robust@PATH does")
    agents = {spec: _driver(spec, scenario, count, uncertainty) for spec in specs}
    drivers = {spec: _shielded(spec, agent, scenario, count, shield, uncertainty) for spec, agent in agents.items()}
    if shield != "none" and all(drivers[spec] is agent for spec, agent in agents.items()):
        raise InvalidInput(
            f"shield {shield}: nobody of {', '.join(specs)} gets it; it is put around what learned and has no shield"
            " yet, for instance ppo@shipped"
        )
    return {spec if driver is agents[spec] else f"{spec}+{shield}": driver for spec, driver in drivers.items()}


def make_agents(specs: Sequence[str], scenario: Scenario, *, count: HarmCount = "first") -> dict[str, Agent]:
    """``make_lineup`` where one vehicle is driven; raises ``InvalidInput`` for a team too."""
    alone = {}
    for spec, agent in make_lineup(specs, scenario, count=count).items():
        if isinstance(agent, Team):
            raise InvalidInput(f"agent {spec!r}: is a team, one agent is needed here: ppo@RUN/policy/vehicle_2")
        alone[spec] = agent
    return alone


def make_proposers(specs: Sequence[str], scenario: Scenario, *, count: HarmCount = "first") -> dict[str, Agent]:
    """``make_agents`` for what goes behind a shield; raises ``InvalidInput`` for a spec that has one already."""
    for spec in specs:
        kind = re.split("[:@]", spec, maxsplit=1)[0]
        if kind in ("hybrid", "step", "robust"):
            raise InvalidInput(
                f"agent {spec!r}: has a shield already; here the shields are put around what proposes: ppo@PATH"
            )
    return make_agents(specs, scenario, count=count)


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
    worlds = read_initial_states(initial_states, scenario)
    return Sample(worlds, np.arange(worlds.n, dtype=np.int64), 0), None


def _try_out(agent: Agent, worlds: Worlds, vehicle: int) -> None:
    """Let a copy of the agent begin and act once."""
    driver = copy.deepcopy(agent)
    driver.begin(worlds, vehicle, np.arange(worlds.n))
    driver.act(worlds, vehicle)


def _place_of_role(name_or_path: str, role: str) -> str:
    """File and line of a role, or the name of a shipped scenario."""
    if not Path(name_or_path).is_file():
        return f"scenario {name_or_path!r}"
    return f"{name_or_path}, line {read_yaml(name_or_path).line_of(('roles', role))}"


def _ladder() -> list[str]:
    """The agents of the ladder that are registered."""
    return [spec for spec in LADDER if spec.partition(":")[0] in agent_names()]


def _driver(spec: str, scenario: Scenario, count: HarmCount, uncertainty: Uncertainty | None) -> Driver:
    kind, at, path = spec.partition("@")
    if at and (kind == _TEAM or (kind in ("ppo", "sac") and is_team(path))):
        team = load_team(path, scenario, spec)
        _check_algorithm(spec, load_driver(path, scenario.vehicle_names[min(team.drivers)]))
        return team
    return _agent(spec, scenario, count, uncertainty)


def _check_algorithm(spec: str, policy: Policy) -> None:
    """``ppo@PATH`` and ``sac@PATH`` are for policies of that algorithm."""
    kind, _, path = spec.partition("@")
    trained_by = policy.manifest.algorithm
    if kind in ("ppo", "sac") and kind != trained_by:
        raise InvalidInput(f"agent {spec!r}: that policy was trained by {trained_by.upper()}: {trained_by}@{path}")


def _agent(spec: str, scenario: Scenario, count: HarmCount, uncertainty: Uncertainty | None) -> Agent:
    name = re.split("[:@]", spec, maxsplit=1)[0]
    if name in _OF_A_POLICY:
        return _agent_of_a_policy(spec, scenario, count, uncertainty)
    if name not in agent_names():
        raise unknown_name("agent", name, {*agent_names(), *_OF_A_POLICY, _TEAM, _LADDER_SPEC})
    return make_agent(spec, count=count, horizon_s=scenario.horizon_s)


def _agent_of_a_policy(
    spec: str, scenario: Scenario | None, count: HarmCount, uncertainty: Uncertainty | None = None
) -> Agent:
    """A policy alone, or behind its shield, which needs the scenario."""
    kind, _, path = spec.partition("@")
    if not path or kind not in (*POLICY_KINDS, *_WITH_SCENARIO):
        kinds = ", ".join(f"{each}@PATH" for each in ("ppo", "sac", *_WITH_SCENARIO))
        raise InvalidInput(
            f"agent {spec!r}: must be universal@shipped or one of {kinds}, where PATH is a run or a policy bundle, for"
            " instance ppo@runs/my-run, or shipped"
        )
    wanted: PolicyKind = "sac" if kind == "sac" else "universal" if kind == "universal" else "ppo"
    if kind == "universal" and path != SHIPPED:
        raise InvalidInput(f"agent {spec!r}: must be universal@{SHIPPED}; for another policy: ppo@PATH or sac@PATH")
    loaded = load_named_policy(path, wanted, scenario, count)
    _check_algorithm(spec, loaded)
    policy = LearnedAgent(loaded, name=spec if kind in POLICY_KINDS else f"{loaded.manifest.algorithm}@{path}")
    if kind in POLICY_KINDS:
        return policy
    assert scenario is not None
    driver = Rehearsed(policy, scenario, count=count) if kind.endswith("rehearsed") else policy
    if kind == "rehearsed":
        return driver
    if kind.startswith("step"):
        return StepShieldAgent(driver, scenario, count=count)
    if kind.startswith("robust"):
        return StepShieldAgent(driver, scenario, count=count, uncertainty=mode_uncertainty("robust", uncertainty, spec))
    return HybridAgent(driver, scenario, bound="pairwise" if kind == "hybrid:pairwise" else "coupled", count=count)


def _shielded(
    spec: str, agent: Driver, scenario: Scenario, count: HarmCount, shield: str, uncertainty: Uncertainty | None
) -> Driver:
    """A learned agent behind the shield; any other agent as it is. Raises ``UnknownName`` for another shield.

    Raises ``InvalidInput`` for a team.
    """
    if shield not in SHIELDS:
        raise unknown_name("shield", shield, SHIELDS)
    intervals = mode_uncertainty(shield, uncertainty, "shield") if shield == "robust" else None
    if shield != "none" and isinstance(agent, Team):
        raise InvalidInput(
            f"agent {spec!r}: is a team, and shield {shield} is for one driven vehicle, the others following scripts;"
            " name that vehicle (--vehicle vehicle_2) and one policy of the team (ppo@RUN/policy/vehicle_2)"
        )
    if shield == "none" or not isinstance(agent, LearnedAgent | Rehearsed):
        return agent
    if shield == "episode":
        return HybridAgent(agent, scenario, count=count)
    return StepShieldAgent(agent, scenario, count=count, uncertainty=intervals)


def _register_policies() -> None:
    """Make ``ppo@PATH``, ``sac@PATH`` and ``universal@shipped`` known to ``make_agent``."""

    def factory_of(kind: str) -> Factory:
        return lambda argument, settings: _agent_of_a_policy(f"{kind}@{argument or ''}", None, settings.count)

    for kind in POLICY_KINDS:
        register_agent(kind, factory_of(kind))


_register_policies()
