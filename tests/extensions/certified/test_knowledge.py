"""Estimated worlds by hand, who drives by them, and whether agents of this extension use what they say they know."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.certified.estimated import Ranges
from ethbrake_marl.extensions.certified.estimating_agents import Odometer
from ethbrake_marl.extensions.certified.uncertainty import parse_uncertainty
from ethbrake_marl.first_edition.agents.driving import drive, script_agents
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Source
from ethbrake_marl.first_edition.agents.received import Received
from ethbrake_marl.first_edition.agents.spec import parse_spec
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from tests.first_edition.agents.test_knowledge import (
    PAPER,
    agent_of,
    changed_decisions,
    check_stated,
    in_two,
    with_channels,
)

BLOCKED = eb.load_scenario("cooperation-2-blocked")


@pytest.mark.parametrize("spec", ["e_v2x_bm:estimated", "coast+step:estimated", "ppo+episode:estimated"])
@pytest.mark.parametrize("leak", ["known", "speed_mps"])
def test_estimated_model__a_planted_leak_is_found(spec, leak, monkeypatch):
    honest = Received.by

    def leaking(worlds, vehicle):
        told = honest(worlds, vehicle)
        all_of_it = {"known": np.ones_like(told.known), "speed_mps": worlds.speeds_mps.copy()}
        return told._replace(**{leak: all_of_it[leak]})

    scenario = BLOCKED.replace(v2x={"preset": "blocked", "persistence": "periodic"})
    monkeypatch.setattr(Received, "by", leaking)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=100) > 0


BASE = eb.load_scenario("cooperation-2-paper").replace(early_impacts="keep")


DEAF = {"preset": "paper", "hears": "front"}


PERIODIC = {"preset": "blocked", "persistence": "periodic"}


def engine_of(scenario: eb.Scenario, n: int = 40, vehicle: int = 1, seed: int = 7) -> eb.Engine:
    scripts = script_agents(scenario, except_for=vehicle)
    return eb.Engine(scenario, n, learners=[vehicle], scripts=scripts, worlds=scenario.sample(n, seed).worlds)


def estimated(engine: eb.Engine, vehicle: int = 1, odometer: Odometer | None = None) -> eb.Worlds:
    worlds, scenario = engine.worlds, engine.scenario
    way = worlds.speeds_mps[:, vehicle] * worlds.time_s if odometer is None else odometer.way_m
    return Ranges.of(scenario, vehicle).estimate(worlds, way)


def test_estimated__is_the_world_where_everything_is_known_and_who_estimates_drives_as_who_sees() -> None:
    engine, told = engine_of(BASE), ("gaps_m", "speeds_mps", "pair_hit", "time_s")
    for _ in range(10):
        now, taken = engine.worlds, estimated(engine)
        for name in told:
            np.testing.assert_array_equal(getattr(taken, name), getattr(now, name))
        np.testing.assert_array_equal(taken.vehicles.mass_t, now.vehicles.mass_t)
        waiting = now.vehicles.latency_s > now.time_s[:, np.newaxis]
        np.testing.assert_array_equal(taken.vehicles.latency_s[waiting], now.vehicles.latency_s[waiting])
        engine.step(np.full((40, 1), -0.5))
    agents, worlds = (
        [make_agent(f"e_v2x_bm{way}", scenario=BASE) for way in ("", ":estimated")],
        BASE.sample(40, 7).worlds,
    )
    harm, estimating = (drive(worlds, agent, BASE, 1).ledger.world_harm("first") for agent in agents)
    np.testing.assert_allclose(estimating, harm, atol=1e-4)


def test_estimated__who_is_not_known_is_in_the_middle_of_the_ranges_and_follows_its_script() -> None:
    # Vehicle 3 is never heard: at the alert 7.5 m behind, at 20 m/s; it coasts to 0.8 s, then brakes with 6. At 1 s it
    # has made 20 m less 0.5 * 6 * 0.2^2 = 0.12 m, and Vehicle 2, with 20 m/s and no command, 20 m.
    scenario = BASE.replace(
        v2x=DEAF, gaps_m=[7.0, {"uniform": [5, 10]}], speeds_mps=[20.0, 20.0, {"uniform": [18, 22]}]
    )
    engine = engine_of(scenario)
    for _ in range(5):
        engine.step(np.zeros((40, 1)))
    taken = estimated(engine)
    np.testing.assert_allclose(engine.worlds.time_s, 1.0)
    free = ~engine.worlds.pair_hit[:, 0] & (engine.worlds.speeds_mps[:, 1] == 20.0)
    assert free.sum() > 20
    np.testing.assert_allclose(taken.gaps_m[free, 1], 7.5 + 0.12)
    np.testing.assert_allclose(taken.speeds_mps[:, 2], 20.0 - 6.0 * 0.2)
    np.testing.assert_array_equal(taken.gaps_m[:, 0], engine.worlds.gaps_m[:, 0])
    assert (taken.command_mps2[:, 2] == -6.0).all() and not taken.pair_hit[:, 1].any()


def test_estimated__an_old_message_is_moved_on_by_the_script_to_the_truth() -> None:
    channel = {
        "preset": "paper",
        "link_latency_s": 0.2,
        "persistence": "periodic",
        "senses": "front",
        "sensing_s": [5, 5],
    }
    engine = engine_of(BASE.replace(v2x=channel))
    odometer = Odometer.begun(engine.scenario.sample(40, 7).worlds, 1)
    for _ in range(12):
        now, told = engine.worlds, Received.by(engine.worlds, 1)
        assert told.known.all() and (told.at_s[:, [0, 2]] < now.time_s[:, np.newaxis] - 0.19).all()
        odometer = odometer.look(now, 1)
        taken = estimated(engine, odometer=odometer)
        free = ~now.pair_hit.any(axis=1)
        np.testing.assert_allclose(taken.gaps_m[free], now.gaps_m[free], atol=1e-9)
        np.testing.assert_allclose(taken.speeds_mps[free], now.speeds_mps[free], atol=1e-9)
        engine.step(np.full((40, 1), -0.85))
    assert free.sum() > 3


def drives_each_world_alone(agent: eb.Agent, scenario: eb.Scenario) -> None:
    worlds = scenario.sample(6, 3).worlds  # the same again for a batch of another size
    whole, alone = drive(worlds, agent, scenario, 1), drive(worlds.take([4]), agent, scenario, 1)
    assert whole.ledger.world_harm("first")[4] == alone.ledger.world_harm("first")[0]
    np.testing.assert_array_equal(whole.final.speeds_mps[4], alone.final.speeds_mps[0])


LINES = [
    *((3, v2x) for v2x in (DEAF, PERIODIC, "blocked", "sensors-only")), (2, PERIODIC), (5, PERIODIC), (5, "blocked"),
]  # fmt: skip


def line_of(vehicles: int, v2x: object) -> eb.Scenario:
    return eb.load_scenario("paper-random").replace(
        vehicles=vehicles, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0, mass_t=5.0, latency_s=0.1, v2x=v2x,
        roles={"vehicle_2": "learner"}, horizon_s=12.0,
    )  # fmt: skip


@pytest.mark.parametrize(("vehicles", "v2x"), LINES)
def test_estimating__drives_every_line_and_no_world_depends_on_the_batch(vehicles: int, v2x: object) -> None:
    scenario = line_of(vehicles, v2x)
    drives_each_world_alone(make_agent("e_v2x_bm:estimated", scenario=scenario), scenario)


@pytest.mark.parametrize("v2x", ["paper", PERIODIC])
def test_estimating__knows_of_the_obstacle_what_it_was_told(v2x: object) -> None:
    scenario = eb.load_scenario("cooperation-4-all").replace(early_impacts="keep", v2x=v2x).with_learners(["vehicle_2"])
    engine = engine_of(scenario)
    for _ in range(15):
        engine.step(np.full((40, 1), -0.9))
    told, now = Received.by(engine.worlds, 1), engine.worlds
    heard = told.known[:, 0]
    assert heard.sum() > 20
    np.testing.assert_allclose(told.obstacle_m[heard], (now.obstacle_gap_m + now.gaps_m[:, 0])[heard], atol=1e-9)
    assert np.isinf(told.obstacle_m[~heard]).all() and np.isfinite(estimated(engine).obstacle_gap_m).all()
    drive(scenario.sample(5, 3).worlds, make_agent("e_v2x_bm:estimated", scenario=scenario), scenario, 1)


# ---------------------------------------------------------------- what its agents state

SENSORS, MESSAGES, ESTIMATES, MODEL = Source.SENSORS, Source.MESSAGES, Source.ESTIMATES, Source.MODEL
STATED = {
    "e_v2x_bm:estimated": (ESTIMATES,),
    "e_v2x_bm:pairwise:estimated": (ESTIMATES,),
    "coast+step:estimated": (SENSORS, ESTIMATES),
    "coast+robust:estimated": (SENSORS, ESTIMATES),
    "ppo+step:estimated": (MESSAGES, ESTIMATES),
    "ppo+episode:estimated": (MESSAGES, ESTIMATES),
    "ppo+episode:pairwise:estimated": (MESSAGES, ESTIMATES),
    "ppo+robust": (MESSAGES, MODEL),
}
HONEST, SEEING = in_two(STATED)


@pytest.mark.parametrize(("spec", "knows"), STATED.items())
def test_knowledge__every_agent_states_it(spec, knows):
    check_stated(spec, certified(spec), knows)


def certified(spec: str, scenario: eb.Scenario = PAPER) -> eb.Agent:
    uncertainty = parse_uncertainty("gaps_m=0.5") if parse_spec(spec).shield == "robust" else None
    return make_lineup([spec], scenario, uncertainty=uncertainty)[spec]


@pytest.mark.parametrize(("spec", "channel"), with_channels(HONEST), ids=str)
def test_own_sensors_and_messages__what_was_not_received_changes_no_action(spec, channel):
    n = 4 if "robust" in spec else 10
    scenario = BLOCKED.replace(v2x=channel)
    assert changed_decisions(certified(spec, scenario), scenario, n=n) == 0


@pytest.mark.parametrize("channel", ["blocked", {"preset": "blocked", "persistence": "periodic"}], ids=str)
@pytest.mark.parametrize("spec", ["e_v2x_bm:estimated", "coast+robust:estimated"])
def test_own_sensors_and_messages__nor_where_an_obstacle_is_that_was_not_received(spec, channel):
    scenario = eb.load_scenario("cooperation-4-all").with_learners(["vehicle_2"]).replace(v2x=channel)
    assert changed_decisions(certified(spec, scenario), scenario, n=3 if "robust" in spec else 20) == 0


@pytest.mark.parametrize("spec", SEEING)
def test_true_state_and_model__is_not_said_without_need(spec):
    scenario = BLOCKED.replace(v2x={"preset": "paper", "hears": "front"})
    assert changed_decisions(certified(spec, scenario), scenario, vehicle=1, decisions=1, n=4) > 0
