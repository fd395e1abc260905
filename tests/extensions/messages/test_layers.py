"""Extensions of ``v2x`` and physics in one scenario: each would replace the game of the other, so one line refuses."""

from collections.abc import Callable
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.game import Game
from ethbrake_marl.worlds.channel import register_preset, register_v2x_extension
from ethbrake_marl.worlds.physics import register_physics
from tests.contract.interfaces import PAPER
from tests.fixtures.layer import Layer
from tests.refused import refused


class Mine(Game):
    __slots__ = ()

    def own_infos(self, state: eb.State) -> dict[str, Any]:
        return {**super().own_infos(state), "mine": state.time_s}


@pytest.fixture(autouse=True)
def _registered() -> None:
    mine = Layer("mine", Mine)
    for key, layer in {
        "mine": mine,
        "also_mine": mine,
        "other": Layer("other", Mine),
        "news": Layer("messages", Mine),
    }.items():
        register_v2x_extension(key, layer)  # type: ignore[arg-type]
    register_physics("sliding", Layer("sliding", Mine))


def changed(v2x: dict[str, Any], **beside: Any) -> eb.Scenario:
    return PAPER.replace(v2x={"preset": "nominal", **v2x}, **beside)


def of_preset() -> eb.Scenario:
    register_preset("frank", {"preset": "nominal", "tells": ["speed"]})
    return PAPER.replace(v2x={"preset": "frank", "mine": 1})


ACTS = "belong to different extensions, whose games would replace each other; leave one out"
REFUSED: dict[str, Callable[[], Any]] = {
    f"v2x: tells and mine {ACTS}": lambda: changed({"tells": ["speed"], "mine": 1}),
    f"v2x: tells and mine {ACTS} ": of_preset,
    f"mixture[0].scenario: scenario 'paper-random': v2x: tells and mine {ACTS}": lambda: eb.load_scenario(
        {"name": "two", "mixture": [{"scenario": "paper-random"}], "v2x": {"preset": "nominal", "tells": [], "mine": 1}}
    ),
    "v2x: is not known to physics: sliding; leave one of the two out": lambda: changed(
        {"persistence": "periodic"}, physics="sliding"
    ),
    "v2x: is not known to physics: sliding; leave one": lambda: changed({"mine": 1}, physics="sliding"),
    "key 'kept' of v2x: the name of its memory, 'shield', is in use; choose": lambda: register_v2x_extension(
        "kept", Layer("shield", Mine)  # type: ignore[arg-type]
    ),
    "key 'kept' of v2x: the name of its memory, 'physics', is in use": lambda: register_v2x_extension(
        "kept", Layer("physics", Mine)  # type: ignore[arg-type]
    ),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_layer__that_would_replace_another_is_refused(message: str) -> None:
    with refused(message.rstrip()) as error:
        REFUSED[message]()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("v2x", "infos"),
    [
        ({"tells": ["place", "speed"], "persistence": "periodic"}, ["age_s_vehicle_1", "known_from_s_vehicle_1"]),
        ({"persistence": "first"}, ["known_from_s_vehicle_1"]),
        ({"mine": 1, "also_mine": 2}, ["mine"]),
    ],
    ids=str,
)
def test_keys__of_one_extension_act_together(v2x: dict[str, Any], infos: list[str]) -> None:
    env = eb.parallel_env(changed(v2x))
    assert env.reset(seed=7)[1]["vehicle_2"].keys() >= {*infos}
    assert env.step({"vehicle_2": [-0.5]})[4]["vehicle_2"].keys() >= {*infos}
    eb.parallel_env(PAPER.replace(v2x="nominal", physics="sliding"))
