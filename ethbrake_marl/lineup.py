"""Who drives in an evaluation (agents from their specs, trained policies among them), and in which worlds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.registry import agent_names, make_agent
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.learning.bundle import load_policy
from ethbrake_marl.scenario import Sample, Scenario, read_initial_states
from ethbrake_marl.shield.episode import HybridAgent

EPISODES = 10_000
LIST_SEED = 7  # of the worlds on which everything is measured; has nothing to do with the seed of a training

_OF_A_POLICY = ("ppo", "hybrid")


def make_lineup(specs: Sequence[str], scenario: Scenario, *, count: HarmCount = "first") -> dict[str, Agent]:
    """One fresh agent per spec, by its spec, to drive a vehicle of ``scenario``.

    Every spec of ``make_agent``, and ``ppo@PATH`` (the policy of a run, or a bundle), ``hybrid@PATH`` (Algorithm 1:
    that policy or coupled E-V2X-BM, whichever harms less) and ``hybrid:pairwise@PATH`` (with the paper's closed form
    instead). ``count`` is the harm that optimising and choosing agents minimise. Raises ``InvalidInput`` for a spec
    given twice, ``UnknownName`` with a suggestion, and whatever loading a policy raises.
    """
    for k, spec in enumerate(specs):
        if spec in specs[:k]:
            raise InvalidInput(f"agent {spec!r} is given twice; each agent drives every world once")
    return {spec: _agent(spec, scenario, count) for spec in specs}


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


def _agent(spec: str, scenario: Scenario, count: HarmCount) -> Agent:
    name = re.split("[:@]", spec, maxsplit=1)[0]
    if name in _OF_A_POLICY:
        return _agent_of_a_policy(spec, scenario, count)
    if name not in agent_names():
        raise unknown_name("agent", name, [*agent_names(), *_OF_A_POLICY])
    return make_agent(spec, count=count, horizon_s=scenario.horizon_s)


def _agent_of_a_policy(spec: str, scenario: Scenario, count: HarmCount) -> Agent:
    kind, _, path = spec.partition("@")
    if not path or kind not in ("ppo", "hybrid", "hybrid:pairwise"):
        raise InvalidInput(
            f"agent {spec!r}: must be ppo@PATH, hybrid@PATH or hybrid:pairwise@PATH, where PATH is a run or a policy"
            " bundle, for instance ppo@runs/my-run"
        )
    policy = LearnedAgent(load_policy(path), name=f"ppo@{path}")
    if kind == "ppo":
        return policy
    return HybridAgent(policy, scenario, bound="pairwise" if kind == "hybrid:pairwise" else "coupled", count=count)
