"""Trained policies as agents: ``ppo@PATH``, ``sac@PATH``, ``policy@PATH``, ``universal@shipped`` and ``team@RUN``.

This module needs no torch.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Driver, Source, Team
from ethbrake_marl.agents.settings import AgentSettings
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.shipped import SHIPPED, load_named_policy, shipped_name
from ethbrake_marl.registry import Part
from ethbrake_marl.training.recipe import ALGORITHMS
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.team import has_policy_each, load_team


def make_policy_agent(argument: None, settings: AgentSettings) -> Driver:
    """Return the agent of a spec such as ``ppo@PATH``: the policy of a run or of a policy bundle.

    It is a team if each learner of the run has its own policy. ``argument`` is unused; ``settings`` holds the spec with
    the path, the scenario and the harm count.

    ``PATH`` may also be ``shipped``, the policy that comes with the package for this scenario and harm count, or
    ``shipped/NAME``. ``universal@shipped`` is for all scenarios; ``team@shipped`` is the same as ``policy@shipped``.
    Raises ``InvalidInput`` for a policy of another algorithm, and whatever loading the policy raises.
    """
    spec, path = settings.spec, settings.policy
    name = spec.partition("@")[0]
    if path is None:
        raise InvalidInput(
            f"agent {spec!r}: a policy is needed: {name}@PATH, where PATH is a run or a policy bundle, for instance"
            f" {name}@runs/my-run, or {name}@{SHIPPED}"
        )
    ships = path.partition("/")[0] == SHIPPED  # one policy for all learners
    agent: LearnedAgent | Team
    if name == "universal" and path.partition("/universal")[0] != SHIPPED:
        raise InvalidInput(f"agent {spec!r}: must be universal@{SHIPPED}; for another policy: ppo@PATH or sac@PATH")
    if not ships and (name == "team" or (name != "universal" and has_policy_each(RunDirectory(Path(path))))):
        vehicles = None if settings.role is None else (settings.role,)
        agent = load_team(path, settings.needed_scenario(), spec, vehicles)
        first: Any = agent.drivers[min(agent.drivers)]
        policy: Policy = first.policy
    else:
        kind, known = "policy" if name == "team" else name, settings.scenario
        if path == SHIPPED:
            path = f"{SHIPPED}/{shipped_name(kind, known, settings.harm_count)}"
        policy = load_named_policy(path, kind, known, settings.harm_count)
        agent = LearnedAgent(policy, name=spec if path == f"{SHIPPED}/{kind}" else f"{kind}@{path}")
    trained_by = policy.manifest.algorithm
    if name in ALGORITHMS and name != trained_by:
        raise InvalidInput(f"agent '{name}@{path}': that policy was trained by {trained_by}; write {trained_by}@{path}")
    return agent


PPO_AGENT, SAC_AGENT = (
    Part(
        make_policy_agent,
        form=f"{name}@PATH",
        about=f"a policy trained by {name.upper()}: a run, a bundle, or shipped",
        knows=Source.MESSAGES,
    )
    for name in ("ppo", "sac")
)

POLICY = Part(
    make_policy_agent,
    form="policy@PATH",
    about="a policy, whatever trained it: a run, a bundle, or shipped, the best for scenario and harm",
    knows=Source.MESSAGES,
)

UNIVERSAL = Part(
    make_policy_agent, form="universal@shipped", about="the shipped policy for every scenario", knows=Source.MESSAGES
)

TEAM = Part(
    make_policy_agent,
    form="team@RUN",
    about="the learners of a run, each as it was trained, or shipped",
    knows=Source.MESSAGES,
)
