"""What parts of the user's own are refused: at registration, and when they give something else than they said."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import AlreadyExists, UnknownName
from ethbrake_marl.first_edition.game.features import FEATURES
from ethbrake_marl.first_edition.game.rewards import reward_params
from tests.fixtures.policies import make_policy
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
SCALED: dict[str, Any] = {"unit": "1", "scale": 2.0, "low": -1.0, "high": 1.0}


def gives(value: Any) -> Callable[..., Any]:
    """A function that gives this, or what this makes of its first argument."""

    def given(*arguments: Any) -> Any:
        """For a test."""
        return value(arguments[0]) if callable(value) else value

    return given


TIME = gives(lambda worlds: worlds.time_s)
NOTHING = gives(lambda episodes: np.zeros(episodes.worlds.n))


PARTS: dict[str, Callable[[], object]] = {
    "feature 'front_1.gap': the name must be": lambda: eb.register_feature("front_1.gap", TIME, **SCALED),
    "feature 'mine': must be a function with": lambda: eb.register_feature("mine", 3, **SCALED),
    "feature 'mine': scale = 0: must be": lambda: eb.register_feature("mine", TIME, **SCALED | {"scale": 0.0}),
    "feature 'mine': low = 1: must be below": lambda: eb.register_feature("mine", TIME, **SCALED | {"low": 1.0}),
    "feature 'mine': its function returned": lambda: eb.register_feature("mine", gives(1.0), **SCALED),
    "feature 'mine': its value is nan for": lambda: eb.register_feature(
        "mine", gives(lambda worlds: np.full(worlds.n, np.nan)), **SCALED
    ),
    "feature 'mine': its function fails for": lambda: eb.register_feature(
        "mine", gives(lambda worlds: worlds.speeds_mps.fill(0.0)), **SCALED
    ),
    "observation: own.speed is listed twice": lambda: eb.choose_observation(["own", "own.speed"]),
    "observation: must be a list of groups": lambda: eb.choose_observation([]),
    "feature 'age' describes a neighbour;": lambda: eb.choose_observation(["age"]),
    "observation: 5: must be the name of a": lambda: eb.choose_observation([5]),
    "recipe 'ppo': observation =": lambda: eb.load_recipe("ppo").replace(observation=["front_1.gp"]),
    "preset 'My preset': the name must be 1": lambda: eb.register_preset("My preset", {}),
    "must be a preset: paper, clear,": lambda: eb.register_preset("mine", {"preset": "ruarl"}),
    "objective 'Mine': the name must be 1 to": lambda: eb.register_objective("Mine", gives(0.0)),
    "objective 'mine': must be a function": lambda: eb.register_objective("mine", 3),
    "measure 'Squared': the name must be 1": lambda: eb.register_measure("Squared", NOTHING, unit="1"),
    "measure 'mine': must be a function with": lambda: eb.register_measure("mine", 3, unit="1"),
    "its function returned float64 of shape": lambda: eb.register_measure("mine", gives(1.0), unit="1"),
    "measure 'mine': its value is nan in": lambda: eb.register_measure(
        "mine", gives(lambda episodes: np.full(episodes.worlds.n, np.nan)), unit="1"
    ),
    "measure 'mine': its function fails:": lambda: eb.register_measure(
        "mine", gives(lambda episodes: episodes.rows.closing_speed_mps.fill(0.0)), unit="1"
    ),
    "scenarios 'nowhere': is not an existing": lambda: eb.register_scenarios("nowhere"),
}


@pytest.mark.parametrize("message", PARTS)
def test_part__is_refused(message: str) -> None:
    with refused(message):
        PARTS[message]()


THERE: dict[str, Callable[[], object]] = {
    "feature 'own': this name is already in": lambda: eb.register_feature("own", TIME, **SCALED),
    "objective 'own' is registered already;": lambda: eb.register_objective("own", gives(0.0)),
    "agent 'ladder': is the name of a group": lambda: eb.register_agent("ladder", gives(None)),
}


@pytest.mark.parametrize("message", THERE)
def test_part__of_a_name_that_is_there_is_refused(message: str) -> None:
    with refused(message, AlreadyExists):
        THERE[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown feature 'zzz'": lambda: eb.choose_observation(["own", "zzz"]),
    "unknown setting of a reward 'jrek'; did": lambda: reward_params({"jrek": 1.0}),
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


@pytest.mark.parametrize(
    "register",
    [
        lambda value: eb.register_feature("mine", value, **SCALED),
        lambda value: eb.register_measure("mine", value, unit="1"),
    ],
)
def test_part__needs_a_docstring_and_a_name_that_no_other_part_has(register: Callable[[Any], None]) -> None:
    with refused(" 'mine': must be a function with a docstring that describes the"):
        register(lambda *given: given[0])
    ours = gives(lambda first: np.zeros(len(first.time_s) if hasattr(first, "time_s") else first.worlds.n))
    register(ours)
    register(ours)
    with refused(" 'mine' is registered already; give another name", AlreadyExists):
        register(gives(lambda first: np.zeros(len(first.time_s) if hasattr(first, "time_s") else first.worlds.n)))


def started(reward: dict[str, Any]) -> Any:
    """An environment with this reward, at the beginning of an episode."""
    env = eb.parallel_env("paper-random", reward=reward)
    env.reset(seed=1)
    return env


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda step: step.speeds_mps[:, :1], "its function returned float64 of shape"),
        (lambda step: np.full(len(step.time_s), np.nan), "its value is nan in world 0; must be"),
        (lambda step: step.speeds_mps.fill(0.0), "its function fails: ValueError:"),
    ],
)
def test_measure_by_step__gives_a_finite_number_per_vehicle(given: Any, message: str) -> None:
    with refused(f"measure 'mine': {message}"):
        eb.register_measure("mine", gives(given), by="step")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (1.0, "its function returned float64 values of"),
        (lambda harm: np.full(len(harm.whole), np.nan), "its function returned nan for vehicle_1"),
    ],
)
def test_objective__gives_a_finite_number_per_world_and_changes_nothing(given: Any, message: str) -> None:
    eb.register_objective("mine", gives(given))
    with refused(f"objective 'mine': {message}"):
        started({"harm": 1.0, "objective": "mine"}).step({"vehicle_2": [0.0]})


@pytest.mark.parametrize(
    ("urgency", "message"),
    [(None, "observes the feature 'urgency', which"), ((1.0, 3.0), "observes the feature 'urgency', whose")],
)
def test_policy__observes_the_features_that_it_was_trained_on(urgency: Any, message: str, empty_folder: Path) -> None:
    eb.register_feature("urgency", gives(lambda worlds: worlds.speeds_mps[:, 0] / 40.0), **SCALED)
    make_policy(eb.choose_observation(["own", "urgency"]), {"name": "paper-random"}).save(Path("kept"))
    eb.load_policy("kept")
    del FEATURES.loaded["urgency"]
    if urgency is not None:
        factor, scale = urgency
        other = gives(lambda worlds: factor * worlds.speeds_mps[:, 0] / 40.0)
        eb.register_feature("urgency", other, **SCALED | {"scale": scale})
    with refused(f"kept/manifest.json: the policy {message}"):
        eb.load_policy("kept")


@pytest.mark.parametrize(
    ("few", "kind"),
    [(lambda n: np.zeros(n, bool), "truth value per world"), (lambda n: np.zeros((n, 3)), "number per vehicle")],
    ids=["truth", "number per vehicle"],
)
def test_measure__always_gives_what_it_gave_when_it_was_registered(few: Any, kind: str) -> None:
    changes = gives(lambda episodes: few(episodes.worlds.n) if episodes.worlds.n < 10 else np.zeros(episodes.worlds.n))
    eb.register_measure("mine", changes, unit="1")
    with refused(f"measure 'mine': its function returned a number per world, but a {kind} when it was registered"):
        eb.evaluate(PAPER.sample(40, 7), {"full_brake": eb.make_agent("full_brake")}, scenario=PAPER)
