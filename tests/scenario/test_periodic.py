"""Periodic messages: when they arrive, what they carry, how it grows old; and that ``first`` stays what it was."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest

from ethbrake_marl.agents.registry import script_agents
from ethbrake_marl.engine import Engine
from ethbrake_marl.envs.interfaces import parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import worlds_sha256
from ethbrake_marl.observations import choose_observation
from ethbrake_marl.physics.messages import CHANNEL, Messages, chance
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.scenario.v2x import CHANNELS

BASE = load_scenario("cooperation-2-paper").replace(early_impacts="keep")
AGED = ["own", "front_1", "rear_1", "front_1.age", "rear_1.age"]


def periodic(preset: str = "nominal", base: Scenario = BASE, **changes: object) -> Scenario:
    return base.replace(v2x={"preset": preset, "persistence": "periodic", **changes})


def first_only(scenario: Scenario) -> Scenario:
    given = scenario.v2x.model_dump(exclude_none=True)
    return scenario.replace(v2x={**given, "persistence": "first"})


def engine_of(scenario: Scenario, n: int = 6, seed: int = 7, rows: object = None) -> Engine:
    worlds = scenario.sample(n, seed).worlds
    if rows is not None:
        worlds = worlds.take(rows)
    learners = list(scenario.learners)
    scripts = script_agents(scenario, except_for=learners)
    return Engine(scenario, worlds.n, learners=learners, scripts=scripts, worlds=worlds)


def driven(engine: Engine, steps: int, action: float = -0.6) -> list[np.ndarray]:
    seen = [engine.observe_all(np.arange(engine.scenario.vehicles))]
    for _ in range(steps):
        engine.step(np.full((engine.n, len(engine.learners)), action))
        seen.append(engine.observe_all(np.arange(engine.scenario.vehicles)))
    return seen


def ages_in(worlds):
    return Messages.of(worlds).age_s(worlds.time_s)


def test_persistence__first_is_the_default_and_adds_nothing() -> None:
    said, unsaid = BASE.replace(v2x={"preset": "blocked", "persistence": "first"}), BASE.replace(v2x="blocked")
    one, other = said.sample(50, 3), unsaid.sample(50, 3)
    assert one.worlds.messages.shape == (50, 0)
    assert worlds_sha256(one.worlds, one.index) == worlds_sha256(other.worlds, other.index)
    assert "persistence" not in unsaid.v2x.model_dump(mode="json")


def test_periodic__the_first_news_and_the_motion_are_those_of_first() -> None:
    scenario = periodic("blocked")
    one, other = engine_of(scenario), engine_of(first_only(scenario))
    assert np.array_equal(one.packed.known_from_s, other.packed.known_from_s)
    driven(one, 20), driven(other, 20)
    assert np.array_equal(one.worlds.speeds_mps, other.worlds.speeds_mps)
    assert np.array_equal(one.worlds.gaps_m, other.worlds.gaps_m)


def test_periodic__in_sight_what_is_seen_is_what_first_shows() -> None:
    scenario = periodic(sensing_s=[0.0, 0.0])
    for one, other in zip(driven(engine_of(scenario), 15), driven(engine_of(first_only(scenario)), 15), strict=True):
        np.testing.assert_array_equal(one[:, 1], other[:, 1])


def test_fixed_delay_without_loss__by_hand() -> None:
    # One message every 0.1 s from the alert on, 0.2 s on its way, decisions at 0.5, 0.6, ...: each carries the sample
    # of the moment at which it is sent, so whatever is known is 0.2 s old. Vehicle 1 brakes with 6 from the alert on.
    base = BASE.replace(gaps_m=[8.0, 8.0], speeds_mps=[20.0, 20.0, 20.0])
    engine = engine_of(periodic("paper", base, link_latency_s=0.2, senses="front", sensing_s=[5.0, 5.0]), n=1)
    for step in range(6):
        time = 0.5 + 0.1 * step
        told = Messages.of(engine.worlds).newest_told(1)
        assert engine.worlds.time_s[0] == pytest.approx(time)
        assert told.at_s[0, 0] == pytest.approx(time - 0.2)
        assert told.speed_mps[0, 0] == pytest.approx(20.0 - 6.0 * (time - 0.2))
        assert told.place_m[0, 0] == pytest.approx(20.0 * (time - 0.2) - 3.0 * (time - 0.2) ** 2)
        seen = engine.observe(1)[0]  # moved on with the command of then, it is where Vehicle 1 is
        assert seen[8] == pytest.approx(engine.worlds.gaps_m[0, 0] / 10.0, abs=1e-6)
        engine.step(np.full((1, 1), -0.5))


def test_estimate__moves_on_with_the_command_of_then() -> None:
    # Vehicle 3 begins to brake at 0.8 s; at 0.9 s Vehicle 2 knows it as it was at 0.7 s, coasting, at 1 s as at 0.8 s.
    base = BASE.replace(gaps_m=[8.0, 9.0], speeds_mps=[20.0, 20.0, 20.0])
    engine = engine_of(periodic("paper", base, link_latency_s=0.2, senses="front", sensing_s=[5.0, 5.0]), n=1)
    for _ in range(4):
        engine.step(np.zeros((1, 1)))
    assert engine.worlds.time_s[0] == pytest.approx(0.9)
    seen = engine.observe(1)[0]
    assert seen[18] == pytest.approx(0.9) and seen[19] == pytest.approx(0.0) and seen[20] == 0.0
    assert engine.worlds.gaps_m[0, 1] == pytest.approx(9.0 + 0.5 * 6.0 * 0.1**2)


@pytest.mark.parametrize(("p", "r"), [(0.05, 0.5), (0.2, 0.2), (0.3, 0.7)])
def test_losses__go_on_with_the_share_and_the_bursts_of_the_channel(p: float, r: float) -> None:
    # Of messages 0.1 s apart the newest that arrived is sent m periods ago where the last m were lost.
    base = BASE.replace(horizon_s=30.0)
    scenario = periodic(
        base=base, loss_begins=p, loss_ends=r, radio_s=0.0, senses="front", sensing_s=[7.0, 7.0], lost=0.0
    )
    engine = engine_of(scenario, n=8000)
    for _ in range(30):
        engine.step(np.full((8000, 1), -1.0))
    lost = np.rint((ages_in(engine.worlds)[:, 2, 0] - 0.4) / 0.1)  # sent 0.3 to 0.4 s ago, sampled 0.4
    for m in (1, 2, 4):
        share = (lost >= m).mean()
        assert share == pytest.approx(p / (p + r) * (1 - r) ** (m - 1), abs=0.02)


def test_chance__is_uniform_and_of_its_own_for_every_link_and_message() -> None:
    u = np.array([[[chance(key, link, number) for number in range(40)] for link in range(9)] for key in
                  (0.0, 1.0, 2.0**53 - 1)])  # fmt: skip
    assert len(np.unique(u)) == u.size
    assert (u >= 0.0).all() and (u < 1.0).all() and abs(u.mean() - 0.5) < 0.03
    assert abs(np.corrcoef(u[0, :, :-1].ravel(), u[0, :, 1:].ravel())[0, 1]) < 0.1


@pytest.mark.parametrize("vehicles", [2, 3, 6])
def test_periodic__a_world_alone_hears_what_it_hears_in_a_batch(vehicles: int) -> None:
    base = load_scenario("paper-random").replace(
        vehicles=vehicles, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0, mass_t=5.0, latency_s=0.1,
        roles={"vehicle_2": "learner"},
    )  # fmt: skip
    scenario = periodic("congested", base)
    whole, alone = driven(engine_of(scenario, 9), 12), driven(engine_of(scenario, 9, rows=[4]), 12)
    for one, other in zip(whole, alone, strict=True):
        np.testing.assert_array_equal(one[4], other[0])


def test_resume__goes_on_to_the_same_bits() -> None:
    scenario = periodic("congested")
    one, other = engine_of(scenario), engine_of(scenario, seed=8)
    driven(one, 4)
    other.restore(one.snapshot())
    for left, right in zip(driven(one, 10), driven(other, 10), strict=True):
        np.testing.assert_array_equal(left, right)
    assert np.array_equal(one.worlds.messages, other.worlds.messages)


def test_obstacle__is_known_as_it_was_told_and_stands_where_it_stands() -> None:
    base = load_scenario("cooperation-4-all").replace(early_impacts="keep")
    engine = engine_of(periodic("nominal", base, senses="front", sensing_s=[5.0, 5.0]), n=20)
    at = [feature.name for feature in engine.observation.features].index("obstacle.gap")
    for _ in range(10):
        worlds, seen = engine.worlds, engine.observe(1)
        known = worlds.vehicles.known_from_s[:, 1, 0] <= worlds.time_s
        true = worlds.obstacle_gap_m + worlds.gaps_m[:, 0]
        np.testing.assert_allclose(seen[known, at], true[known] / 10.0, rtol=1e-6)
        engine.step(np.full((20, 3), -0.9))
    assert known.all()


def test_age__is_a_feature_that_grows_between_messages() -> None:
    scenario = periodic("blocked", senses="front", sensing_s=[5.0, 5.0], lost=0.0, base=BASE.replace(horizon_s=30.0))
    spec = choose_observation(AGED)
    scripts = script_agents(scenario, except_for=1)
    engine = Engine(scenario, 30, learners=[1], scripts=scripts, worlds=scenario.sample(30, 7).worlds, observation=spec)
    ages = []
    for _ in range(20):
        seen, told = engine.observe(1), ages_in(engine.worlds)[:, 1]
        known = seen[:, 7] == 1.0
        np.testing.assert_allclose(seen[known, 27], told[known, 0], atol=1e-6)
        assert (seen[~known, 27] == 0.0).all() and (seen[known, 27] > 0.3).all()
        ages.append(seen[:, 27])
        engine.step(np.full((30, 1), -0.5))
    growth = np.diff(np.array(ages), axis=0)
    assert (growth > 0.09).any() and (growth < -0.05).any()


def test_age__reads_0_over_a_channel_whose_news_stays_present() -> None:
    scenario = BASE.replace(v2x="blocked", observation=AGED)
    assert (np.array(driven(engine_of(scenario), 10))[..., 27:] == 0.0).all()


def test_interfaces__see_the_same() -> None:
    scenario = periodic("congested", base=BASE.replace(observation=AGED))
    env = parallel_env(scenario=scenario)
    seen, _ = env.reset(seed=5)
    engine = env.unwrapped.engine
    assert Messages.of(engine.worlds).periodic.all() and not (engine.worlds.messages[:, CHANNEL.KEY] == 0.0).any()
    for _ in range(5):
        seen, *_, infos = env.step({"vehicle_2": np.array([-0.5], np.float32)})
    np.testing.assert_array_equal(seen["vehicle_2"], engine.observe(1)[0])
    np.testing.assert_array_equal(infos["vehicle_2"]["age_s"], ages_in(engine.worlds)[0, 1])
    many = gymnasium.make_vec("EthBrake-v0", num_envs=3, scenario=scenario)
    _, told = many.reset(seed=5)
    assert told["age_s"].shape == (3, 3) and (told["age_s"][:, 1] == 0.0).all()
    vec = make_sb3_vec_env(scenario, 3, seed=5)
    alike = vec.reset()
    for _ in range(90):  # through an automatic reset
        alike, _, _, _ = vec.step(np.full((3, 1), -0.5, np.float32))
    np.testing.assert_array_equal(alike, vec.engine.observe(1))
    assert np.isfinite(alike).all() and vec.reset_infos[0]["age_s"].shape == (3,)


@pytest.mark.parametrize(
    ("v2x", "words"),
    [
        ({"preset": "paper", "persistence": "periodic"}, "persistence = periodic: nobody sends"),
        ({"preset": "sensors-only", "persistence": "periodic"}, "persistence = periodic: nobody sends"),
        ({"preset": "nominal", "persistence": "always"}, "persistence"),
        ({"preset": "paper", "link_latency_s": 0.1, "loss_begins": 0.2}, "loss_begins = 0.2: a fixed"),
        ({"preset": "nominal", "persistence": "periodic", "radio_s": 1e-3, "actuation_s": 2.0, "lost": 0.0}, None),
    ],
)
def test_persistence__what_cannot_be_is_refused(v2x: dict[str, object], words: str | None) -> None:
    if words is None:
        BASE.replace(v2x=v2x)
        return
    with pytest.raises(InvalidInput, match=words):
        BASE.replace(v2x=v2x)


def test_persistence__a_delay_of_too_many_steps_is_refused() -> None:
    with pytest.raises(InvalidInput, match="on its way for 3200 time steps; at most 997"):
        periodic(base=BASE.replace(time_step_s=1e-4))


def test_given_states__need_a_channel_without_chance() -> None:
    assert CHANNELS["nominal"].persistence == "first" and math.isfinite(CHANNELS["nominal"].delay_s)
    env = parallel_env(scenario=periodic())
    with pytest.raises(InvalidInput, match="the scenario draws what each vehicle knows when"):
        env.reset(options={"initial_state": {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}})


def test_mixture__its_scenarios_share_the_persistence() -> None:
    members = [
        {"scenario": {**load_scenario(name).declared(), "v2x": v2x}}
        for name, v2x in (
            ("paper-random", {"preset": "nominal", "persistence": "periodic"}),
            ("paper-random-brake-only", "nominal"),
        )
    ]
    with pytest.raises(InvalidInput, match=r"v2x\.persistence must be the same in all"):
        Scenario(name="mixed", mixture=members)
    members[1]["scenario"]["v2x"] = {"preset": "blocked", "persistence": "periodic"}
    mixed = Scenario(name="mixed", mixture=members)
    assert Messages.of(mixed.sample(30, 3).worlds).periodic.all()
    driven(engine_of(mixed), 5)
