"""What recipes, settings, trainings, their folders and teams refuse."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.driving import script_agents
from ethbrake_marl.errors import AlreadyExists, CorruptBundle, UnknownName
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.files.store import hold_lock
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.training.ppo import Ppo
from ethbrake_marl.training.recipe import load_recipe, register_algorithm
from ethbrake_marl.training.recipes import PpoRecipe
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.session import resume, train
from ethbrake_marl.training.settings import read_settings
from ethbrake_marl.training.team import load_team
from ethbrake_marl.training.training import Training, check_same_training
from tests.fixtures.policies import make_policy
from tests.learning.test_algorithms import A2C, recipe_file
from tests.learning.tiny import TINY_PPO
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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_stepz": 3}, "mine.yaml, line 22: n_stepz: unknown"),
        ({"scheme": "independent"}, "scheme independent: the algorithm a2c"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_recipe_of_a_user__is_checked_as_ours(changes: dict[str, Any], message: str, empty_folder: Path) -> None:
    Path("my_algorithm.py").write_text(A2C)
    load_from_file("my_algorithm.py", "A2C")
    with refused(message):
        train(recipe_file(Path(), **changes), PAIR, Path("run"))


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


def test_training_that_has_finished__says_how_to_measure_it(run: RunDirectory) -> None:
    run.write_status("finished")
    with refused("evaluate its policy with: ethbrake evaluate --scenario paper-random --agents full_brake,ppo@"):
        resume(run.path)
    team = RunDirectory(Path("team")).create(Training.of(TINY_PPO, PAIR, scheme="independent").config())
    team.write_status("finished")
    with refused(
        "evaluate its policy with: ethbrake evaluate --scenario cooperation-3-pair --agents full_brake,team@team"
    ):
        resume(team.path)


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

FOUR = PAIR.replace(
    vehicles=4,
    braking_capacity_mps2=6,
    driving_capacity_mps2=6,
    mass_t=5,
    latency_s=0.5,
    roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "learner", "vehicle_4": "full_brake"},
)
TEAM = Path("team/team.json")
DRIVERS = {name: f"policy/{name}" for name in ("vehicle_2", "vehicle_3")}


@pytest.fixture
def team(empty_folder: Path) -> RunDirectory:
    """A run whose learners have a policy each."""
    for path in DRIVERS.values():
        make_policy(eb.ObservationSpec(), {"name": "cooperation-3-pair"}).save(TEAM.parent / path)
    TEAM.write_text(json.dumps({"scheme": "independent", "vehicles": 3, "drivers": DRIVERS}))
    return RunDirectory(TEAM.parent)


def test_team__drives_a_line_of_its_length_and_vehicles_of_its_own(team: RunDirectory) -> None:
    assert sorted(load_team(team.path, PAIR).drivers) == [1, 2]
    assert sorted(load_team(team.path, PAIR.with_learners(["vehicle_3"])).drivers) == [2]
    with refused(
        "team: this team is for a line of 3 vehicles, but scenario 'cooperation-3-pair' has 4 vehicles; choose a"
    ):
        load_team(team.path, FOUR)
    with refused("team: this team can drive vehicle_2, vehicle_3, but scenario 'cooperation-3-pair' has no learner"):
        load_team(team.path, PAIR.with_learners([]))
    with refused(
        "team: has one policy for each learner; give the path of one of them, for instance team/policy/vehicle_2"
    ):
        load_policy(TEAM.parent)
    with refused(
        "team: this team can drive vehicle_2, vehicle_3, but scenario 'cooperation-3-pair' has learner vehicle_1"
    ):
        script_agents(PAIR.replace(roles={"vehicle_1": "team@team", "vehicle_2": "team@team", "vehicle_3": "learner"}))


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


def test_policy_of_a_team__is_whole(team: RunDirectory) -> None:
    Path("team/policy/vehicle_3/weights.safetensors").unlink()
    with refused("team/policy/vehicle_3/weights.safetensors: is missing", CorruptBundle):
        load_team(team.path, PAIR)
    Path("team/policy/vehicle_2/manifest.json").write_text("{}")
    with refused("team/policy/vehicle_2/manifest.json: algorithm: is missing", CorruptBundle):
        load_team(team.path, PAIR)
