"""Attacks on shields in worlds that are members of what they certify: harm must never exceed the bound."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.certified.robust import RobustShield, reset_without_shield
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


class Wrongly(RobustShield):
    """A robust shield that takes other worlds than the true ones for the nominal ones."""

    def __init__(self, nominal: State, **options: Any) -> None:
        super().__init__(**options)
        self.nominal = nominal

    def begin(self, game: Game, alert: State, state: State) -> Any:
        return super().begin(game, self.nominal, reset_without_shield(game, self.nominal))


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
        state, _ = game.step(state, propose((state.n, len(game.settings.learners))), donate=True)
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
