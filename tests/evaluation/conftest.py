from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.evaluation import Evaluation, evaluate
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario, load_scenario

# Two vehicles at 20 m/s, 1 m apart, brake with 6 m/s2, the rear one from 0.5 s. By hand: at 0.5 s the gap is 0.25 m and
# the closing speed 3 m/s, which stays; so the impact is at 0.5 + 0.25/3 s with w = 3: harm 9, shared 4.95 and 4.05.
# With e = 0.1 the speeds after it are 18.315 and 18.015 m/s; the front one stops 3.0525 s later, 0.90825 m ahead.
PAIR = Scenario(
    name="pair", vehicles=2, gaps_m=1.0, speeds_mps=20.0, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0,
    mass_t=[4.5, 5.5], latency_s=[0.0, 0.5], roles={"vehicle_2": "learner"},
)  # fmt: skip


class GapAgent:
    """Brakes in proportion to how near the vehicle in front is; predicts, and says it is a hybrid."""

    def __init__(self) -> None:
        self.name = "gap"
        self.predicted_harm: Floats = np.zeros(0)
        self.times: list[Floats] = []

    @property
    def chosen_policy(self) -> np.ndarray:
        return self.predicted_harm > 7.5

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        self.predicted_harm = worlds.gaps_m[:, 0].copy()

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        self.times.append(worlds.time_s)
        return -7.0 / (1.0 + worlds.gaps_m[:, vehicle - 1])


@pytest.fixture
def pair() -> Scenario:
    return PAIR


@pytest.fixture
def gap_agent() -> GapAgent:
    return GapAgent()


@pytest.fixture(scope="session")
def paper_random() -> Scenario:
    return load_scenario("paper-random")


@pytest.fixture(scope="session")
def evaluation(paper_random: Scenario) -> Evaluation:
    """Three agents in 200 worlds of paper-random."""
    agents = {"full_brake": make_agent("full_brake"), "constant:4.5": make_agent("constant:4.5"), "gap": GapAgent()}
    return evaluate(paper_random.sample(200, 7), agents, scenario=paper_random, seed=7)
