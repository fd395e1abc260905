"""Periodic messages: how old news is, what is made of it, and which messages are lost."""

import numpy as np
import pytest

from ethbrake_marl.extensions.messages.belief import ages_s, belief_of
from ethbrake_marl.extensions.messages.links import MESSAGES_KEY, moved_on
from ethbrake_marl.motion.elementary import hash_number
from ethbrake_marl.motion.layout import FOREIGN, GAP, HIT, SPEED
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.extensions.messages.line import LINE, played, seen_by, stepped

PERIODIC = {"persistence": "periodic"}
# Every 0.1 s a message is sent, of use 0.2 s later, and every second one is lost: (p, r) = (1, 1).
EVERY_SECOND = {"link_latency_s": 0.2, "senses": "none", "loss_begins": 1.0, "loss_ends": 1.0, **PERIODIC}
SEEN = ["own", "front_1", "rear_1", "front_1.intent", "rear_1.intent", "front_1.age", "rear_1.age"]


@pytest.mark.parametrize(
    ("tells", "gap", "closing"),
    [
        # At 0.5 s the newest sample is that of 0.2 s: Vehicle 1 was 3.88 m on, and as fast as 18.8 m/s.
        (["place"], 8 + 3.88 - 9, 0.0),
        (["place", "speed"], 8 + 3.88 + 18.8 * 0.3 - 9, 18 - 18.8),
        (["place", "speed", "acceleration"], 8 + 9.25 - 9, 18 - 17),
        (["speed"], 0.0, 18 - 18.8),
    ],
)
def test_old_news__is_moved_on_with_what_it_contains(tells, gap, closing) -> None:
    game, state = played({**EVERY_SECOND, "tells": tells}, SEEN)
    seen = seen_by(game, state, 2)
    names = ("front_1.gap", "front_1.closing_speed", "front_1.age")
    assert [seen[name] for name in names] == pytest.approx([gap / 10, closing / 10, 0.3], abs=1e-6)


def test_sample_of_the_alert__has_the_force_that_acts_at_once() -> None:
    game, state = played({"link_latency_s": 0.5, "senses": "none", **PERIODIC}, SEEN)
    seen = seen_by(game, state, 2)  # of Vehicle 1 at the alert: 20 m/s, -6 m/s2; Vehicle 3 coasts until 1 s
    names = ("front_1.age", "front_1.acceleration", "front_1.gap", "rear_1.acceleration")
    assert [seen[name] for name in names] == pytest.approx([0.5, -0.6, (8 + 9.25 - 9) / 10, 0.0], abs=1e-6)


def test_episode_that_has_ended__hears_no_more() -> None:
    game, state = played(EVERY_SECOND)
    while not state.ended[0]:
        state = stepped(game, state, -1.0)
    later = stepped(game, state, -1.0)
    assert [a.tobytes() for a in later.memories[MESSAGES_KEY]] == [a.tobytes() for a in state.memories[MESSAGES_KEY]]


def test_moved_on__by_hand() -> None:
    assert moved_on(10.0, -4.0, 40.0, 1.0) == (6.0, 8.0)
    assert moved_on(10.0, -4.0, 40.0, 9.0) == (0.0, 12.5)  # at rest after 2.5 s
    assert moved_on(10.0, 2.0, 11.0, 1.0) == (11.0, 10.75)  # the limit comes after 0.5 s
    assert moved_on(-2.0, -4.0, 40.0, 0.25) == moved_on(-2.0, 4.0, 40.0, 0.25) == (-1.0, -0.375)
    assert moved_on(-2.0, 4.0, 40.0, 3.0) == (0.0, -0.5)
    assert moved_on(-2.0, 0.0, 40.0, 3.0) == (-2.0, -6.0)


def test_chance__is_uniform_and_of_its_own_for_every_link_and_message() -> None:
    u = np.array(
        [
            [[hash_number(key, link, number) for number in range(40)] for link in range(9)]
            for key in (0.0, 1.0, 2.0**53 - 1)
        ]
    )
    assert len(np.unique(u)) == u.size and ((u >= 0.0) & (u < 1.0)).all()
    assert abs(u.mean() - 0.5) < 0.03
    assert abs(np.corrcoef(u[0, :, :-1].ravel(), u[0, :, 1:].ravel())[0, 1]) < 0.1


def test_intent__is_as_old_as_the_message() -> None:
    # Decisions at 0.5, 0.6, 0.7, ... The sample of 0.6 s has the choice of 0.5 s; Vehicle 1 uses it from 0.8 s on.
    game, state = played({**EVERY_SECOND, "tells": {"vehicle_2": ["intent"]}}, SEEN)
    intents = []
    for action in (-0.1, -0.2, -0.3, -0.4, -0.5, -0.6, 0.0):
        intents.append(seen_by(game, state, 1)["rear_1.intent"])
        state = stepped(game, state, action)
    assert intents == pytest.approx([0, 0, 0, -0.07, -0.07, -0.21, -0.21])


def test_belief__knows_of_no_impact_between_others() -> None:
    # Vehicle 2 coasts into Vehicle 1. Vehicle 3 has older news, and moves both on as if they had not met.
    game, state = played(EVERY_SECOND, scenario=LINE.replace(gaps_m=[2, 30]))
    while not state.pair_hit[0, 0]:
        state = stepped(game, state, 0.0)
    three = belief_of(state, 3)
    assert (three.line[0, HIT, 1], belief_of(state, 2).line[0, HIT, 1]) == (0.0, 1.0)
    assert state.line[0, FOREIGN, 1] > 0.0 == three.line[0, FOREIGN, 1]
    assert three.line[0, SPEED, 1] < state.line[0, SPEED, 1]  # as if it had braked on
    assert three.line[0, GAP, 1] == 0.0  # moved on, the two would overlap
    present = played({"tells": ["place"]}, scenario=LINE.replace(gaps_m=[2, 30]))
    while not present[1].pair_hit[0, 0]:
        present = present[0], stepped(*present, 0.0)
    assert belief_of(present[1], 3).line[0, HIT, 1] == 1.0


def test_obstacle_hit__is_known_from_a_message() -> None:
    game, state = played(EVERY_SECOND, scenario=LINE.replace(obstacle_gap_m=20, gaps_m=[60, 60]))
    known = []
    while len(known) < 14:  # Vehicle 1 hits it at 1.23 s; the samples of 1.3 s and 1.4 s are used at 1.5 s or 1.6 s
        known.append((round(float(state.time_s[0]), 1), belief_of(state, 2).line[0, HIT, 0], state.line[0, HIT, 0]))
        state = stepped(game, state, -1.0)
    assert [min(time for time, *hit in known if hit[k] == 1.0) for k in (0, 1)] == [1.6, 1.3]


def test_in_sight__news_is_never_old() -> None:
    paper = load_scenario("cooperation-2-paper").replace(early_impacts="keep")
    sight = {"preset": "nominal", "sensing_s": [0.0, 0.0]}
    (game, old), (first, new) = (
        played({**sight, "persistence": p}, n=6, scenario=paper) for p in ("periodic", "first")
    )
    for _ in range(15):
        assert game.observe(old, np.array([2]))[0].tobytes() == first.observe(new, np.array([2]))[0].tobytes()
        old, new = stepped(game, old, -0.6), stepped(first, new, -0.6)
    assert (ages_s(old)[:, 2, [1, 3]] == 0.0).all()


@pytest.mark.parametrize(("p", "r"), [(0.2, 0.2), (0.3, 0.7)])
def test_losses__have_the_share_and_the_bursts_of_the_channel(p: float, r: float) -> None:
    # Of messages 0.1 s apart, the newest one that arrived is sent m periods ago if the last m were lost.
    channel = {"preset": "nominal", "radio_s": 0.0, "senses": "front", "sensing_s": [7, 7], **PERIODIC}
    paper = load_scenario("cooperation-2-paper").replace(early_impacts="keep", horizon_s=30.0)
    game, state = played({**channel, "loss_begins": p, "loss_ends": r}, n=3000, scenario=paper)
    for _ in range(30):
        state = stepped(game, state, -1.0)
    lost = np.rint((ages_s(state)[:, 3, 1] - 0.4) / 0.1)  # sent 0.3 to 0.4 s ago, sampled 0.4
    for m in (1, 2, 4):
        assert (lost >= m).mean() == pytest.approx(p / (p + r) * (1 - r) ** (m - 1), abs=0.03)


def test_world__hears_alone_what_it_hears_in_a_batch_and_after_a_put() -> None:
    paper = load_scenario("cooperation-4-all").replace(early_impacts="keep")
    game, whole = played({"preset": "congested", **PERIODIC}, n=9, scenario=paper)
    alone, mixed = game.reset(game.draw(1, 7, 4)), game.reset(game.draw(9, 3, 0))
    mixed = mixed.put([2], whole.take([4])).put([5], whole.take([4]))
    for _ in range(12):
        whole, alone, mixed = stepped(game, whole, -0.3), stepped(game, alone, -0.3), stepped(game, mixed, -0.3)
        expected = [
            game.observe_alike(alone, [2])[0].tobytes(),
            *(array.tobytes() for array in alone.memories[MESSAGES_KEY]),
        ]
        for state, row in ((whole, 4), (mixed, 2), (mixed, 5)):
            one = state.take([row])
            assert [
                game.observe_alike(one, [2])[0].tobytes(),
                *(a.tobytes() for a in one.memories[MESSAGES_KEY]),
            ] == expected
