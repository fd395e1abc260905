"""Who hears of whom, and when: distributions against their formulas, the news by hand, and nothing that leaks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.envs.interfaces import parallel_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import observe
from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.physics.batch import Packed
from ethbrake_marl.physics.kernel import CLOCK
from ethbrake_marl.scenario import Scenario, full_state, load_scenario, observation_for, state_features
from ethbrake_marl.scenario.v2x import CHANNELS, PER_LINK, PRESETS, V2X, Channel, burst_periods, link_delays
from ethbrake_marl.search import identities

PAPER = load_scenario("paper-random")
MESSAGES = [name for name in PRESETS if CHANNELS[name].timing == "messages"]
RADIO = [name for name in MESSAGES if CHANNELS[name].hears == "all"]


def channel_of(name: str, **changes: object) -> Scenario:
    return PAPER.replace(v2x={"preset": name, **changes}, latency_s=0, early_impacts="keep")


def vehicles(latency_s, n=1):
    given = {"braking_capacity_mps2": 6, "driving_capacity_mps2": 6, "mass_t": 5, "restitution": 0.1}
    return make_worlds(5.0, np.full((n, np.shape(latency_s)[-1]), 20.0), latency_s=latency_s, **given).vehicles


@pytest.mark.parametrize("name", RADIO)
def test_burst_periods__have_the_share_of_their_formula(name):
    p, r = CHANNELS[name].loss_begins, CHANNELS[name].loss_ends
    periods = burst_periods(np.random.default_rng(3).random(1_000_000), p, r)
    for k in range(1, 12):
        assert (periods >= k).mean() == pytest.approx(p / (p + r) * (1 - r) ** (k - 1), abs=0.01)
    assert periods.min() == 0 and periods.max() >= 5


def test_burst_periods__at_the_bounds_by_hand():
    # p = r = 0.5: P(k >= 1) = 1/2, P(k >= 2) = 1/4, P(k >= 3) = 1/8; all exact in binary.
    u = np.array([0.5, 0.4999, 0.25, 0.2499, 0.125, 0.1249, 0.99])
    assert burst_periods(u, 0.5, 0.5).tolist() == [0, 1, 1, 2, 2, 3, 0]
    assert burst_periods(u, 0.0, 0.5).tolist() == [0] * 7
    assert burst_periods(np.array([0.0]), 0.5, 1.0).tolist() == [1]


@pytest.mark.parametrize("name", RADIO)
def test_link_delays__of_10_to_the_6_links_follow_the_model(name):
    channel = CHANNELS[name]
    delay = link_delays(channel, np.random.default_rng(4).random((1_000_000, PER_LINK)))
    assert np.isinf(delay).mean() == pytest.approx(channel.lost, abs=0.01)
    periods = (delay[np.isfinite(delay)] - 0.02 - 0.1 - 0.2) / 0.1  # U(0, 1) + k
    assert periods.min() >= -1e-9
    p, r = channel.loss_begins, channel.loss_ends
    for k in range(1, 8):
        assert (periods >= k).mean() == pytest.approx(p / (p + r) * (1 - r) ** (k - 1), abs=0.01)
    wait = periods % 1.0
    assert np.histogram(wait, 10, (0, 1))[0] / wait.size == pytest.approx(np.full(10, 0.1), abs=0.01)


def test_link_delays__by_hand():
    # wait 0.25 periods, one period lost, 20 + 100 + 200 ms; then a link that is lost, and a fixed one.
    u = np.array([[0.25, 0.1, 0.9, 0.0], [0.25, 0.1, 0.05, 0.0]])
    channel = CHANNELS["congested"]._replace(loss_begins=0.5, loss_ends=0.5)
    channel = channel._replace(lost=0.1)
    assert link_delays(channel, u)[0] == pytest.approx((0.25 + 3) * 0.1 + 0.32)  # 0.1 < 1/8: k = 3
    assert link_delays(channel, u)[1] == np.inf
    assert link_delays(channel._replace(timing="fixed", link_latency_s=0.3), u).tolist() == [0.3, np.inf]


def test_with_news__sight_goes_hop_by_hop():
    # hops drawn at the middle: 0.95 s each; nobody hears anything.
    u = np.full((1, 9 * PER_LINK), 0.5)
    told = V2X.model_validate("sensors-only").with_news(vehicles([0.0, 0.1, 2.5]), u)
    assert told.latency_s.tolist() == [[0.0, pytest.approx(0.95), 2.5]]  # 0.95 + 0.95 < 2.5, its own part
    known = told.known_from_s[0]
    assert known[0].tolist() == [0.0, pytest.approx(0.95), np.inf]
    assert known[1].tolist() == [pytest.approx(0.95)] * 3
    assert known[2].tolist() == [np.inf, 2.5, 2.5]
    assert told.own_latency_s.tolist() == [[0.0, 0.1, 2.5]]


def test_with_news__news_of_the_emergency_comes_by_radio_or_by_sight():
    v2x = V2X.model_validate({"preset": "nominal", "link_latency_s": 0.4, "loss_begins": None})
    u = np.full((1, 9 * PER_LINK), 0.5)
    told = v2x.with_news(vehicles([0.0, 0.1, 0.6]), u)
    assert told.latency_s.tolist() == [[0.0, 0.4, 0.6]]
    assert told.known_from_s[0].tolist() == [[0.0, 0.4, 0.4], [0.4, 0.4, 0.4], [0.6, 0.6, 0.6]]
    links = u.reshape(9, PER_LINK).copy()
    links[2 * 3 + 0, 2] = 0.0  # the link from vehicle_1 to vehicle_3 is lost
    lossy = V2X.model_validate({"preset": "nominal", "link_latency_s": 0.4, "lost": 0.1})
    told = lossy.with_news(vehicles([0.0, 0.1, 0.6]), links.reshape(1, -1))
    assert told.latency_s.tolist() == [[0.0, 0.4, pytest.approx(0.4 + 0.95)]]
    assert told.known_from_s[0, 2].tolist() == [np.inf, pytest.approx(1.35), pytest.approx(1.35)]


def test_with_news__front_news_only_at_the_papers_times():
    told = V2X.model_validate({"hears": "front"}).with_news(vehicles([0.0, 0.5, 0.8]), np.zeros((1, 36)))
    assert told.latency_s.tolist() == [[0.0, 0.5, 0.8]]
    assert told.known_from_s[0].tolist() == [[0.0, np.inf, np.inf], [0.5, 0.5, np.inf], [0.8, 0.8, 0.8]]


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
    told = v2x.with_news(vehicles(own, 40), u)
    for k in range(40):
        latency, known = slow_news(v2x.channel, own[k].tolist(), u[k].reshape(4, 4, PER_LINK))
        assert told.latency_s[k] == pytest.approx(latency, rel=1e-12)
        assert told.known_from_s[k] == pytest.approx(known, rel=1e-12)


def test_channels__are_those_of_the_page():
    usual = ("all", "both", 0.0)
    rest = (0.1, 0.02, 0.1, 0.2, (0.8, 1.1), "first")
    assert {name: tuple(channel) for name, channel in CHANNELS.items()} == {
        "paper": ("latency", "all", "none", 0.0, 0.0, 1.0, 0.0, *rest),
        "clear": ("messages", *usual, 0.01, 0.5, 0.0, *rest),
        "nominal": ("messages", *usual, 0.05, 0.5, 0.0, *rest),
        "congested": ("messages", *usual, 0.1, 0.3, 0.05, *rest),
        "blocked": ("messages", *usual, 0.2, 0.2, 0.2, *rest),
        "sensors-only": ("messages", "none", "both", 0.0, 0.0, 1.0, 0.0, *rest),
    }


@pytest.mark.parametrize(
    ("given", "by_link", "drawn"),
    [
        ("paper", False, False),
        ("nominal", True, True),
        ("sensors-only", True, True),
        ({"preset": "sensors-only", "sensing_s": [0.9, 0.9]}, True, False),
        ({"hears": "front"}, True, False),
        ({"lost": 0.5}, True, True),
        ({"lost": 1.0}, True, False),
        ({"preset": "nominal", "link_latency_s": 0.4}, True, True),  # the hops
        ({"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1]}, True, False),
        ({"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1], "lost": 0.5}, True, True),
        ({"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1], "lost": 1.0}, True, False),
        ({"link_latency_s": 0.4, "senses": "none"}, True, False),
    ],
)
def test_v2x__says_whether_it_differs_from_the_paper_and_whether_chance_decides(given, by_link, drawn):
    v2x = V2X.model_validate(given)
    assert (v2x.by_link, v2x.drawn) == (by_link, drawn)


def test_paper__is_the_rule_of_the_own_latency():
    plain, named = PAPER.sample(50, 7).worlds, PAPER.replace(v2x="paper").sample(50, 7).worlds
    for vehicles in (plain.vehicles, named.vehicles):
        assert vehicles.own_latency_s.tolist() == vehicles.latency_s.tolist() == [[0.0, 0.5, 0.8]] * 50
        assert vehicles.known_from_s.tolist() == [[[0.0] * 3, [0.5] * 3, [0.8] * 3]] * 50
    assert named.gaps_m.tobytes() == plain.gaps_m.tobytes()


@pytest.mark.parametrize("name", MESSAGES)
def test_sample__a_world_alone_has_the_same_news_and_the_line_of_the_paper(name):
    scenario = channel_of(name)
    many, alone = scenario.sample(30, 7).worlds, scenario.sample(1, 7, first=17).worlds
    assert many.vehicles.known_from_s[17].tobytes() == alone.vehicles.known_from_s[0].tobytes()
    assert many.vehicles.latency_s[17].tobytes() == alone.vehicles.latency_s[0].tobytes()
    same = PAPER.replace(early_impacts="keep").sample(30, 7).worlds
    assert many.gaps_m.tobytes() == same.gaps_m.tobytes() and many.speeds_mps.tobytes() == same.speeds_mps.tobytes()
    other = scenario.sample(30, 7, channel="training").worlds
    assert (many.vehicles.known_from_s[:, 1] != other.vehicles.known_from_s[:, 1]).all()
    for k in range(3):  # of itself a vehicle knows from its latency on, whatever the channel does
        assert many.vehicles.known_from_s[:, k, k].tobytes() == many.vehicles.latency_s[:, k].tobytes()
    assert (many.vehicles.own_latency_s == 0.0).all()


def exchanged(of, values, rng):
    """``values`` [n, ...] with the entries ``of`` exchanged between the worlds, and made 0.7 later."""
    other = values.copy()
    for at in np.ndindex(values.shape[1:]):
        rows = np.flatnonzero(of[(slice(None), *at)])
        other[(rows, *at)] = values[(rng.permutation(rows), *at)] + 0.7
    return other


def shuffled(worlds, vehicle):
    """The worlds with everything exchanged between them that ``vehicle`` does not know yet.

    So also all that the channel has in store: news to come, and latencies of those who have not reacted.
    """
    unknown = unknown_to(vehicle, worlds)
    lines = np.random.default_rng(1).permutation(worlds.n)
    changed = {}
    for name in ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "speed_limit_mps"):
        column = getattr(worlds.vehicles, name)
        changed[name] = np.where(unknown, column[lines] * 1.5, column)
    changed |= other_future(worlds, unknown)
    gaps = np.where(unknown[:, [0, 2]], worlds.gaps_m[lines] + 3.0, worlds.gaps_m)
    return replace(
        worlds,
        vehicles=replace(worlds.vehicles, **changed),
        gaps_m=gaps,
        speeds_mps=np.where(unknown, worlds.speeds_mps[lines] * 0.5, worlds.speeds_mps),
        command_mps2=np.where(unknown, -1.0, worlds.command_mps2),
        pair_hit=np.where(unknown[:, [0, 2]], True, worlds.pair_hit),
        obstacle_gap_m=np.where(unknown[:, 0], worlds.obstacle_gap_m[lines] + 5.0, worlds.obstacle_gap_m),
        obstacle_hit=unknown[:, 0] | worlds.obstacle_hit,
    )


def unknown_to(vehicle, worlds):
    """Which vehicles this one has no news of by now, [n, N]; of itself it knows."""
    unknown = worlds.vehicles.known_from_s[:, vehicle] > worlds.time_s[:, np.newaxis]
    unknown[:, vehicle] = False
    return unknown


def other_future(worlds, unknown):
    """Latencies and news by link with all that is still to come exchanged, and the own parts of the ``unknown``."""
    rng, now, v = np.random.default_rng(2), worlds.time_s[:, np.newaxis], worlds.vehicles
    to_come = v.known_from_s > now[:, :, np.newaxis]
    return {
        "latency_s": exchanged(v.latency_s > now, v.latency_s, rng),
        "own_latency_s": exchanged(unknown, v.own_latency_s, rng),
        "known_from_s": exchanged(to_come, v.known_from_s, rng),
    }


def test_observe__tells_own_parts_of_latencies_and_nothing_that_the_channel_has_drawn():
    # Vehicle 2 knows Vehicle 3 from 0.4 s on; Vehicle 3's own part is 0.5 s, Vehicle 1's message reaches it at 0.9 s.
    scenario = PAPER.replace(v2x="congested", latency_s=[0, 0.1, 0.5], early_impacts="keep")
    worlds = scenario.sample(1, 7).worlds
    worlds.vehicles.latency_s[0] = [0.0, 0.4, 0.9]
    worlds.vehicles.known_from_s[0] = [[0.0, 0.8, 0.8], [0.4, 0.4, 0.4], [0.9, 0.9, 0.9]]
    assert worlds.vehicles.own_latency_s.tolist() == [[0.0, 0.1, 0.5]]
    spec = observation_for(scenario)
    at = [f.name for f in spec.features].index("rear_1.latency_left")
    for time, own_left, rear_left in ((0.0, 0.1, 0.0), (0.4, 0.0, 0.1), (0.6, 0.0, 0.0), (0.95, 0.0, 0.0)):
        seen = observe(replace(worlds, time_s=np.full(1, time)), 1, spec)[0]
        assert (seen[5], seen[at]) == (pytest.approx(own_left), pytest.approx(rear_left))


def test_full_state__has_the_latency_that_the_channel_has_drawn():
    scenario = channel_of("blocked")
    worlds = scenario.sample(50, 7).worlds
    at = [f.name for f in state_features(scenario)].index("vehicle_3.latency_left")
    assert (full_state(worlds, scenario)[:, at] == worlds.vehicles.latency_s[:, 2].astype(np.float32)).all()


def test_observe__writing_the_papers_news_out_by_link_changes_no_bit():
    plain = PAPER.sample(50, 7).worlds
    rows = Packed.of(plain)
    told = rows.widened(obstacle=False, news=True).worlds()
    for time in (0.0, 0.3, 0.6, 1.0):
        for i in range(3):
            now = (replace(w, time_s=np.full(50, time)) for w in (plain, told))
            one, other = (observe(w, i, observation_for(PAPER)) for w in now)
            assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize("latency", [0, [0, {"uniform": [0.3, 0.7]}, {"uniform": [0.5, 1.0]}]])
@pytest.mark.parametrize("obstacle", [False, True])
@pytest.mark.parametrize("name", ["blocked", "congested", "sensors-only"])
def test_observe__what_is_not_known_changes_no_bit(name, obstacle, latency):
    scenario = channel_of(name).replace(latency_s=latency)
    scenario = scenario.replace(obstacle_gap_m={"uniform": [30, 50]}) if obstacle else scenario
    start, spec = scenario.sample(400, 5).worlds, observation_for(scenario)
    seen = 0
    for time in (0.0, 0.5, 0.8, 1.0, 1.5):
        worlds, _ = advance(start, -3.0, until_s=time)
        other = shuffled(worlds, 1)
        unknown = worlds.vehicles.known_from_s[:, 1][:, [0, 2]] > time
        assert observe(worlds, 1, spec).tobytes() == observe(other, 1, spec).tobytes()
        for i in range(3):
            later = replace(worlds, vehicles=replace(worlds.vehicles, **other_future(worlds, unknown_to(i, worlds))))
            assert observe(worlds, i, spec).tobytes() == observe(later, i, spec).tobytes()
        flags = observe(worlds, 1, spec)[:, [7, 17]]
        assert (flags == ~unknown).all()
        if obstacle:
            at = [f.name for f in spec.features].index("obstacle.known")
            assert (observe(worlds, 1, spec)[:, at] == ~unknown[:, 0]).all()
        seen += int(unknown.sum())
    assert seen > 400


def engine(scenario, n=20, **settings):
    scripts = {i: make_agent(script) for i, script in scenario.scripts.items()}
    return Engine(scenario, n, learners=scenario.learners, scripts=scripts, **settings)


def test_engine__tells_what_is_known_when_and_starts_when_a_learner_may_act():
    running = engine(channel_of("blocked"), seed=3)
    vehicles = running.worlds.vehicles
    assert running.packed.known_from_s.tolist() == vehicles.known_from_s.tolist()
    assert running.worlds.time_s.tolist() == vehicles.latency_s[:, 1].tolist()
    assert np.ptp(running.worlds.time_s) > 0.2
    before = running.packed.known_from_s.copy()
    running.renew(np.array([4]))
    after = running.packed.known_from_s
    assert (np.delete(after, 4, 0) == np.delete(before, 4, 0)).all() and (after[4] != before[4]).any()


def test_engine__takes_worlds_with_and_without_news_by_link():
    plain = PAPER.sample(20, 7).worlds
    running = engine(channel_of("nominal"))
    running.reset(worlds=plain)
    assert running.packed.known_from_s.tolist() == plain.vehicles.known_from_s.tolist()
    running.renew(np.array([0]))
    running.step(np.zeros((20, 1)))
    of_paper = engine(PAPER)
    of_paper.reset(worlds=channel_of("nominal").sample(20, 7).worlds)
    of_paper.renew(np.array([0]))
    assert of_paper.packed.known_from_s[0].tolist() == plain.vehicles.known_from_s[0].tolist()


def test_engine__snapshot_keeps_the_news():
    running, other = engine(channel_of("blocked"), seed=3), engine(channel_of("blocked"), seed=4)
    other.restore(running.snapshot())
    assert other.packed.known_from_s.tobytes() == running.packed.known_from_s.tobytes()
    assert other.observe(1).tobytes() == running.observe(1).tobytes()


def test_engine__a_snapshot_of_another_shape_is_refused():
    other = engine(channel_of("blocked"), seed=4)
    kept = engine(channel_of("blocked"), seed=3).snapshot()
    with pytest.raises(InvalidInput, match=r"params is \(20, 20\); \(20, 28\) is needed"):
        other.restore({**kept, "params": kept["params"][:, :20]})


def test_infos__tell_the_news_only_where_there_is_a_channel():
    env = parallel_env(channel_of("congested"))
    _, infos = env.reset(seed=5)
    known = env.engine.packed.known_from_s[0]
    assert all(infos[f"vehicle_{i + 1}"]["known_from_s"].tolist() == known[i].tolist() for i in range(3))
    _, _, _, _, infos = env.step({"vehicle_2": np.zeros(1, np.float32)})
    assert infos["vehicle_2"]["known_from_s"].tolist() == known[1].tolist()
    assert "known_from_s" not in parallel_env(PAPER).reset(seed=5)[1]["vehicle_2"]


def test_initial_state__needs_a_channel_without_chance():
    given = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}
    with pytest.raises(InvalidInput, match="the scenario draws what each vehicle knows when"):
        channel_of("nominal").worlds_from_state(given)
    fixed = channel_of("nominal", link_latency_s=0.25, sensing_s=[1, 1])
    assert fixed.worlds_from_state(given).vehicles.latency_s.tolist() == [[0.0, 0.25, 0.25]]


@pytest.mark.parametrize(
    ("v2x", "message"),
    [
        ("papr", r"v2x.preset = papr: must be paper, clear, nominal, congested, blocked or sensors-only"),
        ({"preset": "clear", "los": 1}, r"v2x.los: unknown key; did you mean lost"),
        ({"loss_begins": 0.1}, r"v2x.loss_begins = 0.1: preset paper has no generated messages"),
        ({"preset": "clear", "senses": "none"}, r"v2x.senses = none: without sight .* would never react"),
        ({"preset": "clear", "loss_ends": 0}, r"v2x.loss_ends = 0: must be greater than or equal to 0.01"),
        ({"preset": "clear", "lost": float("nan")}, r"v2x.lost = .nan: must be a finite number"),
        ({"preset": "clear", "sensing_s": [2, 1]}, r"v2x.sensing_s = .*: low must not be above high"),
        ({"preset": "clear", "link_latency_s": 0.1, "radio_s": 0.1}, r"v2x.radio_s = 0.1: a fixed link_latency_s"),
        ({"preset": "clear", "hears": "none", "radio_s": 0.1}, r"v2x.radio_s = 0.1: hears none has no messages"),
        ({"preset": "sensors-only", "lost": 0.5}, r"v2x.lost = 0.5: hears none has no messages; leave it out"),
        ({"preset": "sensors-only", "link_latency_s": 0.2}, r"v2x.link_latency_s = 0.2: hears none has no messages"),
        ({"link_latency_s": 0.1, "hears": "none"}, r"v2x.link_latency_s = 0.1: hears none has no messages"),
        ({"sensing_s": [0.8, 1]}, r"v2x.sensing_s = \[0.8, 1\]: senses none has nobody in sight; leave it out"),
        ({"link_latency_s": 0.1, "lost": 0.1}, r"v2x.lost = 0.1: without sight .* use senses: both or front"),
        (5, r"v2x = 5: must be a preset \(paper, .*\), or a mapping such as"),
    ],
)
def test_v2x__that_cannot_be_is_refused_with_its_place(v2x, message):
    with pytest.raises(InvalidInput, match=message):
        PAPER.replace(v2x=v2x)


def test_v2x__everybody_may_act_before_the_horizon():
    with pytest.raises(
        InvalidInput, match=r"vehicle_3 may have no news until 2.2 s; .* below horizon_s \(2 s\), which may be raised"
    ):
        PAPER.replace(v2x="blocked", horizon_s=2)


@pytest.mark.parametrize(("name", "latest"), [("clear", 5.22), ("nominal", 5.42)])
def test_v2x__where_nothing_is_lost_the_longest_burst_bounds_the_news(name, latest):
    # 48 and 50 periods, in which the share of a burst falls below 2^-53; one of waiting; 20 + 100 + 200 ms.
    v2x = V2X(preset=name)
    assert v2x.latest_reaction_s(np.zeros(12)).tolist()[5:] == pytest.approx([latest] * 7)
    u = np.random.default_rng(3).random((2_000, 144 * PER_LINK))
    u.reshape(2_000, 144, PER_LINK)[:1_000, :, 1] = 0.0  # the longest bursts everywhere
    drawn = v2x.with_news(vehicles([0.0] * 12, 2_000), u).latency_s
    assert (drawn <= v2x.latest_reaction_s(np.zeros(12))).all() and drawn.max() > latest - 0.1


@pytest.mark.parametrize("name", PRESETS)
def test_v2x__declared_is_the_same_scenario(name):
    scenario = PAPER.replace(v2x=name)
    assert Scenario(**scenario.declared()) == scenario


def test_identities__do_not_depend_on_the_news():
    worlds = PAPER.sample(5, 7).worlds
    clock, command = np.zeros((5, CLOCK.WIDTH)), -worlds.vehicles.braking_capacity_mps2
    late = replace(worlds.vehicles, known_from_s=worlds.vehicles.known_from_s + 1.0)
    by_link = replace(worlds, vehicles=late)
    plain, told = (identities(w, command, clock, np.array([1])) for w in (worlds, by_link))
    assert plain.tolist() == told.tolist() and len(set(plain.tolist())) == 5
