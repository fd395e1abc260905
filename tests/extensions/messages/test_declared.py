"""The keys ``v2x.persistence`` and ``v2x.tells``: what is refused, and what a scenario says of itself."""

from collections.abc import Callable

import jsonschema
import numpy as np
import pytest

from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario
from ethbrake_marl.worlds.scenario_file import scenario_json_schema
from ethbrake_marl.worlds.user_worlds import worlds_from_state
from tests.extensions.messages.line import LINE
from tests.refused import refused

PAPER = load_scenario("paper-random")
PERIODIC = {"preset": "nominal", "persistence": "periodic"}


def given(v2x: object, **more: object) -> Callable[[], object]:
    return lambda: PAPER.replace(v2x=v2x, **more)


def mixed(*channels: object) -> Callable[[], object]:
    members = [PAPER.replace(name=f"m{k}", v2x=v2x).declared() for k, v2x in enumerate(channels)]
    return lambda: Scenario(name="mixed", mixture=[{"scenario": member} for member in members])


REFUSED = {
    "v2x.tell: unknown key; did you mean tells?": given({"tell": ["mass"]}),
    "v2x.persistence = always: must be first or periodic": given({"preset": "nominal", "persistence": "always"}),
    "v2x.persistence = periodic: needs a channel with separate messages; use a preset": given(
        {"persistence": "periodic"}
    ),
    "v2x.tells[0] = plce: must be place, speed, acceleration, braking_capacity, latency, mass, intent or plan": given(
        {"tells": ["plce"]}
    ),
    "v2x.tells.vehicle_2[1] = 3: must be place, speed": given({"tells": {"vehicle_2": ["mass", 3]}}),
    "v2x.tells.vehicle_9: unknown vehicle; this scenario has vehicle_1 ... vehicle_3": given(
        {"tells": {"vehicle_9": []}}
    ),
    "v2x.tells = {}: must not be empty": given({"tells": {}}),
    "v2x.tells = [mass, mass]: must not list an item twice": given({"tells": ["mass", "mass"]}),
    "v2x.tells.vehicle_2 = mass: must be a list": given({"tells": {"vehicle_2": "mass"}}),
    "v2x.tells = [mass]: has no effect, because hears: none means that no": given(
        {"preset": "sensors-only", "tells": ["mass"]}
    ),
    "v2x.loss_begins = 0.1: has no effect, because link_latency_s fixes the delay of messages": given(
        {"link_latency_s": 0.2, "loss_begins": 0.1, "senses": "none", "tells": ["mass"]}
    ),
    "v2x.radio_s = 0.1: has no effect, because link_latency_s fixes the delay of messages": given(
        {**PERIODIC, "link_latency_s": 0.2, "radio_s": 0.1}
    ),
    "a message takes 1020 time steps; at most 997 are possible, so shorten the delay": given(
        {**PERIODIC, "radio_s": 0.72}, time_step_s=0.001
    ),
    "mixture: v2x must be the same in all scenarios of the mixture, but m0 has {preset: nominal} and m1 has": mixed(
        "nominal", PERIODIC
    ),
    "it is random what the vehicles learn about each other": lambda: worlds_from_state(
        LINE.replace(v2x={"link_latency_s": 0.2, "senses": "none", "loss_begins": 0.1, "persistence": "periodic"}), {}
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


def one(pieces: object) -> object:
    return {"vehicle_2": pieces}


LISTS: list[tuple[object, bool]] = [
    ([], True), (["mass"], True), (["place", "mass"], True), (["mass", "mass"], False),
    (["mass", "place", "mass"], False),
    (["plce"], False), ("mass", False), ([["mass"]], False), ({}, False), (None, False),
]  # fmt: skip


@pytest.mark.parametrize("form", [lambda pieces: pieces, one], ids=["for all vehicles", "by name"])
@pytest.mark.parametrize(("pieces", "right"), LISTS, ids=str)
def test_schema__accepts_the_lists_of_contents_that_the_reader_accepts(
    pieces: object, right: bool, form: Callable[[object], object]
) -> None:
    editor = jsonschema.Draft202012Validator(scenario_json_schema())
    v2x = {**PERIODIC, "tells": form(pieces)}
    assert editor.is_valid({"name": "x", "v2x": v2x}) == right
    if right:
        PAPER.replace(v2x=v2x)
    else:
        with refused("v2x.tells"):
            PAPER.replace(v2x=v2x)


def test_scenario__says_what_is_declared_and_can_be_made_of_it() -> None:
    v2x = {"preset": "nominal", "persistence": "periodic", "tells": {"vehicle_2": ["mass", "place"]}}
    scenario = PAPER.replace(v2x=v2x)
    assert scenario.declared()["v2x"] == {**v2x, "tells": {"vehicle_2": ["place", "mass"]}}
    assert Scenario(**scenario.declared()) == scenario == scenario.replace(title=scenario.title)
    assert scenario != PAPER.replace(v2x={**v2x, "tells": ["mass"]})
    assert scenario.v2x.drawn and PAPER.v2x.channel_keys == ()


def test_given_worlds__have_messages_if_no_message_can_be_lost() -> None:
    sure = LINE.replace(v2x={"link_latency_s": 0.2, "senses": "none", "persistence": "periodic"})
    given_memory, drawn = (w.memories["messages"] for w in (worlds_from_state(sure, {}), sure.sample(1, 7)))
    for one, other, name in zip(given_memory, drawn, drawn._fields, strict=True):
        assert name == "channel" or one.tobytes() == other.tobytes()


def test_worlds__that_are_drawn_again_have_their_own_memory() -> None:
    crowded = PAPER.replace(gaps_m={"uniform": [0.2, 2.0]}, v2x=PERIODIC)
    rejecting, keeping = (crowded.replace(early_impacts=each) for each in ("reject", "keep"))
    drawn, all_worlds = rejecting.draw(200, 7), keeping.draw(200, 7)
    again = (drawn.worlds.gaps_m != all_worlds.worlds.gaps_m).any(axis=1)
    assert 20 < again.sum() < 180
    keys = [each.worlds.memories["messages"].channel[:, 4] for each in (drawn, all_worlds)]
    np.testing.assert_array_equal(keys[0] != keys[1], again)
    first = np.maximum(drawn.worlds.latency_s[:, 1], drawn.worlds.memories["messages"].heard_s[:, 2, 1])
    seen = drawn.worlds.memories["messages"].seen_s[:, 2, 1]
    np.testing.assert_array_equal(
        drawn.worlds.know[:, 2, 1], np.minimum(first, np.maximum(drawn.worlds.latency_s[:, 1], seen))
    )
