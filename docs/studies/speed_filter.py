"""What `plan` gains from a filter of reported speeds, and what is left of it once reported places have noise, too.

    python docs/studies/speed_filter.py

The filter replaces a sender's reported speed by the one that its last two reported places and its told braking capacity
imply. Prints mean honest costs of `benchmark-noisy` for several noises of places, and paired differences with 95 %
intervals. The filter is no part of the package, because it trusts places.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.layer import see_through
from ethbrake_marl.extensions.forecasts.planner import Planner
from ethbrake_marl.extensions.messages.belief import belief_of
from ethbrake_marl.extensions.messages.game import MessagesLayer
from ethbrake_marl.extensions.messages.links import AT, MESSAGES_KEY, PLACE, SAMPLE_SPEED, newest_samples
from ethbrake_marl.motion.layout import BRAKING, OWN_LATENCY, Floats

WORLDS, SEED = 300, 111
NOISE_MPS, NOISES_M = 0.5, (0.0, 0.1, 0.3)
IMPACT_MPS = 9.0  # a slope that differs more from the reported speed contains an impact
NEVER = -1.0  # time of a sample of a vehicle of which nothing has arrived
ROWS = 4  # of the filter's memory: time, place and filtered speed of the last sample; 1 if that speed is exact


def filtered(state: eb.State, last: Floats, body: int) -> tuple[Floats, Floats]:
    """Speeds, [n, N + 1] m/s, and the new memory.

    The slope of two places is the mean speed between them. If the speed at the first one is exact, the time of braking
    between both follows; otherwise the sender is assumed to brake from its latency on. A slope that no braking explains
    contains an impact: then the reported speed is used.
    """
    news, car = newest_samples(state, body), np.nan_to_num(belief_of(state, body).car, nan=1e9)
    at_s, place, reported, brake = news[:, AT], news[:, PLACE], news[:, SAMPLE_SPEED], car[:, BRAKING]
    last_s, last_place, last_speed, is_exact = (last[:, row] for row in range(ROWS))
    passed = np.maximum(at_s - last_s, 0.0)
    is_new = (at_s >= 0.0) & (passed > 1e-6)
    is_pair = is_new & (last_s >= 0.0)
    slope = (place - last_place) / np.where(is_pair, passed, 1.0)
    lost = last_speed - slope
    braked = np.minimum(np.sqrt(2.0 * passed * np.maximum(lost, 0.0) / np.maximum(brake, 1e-9)), passed)
    assumed = np.clip(at_s - np.maximum(last_s, car[:, OWN_LATENCY]), 0.0, passed)
    late = brake * assumed * (1.0 - 0.5 * assumed / np.maximum(passed, 1e-6))
    speed = np.where(is_exact == 1.0, last_speed - brake * braked, slope - late)
    possible = (lost > -1e-4) & (lost < 0.5 * brake * passed + 1e-4)
    fits = np.where(is_exact == 1.0, possible, np.abs(speed - reported) < IMPACT_MPS) & is_pair & (speed >= 0.0)
    speed = np.where(fits, speed, np.where(is_new, reported, last_speed))
    speed = np.where(at_s >= 0.0, speed, reported)
    updated = np.stack([at_s, place, speed, fits], axis=1)
    return speed, np.where(is_new[:, np.newaxis], updated, last)


@dataclass(frozen=True, kw_only=True)
class FilteringPlanner(Planner):
    """Its memory is that of the plan and that of the filter, [n, ROWS, N + 1]."""

    def begin(self, alert: eb.State, body: int) -> Any:
        return super().begin(alert, body), np.full((alert.n, ROWS, alert.vehicles + 1), NEVER)

    def act(self, state: eb.State, memory: Any, body: int) -> tuple[Any, Any]:
        for layer in self.layers:
            if not isinstance(layer, MessagesLayer):
                state = see_through(layer, state, body)
        speed, last = filtered(state, memory[1], body)
        messages = state.memories[MESSAGES_KEY]
        news = messages.news.copy()
        news[:, SAMPLE_SPEED, body, 1:] = speed[:, 1:]
        state = state._replace(memories={**state.memories, MESSAGES_KEY: messages._replace(news=news)})
        inner = replace(self, layers=tuple(layer for layer in self.layers if isinstance(layer, MessagesLayer)))
        command, plan = Planner.act(inner, state, memory[0], body)
        return command, (plan, last)


def costs(scenario: eb.Scenario, agent: Any) -> Floats:
    _, game = eb.open_game(scenario)
    team = Team("team", dict.fromkeys(scenario.learners, agent))
    return np.asarray(play_to_end(game, scenario.sample(WORLDS, SEED), team).harm("honest"))


def main() -> None:
    base = eb.load_scenario("benchmark-noisy")
    channel, step_s = base.v2x.model_dump(exclude_none=True), base.time_step_s
    for noise_m in NOISES_M:
        reports = {"noise_mps": NOISE_MPS, "liar": "vehicle_1", **({"noise_m": noise_m} if noise_m else {})}
        scenario = base.replace(v2x={**channel, "reports": reports})
        plain = costs(scenario, Planner(time_step_s=step_s))
        more = costs(scenario, FilteringPlanner(time_step_s=step_s)) - plain
        half = 1.96 * more.std(ddof=1) / np.sqrt(len(more))
        print(
            f"noise of places {noise_m} m: plan {plain.mean():.2f}, with the filter {more.mean():+.2f}"
            f" [{more.mean() - half:+.2f}, {more.mean() + half:+.2f}]",
            flush=True,
        )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    main()
