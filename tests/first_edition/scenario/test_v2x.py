"""Who hears of whom, and when: distributions against formulas, nothing that leaks."""

import math
from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.envs.making import make_engine
from ethbrake_marl.first_edition.game.observations import observe
from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.messages import Messages, chance
from ethbrake_marl.first_edition.scenario.channel import (
    CHANNELS,
    PER_LINK,
    PRESETS,
    V2X,
    Channel,
    Equipage,
    Equipped,
    burst_periods,
)
from tests.first_edition.rest.fixture_knowledge import alter_unreceived

PAPER = eb.load_scenario("paper-random")


def channel_of(name: str, **changes: object) -> eb.Scenario:
    return PAPER.replace(v2x={"preset": name, **changes}, latency_s=0, early_impacts="keep")


def vehicles(latency_s, n=1):
    given = {"braking_capacity_mps2": 6, "driving_capacity_mps2": 6, "mass_t": 5, "restitution": 0.1}
    return eb.make_worlds(5.0, np.full((n, np.shape(latency_s)[-1]), 20.0), latency_s=latency_s, **given).vehicles


def everybody(vehicles: int) -> Equipped:
    return Equipped.of([Equipage()] * vehicles)


def slow_news(channel: Channel, own_s: list[float], links: np.ndarray) -> tuple[list[float], np.ndarray]:
    """Latencies and news of one world, link by link; ``links`` [N, N, 4]: receiver, sender, uniform numbers."""
    N, latency = len(own_s), list(own_s)
    heard, seen = np.full((N, N), math.inf), np.full((N, N), math.inf)
    low, high = channel.sensing_s
    for i in range(N):
        for j in {"all": range(N), "front": range(i), "none": ()}[channel.hears]:
            wait, burst, loss, _ = links[i, j]
            share, periods = channel.loss_begins / (channel.loss_begins + channel.loss_ends), 0
            while burst < share * (1.0 - channel.loss_ends) ** periods:
                periods += 1
            generated = (wait + periods) * channel.message_period_s
            generated += channel.radio_s + channel.processing_s + channel.actuation_s
            arrives = {"latency": -math.inf, "fixed": channel.link_latency_s, "messages": generated}[channel.timing]
            heard[i, j] = math.inf if loss < channel.lost else arrives
        for j in {"both": (i - 1, i + 1), "front": (i - 1,), "none": ()}[channel.senses]:
            if 0 <= j < N:
                seen[i, j] = low + (high - low) * links[i, j, 3]
    for i in range(1, N) if channel.timing != "latency" else ():
        latency[i] = max(latency[i], min(heard[i, 0], latency[i - 1] + seen[i, i - 1]))
    known = np.maximum(np.array(latency)[:, np.newaxis], np.minimum(heard, seen))
    known[np.arange(N), np.arange(N)] = latency
    return latency, known


@pytest.mark.parametrize(
    "given",
    [
        *PRESETS, {"hears": "front"}, {"lost": 0.3, "senses": "front"}, {"preset": "congested", "hears": "front"},
        {"preset": "blocked", "senses": "front"}, {"preset": "nominal", "link_latency_s": 0.4, "lost": 0.3},
        {"preset": "clear", "radio_s": 0.5, "processing_s": 0.25, "actuation_s": 0.125, "message_period_s": 0.3},
        {"preset": "sensors-only", "sensing_s": [0.3, 0.9]}, {"link_latency_s": 0.4, "senses": "none"},
    ],
)  # fmt: skip
def test_with_news__is_what_a_loop_over_the_links_gives(given):
    v2x, rng = V2X.model_validate(given), np.random.default_rng(6)
    u, own = rng.random((40, 16 * PER_LINK)), rng.choice([0.0, 0.2, 0.7, 1.5], (40, 4))
    u[0, 2::PER_LINK] = 0.0  # every link is lost, if any
    told = v2x.with_news(vehicles(own, 40), u, everybody(4))
    for k in range(40):
        latency, known = slow_news(v2x.channel, own[k].tolist(), u[k].reshape(4, 4, PER_LINK))
        assert told.latency_s[k] == pytest.approx(latency, rel=1e-12)
        assert told.known_from_s[k] == pytest.approx(known, rel=1e-12)


def test_observe__writing_the_papers_news_out_by_link_changes_no_bit():
    plain = PAPER.sample(50, 7).worlds
    told = Packed.of(plain).widened(obstacle=False, news=True).worlds()
    for time in (0.0, 0.3, 0.6, 1.0):
        for i in range(3):
            now = (replace(w, time_s=np.full(50, time)) for w in (plain, told))
            one, other = (observe(w, i, eb.observation_for(PAPER)) for w in now)
            assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize("latency", [0, [0, {"uniform": [0.3, 0.7]}, {"uniform": [0.5, 1.0]}]])
@pytest.mark.parametrize("obstacle", [False, True])
@pytest.mark.parametrize("name", ["blocked", "congested", "sensors-only"])
def test_observe__what_is_not_known_changes_no_bit(name, obstacle, latency):
    scenario = channel_of(name).replace(latency_s=latency)
    scenario = scenario.replace(obstacle_gap_m={"uniform": [30, 50]}) if obstacle else scenario
    start, spec, rng, seen = scenario.sample(400, 5).worlds, eb.observation_for(scenario), np.random.default_rng(1), 0
    at = [7, 17] + [k for k, feature in enumerate(spec.features) if feature.name == "obstacle.known"]
    for time in (0.0, 0.5, 0.8, 1.0, 1.5):
        worlds, _ = eb.advance(start, -3.0, until_s=time)
        for i in [1] if obstacle else range(3):  # from the ends the way to it goes over gaps that are altered
            assert observe(worlds, i, spec).tobytes() == observe(alter_unreceived(worlds, i, rng), i, spec).tobytes()
        unknown = worlds.vehicles.known_from_s[:, 1][:, [0, 2, 0]] > time
        assert (observe(worlds, 1, spec)[:, at] == ~unknown[:, : len(at)]).all()
        seen += int(unknown.sum())
    assert seen > 600


def test_engine__takes_worlds_with_and_without_news_by_link():
    plain = PAPER.sample(20, 7).worlds
    running = make_engine(channel_of("nominal"), 20)
    running.reset(worlds=plain)
    assert running.packed.known_from_s.tolist() == plain.vehicles.known_from_s.tolist()
    running.renew(np.array([0]))
    running.step(np.zeros((20, 1)))
    of_paper = make_engine(PAPER, 20)
    of_paper.reset(worlds=channel_of("nominal").sample(20, 7).worlds)
    of_paper.renew(np.array([0]))
    assert of_paper.packed.known_from_s[0].tolist() == plain.vehicles.known_from_s[0].tolist()


@pytest.mark.parametrize(("name", "latest"), [("clear", 5.22), ("nominal", 5.42)])
def test_v2x__where_nothing_is_lost_the_longest_burst_bounds_the_news(name, latest):
    # 48 and 50 periods, in which the share of a burst falls below 2^-53; one of waiting; 20 + 100 + 200 ms.
    v2x = V2X(preset=name)
    assert v2x.latest_reaction_s(np.zeros(12), everybody(12)).tolist()[5:] == pytest.approx([latest] * 7)
    u = np.random.default_rng(3).random((2_000, 144 * PER_LINK))
    u.reshape(2_000, 144, PER_LINK)[:1_000, :, 1] = 0.0  # the longest bursts everywhere
    drawn = v2x.with_news(vehicles([0.0] * 12, 2_000), u, everybody(12)).latency_s
    assert (drawn <= v2x.latest_reaction_s(np.zeros(12), everybody(12))).all() and drawn.max() > latest - 0.1


# ---------------------------------------------------------------- messages that go on

BASE = eb.load_scenario("cooperation-2-paper").replace(early_impacts="keep")
AGED = ["own", "front_1", "rear_1", "front_1.age", "rear_1.age"]


def periodic(preset: str = "nominal", base: eb.Scenario = BASE, **changes: object) -> eb.Scenario:
    return base.replace(v2x={"preset": preset, "persistence": "periodic", **changes})


def first_only(scenario: eb.Scenario) -> eb.Scenario:
    return scenario.replace(v2x={**scenario.v2x.model_dump(exclude_none=True), "persistence": "first"})


def engine_of(scenario: eb.Scenario, n: int = 6, first: int = 0) -> eb.Engine:
    worlds = scenario.sample(n, 7, first=first).worlds
    scripts = script_agents(scenario, except_for=scenario.learners)
    return eb.Engine(scenario, n, learners=scenario.learners, scripts=scripts, worlds=worlds)


def driven(engine: eb.Engine, steps: int) -> list[np.ndarray]:
    seen = [engine.observe_all(np.arange(engine.scenario.vehicles))]
    for _ in range(steps):
        engine.step(np.full((engine.n, len(engine.learners)), -0.6))
        seen.append(engine.observe_all(np.arange(engine.scenario.vehicles)))
    return seen


def ages_in(worlds):
    return Messages.of(worlds).age_s(worlds.time_s)


def test_periodic__in_sight_what_is_seen_is_what_first_shows() -> None:
    scenario = periodic(sensing_s=[0.0, 0.0])
    for one, other in zip(driven(engine_of(scenario), 15), driven(engine_of(first_only(scenario)), 15), strict=True):
        np.testing.assert_array_equal(one[:, 1], other[:, 1])


@pytest.mark.parametrize(("p", "r"), [(0.05, 0.5), (0.2, 0.2), (0.3, 0.7)])
def test_losses__go_on_with_the_share_and_the_bursts_of_the_channel(p: float, r: float) -> None:
    # Of messages 0.1 s apart the newest that arrived is sent m periods ago where the last m were lost.
    channel = {"loss_begins": p, "loss_ends": r, "lost": 0.0, "radio_s": 0.0, "senses": "front", "sensing_s": [7, 7]}
    engine = engine_of(periodic(base=BASE.replace(horizon_s=30.0), **channel), n=4000)
    for _ in range(30):
        engine.step(np.full((4000, 1), -1.0))
    lost = np.rint((ages_in(engine.worlds)[:, 2, 0] - 0.4) / 0.1)  # sent 0.3 to 0.4 s ago, sampled 0.4
    for m in (1, 2, 4):
        share = (lost >= m).mean()
        assert share == pytest.approx(p / (p + r) * (1 - r) ** (m - 1), abs=0.025)


@pytest.mark.parametrize("vehicles", [2, 3, 6])
def test_periodic__a_world_alone_hears_what_it_hears_in_a_batch(vehicles: int) -> None:
    base = eb.load_scenario("paper-random").replace(
        vehicles=vehicles, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0, mass_t=5.0, latency_s=0.1,
        roles={"vehicle_2": "learner"},
    )  # fmt: skip
    scenario = periodic("congested", base)
    whole, alone = driven(engine_of(scenario, 9), 12), driven(engine_of(scenario, 1, first=4), 12)
    for one, other in zip(whole, alone, strict=True):
        np.testing.assert_array_equal(one[4], other[0])


def test_obstacle__is_known_as_it_was_told_and_stands_where_it_stands() -> None:
    base = eb.load_scenario("cooperation-4-all").replace(early_impacts="keep")
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
    base = BASE.replace(horizon_s=30.0, observation=AGED)
    engine = engine_of(periodic("blocked", base, senses="front", sensing_s=[5.0, 5.0], lost=0.0), 30)
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


def delayed(gaps_m):
    base = BASE.replace(gaps_m=gaps_m, speeds_mps=[20.0, 20.0, 20.0])
    return engine_of(periodic("paper", base, link_latency_s=0.2, senses="front", sensing_s=[5.0, 5.0]), n=1)


def test_burst_periods__by_hand() -> None:
    # The periods of a burst, p = r = 0.5: P(k >= 1) = 1/2, P(k >= 2) = 1/4, P(k >= 3) = 1/8; all exact in binary.
    u = np.array([0.5, 0.4999, 0.25, 0.2499, 0.125, 0.1249, 0.99])
    assert burst_periods(u, 0.5, 0.5).tolist() == [0, 1, 1, 2, 2, 3, 0]
    assert burst_periods(u, 0.0, 0.5).tolist() == [0, 0, 0, 0, 0, 0, 0]
    assert burst_periods(np.array([0.0]), 0.5, 1.0).tolist() == [1]


def test_channels__are_those_of_the_page() -> None:
    assert [(name, *channel[:-1]) for name, channel in CHANNELS.items() if channel.tells is None] == [
        ("paper", "latency", "all", "none", 0.0, 0.0, 1.0, 0.0, 0.1, 0.02, 0.1, 0.2, (0.8, 1.1), "first"),
        ("clear", "messages", "all", "both", 0.0, 0.01, 0.5, 0.0, 0.1, 0.02, 0.1, 0.2, (0.8, 1.1), "first"),
        ("nominal", "messages", "all", "both", 0.0, 0.05, 0.5, 0.0, 0.1, 0.02, 0.1, 0.2, (0.8, 1.1), "first"),
        ("congested", "messages", "all", "both", 0.0, 0.1, 0.3, 0.05, 0.1, 0.02, 0.1, 0.2, (0.8, 1.1), "first"),
        ("blocked", "messages", "all", "both", 0.0, 0.2, 0.2, 0.2, 0.1, 0.02, 0.1, 0.2, (0.8, 1.1), "first"),
        ("sensors-only", "messages", "none", "both", 0.0, 0.0, 1.0, 0.0, 0.1, 0.02, 0.1, 0.2, (0.8, 1.1), "first"),
    ]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("paper", (False, False)),
        ("nominal", (True, True)),
        ("sensors-only", (True, True)),
        ({"preset": "sensors-only", "sensing_s": [0.9, 0.9]}, (True, False)),
        ({"hears": "front"}, (True, False)),
        ({"lost": 0.5}, (True, True)),
        ({"lost": 1.0}, (True, False)),
        ({"preset": "nominal", "link_latency_s": 0.4}, (True, True)),
        ({"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1]}, (True, False)),
        ({"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1], "lost": 0.5}, (True, True)),
        ({"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1], "lost": 1.0}, (True, False)),
        ({"link_latency_s": 0.4, "senses": "none"}, (True, False)),
    ],
)
def test_channel__says_whether_it_differs_from_the_paper_and_whether_chance_decides(given, expected) -> None:
    v2x = V2X.model_validate(given)
    assert (v2x.by_link, v2x.drawn) == expected


def test_observation__tells_own_parts_of_latencies_and_nothing_that_was_drawn() -> None:
    # An observation tells own parts of latencies, and nothing that the channel has drawn: Vehicle 2 knows Vehicle 3
    # from 0.4 s on; Vehicle 3's own part is 0.5 s, Vehicle 1's message reaches it at 0.9 s. Of each time, what
    # Vehicle 2 is told to be left of its own latency and of that of Vehicle 3.
    scenario = PAPER.replace(v2x="congested", latency_s=[0, 0.1, 0.5], early_impacts="keep")
    worlds, spec = scenario.sample(1, 7).worlds, eb.observation_for(scenario)
    worlds.vehicles.latency_s[0] = [0.0, 0.4, 0.9]
    worlds.vehicles.known_from_s[0] = [[0.0, 0.8, 0.8], [0.4, 0.4, 0.4], [0.9, 0.9, 0.9]]
    assert worlds.vehicles.own_latency_s.tolist() == [[0.0, 0.1, 0.5]]
    at = [5, [feature.name for feature in spec.features].index("rear_1.latency_left")]
    assert [
        observe(replace(worlds, time_s=np.full(1, time)), 1, spec)[0, at].astype(float).round(6).tolist()
        for time in (0.0, 0.4, 0.6, 0.95)
    ] == [[0.1, 0.0], [0.0, 0.1], [0.0, 0.0], [0.0, 0.0]]


def test_fixed_delay__tells_what_was_sent_and_moves_it_on() -> None:
    # All at 20 m/s; one message every 0.1 s from the alert on, 0.2 s on its way, decisions at 0.5, 0.6, ..., and who
    # is behind is not in sight. Each message carries the sample of the moment at which it is sent, so whatever is
    # known is 0.2 s old: sent at t, a speed of 20 - 6 t and a place of 20 t - 3 t^2, since Vehicle 1 brakes with 6
    # from the alert on. Moved on with the command of then, it is where Vehicle 1 is.
    engine = delayed([8.0, 8.0])
    for step in range(6):
        told, gap_m = Messages.of(engine.worlds).newest_told(1), engine.worlds.gaps_m[0, 0]
        sent = 0.3 + 0.1 * step
        assert engine.worlds.time_s[0] == pytest.approx(sent + 0.2)
        known = [told.at_s[0, 0], told.speed_mps[0, 0], told.place_m[0, 0]]
        assert known == pytest.approx([sent, 20.0 - 6.0 * sent, 20.0 * sent - 3.0 * sent**2])
        assert abs(engine.observe(1)[0, 8] - gap_m / 10.0) <= 1e-6
        engine.step(np.full((1, 1), -0.5))
    # Vehicle 3 begins to brake at 0.8 s; at 0.9 s Vehicle 2 knows it as it was at 0.7 s, coasting, at 1 s as at 0.8
    # s: an estimate moves on with the command of then. It is 9 m + 3 x 0.1^2 behind.
    engine = delayed([8.0, 9.0])
    for _ in range(4):
        engine.step(np.zeros((1, 1)))
    seen = engine.observe(1)[0].astype(float)
    assert round(float(engine.worlds.time_s[0]), 6) == 0.9
    assert seen[18:20].round(6).tolist() == [0.9, 0.0]
    assert float(seen[20]) == 0.0
    assert round(float(engine.worlds.gaps_m[0, 1]), 6) == 9.03


def test_periodic__the_first_news_and_the_motion_are_those_of_first() -> None:
    scenario = periodic("blocked")
    one, other = engine_of(scenario), engine_of(first_only(scenario))
    assert np.array_equal(one.packed.known_from_s, other.packed.known_from_s)
    driven(one, 20), driven(other, 20)
    assert np.array_equal(one.worlds.speeds_mps, other.worlds.speeds_mps)
    assert np.array_equal(one.worlds.gaps_m, other.worlds.gaps_m)


def test_chance__is_uniform_and_of_its_own_for_every_link_and_message() -> None:
    u = np.array([[[chance(key, link, number) for number in range(40)] for link in range(9)] for key in
                  (0.0, 1.0, 2.0**53 - 1)])  # fmt: skip
    assert len(np.unique(u)) == u.size
    assert (u >= 0.0).all()
    assert (u < 1.0).all()
    assert abs(u.mean() - 0.5) < 0.03
    assert abs(np.corrcoef(u[0, :, :-1].ravel(), u[0, :, 1:].ravel())[0, 1]) < 0.1
