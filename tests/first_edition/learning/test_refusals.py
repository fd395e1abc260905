"""What recipes, settings, trainings, their folders and teams refuse."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import AlreadyExists, CorruptBundle, UnknownName
from ethbrake_marl.files.store import hold_lock
from ethbrake_marl.first_edition.training.ppo import Ppo
from ethbrake_marl.first_edition.training.recipe import load_recipe, register_algorithm
from ethbrake_marl.first_edition.training.recipes import PpoRecipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.session import resume, train
from ethbrake_marl.first_edition.training.settings import read_settings
from ethbrake_marl.first_edition.training.team import load_team
from ethbrake_marl.first_edition.training.training import Training, check_same_training
from tests.first_edition.learning.tiny import TINY_PPO
from tests.first_edition.rest.fixture_policies import make_policy
from tests.refused import refused

PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")
PPO = load_recipe("ppo")
GOOD = """name: mine
algorithm: ppo
total_steps: 4096
n_envs: 16
n_steps: 32
batch_size: 128
n_epochs: 2
learning_rate: {start: 1e-3, end: 1e-4}
gamma: 0.99
gae_lambda: 0.95
clip_range: 0.2
ent_coef: 0
vf_coef: 0.5
max_grad_norm: 0.5
network: {policy: [8], value: [8, 4]}
reward: {harm: 1}
evaluation: {every_updates: 2, worlds: 10, seed: 7}
checkpoint_every_updates: 3
"""


def recipe(old: str, new: str) -> Any:
    """The recipe of a file that is GOOD with one text changed."""
    assert old in GOOD
    Path("mine.yaml").write_text(GOOD.replace(old, new, 1))
    return load_recipe("mine.yaml")


RECIPES: dict[str, Callable[[], object]] = {
    "mine.yaml, line 4: n_env: unknown key;": lambda: recipe("n_envs: 16", "n_env: 16"),
    "mine.yaml, line 2: algorithm = trpo:": lambda: recipe("algorithm: ppo", "algorithm: trpo"),
    "mine.yaml, line 15: network.policy =": lambda: recipe("policy: [8]", "policy: []"),
    "mine.yaml: must be a mapping of keys to": lambda: recipe(GOOD, "- ppo\n"),
    "recipe 'sac': n_steps: unknown key; did": lambda: load_recipe("sac").replace(n_steps=3),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", RECIPES)
def test_recipe__is_refused(message: str) -> None:
    with refused(message):
        RECIPES[message]()


SETTINGS: dict[str, Callable[[], object]] = {
    "--set 'gamma': must be KEY=VALUE or": lambda: read_settings(["gamma"], [PPO]),
    "--set gamma: this setting is given": lambda: read_settings(["gamma=0.9", "gamma=0.8"], [PPO]),
    "--set gamma.x: 'x' cannot be set inside": lambda: read_settings(["gamma.x=1"], [PPO]).change(PPO),
}


@pytest.mark.parametrize("message", SETTINGS)
def test_setting__is_refused(message: str) -> None:
    with refused(message):
        SETTINGS[message]()


TRAININGS: dict[str, Callable[[], object]] = {
    "algorithm 'My algorithm': the name must": lambda: register_algorithm("My algorithm", PpoRecipe, Ppo),
    "algorithm 'new': recipe = <class": lambda: register_algorithm("new", dict, Ppo),
    "scenario 'cooperation-3-pair' has no": lambda: train(TINY_PPO, PAIR.with_learners([]), Path("run")),
    "scheme single: scenario": lambda: train(TINY_PPO, PAIR, Path("run"), scheme="single"),
    "recipe 'ppo': turns = 5 for each of 2": lambda: train(
        TINY_PPO, PAIR, Path("run"), scheme="independent", steps=2048, turns=5
    ),
    ".: is not the folder of a run; name the": lambda: resume(Path()),
    ".: has no file team.json, so it is not": lambda: load_team(Path(), PAIR),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", TRAININGS)
def test_training__is_refused(message: str) -> None:
    with refused(message):
        TRAININGS[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown recipe 'ppo-papre'; did you": lambda: load_recipe("ppo-papre"),
    "unknown setting 'gama'; did you mean": lambda: read_settings(["gama=0.9"], [PPO]),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


def test_algorithm__has_a_name_of_its_own() -> None:
    with refused("algorithm 'ppo' is registered already; give another name", AlreadyExists):
        register_algorithm("ppo", PpoRecipe, Ppo)


# ---------------------------------------------------------------- the folder of a run


@pytest.fixture
def run(empty_folder: Path) -> RunDirectory:
    """The folder of a training that has begun."""
    scenario = PAPER.model_dump(mode="json", exclude_unset=True)
    return RunDirectory(Path("run")).create({"recipe": TINY_PPO.model_dump(mode="json"), "scenario": scenario})


def test_folder__that_is_there_is_not_replaced_unasked(run: RunDirectory) -> None:
    with refused(
        "run: this run already exists; choose another folder (--output), resume the run (ethbrake train", AlreadyExists
    ):
        RunDirectory(run.path).create({})
    Path("thesis").mkdir()
    Path("thesis/chapter-1").touch()
    with refused("thesis: already exists and is not the folder of a run; choose another name", AlreadyExists):
        RunDirectory(Path("thesis")).create({}, force=True)
    with refused("thesis: already exists and is not the folder of a run; choose another name", AlreadyExists):
        train(TINY_PPO, PAPER, Path("thesis"))


@pytest.mark.parametrize(
    ("training", "other"),
    [
        (lambda: Training.of(TINY_PPO.replace(seed=1), PAPER), "recipe seed"),
        (lambda: Training.of(TINY_PPO, PAPER.replace(name="mine")), "scenario name"),
    ],
)
def test_folder__of_another_training_is_refused(
    training: Callable[[], Training], other: str, run: RunDirectory
) -> None:
    with refused(f"run: this folder contains another training run, which differs in {other}; choose another folder"):
        check_same_training(run, training())


@pytest.mark.parametrize(
    ("status", "message"),
    [
        ('{"format": "ethbrake', "run/run.json: is damaged: Unterminated"),
        ("[]", "run/run.json: is damaged: the content"),
        ("{}", "run/run.json: format = None: must be"),
    ],
)
def test_status_of_a_run__is_refused(status: str | None, message: str, run: RunDirectory) -> None:
    run.status.unlink() if status is None else run.status.write_text(status)
    with refused(message):
        resume(run.path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"recipe": None}, "run/config.json: does not describe a"), ({"recipe": 3}, "run/config.json: recipe: must be a")],
    ids=lambda value: str(value)[:30],
)
def test_configuration_of_a_run__is_refused(changes: dict[str, Any], message: str, run: RunDirectory) -> None:
    told = json.loads(run.config.read_text()) | changes
    run.config.write_text(json.dumps({key: value for key, value in told.items() if value is not None}))
    with refused(message):
        resume(run.path)


def test_lock__is_held_by_one_and_is_a_file(empty_folder: Path) -> None:
    Path("some.lock").mkdir()
    with (
        refused("some.lock: cannot be used as a lock (Is a directory); delete this file"),
        hold_lock(Path("some.lock"), ""),
    ):
        pass
    with (
        hold_lock(Path("other.lock"), "somebody works here"),
        refused(".: somebody works here"),
        hold_lock(Path("other.lock"), "somebody works here"),
    ):
        pass


# ---------------------------------------------------------------- a policy for each vehicle

TEAM = Path("team/team.json")
DRIVERS = {name: f"policy/{name}" for name in ("vehicle_2", "vehicle_3")}


@pytest.fixture
def team(empty_folder: Path) -> RunDirectory:
    """A run whose learners have a policy each."""
    for path in DRIVERS.values():
        make_policy(eb.ObservationSpec(), {"name": "cooperation-3-pair"}).save(TEAM.parent / path)
    TEAM.write_text(json.dumps({"scheme": "independent", "vehicles": 3, "drivers": DRIVERS}))
    return RunDirectory(TEAM.parent)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "team/team.json: is not JSON (Expecting"),
        ("[]", "team/team.json: must be a mapping of"),
        ({"drivers": {"vehicle_3": "policy/vehicle_3"}}, "must be two vehicles or more under"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_file_of_a_team__is_refused(content: Any, message: str, team: RunDirectory) -> None:
    good = {"scheme": "independent", "vehicles": 3, "drivers": DRIVERS}
    TEAM.write_text(content if isinstance(content, str) else json.dumps(good | content))
    with refused(message, CorruptBundle):
        load_team(team.path, PAIR)
