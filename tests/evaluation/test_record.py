"""The record of an episode: by hand, and as in an evaluation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.evaluation.evaluate import evaluate
from ethbrake_marl.evaluation.record import EpisodeRecord, record_agents, record_episode
from ethbrake_marl.worlds.scenario import Scenario
from tests.evaluation.lines import COAST, FULL_BRAKE, GENTLE, PAIR, Careless
from tests.refused import refused


def recorded(scenario: Any, agent: Any = FULL_BRAKE, number: int = 0, **more: Any) -> EpisodeRecord:
    return record_episode(scenario, agent, number=number, **more)


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


@pytest.mark.parametrize("scenario", ["paper-random-obstacle", "paper-random-buildup"])
def test_record__is_the_episode_of_an_evaluation_and_ends_with_it(scenario: str) -> None:
    loaded, game = open_game(scenario)
    for number in range(4):
        record, team = recorded(scenario, GENTLE, number), Team("x", {2: GENTLE})
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
    worlds = scenario.sample(2, 7)
    with refused("record_episode: worlds has 2 worlds; pass exactly 1"):
        record_episode(worlds, Careless(), scenario=scenario)
    with refused("pass exactly 1 at the alert"):
        record_episode(game.reset(worlds.take([0])), Careless(), scenario=scenario)
    with refused("a world needs its scenario"):
        record_episode(worlds.take([0]), Careless())
    with refused("scenario: is given twice"):
        record_episode("paper-random", Careless(), scenario=scenario)
    with refused("means 2 agents; name one agent"):
        record_episode(scenario, "full_brake,coast")
    with refused("unknown agent 'full_break'"):
        record_episode(scenario, "full_break")
    for bad in (0.0, -1.0, np.inf, np.nan, "1"):
        with refused("must be a finite number of seconds above 0"):
            record_episode(scenario, Careless(), sample_s=bad)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "agent",
    ["full_brake", FULL_BRAKE, {"vehicle_2": "full_brake"}, Team("x", {2: FULL_BRAKE})],
    ids=("name", "agent", "vehicles", "team"),
)
def test_record__takes_every_description_of_an_agent_and_of_a_world(agent: Any) -> None:
    scenario = open_game("paper-random")[0]
    right = scenario.sample(1, 3, first=2)
    for record in (
        record_episode("paper-random", agent, number=2, seed=3),
        record_episode(right, agent, scenario="paper-random"),
    ):
        assert record.initial.line.tobytes() == right.line.tobytes()
        last = evaluate(right, "full_brake", scenario=scenario)["full_brake"]
        assert record.last.harm("total") == last["total_harm"] and record.time_s[-1] == last["end_s"]


def test_records__have_a_row_for_each_agent_of_an_evaluation() -> None:
    records = record_agents("paper-random", {"hard": "full_brake", "soft": "constant:2"}, number=4)
    harms = evaluate("paper-random", {"hard": "full_brake", "soft": "constant:2"}, episodes=5)
    assert {name: record.last.harm("first")[0] for name, record in records.items()} == {
        name: harms[name]["first_impact_harm"][4] for name in ("hard", "soft")
    }
