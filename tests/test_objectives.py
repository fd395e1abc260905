"""Whose harm counts: every objective by hand, rewards that add up to it, and one ledger under all of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.envs.interfaces import parallel_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import STANDARD, Ledger, objective_harm, objectives_of, parse_objective, scored
from ethbrake_marl.physics.batch import Impacts
from ethbrake_marl.rewards import RewardParams, reward_params
from ethbrake_marl.scenario import Scenario, load_scenario

PAPER = load_scenario("paper-random")
EACH = [*STANDARD, "social:30", "social:90", "weighted:1,4,2"]


def ledger() -> Ledger:
    """Pair 1 met with 12 m2/s2 (masses 1, 2), pair 2 with 9 (masses 2, 1); a second, harder impact of pair 2."""
    first, total = np.array([[12.0, 9.0]]), np.array([[12.0, 30.0]])
    return Ledger(first, total, np.array([[1, 2]]), *Impacts.no_obstacle(1), np.array([[1.0, 2.0, 1.0]]))


# Shares by mass: pair 1 gives 12 * 2/3 = 8 and 4, pair 2 gives 9 * 1/3 = 3 and 6; so H = (8, 7, 6), 21 in all.
@pytest.mark.parametrize(
    ("objective", "expected"),
    [
        ("total", [21.0, 21.0, 21.0]),
        ("own", [8.0, 7.0, 6.0]),
        ("social:0", [8.0, 7.0, 6.0]),
        ("social:90", [13.0, 14.0, 15.0]),
        ("social:45", [21.0 / math.sqrt(2.0)] * 3),
        ("social:30", [h * math.cos(math.pi / 6) + (21 - h) * 0.5 for h in (8.0, 7.0, 6.0)]),
        ("maximin", [8.0, 8.0, 8.0]),
        ("mass-weighted", [3 * (8 + 2 * 7 + 6) / 4] * 3),
        ("weighted:1,4,2", [3 * (8 + 4 * 7 + 2 * 6) / 7] * 3),
    ],
)
def test_objective_harm__by_hand(objective, expected):
    assert objective_harm(ledger(), "first", objectives_of(objective, 3))[0] == pytest.approx(expected, rel=1e-14)


def test_objective_harm__each_vehicle_may_have_its_own_and_the_count_is_told():
    mixed = objectives_of(("total", "own", "maximin"), 3)
    assert objective_harm(ledger(), "first", mixed)[0] == pytest.approx([21.0, 7.0, 8.0])
    # total count: pair 2 gives 10 and 20; H = (8, 14, 20)
    assert objective_harm(ledger(), "total", mixed)[0] == pytest.approx([42.0, 14.0, 20.0])


def test_scored__has_a_column_for_each_vehicle_under_each_objective():
    told = scored(ledger(), "first", (*STANDARD, ("own", "own", "maximin")))
    assert list(told) == [*STANDARD, "own, own, maximin"]
    assert told["own"][0] == pytest.approx([8.0, 7.0, 6.0])
    assert told["own, own, maximin"][0] == pytest.approx([8.0, 7.0, 8.0])
    assert all(column.shape == (1, 3) for column in told.values())


def played(reward, scenario=PAPER, n=60):
    """The sum of rewards of each vehicle, and the engine at the end."""
    scripts = {i: make_agent(script) for i, script in scenario.scripts.items()}
    engine = Engine(scenario, n, learners=scenario.learners, scripts=scripts, reward=reward, seed=4)
    action, total = np.random.default_rng(2).uniform(-1.0, 0.0, (n, len(scenario.learners))), 0.0
    while not engine.ended.all():
        total += engine.step(action).reward
    return total, engine


@pytest.mark.parametrize("harm_count", ["first", "total"])
@pytest.mark.parametrize("objective", EACH)
def test_rewards__add_up_to_minus_the_objective_of_the_ledger(objective, harm_count):
    total, engine = played({"objective": objective, "harm_count": harm_count})
    assert engine.ledger.collided.sum() > 20
    expected = -scored(engine.ledger, harm_count, [objective])[objective]
    assert total == pytest.approx(expected, abs=1e-9)


def test_rewards__of_two_learners_with_unlike_objectives():
    both = PAPER.with_learners(["vehicle_2", "vehicle_3"]).replace(objective=["total", "own", "social:45"])
    total, engine = played("total-harm", both)
    assert total == pytest.approx(-objective_harm(engine.ledger, "total", objectives_of(both.objective, 3)), abs=1e-9)


def test_reward__of_the_scenario_unless_the_reward_has_its_own():
    own = PAPER.replace(objective="own")
    assert played("harm", own)[0].tolist() == played({"objective": "own"})[0].tolist()
    assert played({"objective": "total"}, own)[0].tobytes() == played("harm")[0].tobytes()
    assert played(RewardParams(objective=("total",) * 3))[0].tobytes() == played("harm")[0].tobytes()


def test_reward__weight_and_other_terms_stay_what_they_are():
    doubled, _ = played({"objective": "maximin", "harm": 2.0, "terminal": 3.0})
    single, engine = played({"objective": "maximin"})
    safe = ~engine.ledger.collided
    assert safe.any()
    assert doubled == pytest.approx(2.0 * single + 3.0 * safe[:, np.newaxis])
    without, _ = played({"harm": 0.0, "terminal": 1.0})
    assert without.tolist() == np.repeat(safe[:, np.newaxis] * 1.0, 3, axis=1).tolist()


def test_infos__tell_the_harm_term_of_each_vehicle():
    env = parallel_env(PAPER.replace(objective="own"))
    _, before = env.reset(seed=1)
    total = dict.fromkeys(env.possible_agents, 0.0)
    while env.agents:
        _, rewards, _, _, infos = env.step({"vehicle_2": np.array([0.5], np.float32)})
        for agent, info in infos.items():
            assert info["reward_harm"] == rewards[agent]
            total[agent] += rewards[agent]
    for agent, info in infos.items():
        assert total[agent] == pytest.approx(before[agent]["first_impact_harm"] - info["first_impact_harm"])
    assert total["vehicle_2"] < 0.0


@pytest.mark.parametrize(
    ("objective", "message"),
    [
        ("onw", "unknown objective 'onw'; did you mean 'own'"),
        ("own:1", "own takes no argument"),
        ("social", "social needs an angle from 0 to 90 degrees"),
        ("social:91", "objective 'social:91': social needs an angle from 0 to 90 degrees"),
        ("social:nan", "social needs an angle"),
        ("social:-1", "social needs an angle"),
        ("social:4_5", "social needs an angle"),
        ("weighted:1,0,1", "weighted needs a weight from 1e-6 to 1e6"),
        ("weighted:1,inf,1", "weighted needs a weight from 1e-6 to 1e6"),
        ("weighted:1,1e308,1", "weighted needs a weight from 1e-6 to 1e6"),
        ("weighted:1,1e-7,1", "weighted needs a weight from 1e-6 to 1e6"),
        ("weighted:1,1_0,1", "weighted needs a weight from 1e-6 to 1e6"),
        ("weighted", "weighted needs a weight from 1e-6 to 1e6"),
        ("weighted:1,2", "2 weights; 3 vehicles need 3"),
        (["own", "own"], "2 entries; 3 vehicles need 3"),
        (5, "objective = 5: must be a name, for instance own or social:45, or a list with one per vehicle$"),
        (["own", 5, "own"], r"objective = \['?own'?, 5, '?own'?\]: must be a name"),
    ],
)
def test_objective__that_cannot_be_is_refused_wherever_it_is_given(objective, message):
    with pytest.raises(InvalidInput, match=message):
        PAPER.replace(objective=objective)
    with pytest.raises(InvalidInput, match=message) as refused:
        played({"objective": objective})
    assert str(refused.value).startswith("reward: ")


def test_objective_harm__with_the_largest_and_smallest_weights_is_finite():
    weighted = objective_harm(ledger(), "first", objectives_of("weighted:1e6, 1e-6,1e6", 3))[0]
    assert weighted == pytest.approx([3 * (8 + 6) / 2] * 3)


def test_scored__refuses_a_name_without_its_list():
    with pytest.raises(InvalidInput, match=r"scored: 'own': must be a list of objectives, for instance \['own'\]"):
        scored(ledger(), "first", "own")


def test_objective__round_trips_with_its_scenario():
    for objective in (*EACH, ["own", "social:45", "total"]):
        scenario = PAPER.replace(objective=objective)
        assert Scenario(**scenario.declared()) == scenario
    assert parse_objective("social:45").angle_deg == 45.0
    assert reward_params("harm").objective is None
