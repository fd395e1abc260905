"""Agents that drive with policies: of our bundles, and of any other library."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.agents.drive import MESSAGES, to_command
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, Unfamiliar
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.policies.manifest import PHYSICS
from ethbrake_marl.policies.policy import Policy


@dataclass(frozen=True)
class LearnedAgent:
    """Drives with the deterministic actions of a policy of ours.

    >>> import ethbrake_marl as eb
    >>> from ethbrake_marl.policies.bundle import load_shipped
    >>> LearnedAgent(load_shipped("ppo"), name="mine").name
    'mine'

    """

    policy: Policy
    name: str = "learned"
    knows: str = MESSAGES

    def __post_init__(self) -> None:
        """Raise ``InvalidInput`` for something else than a policy of one action."""
        if not isinstance(self.policy, Policy) or self.policy.manifest.network.action_size > 1:
            raise InvalidInput(
                f"agent {self.name!r}: policy = {self.policy!r:.80}: must be a policy with one action, such as that of"
                " load_policy(PATH); for a function or a model of another library use policy_agent"
            )

    def begin(self, alert: State, body: int) -> None:
        """Return no memory. Warns (``Unfamiliar``) of a policy that was trained on another physics."""
        then = self.policy.manifest.versions.get(PHYSICS, physics_digest())
        if then != physics_digest():
            warnings.warn(
                f"{self.name}: was trained on other physics ({then:.16}) than this installation's"
                f" ({physics_digest()}), so its results may differ; train it again",
                Unfamiliar,
                stacklevel=2,
            )

    def act(self, state: State, memory: None, body: int) -> tuple[Floats, None]:
        """Return the commands of vehicle ``body``, [n] m/s2."""
        policy = self.policy
        seen = policy.observation.observe(state, np.array([body]), policy.manifest.time_step_s)[:, 0]
        return to_command(state, body, policy(seen)[:, 0].astype(np.float64)), None
