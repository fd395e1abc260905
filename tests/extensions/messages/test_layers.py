"""Several extensions of ``v2x`` in one scenario all act; what cannot act together is refused in one line."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.layer import Layer
from ethbrake_marl.motion.layout import FORCE, SPEED
from ethbrake_marl.worlds.channel import register_preset, register_v2x_key
from ethbrake_marl.worlds.physics import register_physics
from tests.contract.interfaces import PAPER
from tests.fixtures.layer import SamePhysics, UsersKey
from tests.refused import refused

PPO = eb.Team.of({"vehicle_2": eb.make_agent("ppo", scenario="paper-random")}, "ppo")


class Mine(Layer):
    """Reports the time."""

    def infos(self, state: eb.State) -> dict[str, Any]:
        return {"mine": state.time_s}


class Faster(Layer):
    """Vehicles seem ``more`` m/s faster, then ``times`` as fast; remembers how often it was asked after a step."""

    def __init__(self, name: str, more: float, times: float, stage: int = 0) -> None:
        self.name, self.more, self.times, self.stage = name, more, times, stage

    def after(self, game: Any, before: eb.State, state: eb.State) -> eb.State:
        return state._replace(memories={**state.memories, self.name: before.memories[self.name] + 1.0})

    def seen(self, state: eb.State, body: int) -> eb.State:
        line = state.line.copy()
        line[:, SPEED, 1:] = (line[:, SPEED, 1:] + self.more) * self.times
        return state._replace(line=line)

    def infos(self, state: eb.State) -> dict[str, Any]:
        return {self.name: state.memories[self.name]}


@pytest.fixture(autouse=True)
def _registered() -> None:
    mine = UsersKey("mine", Mine())
    extensions = {
        "mine": mine,
        "also_mine": mine,
        "more": UsersKey("more", Faster("more", 2.0, 1.0)),
        "twice": UsersKey("twice", Faster("twice", 0.0, 2.0)),
        "early_twice": UsersKey("early", Faster("early", 0.0, 2.0, stage=-1)),
        "late": UsersKey("late", Faster("late", 2.0, 1.0, stage=2)),
        "news": UsersKey("messages", Mine()),
    }
    for key, extension in extensions.items():
        register_v2x_key(key, extension)
    register_physics("sliding", SamePhysics())


def changed(v2x: dict[str, Any], **beside: Any) -> eb.Scenario:
    return PAPER.replace(v2x={"preset": "nominal", **v2x}, **beside)


def of_preset() -> eb.Scenario:
    register_preset("frank", {"preset": "nominal", "tells": ["speed"]})
    return PAPER.replace(v2x={"preset": "frank", "news": 1})


ACTS = "belong to different channel keys, whose memories have the same name; leave one out"
REFUSED: dict[str, Callable[[], Any]] = {
    f"v2x: tells and news {ACTS}": lambda: changed({"tells": ["speed"], "news": 1}),
    f"v2x: tells and news {ACTS} ": of_preset,
    f"mixture[0].scenario: scenario 'paper-random': v2x: tells and news {ACTS}": lambda: eb.load_scenario(
        {"name": "two", "mixture": [{"scenario": "paper-random"}], "v2x": {"preset": "nominal", "tells": [], "news": 1}}
    ),
    "v2x: is not known to physics: sliding; leave one of the two out": lambda: changed(
        {"persistence": "periodic"}, physics="sliding"
    ),
    "v2x: is not known to physics: sliding; leave one": lambda: changed({"mine": 1}, physics="sliding"),
    "key 'kept' of v2x: the name of its memory, 'shield', is in use; choose": lambda: register_v2x_key(
        "kept", UsersKey("shield", Mine())
    ),
    "key 'kept' of v2x: the name of its memory, 'departures', is in use": lambda: register_v2x_key(
        "kept", UsersKey("departures", Mine())
    ),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_extension__that_cannot_act_beside_another_is_refused(message: str) -> None:
    with refused(message.rstrip()) as error:
        REFUSED[message]()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("v2x", "infos"),
    [
        ({"tells": ["place", "speed"], "persistence": "periodic"}, ["age_s_vehicle_1", "known_from_s_vehicle_1"]),
        ({"persistence": "first"}, ["known_from_s_vehicle_1"]),
        ({"mine": 1, "also_mine": 2}, ["mine"]),
        ({"mine": 1, "persistence": "periodic"}, ["mine", "age_s_vehicle_1"]),
    ],
    ids=str,
)
def test_keys__of_all_extensions_act_together(v2x: dict[str, Any], infos: list[str]) -> None:
    env = eb.parallel_env(changed(v2x))
    assert env.reset(seed=7)[1]["vehicle_2"].keys() >= {*infos}
    assert env.step({"vehicle_2": [-0.5]})[4]["vehicle_2"].keys() >= {*infos}
    eb.parallel_env(PAPER.replace(v2x="nominal", physics="sliding"))


@pytest.mark.parametrize(
    ("v2x", "seen_mps"),
    [
        ({"more": 1, "twice": 1}, 44.0),  # (20 + 2) * 2: in the order of their names
        ({"twice": 1, "more": 1}, 44.0),  # whatever the order of the keys
        ({"more": 1, "early_twice": 1}, 42.0),  # 20 * 2 + 2: the lower stage first
        ({"more": 1, "twice": 1, "persistence": "first"}, 44.0),  # messages report what was measured
        ({"more": 1, "twice": 1, "persistence": "periodic"}, 44.0),
        ({"late": 1, "twice": 1, "persistence": "first"}, 42.0),  # a layer behind the messages
        ({"late": 1, "twice": 1, "persistence": "periodic"}, 42.0),
    ],
    ids=str,
)
def test_layers__compose_in_the_order_of_their_stages_each_with_its_memory(
    v2x: dict[str, Any], seen_mps: float
) -> None:
    scenario = PAPER.replace(
        v2x={"preset": "nominal", "link_latency_s": 0.0, **v2x}, speeds_mps=[20.0, 20.0, 20.0], gaps_m=200.0,
        roles={"vehicle_1": "coast", "vehicle_2": "learner", "vehicle_3": "coast"}, early_impacts="keep",
    )  # fmt: skip
    _, game = open_game(scenario, observation=["own.speed", "front_1.closing_speed"])
    state = game.reset(scenario.sample(2, 7))
    for _ in range(3):
        state, _ = game.step(state, np.zeros((2, 1)))
    assert game.seen(state, 2).speeds_mps[:, 0] == pytest.approx(seen_mps)
    assert state.speeds_mps[:, 0] == pytest.approx(20.0)
    own = state.line.copy()
    own[:, SPEED, 1:] = seen_mps
    right = game.views[2].observe(state._replace(line=own), np.array([2]), scenario.time_step_s)[:, 0]
    assert game.observe_alike(state, [2])[:, 0] == pytest.approx(right)
    for layer in game.layers:
        if isinstance(layer, Faster):
            assert state.memories[layer.name].tolist() == [3.0, 3.0]
            assert game.extra_infos(state)[layer.name].tolist() == [3.0, 3.0]


@pytest.mark.parametrize("answer", [lambda state: 1 / 0, lambda state: None, lambda state: state.take([0])])
def test_layer__that_fails_is_named(answer: Callable[[eb.State], Any]) -> None:
    class Broken(Layer):
        def seen(self, state: eb.State, body: int) -> Any:
            return answer(state)

    scenario, game = open_game("paper-random")
    state, broken = game.reset(scenario.sample(3, seed=7)), game.with_layers([Broken()])
    calls = {
        "seen": lambda: broken.seen(state, 2),
        "observe": lambda: broken.observe_alike(state, [2]),
        "drive": lambda: eb.play_to_end(broken, scenario.sample(3, seed=7), PPO),
    }
    for call in calls.values():
        with pytest.raises(eb.EthBrakeError, match=r"^layer Broken: seen "):
            call()


class Late(Layer):
    """A vehicle sees all others as they were two decisions (0.2 s) ago."""

    def first_decision(self, game: Any, alert: eb.State, state: eb.State) -> eb.State:
        return self._remember(state, [self._sight(game, state)] * 3)

    def after(self, game: Any, before: eb.State, state: eb.State) -> eb.State:
        return self._remember(state, [*np.moveaxis(before.memories["late"][:, 1:], 1, 0), self._sight(game, state)])

    def seen(self, state: eb.State, body: int) -> eb.State:
        line = state.memories["late"][:, 0, body].copy()
        line[:, [SPEED, FORCE], body] = state.line[:, [SPEED, FORCE], body]  # of itself it knows the present
        return state._replace(line=line)

    def _sight(self, game: Any, state: eb.State) -> Any:
        """What each vehicle sees now through the layers before, [n, N + 1, rows, N + 1]."""
        return np.stack([game.seen(state, body, before=self).line for body in range(state.vehicles + 1)], axis=1)

    def _remember(self, state: eb.State, sights: list[Any]) -> eb.State:
        return state._replace(memories={**state.memories, "late": np.stack(sights, axis=1)})


def test_a_late_sensor__composes_with_noisy_messages() -> None:
    """The speed of Vehicle 1 that Vehicle 2 sees is the one that its messages said two decisions ago."""
    scenario, noisy = open_game("messages-noisy")
    late = noisy.with_layers([Late()])
    assert [type(layer).__name__ for layer in late.layers] == ["ReportsLayer", "MessagesLayer", "Late"]
    state, said, shown, own = late.reset(scenario.sample(5, 7)), list[Any](), list[Any](), list[Any]()
    for _ in range(8):
        said.append(noisy.seen(state, 2).speeds_mps[:, 0])
        shown.append(late.seen(state, 2).speeds_mps[:, 0])
        own.append(late.seen(state, 2).speeds_mps[:, 1] - state.speeds_mps[:, 1])
        state, _ = late.step(state, np.full((5, 1), -0.4))
    np.testing.assert_array_equal(shown, [said[0], said[0], *said[:-2]])
    assert (np.diff(said, axis=0) != 0.0).any(axis=0).all() and not np.any(own)


def test_layers__append_in_the_order_listed_whatever_their_stage() -> None:
    """20 m/s seem (20 + 2) * 2 m/s, then 2 m/s more: also scripts and agents see the last layer."""
    more, twice = Faster("more", 2.0, 1.0), Faster("twice", 0.0, 2.0, stage=-1)
    scenario, plain = open_game(PAPER.replace(speeds_mps=[20.0, 20.0, 20.0], gaps_m=200.0))
    looks = Looks()
    game = plain._replace(scripts={3: looks}).with_layers([more, twice]).with_layers([Faster("more", 2.0, 1.0)])
    worlds = scenario.sample(1, 7)
    game.reset(worlds._replace(memories={"more": np.zeros(1), "twice": np.zeros(1)}))
    assert [speed for _, speed in looks.speeds] == [46.0]
    assert game.seen(worlds, 2).speeds_mps[0, 0] == 46.0


class Looks:
    """Keeps the speed of Vehicle 1 that it sees, and coasts."""

    name = "looks"

    def __init__(self) -> None:
        self.speeds = list[tuple[int, float]]()

    def begin(self, alert: eb.State, body: int) -> None:
        return None

    def act(self, state: eb.State, memory: None, body: int) -> Any:
        self.speeds.append((body, float(state.speeds_mps[0, 0])))
        return np.zeros(state.n), memory
