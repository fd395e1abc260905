"""Whole episodes: who drives what, what each is told and sees, and that nobody writes into what belongs to all."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agents import registry
from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.registry import Team, drive, make_agent, register_agent, script_agents
from ethbrake_marl.engine import Engine
from ethbrake_marl.envs.interfaces import make_engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.evaluation.episodes import Task, film_scenes, follow_episodes, record_episode, record_episodes
from ethbrake_marl.evaluation.inputs import worlds_sha256
from ethbrake_marl.observations import ObservationSpec, observe
from ethbrake_marl.physics import Floats, Worlds, advance
from ethbrake_marl.rewards import RewardParams
from ethbrake_marl.scenario import load_scenario, observation_for
from ethbrake_marl.shield import HybridAgent, ShieldedDriver

PAPER = load_scenario("paper-random")


PAIR = load_scenario("cooperation-3-pair")


def with_role(role, vehicle="vehicle_3"):
    return PAPER.replace(roles={**PAPER.roles, vehicle: role}, early_impacts="keep")


@pytest.mark.parametrize("role", ["constant:3", "coast", "copy_leader", "gentlest_front", "e_v2x_bm"])
def test_e_v2x_bm__predicts_and_beats_constants_whatever_script_the_others_follow(role):
    scenario = with_role(role)
    worlds = scenario.sample(60, 7).worlds
    agent = make_agent("e_v2x_bm")
    episodes = drive(worlds, agent, scenario, 1)
    realised = episodes.ledger.world_harm("first")
    np.testing.assert_allclose(realised, episodes.memories[1]["predicted_harm"], atol=1e-6)
    for deceleration in np.linspace(0.0, 7.0, 15):
        assert (
            realised
            <= drive(worlds, make_agent(f"constant:{deceleration}"), scenario, 1).ledger.world_harm("first") + 1e-6
        ).all()


def test_e_v2x_bm__knows_who_drives_in_the_engines_of_all_interfaces():
    roles = {"vehicle_1": "learner", "vehicle_2": "e_v2x_bm", "vehicle_3": "constant:3"}
    scenario = PAPER.replace(roles=roles, early_impacts="keep", obstacle_gap_m=60)
    engine, alert = make_engine(scenario, 4, seed=3), scenario.sample(4, 3, channel="training").worlds
    agent, braking = make_agent("e_v2x_bm"), script_agents(PAPER, except_for=1)
    told, papers, alone = (agent.begin(alert, 1, scripts) for scripts in (script_agents(scenario), braking, {}))
    assert engine.memories[1]["deceleration_mps2"].tolist() == told["deceleration_mps2"].tolist()
    assert told["deceleration_mps2"].tolist() != alone["deceleration_mps2"].tolist()
    assert papers["deceleration_mps2"].tolist() == alone["deceleration_mps2"].tolist()


def test_drive__a_scripted_vehicle_that_is_driven_follows_its_script_in_nobodys_plan():
    plain = with_role("e_v2x_bm")
    overridden = plain.replace(roles=plain.roles | {"vehicle_2": "coast"})
    worlds = plain.sample(5, 7).worlds
    agent = make_agent("full_brake")
    found = [drive(worlds, agent, scenario, 1).ledger.world_harm("first") for scenario in (overridden, plain)]
    assert found[0].tolist() == found[1].tolist()


def test_hybrid__its_parts_know_the_others_too():
    scenario = with_role("constant:3")
    worlds = scenario.sample(30, 7).worlds
    hybrid = HybridAgent(make_agent("e_v2x_bm", harm_count="total"), scenario)
    episodes = drive(worlds, hybrid, scenario, 1)
    memory = episodes.memories[1]
    assert episodes.ledger.world_harm("first").tolist() == memory["predicted_harm"].tolist()
    best = drive(worlds, make_agent("e_v2x_bm"), scenario, 1).ledger.world_harm("first")
    np.testing.assert_allclose(memory["bound_harm"], best, atol=1e-9)


@pytest.mark.parametrize("script", ["copy_leader", "gentlest_front"])
def test_scripts__fixed_at_the_alert_are_asked_once_to_the_same_motion(script):
    fixed, remembering = make_agent(script), make_agent(script)
    remembering.state_free = False
    worlds = PAPER.sample(30, 7).worlds
    one, other = drive(worlds, fixed, PAPER, 1), drive(worlds, remembering, PAPER, 1)
    assert one.final.gaps_m.tolist() == other.final.gaps_m.tolist()
    assert one.ledger.total_harm.tolist() == other.ledger.total_harm.tolist()


class Looking:
    """Brakes half, and keeps what a learner with the usual observation would have seen."""

    name = "looking"

    def __init__(self):
        self.seen = []

    def act(self, worlds, vehicle):
        self.seen.append(observe(worlds, vehicle, observation_for(PAPER)))
        return np.full(worlds.n, -3.5)


def test_drive__an_agent_sees_what_a_learner_sees_from_the_first_decision_on():
    worlds, agent = PAPER.sample(20, 7).worlds, Looking()
    drive(worlds, agent, PAPER, 1)
    engine = Engine(PAPER, 20, learners=(1,), scripts=script_agents(PAPER, except_for=1), worlds=worlds)
    for seen in agent.seen[:3]:
        assert engine.observe(1).tobytes() == seen.tobytes()
        engine.step(np.full((20, 1), -0.5))


def test_drive__a_policy_as_a_role_does_what_it_does_when_it_is_driven():
    def with_roles(**roles):
        return PAPER.replace(early_impacts="keep", roles={"vehicle_1": "full_brake", **roles})

    universal, braking = make_agent("universal@shipped"), make_agent("full_brake")
    driven = with_roles(vehicle_2="learner", vehicle_3="full_brake")
    role = with_roles(vehicle_2="universal@shipped", vehicle_3="learner")
    both = with_roles(vehicle_2="learner", vehicle_3="learner")
    worlds = driven.sample(20, 7).worlds
    harm = drive(worlds, universal, driven, 1).ledger.world_harm("first")
    for episodes in (drive(worlds, braking, role, 2), drive(worlds, Team({1: universal, 2: braking}, "both"), both)):
        assert np.abs(episodes.ledger.world_harm("first") - harm).max() < 1e-9
    assert 0.0 < harm.mean() < drive(worlds, braking, driven, 1).ledger.world_harm("first").mean()


class Swinging:
    """Brakes the harder the later it is: every decision is another command."""

    name = "swinging"

    def act(self, worlds, vehicle):
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle] * (0.3 + 0.6 * np.sin(7.0 * worlds.time_s) ** 2)


@pytest.fixture
def swinging(monkeypatch):
    """Lines whose first and last vehicle follow a script that decides within the steps of Vehicle 2."""
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
    register_agent("swinging", lambda argument, settings: Swinging())
    roles = {"vehicle_1": "swinging", "vehicle_2": "learner", "vehicle_3": "swinging"}
    latency = [0.04, 0.5, {"uniform": [0.2, 0.9]}]
    return PAPER.replace(early_impacts="keep", roles=roles, latency_s=latency, gaps_m=4)


def test_drive__shows_every_part_of_a_step_within_which_nobody_decides(swinging):
    class Replay:
        def __init__(self, worlds):
            self.now, self.harm = worlds, np.zeros((worlds.n, 2))

        def see(self, before, command_mps2, until_s):
            assert np.array_equal(before.gaps_m, self.now.gaps_m) or np.allclose(before.gaps_m, self.now.gaps_m)
            self.now, impacts = advance(before, command_mps2, until_s=until_s)
            self.harm += np.stack([impacts.first_impact_harm.sum(axis=1), impacts.total_harm.sum(axis=1)], axis=1)

    worlds = swinging.sample(30, 7).worlds
    replay = Replay(worlds)
    episodes = drive(worlds, make_agent("universal@shipped"), swinging, 1, watched_by=[replay])
    assert np.abs(replay.now.gaps_m - episodes.final.gaps_m).max() < 1e-9
    for k, count in enumerate(("first", "total")):
        assert np.abs(replay.harm[:, k] - episodes.ledger.world_harm(count)).max() < 1e-9
    assert episodes.ledger.world_harm("total").max() > 1.0


def test_record__motion_and_dataset_follow_scripts_that_decide_within_a_step(swinging):
    sample = swinging.sample(4, 7)
    agent = make_agent("constant:3")
    outcome = evaluate(sample, {"it": agent}, scenario=swinging).outcome("it")
    motions = follow_episodes(sample.worlds, agent, swinging)
    task = Task(swinging, 7, RewardParams(), observation_for(swinging))
    recording = record_episodes(sample, agent, "it", task)
    assert outcome.sampled_harm is None  # its samples are the decisions of Vehicle 2 alone
    for k, motion in enumerate(motions):
        record = record_episode(sample.worlds.take([k]), agent, scenario=swinging)
        for impacts in (record.impacts, motion.impacts):
            assert (impacts.closing_speed_mps**2).sum() == pytest.approx(outcome.total_harm[k])
        assert record.gaps_m[-1] == pytest.approx(outcome.final.gaps_m[k])
        last = recording.positions_m[recording.decisions[k], k]
        assert record.positions_m[-1] == pytest.approx(last, abs=1e-6)
        scene = film_scenes(sample.worlds.take([k]), agent, scenario=swinging)[-1]
        assert scene.total_harm == pytest.approx(outcome.total_harm[k])
        assert scene.front_m[0] == pytest.approx(last[0], abs=1e-6)


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
    brake, gentle = make_agent("full_brake"), make_agent("constant:4")
    agents = {"alone": brake, "by_hand": Team({1: brake, 2: brake}, "t"), "unlike": Team({1: gentle, 2: brake}, "u")}
    result = evaluate(PAIR.sample(60, 7), agents, scenario=PAIR)
    paper = evaluate(PAPER.sample(60, 7), {"alone": brake, "unlike": gentle}, scenario=PAPER)
    for name in ("alone", "unlike"):
        np.testing.assert_allclose(harm(result, name), harm(paper, name), rtol=1e-12)
    assert harm(result, "alone").tolist() == harm(result, "by_hand").tolist()
    assert result.vehicles == (1, 2)


def test_evaluate__several_learners_do_what_they_do_in_training():
    worlds, policy = PAIR.sample(50, 3).worlds, SoftPolicy()
    engine = Engine(PAIR, 50, learners=(1, 2), scripts={0: make_agent("full_brake")}, worlds=worlds)
    while not engine.ended.all():
        engine.step({i: policy(engine.observe(i))[:, 0].astype(np.float64) for i in (1, 2)})
    outcome = evaluate(worlds, {"soft": LearnedAgent(policy)}, scenario=PAIR).outcome("soft")
    assert outcome.ledger.total_harm.tolist() == engine.ledger.total_harm.tolist()
    assert outcome.final.gaps_m.tolist() == engine.worlds.gaps_m.tolist()


def test_evaluate__one_agent_remembers_each_learner_apart_and_predicts_for_nobody():
    class Remembering:
        name = "remembering"

        def begin(self, alert, vehicle, scripts):
            assert set(scripts) == {0}
            return {"predicted_harm": np.full(alert.n, float(vehicle))}

        def act(self, worlds, memory, vehicle):
            assert (memory["predicted_harm"] == vehicle).all()
            return np.full(worlds.n, -3.0), memory

    assert evaluate(PAIR.sample(3, 0), {"m": Remembering()}, scenario=PAIR).outcome("m").predicted_harm is None


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


class _Writes:
    """Writes into what it is given, when an episode begins or at each decision."""

    knows = "own sensors"

    def __init__(self, when: str, *, state_free: bool) -> None:
        self.name, self.when, self.state_free = "kmh", when, state_free

    def begin(self, alert, vehicle, scripts):
        if self.when == "begin":
            alert.gaps_m[:] = 1000.0
        return np.zeros(alert.n)

    def act(self, worlds, memory, vehicle):
        memory += 1.0  # in its own copy
        if self.when in ("name", "plan"):
            setattr(self, self.when, "other")
        if self.when == "act":
            speeds = worlds.speeds_mps
            speeds *= 3.6  # a beginner's slip: km/h, in place
        if self.when == "vehicles":
            worlds.vehicles.mass_t[:] = 1.0
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle], memory


WRAPPED = {
    "alone": lambda agent: agent,
    "episode": lambda agent: HybridAgent(agent, PAPER),
    "step": lambda agent: ShieldedDriver(agent, PAPER),
}


@pytest.mark.parametrize("around", WRAPPED)
@pytest.mark.parametrize("state_free", [True, False])
@pytest.mark.parametrize("when", ["begin", "act", "vehicles"])
def test_agent_that_writes_into_worlds__is_refused_by_name(around: str, when: str, state_free: bool) -> None:
    sample = PAPER.sample(20, 3)
    before = worlds_sha256(sample.worlds, sample.index)
    agent = WRAPPED[around](_Writes(when, state_free=state_free))
    with pytest.raises(InvalidInput, match=r"agent 'kmh' of vehicle_2: (begin|act) on .*read-only"):
        evaluate(sample, {"full_brake": make_agent("full_brake"), "kmh": agent}, scenario=PAPER)
    assert worlds_sha256(sample.worlds, sample.index) == before


@pytest.mark.parametrize("around", WRAPPED)
@pytest.mark.parametrize("state_free", [True, False])
@pytest.mark.parametrize("when", ["name", "plan"])  # an attribute that there is, and a new one
def test_agent_that_keeps_something_in_itself__is_refused_by_name(around: str, state_free: bool, when: str) -> None:
    agent = WRAPPED[around](_Writes(when, state_free=state_free))
    told = rf"of vehicle_2: keeps something in its attribute '{when}'; one that remembers has begin\(alert, "
    with pytest.raises(InvalidInput, match=told):
        evaluate(PAPER.sample(3, 3), {"kmh": agent}, scenario=PAPER)


@pytest.mark.parametrize(
    ("begun", "kept", "told"),
    [
        (lambda n: None, lambda m, n: np.zeros(n), "another form"),  # rows that begin anew would keep the old one
        (lambda n: {"a": np.zeros(n)}, lambda m, n: m | {"b": np.zeros(n)}, "another form"),
        (lambda n: np.zeros(n), lambda m, n: np.zeros(n, np.int64), "another form.*int64.*float64"),
        (lambda n: np.zeros((n, 1)), lambda m, n: np.zeros((n, 2)), "another form"),
        (lambda n: {"a": (np.zeros(n), {"b.c": np.zeros(n)})}, lambda m, n: m, "key 'b.c'; must be a name"),
        (lambda n: {0: np.zeros(n)}, lambda m, n: m, "key 0; must be a name"),
        (lambda n: np.array([[]] * n + [[1]], object)[:n], lambda m, n: m, "an array of objects"),
    ],
)
def test_memory_of_another_form__is_refused_by_name(begun: Any, kept: Any, told: str) -> None:
    class Remembers:
        name = "mine"

        def begin(self, alert: Worlds, vehicle: int, scripts: object) -> Any:
            return begun(alert.n)

        def act(self, worlds: Worlds, memory: Any, vehicle: int) -> tuple[Floats, Any]:
            return np.zeros(worlds.n), kept(memory, worlds.n)

    with pytest.raises(InvalidInput, match=f"agent 'mine' of vehicle_2.*{told}"):
        evaluate(PAPER.sample(3, 3), {"mine": Remembers()}, scenario=PAPER)


def test_agent_that_writes_into_its_memory__writes_into_its_own() -> None:
    sample = PAPER.sample(20, 3)
    agents = {"full_brake": make_agent("full_brake"), "kmh": _Writes("memory", state_free=False)}
    result = evaluate(sample, agents, scenario=PAPER)
    full, kmh = (result.outcomes[name].ledger.world_harm("first") for name in agents)
    assert np.array_equal(full, kmh)


def test_read_only__same_values_and_the_given_ones_stay_writable() -> None:
    worlds = PAPER.sample(5, 3).worlds
    seen = worlds.read_only()
    assert worlds_sha256(seen, np.arange(5)) == worlds_sha256(worlds, np.arange(5))
    assert worlds.gaps_m.flags.writeable and not seen.gaps_m.flags.writeable
    assert np.shares_memory(worlds.gaps_m, seen.gaps_m)
    with pytest.raises(ValueError, match="read-only"):
        seen.vehicles.latency_s[0] = 0.0
