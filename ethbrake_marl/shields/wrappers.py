"""One function puts a shield around an environment of any interface, or around a team."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from inspect import signature
from typing import Any

from ethbrake_marl.agents.drive import Agent, Team
from ethbrake_marl.episode.game import Game, Shield
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.faces.rendering import make_renderer
from ethbrake_marl.faces.stream import Stream
from ethbrake_marl.registry import Registry
from ethbrake_marl.shields.algorithm_1 import EpisodeShield
from ethbrake_marl.shields.step import StepShield

MakeShield = Callable[..., Shield]  # (drivers, **options): body -> agent, perhaps empty; the options of the mode


def register_shield_mode(name: str, make: MakeShield) -> None:
    """Register a mode of the shield. Entry points: ``ethbrake_marl.shield_modes``."""
    MODES.add(name, make, lambda other: other is make)


MODES: Registry[MakeShield] = Registry(
    "shield mode", "shield_modes", register_shield_mode, {"step": StepShield, "episode": EpisodeShield}
)


def shield(env: Any, policy: Any = None, mode: str = "step", **options: Any) -> Any:
    """Return a shielded copy of an environment, of the same class, or a shielded team.

    The copy starts with ``reset``; ``env`` stays as it is. The shield decides inside: what wrappers of ``env`` do to an
    action, they do to the proposal. Infos: ``shield_...`` (docs/shield.md).

    Args:
        env: an environment of this package, parallel, in turns, Gymnasium, vector or ``VecEnv``, perhaps in wrappers of
            its library; or a ``Team``, whose agents propose.
        policy: proposes the actions that the caller leaves out (NaN, or no entry in a dictionary); the shield also
            plans with it. An agent for all learners, a ``Team``, or vehicle name -> agent. None: without a proposal the
            shield's own plan is followed.
        mode: ``step``, ``episode`` (the paper's Algorithm 1), or the mode of an extension.
        options: of the mode: ``harm_count`` (``first`` or ``total``) of both, ``allowance`` (m2/s2) of ``step``,
            ``bound`` (``coupled`` or ``pairwise``) of ``episode``.

    >>> import ethbrake_marl as eb
    >>> env = eb.shield(eb.parallel_env(scenario="paper-random"))
    >>> observations, infos = env.reset(seed=7)
    >>> env.step({"vehicle_2": [1.0]})[4]["vehicle_2"]["shield_intervened"]
    True

    """
    if mode not in MODES:
        raise unknown_name("shield mode", mode, MODES)
    make = MODES[mode]
    known = [name for name in signature(make).parameters if name != "drivers"]
    for name in options:
        if name not in known:
            raise unknown_name(f"option of a shield in mode {mode}", name, known)
    if isinstance(env, Team):
        if env.shield is not None or policy is not None:
            what = "already has a shield" if env.shield is not None else "proposes by itself; leave out policy"
            raise InvalidInput(f"shield: team {env.name!r} {what}")
        return env._replace(name=f"{env.name}+{mode}", shield=make(env.drivers, **options))
    base = getattr(env, "unwrapped", None)
    game, stream = getattr(base, "game", None), getattr(base, "stream", None)
    if isinstance(env, type) or not isinstance(game, Game) or not isinstance(stream, Stream):
        raise InvalidInput(
            f"shield: {env!r:.80}: must be a team, or an environment made by eb.parallel_env, eb.env, eb.EthBrakeEnv,"
            " eb.EthBrakeVectorEnv or eb.make_sb3_vec_env, perhaps in wrappers"
        )
    if game.shield is not None:
        raise InvalidInput("shield: this environment already has a shield")
    if not len(game.rules.learners):
        raise InvalidInput(f"shield: scenario {game.name!r} has no learner to shield; pass learners=['vehicle_2']")
    return guarded(env, base, game._replace(shield=make(agents_for(game, policy), **options)))


def agents_for(game: Game, policy: Any) -> dict[int, Agent]:
    """Return learner -> agent, or nothing. Raises ``InvalidInput`` unless the policy drives exactly the learners."""
    if policy is None:
        return {}
    learners = game.rules.learners.tolist()
    if isinstance(policy, Team):
        policy = {f"vehicle_{body}": agent for body, agent in policy.drivers.items()}
    if not isinstance(policy, Mapping):
        return dict.fromkeys(learners, policy)
    names = {f"vehicle_{body}": body for body in learners}
    if set(policy) != set(names):
        given = ", ".join(map(str, policy)) or "nobody"
        raise InvalidInput(
            f"shield: policy drives {given}; must have one agent for each of {', '.join(names)}, and for no other"
        )
    return {body: policy[name] for name, body in names.items()}


def guarded(env: Any, base: Any, game: Game) -> Any:
    """Return a copy of an environment, with its wrappers, that plays ``game`` and has no running episode."""
    shared = {id(base.game): game, id(base.scenario): base.scenario, id(base.renderer): None}
    if hasattr(base, "episode"):
        shared[id(base.episode)] = None
    other = copy.deepcopy(env, shared)
    base = other.unwrapped
    vars(base).pop("episode", None)
    for name, none in (("agents", []), ("_running", False)):
        if hasattr(base, name):
            setattr(base, name, none)
    base.renderer = make_renderer(base, base.render_mode)
    return other
