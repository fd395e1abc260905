"""What parts of the user's own are refused: at registration, and when they give something else than they said."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName
from ethbrake_marl.worlds.channel import ChannelKey, register_v2x_key
from ethbrake_marl.worlds.quantity import ScenarioPart
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
SCALED: dict[str, Any] = {"unit": "1", "scale": 2.0, "low": -1.0, "high": 1.0}


def gives(value: Any) -> Callable[..., Any]:
    """A function that gives this, or what this makes of its arguments."""

    def given(*arguments: Any) -> Any:
        """For a test."""
        return value(*arguments) if callable(value) else value

    return given


PARTS: dict[str, Callable[[], object]] = {
    "feature 'own': this is the name of a group": lambda: eb.register_feature("own", gives(0.0), **SCALED),
    "feature 'gap': the group obstacle has a feature of this name": lambda: eb.register_feature(
        "gap", gives(0.0), of="neighbour", **SCALED
    ),
    "feature 'mine': must be a function with a docstring": lambda: eb.register_feature("mine", 3, **SCALED),
    "low = 1, high = 1: scale must be above 0": lambda: eb.register_feature("mine", gives(0.0), **SCALED | {"low": 1}),
    "feature 'mine': unknown = nan: must be": lambda: eb.register_feature(
        "mine", gives(0.0), **SCALED, unknown=float("nan")
    ),
    "preset 'mine': preset = ruarl: must be a preset (paper, clear,": lambda: eb.register_preset(
        "mine", {"preset": "ruarl"}
    ),
    "objective 'Mine': the name must be 1 to": lambda: eb.register_objective("Mine", gives(0.0)),
    "term 'Mine': the name must be 1 to": lambda: eb.register_term("Mine", gives(0.0)),
    "term 'mine': must be a function with a": lambda: eb.register_term("mine", lambda before, step, after: 0.0),
    "measure 'mine': give one function, of": lambda: eb.register_measure("mine", lambda game, alert, last: 0.0),
    "agent 'My agent': the name must have": lambda: eb.register_agent("My agent", gives(0.0)),
    "agent 'mine': knows = 'all': must be one": lambda: eb.register_agent("mine", gives(0.0), knows="all"),
    "scenarios 'nowhere': has no file that": lambda: eb.register_scenarios("nowhere"),
}


@pytest.mark.parametrize("message", PARTS)
def test_part__is_refused(message: str) -> None:
    with refused(message):
        PARTS[message]()


THERE: dict[str, Callable[[], object]] = {
    "feature 'place' is registered already;": lambda: eb.register_feature("place", gives(0.0), **SCALED),
    "term 'harm': this name is already in": lambda: eb.register_term("harm", gives(0.0)),
    "measure 'total_harm': this name is": lambda: eb.register_measure("total_harm", gives(0.0)),
    "agent 'coast' is registered already;": lambda: eb.register_agent("coast", gives(0.0)),
    "preset 'paper': another channel is already registered": lambda: eb.register_preset("paper", {"preset": "nominal"}),
}


@pytest.mark.parametrize("message", THERE)
def test_part__of_a_name_that_is_there_is_refused(message: str) -> None:
    with refused(message, AlreadyExists):
        THERE[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown term or setting of a reward 'jrek'": lambda: eb.parallel_env(scenario=PAPER, reward={"jrek": 1.0}),
    "unknown objective 'onw'; did you mean": lambda: PAPER.replace(objective="onw"),
    "unknown agent 'caost'; did you mean": lambda: eb.make_agent("caost"),
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        NAMES[message]()
    assert message in str(caught.value)
    assert isinstance(caught.value, UnknownName) or "objective" in message  # a scenario names its key


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda state, body: np.full(state.n, np.nan), "nan"),
        (lambda state, body: state.speeds_mps.fill(0.0), "read-only"),
    ],
    ids=["nan", "in place"],
)
def test_feature__gives_a_finite_number_per_world(given: Any, message: str) -> None:
    eb.register_feature("mine", gives(given), **SCALED)
    with pytest.raises(InvalidInput, match=f"feature 'mine' of vehicle_1: .*{message}"):
        eb.parallel_env(scenario=PAPER, observation=["mine"]).reset(seed=1)


@pytest.mark.parametrize("body", [3])
def test_feature_or_objective__that_is_wrong_for_one_vehicle_names_it(body: int) -> None:
    eb.register_feature(
        "mine", gives(lambda state, other: np.full(state.n, np.nan if other == body else 0.0)), **SCALED
    )
    with refused(f"feature 'mine' of vehicle_{body}: its value is nan in row 0 at 0.5 s"):
        eb.parallel_env(scenario=PAPER, observation=["mine"]).reset(seed=1)
    eb.register_objective("mine", gives(lambda harm, place: harm.whole * (np.nan if place == body - 1 else 1.0)))
    env = eb.parallel_env(scenario=PAPER, reward={"harm": 1.0, "objective": "mine"})
    env.reset(seed=1)
    with refused(f"objective 'mine' of vehicle_{body}: its value is not finite in row 0"):
        env.step({"vehicle_2": [0.0]})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda harm, vehicle: np.full(len(harm.whole), np.nan), "its value is not finite in row 0"),
        (lambda harm, vehicle: harm.pears, "its function fails: AttributeError"),
    ],
    ids=["nan", "error"],
)
def test_objective__gives_a_finite_number_per_world(given: Any, message: str) -> None:
    eb.register_objective("mine", gives(given))
    env = eb.parallel_env(scenario=PAPER, reward={"harm": 1.0, "objective": "mine"})
    env.reset(seed=1)
    with refused(f"objective 'mine' of vehicle_1: {message}"):
        env.step({"vehicle_2": [0.0]})


WORDS = "'own sensors', 'messages', 'estimated model', 'true state', 'true model', or 'not stated'"


@pytest.mark.parametrize(
    ("agent", "message"),
    [
        (Held("coast", "sensors"), f"knows = 'sensors': must be one of {WORDS}"),
        (
            {"vehicle_2": Held("coast", None)},
            "vehicle_2 = Held(name='coast', knows=None): knows = None: must be one of",
        ),
        (eb.Team("ours", {2: Held("coast", "a lot")}), "team 'mine': vehicle_2: knows = 'a lot': must be one of"),
        ({"vehicle_2": "coast", "vehicle_9": "coast"}, "drives vehicle_2, vehicle_9; must drive exactly vehicle_2"),
    ],
    ids=["knows", "in a mapping", "in a team", "too many"],
)
def test_agent__that_is_none_is_refused(agent: Any, message: str) -> None:
    with refused(message):
        eb.evaluate(PAPER, {"mine": agent}, episodes=2)


def test_objective__arguments_are_texts_or_numbers() -> None:
    def mine(harm: Any, vehicle: int, argument: Any) -> Any:
        """Harm of the line."""
        return harm.whole

    for arguments in ([1, 2], 5, None, int, str):
        with pytest.raises(InvalidInput, match="must be a list of texts, or float"):
            eb.register_objective("with-argument", mine, arguments=arguments)  # type: ignore[arg-type]


def test_v2x_key__has_a_name_and_keys() -> None:
    class Keys(ScenarioPart):
        gap_noise_m: float = 0.0
        silent_links: float = 0.0

    class GapNoise(ChannelKey):
        name, keys = "gap_noise", Keys

    for key, wrong in (("gap_noise", GapNoise()), ("gap_noise_m", GapNoise), ("gap_noise_m", "text")):
        with pytest.raises(InvalidInput, match=f"key '{key}' of v2x: .* must be a ChannelKey with a name"):
            register_v2x_key(key, wrong)  # type: ignore[arg-type]
    with pytest.raises(AlreadyExists, match="already in use"):
        register_v2x_key("silent_links", GapNoise())
