"""Put a shield around an environment, an agent or a team."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from ethbrake_marl.agent_names import AgentSettings, make_agent, team_of, teams_of, wrap_team
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.agents.team import Team
from ethbrake_marl.episode.counts import HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.faces.face import Face
from ethbrake_marl.faces.rendering import make_renderer
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.scenario import Scenario

NO_TEAM = Team("", {})  # proposes nothing


def shield(
    env: Any,
    policy: Any = None,
    mode: str = "step",
    *,
    scenario: AnyScenario | None = None,
    harm_count: AnyCount | None = None,
    **options: Any,
) -> Any:
    """Shielded copy of an environment, of the same class, or a shielded team.

    ``env`` is not changed; the copy starts with ``reset``. The shield acts inside the wrappers of ``env``: a wrapper
    that changes actions changes what is proposed to the shield. Infos: ``shield_...`` (docs/shield.md).

    Args:
        env: an environment of this package (perhaps in wrappers of its library), a ``VecEnv``, a ``Team``, an agent or
            its name.
        policy: proposes actions where the caller proposes none (NaN, or no entry in the dictionary); the shield also
            plans with them. A name, an agent for all learners, a ``Team``, or vehicle -> agent. None: without a
            proposal the shield follows its own plan.
        mode: ``step``, ``episode`` (the paper's Algorithm 1), or another shield, as after the ``+`` in an agent's name.
        scenario: scenario in which an agent drives; only for agents.
        harm_count: count of harm to bound (``episode.counts``). None: the count of the environment's reward, or
            ``honest`` for an agent.
        options: settings of the mode: ``allowance`` (m2/s2) and ``cap`` (None or ``baseline``) for ``step``, ``bound``
            (``coupled`` or ``pairwise``) for ``episode``.

    Raises ``InvalidInput`` for any other ``env`` or setting, and for an environment that already has a shield.

    >>> import ethbrake_marl as eb
    >>> env = eb.shield(eb.parallel_env(scenario="paper-random"))
    >>> observations, infos = env.reset(seed=7)
    >>> env.step({"vehicle_2": [1.0]})[4]["vehicle_2"]["shield_intervened"]
    True

    """
    is_agent = hasattr(env, "act") or isinstance(env, str)
    if not is_agent and not isinstance(env, Team) and not hasattr(env, "unwrapped"):
        raise InvalidInput(
            f"shield: {env!r:.80}: must be a team, an agent, or an environment; make an agent of a network or another"
            " policy: eb.shield(eb.policy_agent(policy, scenario=...), scenario=...)"
        )
    if is_agent == (scenario is None):
        right = "pass scenario=..., in which it drives" if is_agent else "leave out scenario"
        raise InvalidInput(f"shield: {env!r:.80}: {right}")
    base = getattr(env, "unwrapped", None)
    worlds: Any = getattr(base, "scenario", None) if scenario is None else load_scenario(scenario)
    rewarded = base.game.rewarding.params.harm_count if isinstance(base, Face) else HONEST
    count = rewarded if harm_count is None else HarmCount.of(harm_count, "shield: harm_count")
    around = partial(guard_team, mode=mode, scenario=worlds, count=count, options=options)
    if not is_agent and not isinstance(env, Team):
        return shielded_environment(env, base, policy, around, count)
    driver: Any = make_agent(env, scenario=worlds, harm_count=count) if isinstance(env, str) else env
    team = team_of(driver, worlds)
    if policy is not None:
        raise InvalidInput(f"shield: {team.name!r} proposes by itself; leave out policy")
    return around(team)


def guard_team(team: Team, mode: str, scenario: Scenario | None, count: HarmCount, options: Mapping[str, Any]) -> Team:
    settings = AgentSettings(f"{team.name}+{mode}", None, scenario, count, options)
    guarded_team = wrap_team(team, str(mode), settings)
    if guarded_team.shield is None:
        raise InvalidInput(f"shield: mode {mode!r}: is no shield; write it in the name of an agent, AGENT+{mode}")
    return guarded_team


def shielded_environment(env: Any, base: Any, policy: Any, around: Callable[[Team], Team], count: HarmCount) -> Any:
    """If ``policy`` is the name of an agent, this agent minimises ``count``."""
    if isinstance(env, type) or not isinstance(base, Face):
        raise InvalidInput(
            f"shield: {env!r:.80}: must be a team, an agent, or an environment made by eb.parallel_env, eb.env,"
            " eb.EthBrakeEnv, eb.EthBrakeVectorEnv or eb.make_sb3_vec_env, perhaps in wrappers"
        )
    if hasattr(env, "venv"):  # copies of Stable-Baselines3's wrappers lose what they wrap
        name = type(env).__name__
        raise InvalidInput(f"shield: put the shield inside: {name}(eb.shield(env), ...) instead of shield({name}(env))")
    game: Game = base.game
    if game.shield is not None:
        raise InvalidInput("shield: this environment already has a shield")
    base._need_learner()
    if policy is None:
        return with_game(env, game._replace(shield=around(NO_TEAM).shield))
    policy = LearnedAgent(policy) if isinstance(policy, Policy) else policy
    team = teams_of({"policy": policy}, base.scenario, harm_count=count)["policy"]
    if team.shield is not None:
        raise InvalidInput(f"shield: policy {policy!r:.60} has a shield of its own; pass it without one")
    return with_game(env, around(team).game(game))


def with_game(env: Any, game: Game) -> Any:
    """With its wrappers, without a running episode."""
    base = env.unwrapped
    instead = {id(base.game): game, id(base.scenario): base.scenario, id(base.episode): None, id(base.renderer): None}
    env_copy = copy.deepcopy(env, instead)
    base = env_copy.unwrapped
    base.renderer = make_renderer(base, base.render_mode)
    return env_copy
