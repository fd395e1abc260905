"""An agent that drives with a trained policy and always applies the policy's deterministic action."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.protocol import ByPolicy, Source
from ethbrake_marl.first_edition.game.actions import action_to_command
from ethbrake_marl.first_edition.game.observations import Observations, ObservationSpec, observe
from ethbrake_marl.first_edition.physics.state import Floats, Worlds

TRAINED_POLICY = "trained policy"  # name of the policy that a run has trained, in tables and figures

TRAINED_TEAM = "trained team"  # name of the team that a run has trained, in tables and figures


class LearnedPolicy(Protocol):
    """Interface of a policy for ``LearnedAgent``, such as ``policies.policy.Policy``."""

    @property
    def observation(self) -> ObservationSpec:
        """The features that the policy observes, in the order of its inputs."""
        ...

    def __call__(self, observation: Observations, /) -> Observations:
        """Return, for each observation [n, F], an action [n, 1] in [-1, 1] that depends on this observation only."""
        ...


class LearnedAgent(ByPolicy):
    """Agent that drives one vehicle with the deterministic actions of ``policy``. The agent has no memory.

    ``name`` is the name of the agent in tables and error messages.

    >>> import ethbrake_marl.first_edition as eb
    >>> eb.LearnedAgent(eb.load_shipped("ppo"), name="mine").name
    'mine'

    """

    knows = Source.MESSAGES

    def __init__(self, policy: LearnedPolicy, name: str = "learned") -> None:
        self.policy = policy
        self.name = name

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Return the acceleration that the agent commands for ``vehicle`` (index, 0 = front) in n worlds, [n] m/s2."""
        action = self.policy(observe(worlds, vehicle, self.policy.observation)).astype(np.float64)
        if action.shape != (worlds.n, 1):
            raise InvalidInput(
                f"{self.name}: actions have shape {action.shape}; must have shape ({worlds.n}, 1), one action per world"
            )
        return action_to_command(action[:, 0], worlds.vehicles, vehicle)
