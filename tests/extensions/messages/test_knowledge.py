"""What has not reached a vehicle changes nothing of what it believes or observes."""

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.messages.belief import CAR_PIECES, ages_s, belief_of, known_pieces
from ethbrake_marl.extensions.messages.links import MESSAGES_KEY, P_ACCELERATION, P_INTENT, P_PLACE, P_SPEED
from ethbrake_marl.motion.layout import CAR_ROWS, FORCE, GAP, LIMIT, RESTITUTION, SCRIPTED, SPEED
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.extensions.messages.line import played, stepped

SEEN = [
    "own",
    "front_1",
    "front_2",
    "rear_1",
    "obstacle",
    "contact",
    "front_1.intent",
    "rear_1.age",
    "rear_1.mass_known",
]
CHANNELS = {
    "periodic": {"preset": "congested", "persistence": "periodic"},
    "periodic, unseen": {"link_latency_s": 0.2, "senses": "none", "persistence": "periodic"},
    "no place": {"tells": ["speed", "mass", "latency"]},
    "each": {
        "preset": "blocked",
        "tells": {"vehicle_1": ["speed"], "vehicle_2": [], "vehicle_3": ["place", "latency", "intent"]},
    },
    "old and few": {"preset": "nominal", "tells": ["speed", "acceleration", "intent"], "persistence": "periodic"},
}


def test_row_of_a_vehicle__is_told_by_a_piece_or_known_to_all() -> None:
    assert sorted([*CAR_PIECES, LIMIT, RESTITUTION, SCRIPTED]) == [*range(CAR_ROWS)]


def altered(state: State, observer: int, rng: np.random.Generator) -> State:
    """The same episodes with random numbers for all that the observer has not received, the future included."""
    known, memory = known_pieces(state, observer), state.memories[MESSAGES_KEY]
    present = known & (ages_s(state)[:, observer, :, np.newaxis] <= 0.0)
    present[:, 0] = True  # the obstacle has no message of its own
    line, car, know, wanted = state.line.copy(), state.car.copy(), state.know.copy(), state.wanted.copy()

    def other(array: Any, hidden: Any) -> None:
        array[hidden] = rng.uniform(1.0, 9.0, int(hidden.sum()))

    for row, piece in ((SPEED, P_SPEED), (FORCE, P_ACCELERATION)):
        other(line[:, row], ~present[:, :, piece])
    for p in range(1, state.vehicles):
        beyond = range(1, p + 1) if p < observer else range(p + 1, state.vehicles + 1)
        other(line[:, GAP, p], ~present[:, beyond, P_PLACE].any(axis=1))
    for row, piece in CAR_PIECES.items():
        other(car[:, row], ~known[:, :, piece])
    other(wanted, ~(present[:, :, P_INTENT]))
    others = np.arange(state.vehicles + 1) != observer
    know[:, others] = rng.uniform(0.0, 2.0, know[:, others].shape)
    if memory.is_periodic:
        news, samples, links = memory.news.copy(), memory.samples.copy(), memory.links.copy()
        news[:, :, others] = rng.uniform(0.0, 9.0, news[:, :, others].shape)
        links[:, :, others] = rng.uniform(0.0, 9.0, links[:, :, others].shape)
        samples[:, 0, :, 1:][:, :, others[1:]] = 3.0
        samples[:, 1:, :, 1:] = 4.0
        channel = memory.channel.copy()
        channel[:, -1] += 1.0
        memory = memory._replace(news=news, samples=samples, links=links, channel=channel)
    memories = {**state.memories, MESSAGES_KEY: memory}
    return state._replace(line=line, car=car, know=know, wanted=wanted, memories=memories)


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("base", ["cooperation-4-all", "paper-random-buildup"])
def test_what_has_not_been_received__changes_no_bit(base: str, channel: str) -> None:
    pytest.importorskip("ethbrake_marl.extensions.forecasts")  # whose feature is `contact`
    scenario, rng = load_scenario(base).replace(early_impacts="keep"), np.random.default_rng(2)
    game, state = played(CHANNELS[channel], SEEN, n=30, scenario=scenario)
    changed = 0
    for _ in range(14):
        for body in (1, 2, 3):
            other = altered(state, body, rng)
            assert game.observe_alike(other, [body]).tobytes() == game.observe_alike(state, [body]).tobytes()
            one, two = belief_of(state, body), belief_of(other, body)
            np.testing.assert_array_equal(one.line[:, : GAP + 1], two.line[:, : GAP + 1])
            np.testing.assert_array_equal(one.car, two.car)
            np.testing.assert_array_equal(one.wanted, two.wanted)
            changed += int((other.line != state.line).sum())
        state = stepped(game, state, -0.4)
    assert changed > 500
