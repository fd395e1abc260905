"""What parts of the user's own are refused: at registration, and when they give something else than they said."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.episode.features import FEATURES
from ethbrake_marl.errors import AgentFailed, AlreadyExists, InvalidInput, UnknownName
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
    "feature 'front_1.gap': the name must be": lambda: eb.register_feature("front_1.gap", gives(0.0), **SCALED),
    "feature 'own': this is the name of a group": lambda: eb.register_feature("own", gives(0.0), **SCALED),
    "feature 'contact': this is the name of a group": lambda: eb.register_feature("contact", gives(0.0), **SCALED),
    "feature 'gap': the group obstacle has a feature of this name": lambda: eb.register_feature(
        "gap", gives(0.0), of="neighbour", **SCALED
    ),
    "feature 'mine': must be a function with a docstring": lambda: eb.register_feature("mine", 3, **SCALED),
    "feature 'mine': scale = 0": lambda: eb.register_feature("mine", gives(0.0), **SCALED | {"scale": 0.0}),
    "low = 1, high = 1: scale must be above 0": lambda: eb.register_feature("mine", gives(0.0), **SCALED | {"low": 1}),
    "feature 'mine': unknown = nan: must be": lambda: eb.register_feature(
        "mine", gives(0.0), **SCALED, unknown=float("nan")
    ),
    "feature 'mine': of = 'both': must be": lambda: eb.register_feature("mine", gives(0.0), **SCALED, of="both"),
    "preset 'My preset': the name must be 1": lambda: eb.register_preset("My preset", {}),
    "preset 'mine': preset = ruarl: must be a preset (paper, clear,": lambda: eb.register_preset(
        "mine", {"preset": "ruarl"}
    ),
    "objective 'Mine': the name must be 1 to": lambda: eb.register_objective("Mine", gives(0.0)),
    "objective 'vehicle_2': the name must be 1 to": lambda: eb.register_objective("vehicle_2", gives(0.0)),
    "objective 'mine': must be a function": lambda: eb.register_objective("mine", 3),
    "term 'Mine': the name must be 1 to": lambda: eb.register_term("Mine", gives(0.0)),
    "term 'calm_2': the name must be 1 to": lambda: eb.register_term("calm_2", gives(0.0)),
    "term 'mine': must be a function with a": lambda: eb.register_term("mine", lambda before, step, after: 0.0),
    "measure 'Mine': the name must be 1 to": lambda: eb.register_measure("Mine", gives(0.0)),
    "measure 'mine': give one function, of": lambda: eb.register_measure("mine", lambda game, alert, last: 0.0),
    "agent 'My agent': the name must have": lambda: eb.register_agent("My agent", gives(0.0)),
    "agent 'mine': knows = 'all': must be one": lambda: eb.register_agent("mine", gives(0.0), knows="all"),
    "shield or search 'mine': knows = 'all': ": lambda: eb.register_shield("mine", gives(0.0), knows="all"),
    "scenarios 'nowhere': has no file that": lambda: eb.register_scenarios("nowhere"),
}


@pytest.mark.parametrize("message", PARTS)
def test_part__is_refused(message: str) -> None:
    with refused(message):
        PARTS[message]()


THERE: dict[str, Callable[[], object]] = {
    "feature 'place' is registered already;": lambda: eb.register_feature("place", gives(0.0), **SCALED),
    "objective 'own' is registered already;": lambda: eb.register_objective("own", gives(0.0)),
    "term 'harm': this name is already in": lambda: eb.register_term("harm", gives(0.0)),
    "term 'intervention' is registered already;": lambda: eb.register_term("intervention", gives(0.0)),
    "measure 'total_harm': this name is": lambda: eb.register_measure("total_harm", gives(0.0)),
    "measure 'pushed_m' is registered already;": lambda: eb.register_measure("pushed_m", gives(0.0)),
    "agent 'coast' is registered already;": lambda: eb.register_agent("coast", gives(0.0)),
    "shield or search 'step' is registered already;": lambda: eb.register_shield("step", gives(0.0)),
    "preset 'paper': another channel is already registered": lambda: eb.register_preset("paper", {"preset": "nominal"}),
}


@pytest.mark.parametrize("message", THERE)
def test_part__of_a_name_that_is_there_is_refused(message: str) -> None:
    with refused(message, AlreadyExists):
        THERE[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown feature 'zzz'; known: ": lambda: eb.View(["own", "zzz"]),
    "unknown term or setting of a reward 'jrek'": lambda: eb.parallel_env(scenario=PAPER, reward={"jrek": 1.0}),
    "unknown objective 'onw'; did you mean": lambda: PAPER.replace(objective="onw"),
    "unknown measure 'pushed_n'; did you mean": lambda: eb.evaluate(PAPER, "coast", episodes=2, measures="pushed_n"),
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
        (1.0, "returned float64"),
        (lambda state, body: np.full(state.n, np.nan), "nan"),
        (lambda state, body: state.speed_mps, "its function fails"),
        (lambda state, body: state.speeds_mps.fill(0.0), "read-only"),
    ],
    ids=["shape", "nan", "error", "in place"],
)
def test_feature__gives_a_finite_number_per_world(given: Any, message: str) -> None:
    eb.register_feature("mine", gives(given), **SCALED)
    with pytest.raises(InvalidInput, match=f"feature 'mine' of vehicle_1: .*{message}"):
        eb.parallel_env(scenario=PAPER, observation=["mine"]).reset(seed=1)


@pytest.mark.parametrize("body", [2, 3])
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
        (1.0, "its function returned float64 of shape (); must return numbers of shape (1,), one per world"),
        (lambda harm, vehicle: np.full(len(harm.whole), np.nan), "its value is not finite in row 0"),
        (lambda harm, vehicle: harm.pears, "its function fails: AttributeError"),
    ],
    ids=["shape", "nan", "error"],
)
def test_objective__gives_a_finite_number_per_world(given: Any, message: str) -> None:
    eb.register_objective("mine", gives(given))
    env = eb.parallel_env(scenario=PAPER, reward={"harm": 1.0, "objective": "mine"})
    env.reset(seed=1)
    with refused(f"objective 'mine' of vehicle_1: {message}"):
        env.step({"vehicle_2": [0.0]})


class Wrong:
    """Answers with what it was made of."""

    name, knows = "wrong", "own sensors"

    def __init__(self, answer: Callable[[eb.State], Any]) -> None:
        self.answer = answer

    def begin(self, alert: eb.State, body: int) -> None:
        return None

    def act(self, state: eb.State, memory: None, body: int) -> Any:
        return self.answer(state)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda state: np.zeros(state.n), "vehicle_2: act returned array([0., 0.]); must return commands and memory"),
        (lambda state: (np.zeros((state.n, 1)), None), "must be numbers of the shape (2,)"),
        (
            lambda state: (np.full(state.n, -99.0), None),
            "world 0, vehicle_2 at 0.50 s: command -99 m/s2; must be in [-7",
        ),
        (lambda state: (np.full(state.n, np.nan), None), "command nan m/s2; must be in [-7, 7] m/s2"),
        (lambda state: state.speed, "vehicle_2: act fails: AttributeError"),
        (lambda state: state.line.fill(0.0), "read-only"),
    ],
    ids=["no memory", "shape", "beyond", "nan", "error", "in place"],
)
def test_agent__that_answers_wrongly_is_named_once_as_the_user_calls_it(answer: Any, message: str) -> None:
    with pytest.raises(AgentFailed) as caught:
        eb.evaluate(PAPER, {"mine": Wrong(answer)}, episodes=2)
    assert str(caught.value).startswith("agent 'mine'") and message in str(caught.value)
    assert str(caught.value).count("agent") == 1


WORDS = "'own sensors', 'messages', 'estimated model', 'true state', 'true model', or 'not stated'"


@pytest.mark.parametrize(
    ("agent", "message"),
    [
        (object(), "has no name and no knows and no begin and no act; must be an agent"),
        (Held("coast", "sensors"), f"knows = 'sensors': must be one of {WORDS}"),
        (Held("coast", np.zeros(2)), "knows = array([0., 0.]): must be one of 'own sensors', 'messages',"),
        (
            {"vehicle_2": Held("coast", None)},
            "vehicle_2 = Held(name='coast', knows=None): knows = None: must be one of",
        ),
        (eb.Team("ours", {2: Held("coast", "a lot")}), "team 'mine': vehicle_2: knows = 'a lot': must be one of"),
        ({"vehicle_2": "coast", "vehicle_9": "coast"}, "drives vehicle_2, vehicle_9; must drive exactly vehicle_2"),
        ({1: "coast"}, "team 'mine': 1: must be the name of a vehicle, such as vehicle_2"),
        ("coats", "unknown agent 'coats'; did you mean 'coast'"),
    ],
    ids=["nothing", "knows", "array", "in a mapping", "in a team", "too many", "a number", "unknown"],
)
def test_agent__that_is_none_is_refused(agent: Any, message: str) -> None:
    with refused(message):
        eb.evaluate(PAPER, {"mine": agent}, episodes=2)


@pytest.mark.parametrize(
    ("again", "message"),
    [(None, "observes the feature 'urgency', which is not"), ((1.0, 3.0), "observes the feature 'urgency', ")],
    ids=["gone", "another scale"],
)
def test_policy__observes_the_features_that_it_was_trained_on(again: Any, message: str, empty_folder: Path) -> None:
    from tests.training.tiny import TINY

    eb.register_feature("urgency", gives(lambda state, body: state.speeds_mps[:, 0] / 40.0), **SCALED)
    recipe = TINY.replace(observation=["own", "urgency"], total_steps=128)
    kept = eb.train(recipe, PAPER, "run", measure=None, on_progress=None).directory
    eb.load_policy(kept)
    del FEATURES.loaded["urgency"]
    if again is not None:
        factor, scale = again
        other = gives(lambda state, body: factor * state.speeds_mps[:, 0] / 40.0)
        eb.register_feature("urgency", other, **SCALED | {"scale": scale})
    with refused(f"manifest.json: the policy {message}"):
        eb.load_policy(kept)


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


def test_commands__of_different_lengths_are_refused() -> None:
    class Ragged:
        name, knows = "ragged", "own sensors"

        def begin(self, alert: Any, body: int) -> None:
            return None

        def act(self, state: Any, memory: None, body: int) -> Any:
            return [[1.0], [1.0, 2.0]], None

    with pytest.raises(AgentFailed, match=r"its commands are \[\[1.0\], \[1.0, 2.0\]\]; must be numbers"):
        eb.evaluate("paper-random", {"ragged": eb.Team.of({"vehicle_2": Ragged()}, "ragged")}, episodes=2)
