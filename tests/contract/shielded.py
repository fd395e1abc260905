"""The shielded interfaces behind the same small interface as the bare ones."""

from __future__ import annotations

from typing import Any

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield import HybridShield, ShieldedEnv, ShieldedVectorEnv
from ethbrake_marl.shield.sb3 import ShieldedVecEnv
from tests.contract.interfaces import Parallel, Sb3, Single, Vector


class ShieldedParallel(Parallel):
    def __init__(self, scenario: Scenario, n: int, **settings: Any) -> None:
        super().__init__(scenario, n, **settings)
        self.env = HybridShield(self.env, mode="step")


class EpisodeParallel(Parallel):
    """Algorithm 1: what is proposed is not asked."""

    def __init__(self, scenario: Scenario, n: int, **settings: Any) -> None:
        super().__init__(scenario, n, **settings)
        self.env = HybridShield(self.env, make_agent("full_brake"), mode="episode")


class ShieldedSingle(Single):
    def __init__(self, scenario: Scenario, n: int, **settings: Any) -> None:
        super().__init__(scenario, n, **settings)
        self.env = ShieldedEnv(self.env)


class ShieldedVector(Vector):
    def __init__(self, scenario: Scenario, n: int, **settings: Any) -> None:
        super().__init__(scenario, n, **settings)
        self.env = ShieldedVectorEnv(self.env)


class ShieldedSb3(Sb3):
    def __init__(self, scenario: Scenario, n: int, **settings: Any) -> None:
        super().__init__(scenario, n, **settings)
        self.env = ShieldedVecEnv(self.env)


STEP = {
    "shielded parallel": ShieldedParallel,
    "shielded single": ShieldedSingle,
    "shielded vector": ShieldedVector,
    "shielded sb3": ShieldedSb3,
}
SHIELDED = {**STEP, "episode parallel": EpisodeParallel}
