"""Attacks on shields in worlds that are members of what they certify: harm must never exceed the bound."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.certified.estimating import EstimatedShield
from ethbrake_marl.extensions.certified.robust import RobustShield, opened
from ethbrake_marl.names import open_game
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario
from tests.shields.attack import LINES, WAYS

UNCERTAINTIES = {
    "gaps_m=0.5": "paper",
    "braking_capacity_mps2=5%,latency_s.vehicle_2=0.15,gaps_m.pair_1=0.5,mass_t.vehicle_3=20%": "paper",
    "speeds_mps=0.5,mass_t=10%": "obstacle",
    "brake_rate_mps3=20%,release_rate_mps3.vehicle_2=5": "build-up",
    "gaps_m=1,latency_s=0.2": "follower",
    "gaps_m.pair_1=2,braking_capacity_mps2.vehicle_3=10%": "pair",
    "speeds_mps.vehicle_2=1,mass_t.vehicle_1=30%,driving_capacity_mps2=10%": "all",
}

BASE = load_scenario("cooperation-2-paper").replace(early_impacts="keep")
NEVER_HEARD = BASE.replace(
    gaps_m=[{"choice": [5.13, 9.71]}, {"choice": [5.37, 9.58]}],
    speeds_mps=[{"choice": [18.23, 21.87]}, {"choice": [18.11, 21.93]}, {"choice": [18.41, 22.19]}],
    v2x={"preset": "paper", "hears": "front"},
    mass_t=[4.5, 5.5, {"choice": [3.0, 9.0]}],
)
CHANCE = {"preset": "congested", "lost": 0.0}  # vehicle_3 reacts after the latest message
LATE = {"link_latency_s": 0.6, "senses": "front", "sensing_s": [3, 3]}
ENDS: dict[str, Scenario] = {  # every unknown quantity is one of two numbers, so each world is a corner
    "never heard": NEVER_HEARD,
    "heard at the first decision": NEVER_HEARD.replace(v2x=LATE, latency_s=[0.0, 0.2, 0.6]),
    "old news": NEVER_HEARD.replace(v2x={**LATE, "persistence": "periodic"}, latency_s=[0.0, 0.2, 0.6]),
    "heard later": NEVER_HEARD.replace(v2x=CHANCE, latency_s=[0.0, 0.2, 6.0]),
    "old news later": NEVER_HEARD.replace(v2x={**CHANCE, "persistence": "periodic"}, latency_s=[0.0, 0.2, 6.0]),
    "no capacity": NEVER_HEARD.replace(
        v2x={"preset": "paper", "tells": ["place", "speed", "acceleration", "latency"]},
        braking_capacity_mps2=[{"choice": [5.13, 7.21]}, 7.0, {"choice": [5.41, 8.23]}],
        speeds_mps=[{"choice": [18.23, 21.87]}, 20.3, {"choice": [18.41, 22.19]}],
    ),
    "early impacts": NEVER_HEARD.replace(
        gaps_m=[{"choice": [1.13, 2.71]}, {"choice": [0.37, 0.58]}], latency_s=[0.0, 1.2, 0.5]
    ),
    "build-up": NEVER_HEARD.replace(brake_rate_mps3=15.0, release_rate_mps3=25.0),
    "obstacle": NEVER_HEARD.replace(obstacle_margin_m=1.7, mass_t=[4.5, 5.5, 5.9]),
}


class Wrongly(RobustShield):
    """A robust shield that takes other worlds than the true ones for the nominal ones."""

    def __init__(self, nominal: State, **options: Any) -> None:
        super().__init__(**options)
        self.nominal = nominal

    def begin(self, game: Game, alert: State, state: State) -> Any:
        return super().begin(game, self.nominal, opened(game, self.nominal))


class Episodes(NamedTuple):
    """What n attacked episodes ended with."""

    harm: np.ndarray
    first: np.ndarray  # bound at the first decision
    last: np.ndarray  # bound at the end
    trusted: np.ndarray
    replaced: np.ndarray
    rises: int  # how often a bound rose
    decisions: int

    @property
    def above(self) -> int:
        return int((~(self.harm <= self.first)).sum() + (~(self.harm <= self.last)).sum())


Way = Callable[[np.random.Generator, int, tuple[int, int]], np.ndarray]


def proposed(way: str, seed: int) -> Iterator[Callable[[tuple[int, int]], np.ndarray]]:
    rng, k = np.random.default_rng(seed), 0
    while True:
        yield lambda shape, k=k: WAYS[way](rng, k, shape)
        k += 1


def attacked(game: Game, truth: State, shield: Any, count: str, way: str, seed: int) -> Episodes:
    game = game._replace(shield=shield)
    state, rises, decisions = game.reset(truth), 0, 0
    bound = first = state.memories["shield"].price.copy()
    for propose in proposed(way, seed):
        if state.ended.all():
            break
        decisions += int((~state.ended).sum())
        state, _ = game.step(state, propose((state.n, len(game.rules.learners))), donate=True)
        memory = state.memories["shield"]
        rises, bound = rises + int((memory.price > bound)[memory.members.trusted].sum()), memory.price.copy()
    memory = state.memories["shield"]
    return Episodes(state.harm(count), first, memory.price, memory.members.trusted, memory.replaced, rises, decisions)


def robust(intervals: str, count: str, way: str, n: int, seed: int) -> Episodes:
    """True worlds that are corners of the boxes around the nominal ones."""
    scenario, game = open_game(LINES[UNCERTAINTIES[intervals]]())
    nominal, rng = scenario.sample(n, seed), np.random.default_rng(seed)
    shield = Wrongly(nominal, uncertainty=intervals, harm_count=count)
    truth = shield.uncertainty.draw(nominal, rng, corners=True)
    return attacked(game, truth, shield, count, way, seed)


def estimated(name: str, count: str, way: str, n: int, seed: int, corners: bool = True) -> Episodes:
    """True worlds that are corners of the scenario's ranges."""
    scenario, game = open_game(ENDS[name])
    shield = EstimatedShield(scenario=scenario, harm_count=count, corners=corners)
    return attacked(game, scenario.sample(n, seed), shield, count, way, seed)
