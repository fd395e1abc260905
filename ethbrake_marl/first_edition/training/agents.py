"""Agents that drive with trained policies: shipped policies such as ``universal``, ``policy@PATH`` and ``team@RUN``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.learned import LearnedAgent
from ethbrake_marl.first_edition.agents.protocol import Driver, Source, Team
from ethbrake_marl.first_edition.agents.settings import AgentSettings
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.policies.shipped import load_shipped, shipped_policies
from ethbrake_marl.first_edition.training.recipe import ALGORITHMS
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.team import has_policy_each, load_team
from ethbrake_marl.registry import Part


def make_policy_agent(argument: None, settings: AgentSettings) -> Driver:
    """Return an agent that drives with a trained policy, or with a team if each learner of the run has its own policy.

    ``settings`` has the text that names the agent (spec), the path of its policy, and the scenario. The spec is the
    name of a shipped policy (``universal``), or contains the path of a run or a policy bundle (``ppo@PATH``).
    ``argument`` is not used.

    Raises ``InvalidInput`` if the spec names another algorithm than the algorithm that trained the policy. Also raises
    the errors of ``load_policy`` and ``load_team``.
    """
    spec, path = settings.spec, settings.policy
    name = spec.partition("@")[0]
    if path is None and name not in shipped_policies():
        raise InvalidInput(
            f"agent {spec!r} needs a policy: write {name}@PATH, where PATH is the folder of a run or a policy bundle,"
            f" for instance {name}@runs/my-run"
        )
    agent: LearnedAgent | Team
    if path is None:
        return LearnedAgent(load_shipped(name), name=spec)
    if name == "team" or has_policy_each(RunDirectory(Path(path))):
        vehicles = None if settings.role is None else (settings.role,)
        agent = load_team(path, settings.needed_scenario(), spec, vehicles)
        first: Any = agent.drivers[min(agent.drivers)]
        policy: Policy = first.policy
    else:
        policy = load_policy(path)
        agent = LearnedAgent(policy, name=spec)
    trained_by = policy.manifest.algorithm
    if name in ALGORITHMS and name != trained_by:
        raise InvalidInput(f"agent {spec!r}: the policy was trained by {trained_by}; write {trained_by}@{path}")
    return agent


PPO_AGENT, SAC_AGENT = (
    Part(
        make_policy_agent,
        form=f"{name}[@PATH]",
        about=f"a policy trained by {name.upper()}: the shipped policy, or the policy of a run or bundle",
        knows=Source.MESSAGES,
    )
    for name in ("ppo", "sac")
)

POLICY = Part(
    make_policy_agent,
    form="policy@PATH",
    about="the policy of a run or bundle, trained by any algorithm",
    knows=Source.MESSAGES,
)

TEAM = Part(
    make_policy_agent, form="team@RUN", about="the learners of a run, each with its policy", knows=Source.MESSAGES
)

UNIVERSAL, PPO_OBSTACLE, ROLLOUT_OBSTACLE, VINE_PREFERENCE, VINE_FRONT, VINE_PAIR, VINE_ALL = (
    Part(make_policy_agent, form=name, about=f"the shipped policy for {what}", knows=Source.MESSAGES)
    for name, what in (
        ("universal", "every scenario"),
        ("ppo-obstacle", "paper-random-obstacle, first-impact harm"),
        ("rollout-obstacle", "paper-random-obstacle, total harm"),
        ("vine-preference", "paper-random-preference"),
        ("vine-front", "cooperation-1-front"),
        ("vine-pair", "cooperation-3-pair, Vehicles 2 and 3"),
        ("vine-all", "cooperation-4-all, all vehicles"),
    )
)
