"""A game with messages (infos, scripts, plans, interfaces), and that a game without messages pays nothing."""

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.features import FEATURES, register_feature
from ethbrake_marl.episode.play import price
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.messages.belief import belief_of, require_pieces
from ethbrake_marl.extensions.messages.game import MESSAGES_LAYER
from ethbrake_marl.extensions.messages.links import MESSAGES_KEY
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.open_game import game_of
from tests.extensions.messages.line import LINE, played, stepped
from tests.refused import refused

PERIODIC = {"preset": "congested", "persistence": "periodic"}
PAPER = load_scenario("paper-random").replace(early_impacts="keep")


class Follower:
    """Brakes by the gap ahead that it believes, and keeps what it has seen."""

    def __init__(self) -> None:
        self.seen: list[State] = []

    def begin(self, alert: State, body: int) -> Any:
        return None

    def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
        self.seen.append(state)
        return -np.minimum(state.car[:, 3, body], 20.0 / (1.0 + state.line[:, 2, body - 1])), memory


def test_script__acts_on_what_its_vehicle_believes() -> None:
    script = Follower()
    _, game = game_of(LINE.replace(v2x=PERIODIC), {3: script})
    state = game.reset(game.draw(1, 7, 0))
    for _ in range(8):
        expected = belief_of(state, 3)
        state = stepped(game, state, -1.0)
        assert script.seen[-1].line.tobytes() == expected.line.tobytes()
        assert script.seen[-1].car.tobytes() == expected.car.tobytes()
    assert script.seen[-1].line[0, 2, 2] != pytest.approx(state.gaps_m[0, 1], abs=1e-3)


@pytest.mark.parametrize("v2x", [PERIODIC, {**PERIODIC, "tells": ["place"]}], ids=["usual", "place"])
def test_price__is_the_harm_of_the_plan_to_the_bit(v2x: dict[str, Any]) -> None:
    _, game = game_of(PAPER.replace(v2x=v2x), {3: Follower()})
    state, rng = game.reset(game.draw(40, 3, 0)), np.random.default_rng(1)
    for _ in range(3):
        state, _ = game.step(state, np.full((40, 1), -0.4))
    plans = rng.uniform(-1.0, 1.0, (40, 5, 1))
    expected, first = price(game, state, plans, "total"), int(state.steps[0])
    while not state.ended.all():
        state, _ = game.step(state, plans[:, min(first, 4)])
        first += 1
    assert expected.tobytes() == state.harm("total").tobytes() and expected.any()


def test_script__that_needs_a_missing_piece_is_refused() -> None:
    class Heavy(Follower):
        def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
            return -state.car[:, 0, body - 1], memory

    _, game = game_of(LINE.replace(v2x={"tells": {"vehicle_2": ["place"]}}), {3: Heavy()})
    with refused("script of vehicle_3: messages of vehicle_2 do not contain its speed (key v2x.tells), but place,"):
        game.reset(game.draw(1, 7, 0))
    _, game = game_of(LINE.replace(v2x={"tells": {}} | PERIODIC | {"tells": ["place", "mass"]}), {3: Heavy()})
    with refused("script of vehicle_3: messages of vehicle_1 do not contain its speed"):
        game.reset(game.draw(1, 7, 0))


def test_require_pieces__of_who_looks_ahead() -> None:
    _, state = played({"tells": {"vehicle_3": ["place", "speed"], "vehicle_2": []}})
    with refused(
        "e_v2x_bm: messages of vehicle_3 do not contain its braking_capacity (key v2x.tells), but place, speed,"
    ):
        require_pieces(state, [2], "e_v2x_bm")
    require_pieces(state, [2], "idm", ["place", "speed"])  # its own messages are not needed
    with refused("pair: messages of vehicle_2 do not contain its place"):
        require_pieces(state, [2, 3], "pair", ["place"])
    _, plain = open_game(LINE)
    require_pieces(plain.reset(plain.draw(1, 7, 0)), [2], "e_v2x_bm")


def test_feature_of_another_package__is_unknown_where_it_needs_a_missing_piece() -> None:
    def weight(state: State, body: int, other: int) -> Floats:
        """Weight of the neighbour."""
        return state.mass_t[:, other - 1] * 9.81

    register_feature("test_weight", weight, unit="kN", scale=1.0, low=0.0, high=900.0, of="neighbour", unknown=7.0)
    try:
        listed = ["front_1.test_weight", "rear_1.test_weight"]
        game, state = played({"tells": {"vehicle_1": ["speed"]}}, listed)
        np.testing.assert_allclose(game.observe(state, np.array([2]))[0], [[7.0, 5.9 * 9.81]], rtol=1e-6)
    finally:
        FEATURES.loaded.pop("test_weight")


def test_infos__tell_when_news_counts_and_how_old_it_is() -> None:
    v2x = {"link_latency_s": 0.2, "senses": "none", "persistence": "periodic"}
    env = EthBrakeParallelEnv(LINE.replace(v2x=v2x))
    _, infos = env.reset(seed=1)
    names = [f"{name}_vehicle_{j}" for name in ("known_from_s", "age_s") for j in (1, 2, 3)]
    assert [infos["vehicle_2"][name] for name in names] == pytest.approx([0.5, 0.5, 0.5, 0.2, 0.0, 0.2])
    *_, infos = env.step({"vehicle_2": np.array([-1.0], np.float32)})
    assert infos["vehicle_2"]["age_s_vehicle_1"] == pytest.approx(0.2)
    _, game = open_game(LINE.replace(v2x={"tells": ["place"]}))
    assert set(game.extra_infos(game.reset(game.draw(1, 7, 0)))) == set(names[:3])


def test_usual_contents__written_out_change_no_bit_of_an_observation() -> None:
    usual = ["place", "speed", "acceleration", "braking_capacity", "latency", "mass"]
    games = [played(v2x, n=30, scenario=PAPER) for v2x in ("nominal", {"preset": "nominal", "tells": usual})]
    (plain, one), (game, other) = games
    for _ in range(12):
        for body in (1, 2, 3):
            assert plain.observe_alike(one, [body]).tobytes() == game.observe_alike(other, [body]).tobytes()
        one, other = stepped(plain, one, -0.4), stepped(game, other, -0.4)
        assert [array.tobytes() for array in one[:5]] == [array.tobytes() for array in other[:5]]


def test_without_messages__there_is_no_memory_and_no_layer() -> None:
    game, state = played("nominal")
    assert game.layers == () and played(PERIODIC)[0].layers == (MESSAGES_LAYER,)
    assert MESSAGES_KEY not in stepped(game, state, 0.0).memories and game.extra_infos(state) == {}
