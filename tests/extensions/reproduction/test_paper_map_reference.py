"""A second program for the paper's map and reward, written from the paper, agrees with ``physics: paper-map``."""

from math import exp

import numpy as np
import pytest

import ethbrake_marl as eb

MAPPED = eb.load_scenario("paper-random-map")
CONSTANTS = {"ttc_scale_s": 1.7, "safety_buffer_m": 0.6, "target_gap_m": 4.2, "distance_slope_per_m": 0.8}
WEIGHTS = {"collision": 1.1, "risk": 0.3, "jerk": 2e-4, "terminal": 7.0}
K_ENERGY = (0.7, 1.3)


class World:
    """One world of three vehicles, of which Vehicle 2 obeys ``step(u_2)``, by the paper's equations; SI units."""

    def __init__(self, worlds: eb.State, k: int, limit: float, step_s: float) -> None:
        self.gap, self.speed = worlds.gaps_m[k].tolist(), worlds.speeds_mps[k].tolist()
        self.braking, self.mass = worlds.braking_capacity_mps2[k].tolist(), worlds.mass_t[k].tolist()
        self.latency, self.e = worlds.latency_s[k].tolist(), float(worlds.restitution[k])
        self.limit, self.step_s, self.steps = limit, step_s, 0
        self.command = [0.0, 0.0, 0.0]
        self.first, self.total, self.hit = [0.0, 0.0], [0.0, 0.0], [False, False]
        first = self.speed[0] - self.braking[0] * self.latency[1]  # until tau_2 Vehicle 1 brakes, and nobody else
        self.move([first, self.speed[1], self.speed[2]], self.latency[1])

    def move(self, after: list[float], duration_s: float) -> None:
        """Positions under constant accelerations, which lead to the speeds ``after``."""
        way = [(self.speed[i] + after[i]) / 2.0 * duration_s for i in range(3)]
        self.gap = [self.gap[p] + (way[p] - way[p + 1]) for p in range(2)]
        self.speed = after

    def impacts(self) -> None:
        """Eq. 13 where a pair overlaps and closes: f3 at the rear pair, then f1 at the front pair."""
        for front, rear in ((1, 2), (0, 1)):
            closing = self.speed[rear] - self.speed[front]
            if self.gap[front] <= 0.0 and closing > 0.0:
                change = (1.0 + self.e) * closing / (self.mass[front] + self.mass[rear])
                self.speed[front] += self.mass[rear] * change
                self.speed[rear] -= self.mass[front] * change
                self.first[front] += 0.0 if self.hit[front] else closing * closing
                self.total[front] += closing * closing
                self.hit[front] = True

    def step(self, command: float) -> float:
        """One sampling period (eq. dynamics2). Return the reward, without the terminal one."""
        closing = [self.speed[1] - self.speed[0], self.speed[2] - self.speed[1]]
        collision = -sum(K_ENERGY[p] * closing[p] ** 2 for p in range(2) if self.gap[p] <= 0.0)
        self.impacts()
        time = self.latency[1] + self.steps * self.step_s
        asked = [-self.braking[0], command, -self.braking[2]]
        asked = [asked[i] if round(time - self.latency[i], 9) >= 0.0 else 0.0 for i in range(3)]
        self.move([self.faster_or_slower(self.speed[i], asked[i]) for i in range(3)], self.step_s)
        jerk = -(((asked[1] - self.command[1]) / self.step_s) ** 2)
        self.command, self.steps = asked, self.steps + 1
        return WEIGHTS["collision"] * collision + WEIGHTS["risk"] * self.risk() + WEIGHTS["jerk"] * jerk

    def faster_or_slower(self, speed: float, command: float) -> float:
        """Speed at the next sample. Engines keep to the limit; brakes end at a standstill, from either side."""
        if command > 0.0:
            return max(speed, min(speed + command * self.step_s, self.limit))
        if speed < 0.0:
            return min(speed - command * self.step_s, 0.0)
        return max(speed + command * self.step_s, 0.0)

    def risk(self) -> float:
        """The paper's r_risk; a pair that does not close has no time to collision, and it is at least 0."""
        total = 0.0
        for p in range(2):
            closing = self.speed[p + 1] - self.speed[p]
            if closing > 0.0:
                seconds = max(self.gap[p] - CONSTANTS["safety_buffer_m"], 0.0) / closing
                total -= 1.0 / (1.0 + exp(min(seconds / CONSTANTS["ttc_scale_s"], 700.0)))
            slope = CONSTANTS["distance_slope_per_m"]
            total -= 1.0 / (1.0 + exp(slope * (self.gap[p] - CONSTANTS["target_gap_m"])))
        return total


@pytest.mark.parametrize(
    ("changes", "bias"),
    [
        ({}, -0.8),
        ({"time_step_s": 0.25, "restitution": 0.5, "latency_s": [0, 0.37, 0.71]}, 0.0),
        ({"mass_t": [12.0, 1.0, 3.3], "restitution": 0.3}, 0.0),  # some vehicles are thrown backwards
        ({"mass_t": [1.0, 3.0, 30.0], "speed_limit_mps": 22}, 0.0),  # or above the limit
        ({"latency_s": [0, 0.7, 0.9]}, -0.5),  # 0.7 + 2 * 0.1 is below 0.9 in floating-point numbers
    ],
)
def test_second_program__agrees(changes, bias: float) -> None:
    n = 20
    reward = {"harm": 0.0, "harm_count": "first", **WEIGHTS, **CONSTANTS, "k_energy": list(K_ENERGY)}
    scenario, game = eb.open_game(MAPPED.replace(**changes), reward=reward)
    alert = scenario.sample(n, 7)
    worlds = [World(alert, k, scenario.speed_limit_mps, scenario.time_step_s) for k in range(n)]
    state, generator = game.reset(alert), np.random.default_rng(1)
    while not state.ended.all():
        actions = np.clip(bias + generator.uniform(-1.0, 1.0, (n, 1)), -1.0, 1.0)
        before, (state, step) = state, game.step(state, actions)
        for k in np.flatnonzero(~before.ended):
            rewarded = worlds[k].step(actions[k, 0] * alert.braking_capacity_mps2[k, 1])
            safe = state.ended[k] and not any(worlds[k].hit)
            assert step.reward[k, 1] == pytest.approx(rewarded + WEIGHTS["terminal"] * safe, rel=0.0, abs=1e-12)
            assert state.gaps_m[k].tolist() == worlds[k].gap
            assert state.speeds_mps[k].tolist() == worlds[k].speed
    assert state.pair_harm("first").tolist() == [world.first for world in worlds]
    assert state.pair_harm("total").tolist() == [world.total for world in worlds]
    assert state.harm("total").any()
