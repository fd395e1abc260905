"""Trained policies as agents: ``ppo@PATH``, ``policy@PATH``, whatever trained it, ``universal@shipped``, ``team@RUN``.

Needs no torch.
"""

from __future__ import annotations

from typing import get_args

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.agents.team import Driver
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.team_file import is_team, load_driver, load_team
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.shipped import SHIPPED, PolicyKind, load_named_policy

_KINDS: dict[str, PolicyKind] = {name: name for name in get_args(PolicyKind)} | {"team": "policy"}


def make_policy_agent(argument: None, settings: AgentSettings) -> Driver:
    """The policy of a run or a bundle, or the team of a run in which each learner has its own.

    ``PATH`` may be ``shipped``, the policy that comes with the package for this scenario and harm count, or
    ``shipped/NAME``; ``universal@shipped`` is for all scenarios, ``team@shipped`` is ``policy@shipped``. Raises
    ``InvalidInput`` for a policy of another algorithm, and what loading it raises.
    """
    spec, path = settings.spec, settings.policy
    name = spec.partition("@")[0]
    if path is None:
        raise InvalidInput(
            f"agent {spec!r}: a policy is needed: {name}@PATH, where PATH is a run or a policy bundle, for instance"
            f" {name}@runs/my-run, or {name}@{SHIPPED}"
        )
    ships = path.partition("/")[0] == SHIPPED  # one policy for all learners
    if not ships and (name == "team" or (name != "universal" and is_team(path))):
        scenario = settings.needed_scenario()
        team = load_team(path, scenario, spec)
        _check_algorithm(name, path, load_driver(path, scenario.vehicle_names[min(team.drivers)]))
        return team
    if name == "universal" and path != SHIPPED:
        raise InvalidInput(f"agent {spec!r}: must be universal@{SHIPPED}; for another policy: ppo@PATH or sac@PATH")
    policy = load_named_policy(path, _KINDS[name], settings.scenario, settings.harm_count)
    _check_algorithm(name, path, policy)
    return LearnedAgent(policy, name=spec)


def _check_algorithm(name: str, path: str, policy: Policy) -> None:
    """``ppo@PATH``, ``sac@PATH`` and ``counterfactual@PATH`` are for policies of that algorithm."""
    trained_by = policy.manifest.algorithm
    if name in ("ppo", "sac", "counterfactual") and name != trained_by:
        raise InvalidInput(
            f"agent '{name}@{path}': that policy was trained by {trained_by.upper()}: {trained_by}@{path}"
        )
