"""What parts of the user's own are refused: at registration, and when they give something else than they said."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import AlreadyExists, UnknownName
from ethbrake_marl.game.features import FEATURES
from ethbrake_marl.game.rewards import reward_params
from ethbrake_marl.scenario.catalogue import new_scenario_text
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
    "reward: terms: unknown measure 'hury'": lambda: reward_params({"terms": {"hury": 1.0}}),
    "feature 'front_1.gap': the name must be 1 to 64 characters a-z, 0-9 and _, beginning with a": lambda: (
        eb.register_feature("front_1.gap", TIME, **SCALED)
    ),
    "feature 'mine': must be a function with a docstring that describes the": lambda: eb.register_feature(
        "mine", 3, **SCALED
    ),
    "feature 'mine': scale = 0: must be above 0": lambda: eb.register_feature("mine", TIME, **SCALED | {"scale": 0.0}),
    "feature 'mine': low = 1: must be below high (1)": lambda: eb.register_feature(
        "mine", TIME, **SCALED | {"low": 1.0}
    ),
    "feature 'mine': high = nan: must be a finite number": lambda: eb.register_feature(
        "mine", TIME, **SCALED | {"high": float("nan")}
    ),
    "of = 'both', unknown = 0: of must be 'own' or 'neighbour'; with of = 'own'": lambda: eb.register_feature(
        "mine", TIME, **SCALED, of="both"
    ),
    "of = 'own', unknown = 1: of must be 'own' or 'neighbour'; with of = 'own'": lambda: eb.register_feature(
        "mine", TIME, **SCALED, unknown=1.0
    ),
    "feature 'mine': its function returned float64 values of shape (); must return numbers of shape (3,),": lambda: (
        eb.register_feature("mine", gives(1.0), **SCALED)
    ),
    "feature 'mine': its value is nan for vehicle_1 in world 0 at 0 s; must be finite": lambda: eb.register_feature(
        "mine", gives(lambda worlds: np.full(worlds.n, np.nan)), **SCALED
    ),
    "feature 'mine': its function fails for a line of three vehicles: ValueError: assignment destination": lambda: (
        eb.register_feature("mine", gives(lambda worlds: worlds.speeds_mps.fill(0.0)), **SCALED)
    ),
    "observation: own.speed is listed twice": lambda: eb.choose_observation(["own", "own.speed"]),
    "observation: must be a list of groups and features": lambda: eb.choose_observation([]),
    "feature 'age' describes a neighbour; write front_1.age or rear_1.age": lambda: eb.choose_observation(["age"]),
    "observation: 5: must be the name of a group or of a feature": lambda: eb.choose_observation([5]),
    "scenario 'paper-random': observation = [own, own.speed]: own.speed is listed twice": lambda: PAPER.replace(
        observation=["own", "own.speed"]
    ),
    "unknown feature 'front_1.gp'; did you mean 'front_1.gap'?": lambda: PAPER.replace(observation=["front_1.gp"]),
    "recipe 'ppo': observation = [front_1.gp]: unknown feature 'front_1.gp'; did you mean 'front_1.gap'?": lambda: (
        eb.load_recipe("ppo").replace(observation=["front_1.gp"])
    ),
    "recipe 'ppo': reward.rsik: unknown key; did you mean risk?": lambda: eb.load_recipe("ppo").replace(
        reward={"harm": 1.0, "rsik": 0.5}
    ),
    "preset 'My preset': the name must be 1 to 64 characters a-z, 0-9, - and _, beginning with a": lambda: (
        eb.register_preset("My preset", {})
    ),
    "must be a preset: paper, clear, nominal, congested, blocked or": lambda: eb.register_preset(
        "mine", {"preset": "ruarl"}
    ),
    "preset 'mine': los: unknown key; did you mean lost?": lambda: eb.register_preset("mine", {"los": 1}),
    "preset 'mine': lost = 2: must be less than or equal to 1": lambda: eb.register_preset(
        "mine", {"preset": "clear", "lost": 2.0}
    ),
    "preset paper generates no messages; leave it out": lambda: eb.register_preset("mine", {"loss_begins": 0.1}),
    "preset 'mine': settings = 'clear': must be a mapping such as {'lost'": lambda: eb.register_preset("mine", "clear"),
    "objective 'Mine': the name must be 1 to 64 characters a-z, 0-9, - and _, beginning with a": lambda: (
        eb.register_objective("Mine", gives(0.0))
    ),
    "objective 'mine': must be a function with a docstring that describes the objective": lambda: eb.register_objective(
        "mine", 3
    ),
    "measure 'Squared': the name must be 1 to 64 characters a-z, 0-9 and _, and must begin with a letter; it": lambda: (
        eb.register_measure("Squared", NOTHING, unit="1")
    ),
    "measure 'delta_v_2': the name must be 1 to 64 characters a-z, 0-9 and _, and must begin with a letter;": lambda: (
        eb.register_measure("delta_v_2", NOTHING, unit="1")
    ),
    "measure 'delta_v_interval': the name must be 1 to 64 characters a-z, 0-9 and _, and must begin with a": lambda: (
        eb.register_measure("delta_v_interval", NOTHING, unit="1")
    ),
    "measure 'mine': must be a function with a docstring that describes the measure": lambda: eb.register_measure(
        "mine", 3, unit="1"
    ),
    "its function returned float64 of shape (); must return numbers of shape (2,), one per world or (2, 3)": lambda: (
        eb.register_measure("mine", gives(1.0), unit="1")
    ),
    "measure 'mine': its value is nan in world 0; must be finite": lambda: eb.register_measure(
        "mine", gives(lambda episodes: np.full(episodes.worlds.n, np.nan)), unit="1"
    ),
    "its function returned object of shape (); must return numbers of shape (2,), one per world or (2, 3)": lambda: (
        eb.register_measure(
            "mine", gives(lambda episodes: np.ma.masked_array(np.zeros(episodes.worlds.n), True)), unit="1"
        )
    ),
    "measure 'mine': its function fails: ValueError: assignment destination is read-only": lambda: eb.register_measure(
        "mine", gives(lambda episodes: episodes.rows.closing_speed_mps.fill(0.0)), unit="1"
    ),
    "scenarios 'nowhere': is not an existing folder": lambda: eb.register_scenarios("nowhere"),
}


@pytest.mark.parametrize("message", PARTS)
def test_part__is_refused(message: str) -> None:
    with refused(message):
        PARTS[message]()


THERE: dict[str, Callable[[], object]] = {
    "feature 'own': this name is already in use; give another name": lambda: eb.register_feature("own", TIME, **SCALED),
    "feature 'front_1': this name is already in use; give another name": lambda: eb.register_feature(
        "front_1", TIME, **SCALED
    ),
    "feature 'gap': this name is already in use; give another name": lambda: eb.register_feature("gap", TIME, **SCALED),
    "measure 'jerk': this name is already in use; give another name": lambda: eb.register_measure("jerk", NOTHING),
    "measure 'k_energy': this name is already in use; give another name": lambda: eb.register_measure(
        "k_energy", NOTHING
    ),
    "preset 'nominal': another channel is already registered under this": lambda: eb.register_preset(
        "nominal", {"lost": 0.1, "preset": "clear"}
    ),
    "objective 'own' is registered already; give another name": lambda: eb.register_objective("own", gives(0.0)),
    "agent 'ladder': is the name of a group of agents; choose another name": lambda: eb.register_agent(
        "ladder", gives(None)
    ),
}


@pytest.mark.parametrize("message", THERE)
def test_part__of_a_name_that_is_there_is_refused(message: str) -> None:
    with refused(message, AlreadyExists):
        THERE[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown feature 'zzz'": lambda: eb.choose_observation(["own", "zzz"]),
    "unknown feature 'onw'; did you mean 'own'?": lambda: eb.choose_observation(["onw"]),
    "unknown feature 'front_1.gp'; did you mean 'front_1.gap'?": lambda: eb.choose_observation(["front_1.gp"]),
    "unknown setting of a reward 'jrek'; did you mean 'jerk'?": lambda: reward_params({"jrek": 1.0}),
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


@pytest.mark.parametrize(
    "register",
    [
        lambda value: eb.register_feature("mine", value, **SCALED),
        lambda value: eb.register_measure("mine", value, by="step"),
        lambda value: eb.register_objective("mine", value),
        lambda value: eb.register_measure("mine", value, unit="1"),
    ],
    ids=["feature", "measure by step", "objective", "measure by impacts"],
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
        (
            lambda step: step.speeds_mps[:, :1],
            "its function returned float64 of shape (2, 1); must return numbers of shape",
        ),
        (
            "no",
            "its function returned <U2 of shape (); must return numbers of shape (2,), one per world or (2, 3), one",
        ),
        (
            None,
            "its function returned object of shape (); must return numbers of shape (2,), one per world or (2, 3), one",
        ),
        (lambda step: np.full(len(step.time_s), np.nan), "its value is nan in world 0; must be finite"),
        (
            lambda step: np.full(step.speeds_mps.shape, np.inf),
            "its value is inf for vehicle_1 in world 0; must be finite",
        ),
        (lambda step: step.speed_mps, "its function fails: AttributeError: 'StepOutcome' object has no attribute"),
        (lambda step: step.speeds_mps.fill(0.0), "its function fails: ValueError: assignment destination is read-only"),
    ],
    ids=["shape", "text", "nothing", "nan", "inf", "fails", "writes"],
)
def test_measure_by_step__gives_a_finite_number_per_vehicle(given: Any, message: str) -> None:
    with refused(f"measure 'mine': {message}"):
        eb.register_measure("mine", gives(given), by="step")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (1.0, "its function returned float64 values of shape (); must return numbers of shape (1,), one"),
        (lambda harm: np.full(len(harm.whole), np.nan), "its function returned nan for vehicle_1 in world 0; must be"),
        (lambda harm: harm.borne.fill(0.0), "its function fails for vehicle_1: ValueError: assignment destination is"),
    ],
    ids=["shape", "nan", "writes"],
)
def test_objective__gives_a_finite_number_per_world_and_changes_nothing(given: Any, message: str) -> None:
    eb.register_objective("mine", gives(given))
    with refused(f"objective 'mine': {message}"):
        started({"harm": 1.0, "objective": "mine"}).step({"vehicle_2": [0.0]})


def test_objective__of_the_user_is_suggested_and_takes_no_argument() -> None:
    eb.register_objective("front-first", gives(lambda harm: harm.borne[:, 0]))
    with refused("objective = frontfirst: unknown objective 'frontfirst'; did you mean 'front-first'?"):
        PAPER.replace(objective="frontfirst")
    with refused("objective 'front-first:3': front-first takes no argument"):
        PAPER.replace(objective="front-first:3")


def test_feature__that_is_not_finite_later_is_told_with_its_world_and_step() -> None:
    late = gives(lambda worlds: np.where((worlds.time_s > 1.0) & (np.arange(worlds.n) == 1), np.inf, 0.0))
    eb.register_feature("late", late, **SCALED)
    engine = eb.make_sb3_vec_env(PAPER, 3, seed=1, observation=["own", "late"]).engine
    with refused("feature 'late': its value is inf for vehicle_2 in world 1 at 1.1 s after step 6; must be finite"):
        for _ in range(20):
            engine.step(-np.ones((3, 1)))
            engine.observe(1)


@pytest.mark.parametrize(
    ("urgency", "message"),
    [
        (None, "observes the feature 'urgency', which is not registered; install the package that registers"),
        ((1.0, 3.0), "observes the feature 'urgency', whose scale was 2.0 in training and is 3.0 now"),
        ((1.001, 2.0), "observes the feature 'urgency', whose function now returns other numbers than in training"),
    ],
    ids=["missing", "other scale", "other numbers"],
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


def test_channel__of_the_user_is_checked_and_listed_as_ours() -> None:
    eb.register_preset("wired", {"preset": "nominal", "link_latency_s": 0.4})
    with refused("v2x.radio_s = 0.1: has no effect, because link_latency_s fixes the delay of messages"):
        PAPER.replace(v2x={"preset": "wired", "radio_s": 0.1})
    with refused(
        "v2x.preset = wierd: must be a preset: paper, clear, nominal, congested, blocked, sensors-only or wired"
    ):
        PAPER.replace(v2x="wierd")


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


def folder(name: str, *scenarios: str) -> None:
    """A folder with these scenarios."""
    Path(name).mkdir()
    for scenario in scenarios:
        Path(name, f"{scenario}.yaml").write_text(new_scenario_text(scenario))


def test_folder_of_scenarios__has_some_and_names_of_its_own(empty_folder: Path) -> None:
    folder("empty")
    with refused("scenarios 'empty': has no file that ends in .yaml"):
        eb.register_scenarios("empty")
    folder("shipped", "paper-random")
    with refused(
        "shipped/paper-random.yaml: a shipped scenario already has the name 'paper-random'; rename", AlreadyExists
    ):
        eb.register_scenarios("shipped")
    folder("mine", "hills", "valleys")
    folder("twin", "hills")
    eb.register_scenarios("mine")
    with refused("mine/hills.yaml already has the name 'hills'; rename the file", AlreadyExists):
        eb.register_scenarios("twin")
    with refused("unknown scenario 'valley'; did you mean 'valleys'?", UnknownName):
        eb.load_scenario("valley")
    Path("mine", "valleys.yaml").write_text("name: valleys\n")
    with refused(
        "mine/valleys.yaml: braking_capacity_mps2: missing; write, for instance, braking_capacity_mps2: [6, 7"
    ):
        eb.load_scenario("valleys")
