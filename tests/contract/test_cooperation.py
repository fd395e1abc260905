"""The contract holds for every cooperation level, over drawn channels, and for lines of 2 to 10 vehicles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test

from ethbrake_marl import ethbrake_v0
from ethbrake_marl.defaults import HARM_COUNTS
from ethbrake_marl.envs.interfaces import make_engine
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.harm import empty_ledger
from ethbrake_marl.physics import advance
from ethbrake_marl.scenario import Scenario, list_scenarios, load_scenario
from tests.contract.interfaces import INTERFACES, actions, initial_state

LEVELS = [entry.name for entry in list_scenarios() if entry.path.parent.name == "cooperation"]
ONE_LEARNS = [name for name in LEVELS if len(load_scenario(name).learners) == 1]


def line(vehicles: int, v2x: str = "congested", horizon_s: int = 12) -> Scenario:
    """All learn, an obstacle ahead, over a channel; each for itself and a little for the others."""
    return Scenario(
        name=f"line-{vehicles}-{v2x}", vehicles=vehicles, gaps_m={"uniform": [5, 10]}, speeds_mps={"uniform": [18, 22]},
        braking_capacity_mps2={"uniform": [5, 9]}, driving_capacity_mps2=3, mass_t={"uniform": [1, 8]},
        latency_s=[0] + [0.3] * (vehicles - 1), horizon_s=horizon_s, v2x=v2x, objective="social:30",
        roles={f"vehicle_{i}": "learner" for i in range(1, vehicles + 1)}, obstacle_gap_m={"uniform": [35, 45]},
    )  # fmt: skip


def named(scenario: str | Scenario) -> str:
    return scenario if isinstance(scenario, str) else scenario.name


def test_levels__are_these():
    assert LEVELS == [
        "cooperation-0-sensors",
        "cooperation-1-front",
        "cooperation-2-blocked",
        "cooperation-2-five",
        "cooperation-2-paper",
        "cooperation-3-congested",
        "cooperation-3-five",
        "cooperation-3-pair",
        "cooperation-4-all",
        "cooperation-4-congested",
        "cooperation-4-five",
    ]


@pytest.mark.parametrize("name", [name for name in LEVELS if not name.endswith("five")])
def test_levels__of_three_vehicles_have_the_lines_of_the_random_test(name: str) -> None:
    paper, worlds = load_scenario("paper-random").sample(40, 7).worlds, load_scenario(name).sample(40, 7).worlds
    assert worlds.gaps_m.tobytes() == paper.gaps_m.tobytes()
    assert worlds.speeds_mps.tobytes() == paper.speeds_mps.tobytes()
    assert (worlds.vehicles.latency_s >= paper.vehicles.latency_s).all()


@pytest.mark.parametrize(
    "scenario", [*LEVELS, *(line(vehicles) for vehicles in (2, 6, 10)), line(10, "nominal", 8)], ids=named
)
@pytest.mark.filterwarnings("ignore:reset. unknown option")
def test_pettingzoo__holds(scenario: Any) -> None:
    parallel_api_test(ethbrake_v0.parallel_env(scenario=scenario), num_cycles=150)
    api_test(ethbrake_v0.env(scenario=scenario), num_cycles=60)
    parallel_seed_test(lambda: ethbrake_v0.parallel_env(scenario=scenario), num_cycles=20)


@pytest.mark.parametrize(
    "scenario", [*ONE_LEARNS, line(2).with_learners(["vehicle_1"]), line(2).with_learners(["vehicle_2"])], ids=named
)
def test_interfaces__agree_on_every_episode(scenario: Any) -> None:
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    bits = {}
    for name, interface in INTERFACES.items():
        running = interface(loaded, 1)
        bits[name] = [running.reset(7).tobytes(), *(running.step(a).bits() for a in actions(3, 160, 1))]
    assert all(run == bits["single"] for run in bits.values())


@pytest.mark.parametrize("name", INTERFACES)
def test_batch__of_one_is_row_k_of_a_batch_where_the_channel_is_fixed(name: str) -> None:
    fixed = {"preset": "nominal", "link_latency_s": 0.6, "hears": "front", "sensing_s": [0.9, 0.9]}
    scenario = load_scenario("paper-random").replace(v2x=fixed, objective="own", early_impacts="keep")
    worlds = scenario.sample(4, 7, channel="training").worlds
    batch = INTERFACES["vector"](scenario, 4)
    start, columns = batch.reset(7), actions(3, 40, 4)
    turns = [batch.step(action) for action in columns]
    for k in range(4):
        alone = INTERFACES[name](scenario, 1)
        assert np.array_equal(alone.reset(options={"initial_state": initial_state(worlds, k)})[0], start[k])
        for turn, action in zip(turns, columns, strict=True):
            mine = alone.step(action[k : k + 1])
            assert np.float32(mine.reward[0]) == np.float32(turn.reward[k])
            if mine.ended[0]:
                assert mine.harm[0] == turn.harm[k]
                break
            assert np.array_equal(mine.observation[0], turn.observation[k])


def test_stable_baselines3__tells_the_news_of_each_learner_at_an_episodes_start() -> None:
    vec = make_sb3_vec_env(line(4), 3, seed=5)
    vec.reset()
    known = vec.engine.packed.known_from_s
    told = [info["known_from_s"].tolist() for info in vec.reset_infos]
    assert told == [known[k, i].tolist() for k in range(3) for i in range(4)]


@pytest.mark.parametrize("name", ["cooperation-3-pair", "cooperation-3-five"])
def test_level_4__has_the_lines_of_level_3_and_full_braking_never_meets_its_obstacle(name: str) -> None:
    level_3, level_4 = load_scenario(name), load_scenario(name.replace("3-pair", "4-all").replace("3-five", "4-five"))
    assert level_4.learners == tuple(range(level_4.vehicles)) and level_4.obstacle_gap_m == 42.0
    worlds = {"3": level_3.sample(2_000, 7).worlds, "4": level_4.sample(2_000, 7).worlds}
    assert worlds["4"].gaps_m.tobytes() == worlds["3"].gaps_m.tobytes()
    ledgers = {}
    for key, at_alert in worlds.items():
        _, impacts = advance(at_alert, -at_alert.vehicles.braking_capacity_mps2, until_s=8.0)
        ledgers[key] = empty_ledger(at_alert).add(impacts)
    assert not ledgers["4"].obstacle_count.any() and ledgers["3"].collided.sum() > 1_000
    for harm_count in HARM_COUNTS:
        assert ledgers["4"].vehicle_harm(harm_count).tobytes() == ledgers["3"].vehicle_harm(harm_count).tobytes()
    v, a = worlds["4"].speeds_mps[:, 0], worlds["4"].vehicles.braking_capacity_mps2[:, 0]
    assert (v * v / (2.0 * a) < worlds["4"].obstacle_gap_m).all()


def test_obstacle__changes_nothing_in_a_level_whose_line_does_not_reach_it() -> None:
    plain = load_scenario("cooperation-3-pair")
    runs = [make_engine(scenario, 200, seed=3) for scenario in (plain, plain.replace(obstacle_gap_m=42))]
    for _ in range(80):
        steps = [run.step(np.full((200, 2), -1.0)) for run in runs]
        assert steps[0].reward.tobytes() == steps[1].reward.tobytes()
        assert steps[0].ended.tobytes() == steps[1].ended.tobytes()
    without, with_it = (run.worlds for run in runs)
    assert without.gaps_m.tobytes() == with_it.gaps_m.tobytes() and with_it.obstacle_gap_m.min() > 0.0
    assert runs[0].ledger.total_harm.tobytes() == runs[1].ledger.total_harm.tobytes()
    assert runs[0].ledger.collided.sum() > 100
