"""One agent per learner, several learners driven at once."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.registry import Team, drive, make_agent, script_agents
from ethbrake_marl.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import HybridAgent

PAPER = load_scenario("paper-random")
PAIR = load_scenario("cooperation-3-pair")


class SoftPolicy:
    """Brakes softer, the larger the gap ahead; its output is float32, as a network's is."""

    observation = ObservationSpec()

    def __call__(self, observation):
        names = [feature.name for feature in self.observation.features]
        gap = observation[:, names.index("front_1.gap")]
        return (np.float32(-1.0) / (np.float32(1.0) + gap))[:, np.newaxis]


def harm(result, name):
    return result.outcome(name).total_harm


def test_team__of_one_drives_as_the_agent_alone():
    sample, agent = PAPER.sample(40, 7), make_agent("e_v2x_bm")
    result = evaluate(sample, {"alone": agent, "team": Team({1: agent}, "team")}, scenario=PAPER)
    named = evaluate(sample, {"alone": agent}, scenario=PAPER, vehicle="vehicle_2")
    for name in ("alone", "team"):
        outcome, other = result.outcome(name), named.outcome("alone")
        assert outcome.final.gaps_m.tobytes() == other.final.gaps_m.tobytes()
        assert outcome.predicted_harm.tobytes() == other.predicted_harm.tobytes()
    assert result.vehicle == named.vehicle == 1


def test_evaluate__an_agent_alone_drives_every_learner():
    sample = PAIR.sample(60, 7)
    agents = {
        "full_brake": make_agent("full_brake"),
        "by_hand": Team({1: make_agent("full_brake"), 2: make_agent("full_brake")}, "by_hand"),
        "unlike": Team({1: make_agent("constant:4"), 2: make_agent("full_brake")}, "unlike"),
    }
    result = evaluate(sample, agents, scenario=PAIR)
    paper = evaluate(PAPER.sample(60, 7), {k: make_agent(k) for k in ("full_brake", "constant:4")}, scenario=PAPER)
    np.testing.assert_allclose(harm(result, "full_brake"), harm(paper, "full_brake"), rtol=1e-12)
    assert harm(result, "full_brake").tolist() == harm(result, "by_hand").tolist()
    np.testing.assert_allclose(harm(result, "unlike"), harm(paper, "constant:4"), rtol=1e-12)
    assert result.vehicles == (1, 2)
    with pytest.raises(InvalidInput, match="needs one driven vehicle; driven are: vehicle_2, vehicle_3"):
        _ = result.vehicle


def test_evaluate__several_learners_do_what_they_do_in_training():
    worlds, policy = PAIR.sample(50, 3).worlds, SoftPolicy()
    engine = Engine(PAIR, 50, learners=(1, 2), scripts={0: make_agent("full_brake")}, worlds=worlds)
    while not engine.ended.all():
        engine.step({i: policy(engine.observe(i))[:, 0].astype(np.float64) for i in (1, 2)})
    outcome = evaluate(worlds, {"soft": LearnedAgent(policy)}, scenario=PAIR).outcome("soft")
    assert outcome.ledger.total_harm.tolist() == engine.ledger.total_harm.tolist()
    assert outcome.final.gaps_m.tolist() == engine.worlds.gaps_m.tolist()


def test_evaluate__one_agent_remembers_each_learner_apart():
    class Remembering:
        name = "remembering"

        def begin(self, alert, vehicle, scripts):
            assert set(scripts) == {0}
            return np.full(alert.n, vehicle)

        def act(self, worlds, memory, vehicle):
            assert (memory == vehicle).all()
            return np.full(worlds.n, -3.0), memory

    evaluate(PAIR.sample(3, 0), {"m": Remembering()}, scenario=PAIR)


def test_evaluate__what_several_predict_is_nobodys_prediction():
    outcome = evaluate(PAIR.sample(3, 0), {"e": make_agent("e_v2x_bm")}, scenario=PAIR).outcome("e")
    assert outcome.predicted_harm is None


def test_e_v2x_bm__takes_the_other_learners_to_brake_fully():
    worlds = PAIR.sample(30, 7).worlds
    team = Team.of(make_agent("e_v2x_bm"), (1, 2))
    both = drive(worlds, team, PAIR).memories[1]
    alone = drive(worlds, make_agent("e_v2x_bm"), PAIR.with_learners(["vehicle_2"]), 1).memories[1]
    assert both["deceleration_mps2"].tolist() == alone["deceleration_mps2"].tolist()


def test_evaluate__nobody_is_driven_by_a_team_of_nobody():
    level = load_scenario("cooperation-0-sensors")
    result = evaluate(level.sample(20, 7), {"scripts": Team({}, "scripts")}, scenario=level)
    driven = evaluate(level.sample(20, 7), {"b": make_agent("full_brake")}, scenario=level, vehicle=1)
    np.testing.assert_allclose(harm(result, "scripts"), harm(driven, "b"), rtol=1e-12)


def test_summarise__with_several_driven_vehicles_tells_the_proven_harm():
    (row,) = summarise(evaluate(PAIR.sample(5, 7), {"b": make_agent("full_brake")}, scenario=PAIR, seed=7))
    found = row.to_json()
    assert 0 < found["proven_harm"] <= found["best_known_first_impact_harm"]
    assert found["known_best_share"] < 1  # no table of teams ships: the best known is that of the agents
    assert found["parameters"]["controlled_vehicles"] == ["vehicle_2", "vehicle_3"]
    assert "controlled_vehicle" not in found["parameters"]
    assert found["parameters"]["scripts"] == {"vehicle_1": "full_brake"}
    assert found["parameters"]["no_limits_because"] is None


def test_hybrid__of_one_among_several_learners_is_refused():
    hybrid = HybridAgent(make_agent("coast"), PAIR)
    with pytest.raises(InvalidInput, match="drives vehicle_2, but vehicle_3 of scenario 'cooperation-3-pair' must be"):
        evaluate(PAIR.sample(2, 0), {"h": hybrid}, scenario=PAIR)
    one = PAIR.with_learners(["vehicle_2"])
    alone = HybridAgent(make_agent("coast"), one)
    assert evaluate(one.sample(2, 0), {"h": alone}, scenario=one).outcome("h").predicted_harm is not None


def test_team__bad_input_is_refused():
    brake = make_agent("full_brake")
    with pytest.raises(InvalidInput, match="must be the index of a vehicle"):
        Team({"vehicle_2": brake}, "t")
    with pytest.raises(InvalidInput, match="vehicle_2 is driven by 'coast', which is no agent"):
        Team({1: "coast"}, "t")
    with pytest.raises(InvalidInput, match="team 't' drives vehicle_2; the vehicles to drive are vehicle_2, vehicle_3"):
        Team.of(Team({1: brake}, "t"), (1, 2))


def test_team__as_a_script_is_refused_with_what_to_write(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = PAIR.with_learners(["vehicle_2"])
    scripted = scenario.replace(roles=dict.fromkeys(("vehicle_1", "vehicle_3"), "coast") | {"vehicle_2": "learner"})
    brake = make_agent("full_brake")
    monkeypatch.setattr("ethbrake_marl.agents.registry.make_agent", lambda *_, **__: Team({2: brake}, "t"))
    with pytest.raises(InvalidInput, match="agent 'coast': is a team, one agent is needed here"):
        script_agents(scripted)
