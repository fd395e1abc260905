"""The record of an episode: by hand, and as in an evaluation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.evaluation.record import EpisodeRecord, record_episode
from ethbrake_marl.worlds.scenario import Scenario
from tests.evaluation.lines import COAST, FULL_BRAKE, GENTLE, PAIR, Careless
from tests.refused import refused


def recorded(scenario: Any, agent: Any = FULL_BRAKE, number: int = 0, **more: Any) -> EpisodeRecord:
    loaded, game = open_game(scenario)
    (body,) = game.settings.learners.tolist()
    return record_episode(loaded.sample(1, 7, first=number), Team(agent.name, {body: agent}), game, **more)


def test_record__of_one_impact_by_hand() -> None:
    record = recorded(Scenario(**PAIR))
    assert record.impacts.time_s == pytest.approx([0.5 + 0.25 / 3.0])
    assert record.impacts.closing_speed_mps == pytest.approx([3.0]) and record.impacts.pair.tolist() == [1]
    assert record.impacts.total_harm == pytest.approx([9.0]) and record.impacts.number.tolist() == [1]
    at = {time: int(np.argmin(abs(record.time_s - time))) for time in (0.0, 0.4, 0.5)}
    assert record.positions_m[at[0.0]].tolist() == [0.0, -1.0]
    assert record.positions_m[at[0.4]] == pytest.approx([8.0 - 0.48, 8.0 - 1.0])  # 3 t^2 = 0.48
    assert record.command_mps2[[at[0.4], at[0.5]]].tolist() == [[-6.0, 0.0], [-6.0, -6.0]]
    late = recorded(Scenario(**{**PAIR, "latency_s": [0.3, 0.5]}))
    assert [late.command_mps2[late.time_s < 0.299, 0].min(), late.command_mps2[late.time_s > 0.301, 0].max()] == [0, -6]
    assert record.speeds_mps[at[0.5]] == pytest.approx([17.0, 20.0])
    assert record.positions_m[-1, 0] == pytest.approx(10.6458333 + 27.95327, abs=1e-4) and record.at_rest
    assert "1 impact, harm 9.00 first-impact, 9.00 total" in repr(record)


@pytest.mark.parametrize("scenario", ["paper-random", "paper-random-obstacle", "paper-random-buildup", "stress-wide"])
def test_record__is_the_episode_of_an_evaluation_and_ends_with_it(scenario: str) -> None:
    loaded, game = open_game(scenario)
    for number in range(4):
        agent = FULL_BRAKE if scenario == "stress-wide" else GENTLE
        record, team = recorded(scenario, agent, number), Team("x", {2: agent})
        last = play_to_end(game, loaded.sample(1, 7, first=number), team)
        assert record.time_s[-1] == last.time_s[0] and record.last.line.tolist() == last.line.tolist()
        assert record.speeds_mps[-1].tolist() == last.speeds_mps[0].tolist()
        assert record.gaps_m[-1].tolist() == last.gaps_m[0].tolist()
        assert record.impacts.total_harm.sum() == pytest.approx(last.harm("total")[0])
        assert record.impacts.first_impact_harm.sum() == pytest.approx(last.harm("first")[0])
        assert (np.diff(record.time_s) > 0.0).all() and np.diff(record.time_s).max() <= 0.02 + 1e-9
        assert -np.diff(record.positions_m, axis=1) == pytest.approx(record.gaps_m, abs=1e-9)
        assert (np.diff(record.impacts.time_s) >= 0.0).all()
        speed = np.diff(record.positions_m[:, 0]) / np.diff(record.time_s)
        assert np.median(abs(speed - record.speeds_mps[:-1, 0])) < 0.1


def test_record__at_the_horizon_is_not_at_rest() -> None:
    record = recorded(Scenario(**{**PAIR, "horizon_s": 2.0}), COAST, sample_s=0.5)
    assert not record.at_rest and record.time_s[-1] == 2.0 and len(record.states) == 17
    assert np.diff(record.time_s)[1:].max() <= 0.1 + 1e-9  # every decision is a sample


def test_record__that_is_refused() -> None:
    scenario, game = open_game("paper-random")
    worlds, team = scenario.sample(2, 7), Team("x", {2: Careless()})
    with refused("record_episode: world has 2 worlds; pass exactly 1"):
        record_episode(worlds, team, game)
    with refused("pass exactly 1 at the alert"):
        record_episode(game.reset(worlds.take([0])), team, game)
    for bad in (0.0, -1.0, np.inf, np.nan, "1"):
        with refused("must be a finite number of seconds above 0"):
            record_episode(worlds.take([0]), team, game, bad)  # type: ignore[arg-type]
