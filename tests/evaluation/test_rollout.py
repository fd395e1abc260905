from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import Evaluation, Outcome, evaluate
from ethbrake_marl.physics import advance
from ethbrake_marl.scenario import Scenario


def arrays(outcome: Outcome) -> dict[str, np.ndarray]:
    """Every number of an outcome."""
    found = {f"ledger.{f.name}": getattr(outcome.ledger, f.name) for f in fields(outcome.ledger)}
    found |= {f"final.{name}": getattr(outcome.final, name) for name in ("gaps_m", "speeds_mps", "time_s", "pair_hit")}
    return found | {"at_rest": outcome.at_rest, "predicted": outcome.predicted_harm, "chosen": outcome.chosen_policy}


def assert_same(one: Outcome, other: Outcome) -> None:
    other_arrays = arrays(other)
    for name, array in arrays(one).items():
        np.testing.assert_array_equal(array, other_arrays[name], err_msg=name, strict=True)


def test_evaluate__one_impact_by_hand(pair: Scenario) -> None:
    result = evaluate(pair.sample(2, 0), {"full_brake": make_agent("full_brake")}, scenario=pair)
    outcome = result.outcome("full_brake")
    assert outcome.collided.tolist() == [True, True]
    assert outcome.impacts.tolist() == [1, 1]
    np.testing.assert_allclose(outcome.first_impact_harm, 9.0, rtol=1e-12)
    np.testing.assert_allclose(outcome.total_harm, 9.0, rtol=1e-12)
    np.testing.assert_allclose(outcome.vehicle_harm("first"), [[4.95, 4.05]] * 2, rtol=1e-12)
    np.testing.assert_allclose(outcome.final.gaps_m, 0.90825, rtol=1e-12)
    assert outcome.final.speeds_mps.tolist() == [[0.0, 0.0]] * 2
    np.testing.assert_allclose(outcome.final.time_s, 3.7, rtol=1e-12)  # the step in which the line came to rest
    assert outcome.ended.tolist() == ["at_rest", "at_rest"]
    assert outcome.predicted_harm is None
    assert outcome.chosen_policy is None


def test_evaluate__full_braking_on_the_papers_random_test(paper_random: Scenario) -> None:
    # Two independent programs, 20,000 worlds: 85.6 %, 24.0, 25.6. Allowed: three standard errors at 2,000.
    result = evaluate(paper_random.sample(2000, 7), {"full_brake": make_agent("full_brake")}, scenario=paper_random)
    outcome = result.outcome("full_brake")
    assert outcome.collided.mean() == pytest.approx(0.856, abs=0.024)
    assert outcome.first_impact_harm.mean() == pytest.approx(24.0, abs=1.2)
    assert outcome.total_harm.mean() == pytest.approx(25.6, abs=1.3)
    assert outcome.at_rest.all()


def test_evaluate__is_what_a_learner_with_the_same_commands_gets(paper_random: Scenario) -> None:
    worlds = paper_random.sample(50, 3).worlds
    scripts = {0: make_agent("full_brake"), 2: make_agent("full_brake")}
    engine = Engine(paper_random, 50, learners=(1,), scripts=scripts, worlds=worlds)
    while not engine.ended.all():
        engine.step({1: np.full(50, -1.0)})
    outcome = evaluate(worlds, {"b": make_agent("full_brake")}, scenario=paper_random).outcome("b")
    np.testing.assert_array_equal(outcome.ledger.total_harm, engine.ledger.total_harm, strict=True)
    np.testing.assert_array_equal(outcome.final.gaps_m, engine.worlds.gaps_m, strict=True)


def test_evaluate__applies_commands_unrounded(paper_random: Scenario) -> None:
    # -3.52 / 7 * 7 is not -3.52 in floating point: a way through the action would show here.
    outcome = evaluate(paper_random.sample(1, 0), {"c": make_agent("constant:3.52")}, scenario=paper_random).outcome(
        "c"
    )
    assert outcome.final.command_mps2[0, 1] == -3.52
    assert -3.52 / 7.0 * 7.0 != -3.52


def test_engine__deciders_must_be_vehicles(paper_random: Scenario) -> None:
    scripts = {i: make_agent("full_brake") for i in range(3)}
    with pytest.raises(InvalidInput, match=r"deciders \(3,\) must be from 0 to 2"):
        Engine(paper_random, 1, learners=(), scripts=scripts, deciders=(3,))


def test_engine__without_deciders_steps_start_at_the_alert(paper_random: Scenario) -> None:
    scripts = {i: make_agent("full_brake") for i in range(3)}
    worlds = paper_random.sample(1, 0).worlds
    starts = [
        Engine(paper_random, 1, learners=(), scripts=scripts, deciders=deciders, worlds=worlds).worlds.time_s[0]
        for deciders in (None, (1,), (2,), (1, 2))
    ]
    assert starts == [0.0, 0.5, 0.8, 0.5]


@pytest.mark.parametrize("chunk", [1, 7, 199])
def test_evaluate__does_not_depend_on_the_chunk(evaluation: Evaluation, gap_agent: object, chunk: int) -> None:
    part = evaluation.worlds.take(np.arange(12)) if chunk == 1 else evaluation.worlds
    agents = {"gap": gap_agent, "e_v2x_bm:pairwise": make_agent("e_v2x_bm:pairwise")}
    whole = evaluate(part, agents, scenario=evaluation.scenario)
    chunked = evaluate(part, agents, scenario=evaluation.scenario, chunk=chunk)
    for name in agents:
        assert_same(whole.outcome(name), chunked.outcome(name))
    assert whole.outcome("gap").collided.any()


def test_evaluate__does_not_depend_on_the_order_of_the_worlds(evaluation: Evaluation, gap_agent: object) -> None:
    order = np.random.default_rng(0).permutation(evaluation.worlds.n)
    shuffled = evaluate(evaluation.worlds.take(order), {"gap": gap_agent}, scenario=evaluation.scenario).outcome("gap")
    expected = arrays(evaluation.outcome("gap"))
    for name, array in arrays(shuffled).items():
        np.testing.assert_array_equal(array, expected[name][order], err_msg=name, strict=True)


def test_evaluate__takes_over_what_the_agent_says(evaluation: Evaluation) -> None:
    outcome = evaluation.outcome("gap")
    np.testing.assert_array_equal(outcome.predicted_harm, evaluation.worlds.gaps_m[:, 0], strict=True)
    np.testing.assert_array_equal(outcome.chosen_policy, evaluation.worlds.gaps_m[:, 0] > 7.5, strict=True)


def test_evaluate__notes_the_place_of_each_world_in_its_list(paper_random: Scenario) -> None:
    agents = {"full_brake": make_agent("full_brake")}
    sample = paper_random.sample(4, 7, first=10)
    assert evaluate(sample, agents, scenario=paper_random).index.tolist() == [10, 11, 12, 13]
    assert evaluate(sample.worlds, agents, scenario=paper_random).index.tolist() == [0, 1, 2, 3]


def test_evaluate__an_episode_that_the_horizon_cuts_is_reported_so(pair: Scenario) -> None:
    short = pair.replace(horizon_s=1.0)
    outcome = evaluate(short.sample(1, 0), {"b": make_agent("full_brake")}, scenario=short).outcome("b")
    assert outcome.ended.tolist() == ["horizon"]
    assert outcome.final.time_s.tolist() == [1.0]
    assert (outcome.final.speeds_mps > 0.0).all()


def test_evaluate__drives_the_vehicle_that_is_named(paper_random: Scenario) -> None:
    third = paper_random.with_learners(["vehicle_3"])
    result = evaluate(paper_random.sample(5, 0), {"coast": make_agent("coast")}, scenario=third, vehicle=2)
    by_default = evaluate(paper_random.sample(5, 0), {"coast": make_agent("coast")}, scenario=third)
    assert result.vehicle == by_default.vehicle == 2
    assert (result.outcome("coast").final.command_mps2[:, 2] == 0.0).all()
    assert (result.outcome("coast").final.command_mps2[:, 1] == -7.0).all()


def test_evaluate__reports_its_progress(paper_random: Scenario) -> None:
    seen: list[tuple[str, int]] = []
    evaluate(
        paper_random.sample(5, 0), {"b": make_agent("full_brake")}, scenario=paper_random, chunk=2,
        on_progress=lambda agent, done: seen.append((agent, done)),
    )  # fmt: skip
    assert seen == [("b", 2), ("b", 4), ("b", 5)]


def test_evaluate__bad_input_is_refused(paper_random: Scenario, gap_agent: object) -> None:
    worlds, agents = paper_random.sample(3, 0).worlds, {"full_brake": make_agent("full_brake")}
    with pytest.raises(InvalidInput, match="no agents"):
        evaluate(worlds, {}, scenario=paper_random)
    with pytest.raises(InvalidInput, match="chunk = 0"):
        evaluate(worlds, agents, scenario=paper_random, chunk=0)
    with pytest.raises(InvalidInput, match="vehicle = 3: must be a name or an index from 0 to 2"):
        evaluate(worlds, agents, scenario=paper_random, vehicle=3)
    with pytest.raises(InvalidInput, match="has 0 learners"):
        evaluate(worlds, agents, scenario=paper_random.replace(roles={}, early_impacts="keep"))
    two = paper_random.with_learners([1, 2])
    with pytest.raises(InvalidInput, match="only vehicle_2 is driven"):
        evaluate(worlds, agents, scenario=two, vehicle=1)
    with pytest.raises(InvalidInput, match="of 3 vehicles given"):
        four = paper_random.replace(
            vehicles=4, gaps_m=7.0, speeds_mps=20.0, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0, mass_t=5.0,
            latency_s=0.5, roles={"vehicle_2": "learner"},
        )  # fmt: skip
        evaluate(worlds, agents, scenario=four)


def test_evaluate__an_agent_that_predicts_for_other_worlds_is_refused(paper_random: Scenario) -> None:
    class Confused:
        name = "confused"

        def __init__(self, shape: tuple[int, ...]) -> None:
            self.shape = shape

        def begin(self, alert: object, vehicle: int, scripts: object) -> dict[str, np.ndarray]:
            return {"predicted_harm": np.zeros(self.shape)}

        def act(self, worlds: object, memory: object, vehicle: int) -> tuple[np.ndarray, object]:
            return np.zeros(3), memory

    for shape, told in (
        ((3, 2), r"'confused': predicted_harm is float64 of shape \(3, 2\)"),
        ((2,), r"'confused' of vehicle_2: .*shape \(2,\)"),
    ):
        with pytest.raises(InvalidInput, match=told):
            evaluate(paper_random.sample(3, 0), {"x": Confused(shape)}, scenario=paper_random)


def test_outcome__of_an_agent_that_was_not_evaluated(evaluation: Evaluation) -> None:
    with pytest.raises(InvalidInput, match=r"'ppo' was not evaluated; evaluated: full_brake, constant:4\.5, gap"):
        evaluation.outcome("ppo")


def test_evaluate__takes_the_vehicle_by_name(paper_random: Scenario) -> None:
    worlds, agents = paper_random.sample(3, 0), {"coast": make_agent("coast")}
    by_name = evaluate(worlds, agents, scenario=paper_random, vehicle="vehicle_2")
    assert by_name.vehicle == 1
    assert_same(by_name.outcome("coast"), evaluate(worlds, agents, scenario=paper_random).outcome("coast"))
    with pytest.raises(InvalidInput, match="unknown vehicle 'vehicle_9'"):
        evaluate(worlds, agents, scenario=paper_random, vehicle="vehicle_9")


def test_evaluate__of_no_worlds_is_refused(paper_random: Scenario) -> None:
    nothing = paper_random.sample(1, 1).worlds.take(np.arange(0))
    with pytest.raises(InvalidInput, match="worlds: there are none"):
        evaluate(nothing, {"coast": make_agent("coast")}, scenario=paper_random)


def test_evaluate__refuses_worlds_that_are_not_at_the_alert(paper_random: Scenario) -> None:
    worlds = paper_random.sample(3, 0).worlds
    later, _ = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=0.1)
    with pytest.raises(InvalidInput, match=r"world 0 is at 0\.1 s; episodes start at the alert"):
        evaluate(later, {"b": make_agent("full_brake")}, scenario=paper_random)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"worlds": 5}, "worlds = 5: must be worlds or a sample"),
        ({"scenario": "paper-random"}, "scenario = 'paper-random': must be a Scenario"),
        ({"agents": ["full_brake"]}, r"agents = \['full_brake'\]: must be a mapping"),
        ({"agents": {"a": "full_brake"}}, "agent 'a': 'str' is no agent"),
        ({"chunk": 2.5}, r"chunk = 2\.5: must be a whole number"),
        ({"vehicle": 1.5}, r"vehicle = 1\.5: must be a name or an index"),
    ],
)
def test_evaluate__says_what_is_not_what_it_must_be(paper_random: Scenario, wrong: dict, message: str) -> None:
    given = {"worlds": paper_random.sample(1, 0), "agents": {"b": make_agent("full_brake")}, "scenario": paper_random}
    with pytest.raises(InvalidInput, match=message):
        evaluate(**{**given, **wrong})
