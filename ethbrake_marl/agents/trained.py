"""Trained policies as agents, by name: ``vine-paper``, ``ppo``, ``policy@PATH``, ``ppo@PATH``, ``team@RUN``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.agents.team import Agent, Team
from ethbrake_marl.episode.layer import MESSAGES
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.bundle import load_drivers, load_policy, load_shipped, shipped_policies
from ethbrake_marl.registry import Part

ANY_ALGORITHM = ("policy", "team")  # names that stand for whatever algorithm has trained the policy


def make_trained(argument: str | None, settings: Any) -> Agent | Team:
    """Agent or team for a policy at a path (``settings.policy``), or for a shipped policy if there is no path.

    ``argument``, or else the name before the ``@``, is the algorithm that must have trained the policy; ``policy`` and
    ``team`` allow any. A run in which each learner has its own policy gives a team. Raises ``InvalidInput`` for a
    policy of another algorithm, and the errors of ``load_policy``.
    """
    spec, path = settings.spec, settings.policy
    name = argument or spec.partition("@")[0]
    if path is None:
        if name not in shipped_policies():
            raise InvalidInput(
                f"agent {spec!r}: needs a policy: write {name}@PATH, where PATH is the folder of a run or bundle, for"
                f" instance {name}@runs/my-run"
            )
        return LearnedAgent(load_shipped(name), spec)
    if any(Path(path, "policy").glob("vehicle_[1-9]*")):  # each learner has its own
        policies = load_drivers(Path(path) / "policy")
        driver: Agent | Team = Team.of(
            {vehicle: LearnedAgent(learner_policy, spec) for vehicle, learner_policy in policies.items()}, spec
        )
        policy = next(iter(policies.values()))
    else:
        policy = load_policy(path)
        driver = LearnedAgent(policy, spec)
    if name not in ANY_ALGORITHM and name != policy.manifest.algorithm:
        by = policy.manifest.algorithm
        raise InvalidInput(f"agent {spec!r}: the policy was trained by {by}; write {by}@{path}")
    return driver


def _shipped(name: str, what: str) -> Part:
    return Part(make_trained, form=name, about=f"the shipped policy for {what}", knows=MESSAGES)


PPO, SAC = (
    Part(
        make_trained,
        form=f"{name}[@PATH]",
        about=f"a policy trained by {name.upper()}: the shipped one, or that of a run or bundle",
        knows=MESSAGES,
    )
    for name in ("ppo", "sac")
)
POLICY = Part(
    make_trained, form="policy@PATH", about="the policy of a run or bundle, trained by any algorithm", knows=MESSAGES
)
TEAM = Part(make_trained, form="team@RUN", about="the learners of a run, each with its policy", knows=MESSAGES)
VINE_PAPER = _shipped("vine-paper", "paper-random, first-impact harm: it pushes")
