"""What is reported can be rewarded, and what is rewarded can be reported: one registry, the same numbers."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.evaluation.own_measures import load_measures
from tests.contract.interfaces import CRASH
from tests.first_edition.learning.tiny import TINY_PPO
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
BUILT_IN = ("harm", "collision", "risk", "jerk", "terminal", "shaping")
INJURY = {"harm": 0.0, "injury_lr4s": -1.0}
# Vehicle 2 pushes Vehicle 1 into a wall: several impacts, of which the largest change of speed counts.
PUSHED = CRASH.replace(obstacle_gap_m=20, restitution=0.5, horizon_s=6, driving_capacity_mps2=6)


def episode(scenario: eb.Scenario, reward: Any, action: float, worlds: eb.Worlds) -> tuple[Any, Engine]:
    """Rewards of every vehicle, summed over the episodes of these worlds [n, N], and the engine at their end."""
    engine = eb.make_engine(scenario, worlds.n, reward=reward)
    engine.reset(worlds=worlds)
    total = np.zeros((worlds.n, worlds.N))
    while not engine.ended.all():
        total += engine.step(np.full((worlds.n, len(engine.learners)), action)).reward
    return total, engine


def measured(scenario: eb.Scenario, agent: str, worlds: eb.Worlds) -> Any:
    """What an evaluation shows of registered measures."""
    return eb.evaluate(worlds, {"a": eb.make_agent(agent)}, scenario=scenario).outcome("a").metrics


# ---------------------------------------------------------------- by impacts


def test_injury__of_one_known_impact_is_paid_in_the_step_of_the_impact() -> None:
    # Vehicle 2 hits with 6 m/s, masses 1 and 3: 4.5 m/s at the rear of Vehicle 1, 1.5 m/s in front of Vehicle 2; in
    # 1,000 lines 1000 / (1 + exp(4.888 - 0.7965)) and 1000 / (1 + exp(4.457 - 0.2655)).
    world = CRASH.sample(1, 7).worlds
    engine = eb.make_engine(CRASH, 1, reward={"harm": 0.0, "injury_lr4s": -2.0, "injury_lr4s_vehicle": 1.0})
    engine.reset(worlds=world)
    paid, hits = [], []
    while not engine.ended.all():
        step = engine.step(np.zeros((1, 1)))
        paid.append((step.further["injury_lr4s"].tolist(), step.further["injury_lr4s_vehicle"].tolist()))
        hits.append(step.total_harm[0] > 0.0)
        expected = -2.0 * 31.337641 + np.array([[16.439373, 14.898267]]) if hits[-1] else np.zeros((1, 2))
        assert step.reward == pytest.approx(expected, abs=1e-5)
    assert hits.count(True) == 1
    assert paid[hits.index(True)] == (pytest.approx([31.337641]), [pytest.approx([16.439373, 14.898267])])
    assert paid[hits.index(False)] == ([0.0], [[0.0, 0.0]])


@pytest.mark.parametrize("name", ["injury_lr4s", "injury_gidas_every", "injury_reference_vehicle"])
@pytest.mark.parametrize(
    ("scenario", "agent", "action"), [(CRASH, "coast", 0.0), (PUSHED, "constant:-6", 1.0), (PAPER, "full_brake", -1.0)]
)
def test_injury__rewards_of_an_episode_are_what_evaluations_report(
    name: str, scenario: eb.Scenario, agent: str, action: float
) -> None:
    """Within rounding; to the bit where no vehicle has more than one impact."""
    load_measures(["injury"])
    worlds = scenario.sample(20, 7).worlds
    found = measured(scenario, agent, worlds)
    columns = [found[name]] * worlds.N if name in found else [found[f"{name}_{i + 1}"] for i in range(worlds.N)]
    total, engine = episode(scenario, {"harm": 0.0, name: -1.0}, action, worlds)
    reported = np.stack(columns, axis=1)
    assert reported.any() and -total == pytest.approx(reported, rel=1e-12, abs=1e-12)
    once = engine.ledger.count.max(axis=1) + engine.ledger.obstacle_count <= 1
    if worlds.N == 2:
        assert (-total[once] == reported[once]).all()


def test_impacts__before_the_first_decision_are_known_but_not_paid() -> None:
    """As their harm: no learner can change them."""
    keep = CRASH.replace(early_impacts="keep", gaps_m=0.5)
    load_measures(["injury_lr4s"])
    worlds = keep.sample(2, 7).worlds
    total, engine = episode(keep, INJURY, 0.0, worlds)
    assert (measured(keep, "coast", worlds)["injury_lr4s"] > 0.0).all() and (engine.ledger.count == 1).all()
    assert not total.any()
    assert (engine.state.impacts.largest_speed_change_mps > 0.0).all()  # a later impact must exceed these


def mixed(seed: int = 3, n: int = 6) -> Engine:
    """A vehicle that may be hit several times, scripts that decide on the way, and impacts in each reward."""
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "e_v2x_bm:pairwise"}
    scenario = PAPER.replace(roles=roles, early_impacts="keep")
    reward = {"harm": 1.0, "injury_lr4s_every": -0.5, "injury_gidas_vehicle": -2.0}
    return eb.make_engine(scenario, n, reward=reward, seed=seed)


def walk(engine: Engine, rng: np.random.Generator, steps: int) -> list[Any]:
    """Rewards of random decisions, with new episodes."""
    seen = []
    for _ in range(steps):
        step = engine.step(rng.uniform(-1.0, 1.0, (engine.n, 1)))
        seen.append(step.reward.copy())
        engine.renew(np.flatnonzero(step.ended))
    return seen


@pytest.mark.parametrize("before", [0, 45])
def test_snapshot__holds_the_impacts_so_far(before: int) -> None:
    first, second, rng = mixed(), mixed(99), np.random.default_rng(0)
    walk(first, rng, before)
    kept, drawn = first.snapshot(), rng.bit_generator.state
    expected = walk(first, rng, 120)
    assert np.any([reward < -1.0 for reward in expected])
    walk(second, np.random.default_rng(5), 7)
    second.restore(kept)
    rng.bit_generator.state = drawn
    assert [each.tobytes() for each in walk(second, rng, 120)] == [each.tobytes() for each in expected]
    del kept["impacts.rows"]
    with refused("engine snapshot: the array impacts.rows is missing; must have shape"):
        second.restore(kept)


def test_renewed_rows__are_paid_as_rows_of_their_own() -> None:
    """The rewards of a batch in which episodes end and begin are those of each world alone."""
    running, rng = mixed(n=4), np.random.default_rng(2)
    gained, actions, done = np.zeros((4, 3)), [[] for _ in range(4)], 0
    while done < 6:
        number, drawn = running.roster.numbers.copy(), rng.uniform(-1.0, 1.0, (4, 1))
        step = running.step(drawn)
        gained += step.reward
        for k in range(4):
            actions[k].append(drawn[k, 0])
        for k in np.flatnonzero(step.ended):
            alone = mixed(n=1)
            alone.reset(seed=3, worlds=alone.scenario.sample(1, 3, first=int(number[k]), channel="training").worlds)
            expected = sum(alone.step(np.array([[action]])).reward[0] for action in actions[k])
            assert gained[k] == pytest.approx(expected, rel=1e-12, abs=1e-12)
            gained[k], actions[k], done = 0.0, [], done + 1
        running.renew(np.flatnonzero(step.ended))


# ---------------------------------------------------------------- by step


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in__reported_is_the_return_of_an_episode_to_the_bit(name: str) -> None:
    load_measures([name])
    worlds = PAPER.sample(20, 7).worlds
    found = measured(PAPER, "full_brake", worlds)
    total, _ = episode(PAPER, {"harm": 0.0, name: 1.0}, -1.0, worlds)
    if name in ("harm", "collision", "terminal"):  # of the line
        assert [*found] == [name] and found[name].any()
        assert found[name].tolist() == total[:, 1].tolist()
    else:
        assert [*found] == [f"{name}_{i}" for i in (1, 2, 3)] and found[f"{name}_2"].any()
        assert np.stack([*found.values()], axis=1).tolist() == total.tolist()


def test_built_in__in_parts_and_behind_a_shield_and_with_an_objective() -> None:
    load_measures(["risk", "harm"])
    scenario = PAPER.replace(objective="own")
    sample, agents = (
        scenario.sample(12, 7),
        {n: eb.make_agent(n, scenario=scenario) for n in ("full_brake", "coast+step")},
    )
    whole, parts = (eb.evaluate(sample, agents, scenario=scenario, chunk=chunk) for chunk in (12, 5))
    for name in agents:
        metrics = whole.outcome(name).metrics
        assert [*metrics] == [f"{each}_{i}" for each in ("risk", "harm") for i in (1, 2, 3)]
        assert all((parts.outcome(name).metrics[n] == column).all() for n, column in metrics.items())
        borne = whole.outcome(name).ledger.vehicle_harm("first")
        assert -np.stack([metrics[f"harm_{i}"] for i in (1, 2, 3)], axis=1) == pytest.approx(borne)


# ---------------------------------------------------------------- of the user's own

MINE = '''
import numpy as np
import ethbrake_marl.first_edition as eb


def hardest(episodes):
    """Largest change of speed of each vehicle."""
    return episodes.largest_speed_change_mps


def own_braking(step):
    """Minus the own deceleration of the learners."""
    return np.minimum(step.command_mps2[:, step.learners], 0.0)


gentle = eb.Part(own_braking, unit="m/s2", by="step")
'''


def test_file__of_the_user_is_reported_and_rewarded(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(MINE)
    load_measures([f"{tmp_path}/mine.py:{name}" for name in ("hardest", "gentle")])
    worlds = PAPER.sample(20, 7).worlds
    found = measured(PAPER, "full_brake", worlds)
    assert [*found] == [f"{name}_{i}" for name in ("hardest", "gentle") for i in (1, 2, 3)]
    for name, weight in (("hardest", -1.0), ("gentle", 1.0)):
        total, _ = episode(PAPER, {"harm": 0.0, name: weight}, -1.0, worlds)
        columns = np.stack([found[f"{name}_{i}"] for i in (1, 2, 3)], axis=1)
        assert total.any() and weight * total == pytest.approx(columns, rel=1e-12, abs=1e-12)


def test_step_measure__of_the_learners_is_zero_for_the_others() -> None:
    def gentle(step: Any) -> Any:
        """Minus the own deceleration."""
        return np.minimum(step.command_mps2[:, step.learners], 0.0)

    eb.register_measure("gentle", gentle, unit="m/s2", by="step")
    worlds = PAPER.sample(20, 7).worlds
    total, _ = episode(PAPER, {"harm": 0.0, "gentle": 0.5}, -1.0, worlds)
    found = measured(PAPER, "full_brake", worlds)
    assert 0.5 * found["gentle_2"] == pytest.approx(total[:, 1]) and total[:, 1].all()
    assert not (found["gentle_1"].any() or found["gentle_3"].any() or total[:, [0, 2]].any())


# ---------------------------------------------------------------- training


def test_training__by_injuries_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    content = {**TINY_PPO.model_dump(mode="json"), "name": "kind", "reward": {"harm": 0.0, "injury_lr4s_vehicle": -0.1}}
    (tmp_path / "kind.yaml").write_text(json.dumps(content))
    recipe = eb.load_recipe(tmp_path / "kind.yaml")
    whole = eb.train(recipe, PAPER, tmp_path / "whole", steps=768)
    eb.train(
        recipe, PAPER, tmp_path / "parts", steps=768, stop_at=lambda found: "enough" * (found["steps"] >= 384) or None
    )
    parts = eb.resume(tmp_path / "parts")
    first, second = (eb.load_policy(each.directory) for each in (whole, parts))
    assert first.manifest.reward["terms"] == {"injury_lr4s_vehicle": -0.1}
    assert all((first.tensors[name] == second.tensors[name]).all() for name in first.tensors)
