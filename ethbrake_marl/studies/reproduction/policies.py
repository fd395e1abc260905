"""The policies that ``ethbrake reproduce`` lets drive beside the shipped ones, as agents."""

from __future__ import annotations

from typing import NamedTuple

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.learning.run_folder import RunDirectory
from ethbrake_marl.policies.policy import Policy, load_policy
from ethbrake_marl.policies.shipped import load_shipped
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield import HybridAgent
from ethbrake_marl.shield.agents import Bound
from ethbrake_marl.studies.reproduction.item import FULL, Settings
from ethbrake_marl.studies.reproduction.trainings import EARLY, STOPPED, finished, group_named

STAND_IN = "universal-ppo"  # the shipped policy that stands in for one that has not converged, where nothing is trained


class Unconverged(NamedTuple):
    """The policy that stands for the paper's "PPO model obtained from training before convergence occurred"."""

    policy: Policy
    about: str  # what it is


def unconverged_policy(settings: Settings) -> Unconverged:
    """The one stopped early that ``--full`` has trained, else a shipped policy that stands in for it."""
    if settings.mode == FULL:
        for (path,) in finished(settings.folder, group_named(STOPPED)).values():
            policy = load_policy(RunDirectory(path).last_policy)
            about = f"PPO stopped early: the last policy of {EARLY.decisions:,} decisions on paper-random"
            return Unconverged(policy, about)
    about = f"the shipped policy {STAND_IN!r}, trained for other worlds, stands in for one that has not converged"
    return Unconverged(load_shipped(STAND_IN), about)


def hybrid(policy: Policy, scenario: Scenario, bound: Bound) -> Agent:
    """Algorithm 1 around a policy."""
    return HybridAgent(LearnedAgent(policy, "policy"), scenario, bound=bound)
