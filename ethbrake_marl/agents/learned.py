"""A trained policy as an agent: observe, infer, ask for that acceleration. Deterministic."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ethbrake_marl.agents.protocol import ByPolicy, Source
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.game.actions import action_to_command
from ethbrake_marl.game.observations import Observations, ObservationSpec, observe
from ethbrake_marl.physics.state import Floats, Worlds

TRAINED_POLICY = "trained policy"  # name, in tables and figures, of the policy that a run trains


class LearnedPolicy(Protocol):
    """What an agent needs of a policy; ``ethbrake_marl.policies.policy.Policy`` is one."""

    @property
    def observation(self) -> ObservationSpec:
        """What to observe for it."""
        ...

    def __call__(self, observation: Observations, /) -> Observations:
        """Map observation [n, F] to action [n, 1] in [-1, 1], each row on its own."""
        ...


class LearnedAgent(ByPolicy):
    """Drives one vehicle by a policy's deterministic action; holds no state between steps.

    >>> import ethbrake_marl as eb
    >>> eb.LearnedAgent(eb.load_shipped("ppo"), name="mine").name
    'mine'

    """

    knows = Source.MESSAGES

    def __init__(self, policy: LearnedPolicy, name: str = "learned") -> None:
        self.policy = policy
        self.name = name

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration [n], m/s2; world k's does not depend on the other worlds of the batch."""
        action = self.policy(observe(worlds, vehicle, self.policy.observation)).astype(np.float64)
        if action.shape != (worlds.n, 1):
            raise InvalidInput(
                f"{self.name}: actions of shape {action.shape}; one per world is needed, ({worlds.n}, 1)"
            )
        return action_to_command(action[:, 0], worlds.vehicles, vehicle)
