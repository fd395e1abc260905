"""Observation features from the user's own file: chosen in recipes and scenarios, kept by policies that name them."""

from __future__ import annotations

import importlib
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.errors import AlreadyExists, InvalidInput, Progress, UnknownName
from ethbrake_marl.learning.runs import resume, train
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.observations import FEATURES, observe
from ethbrake_marl.policies import load_policy
from ethbrake_marl.scenario import scenario_json_schema
from tests.learning.tiny import TINY_PPO

SCENARIO = eb.load_scenario("paper-random")
LISTED = ["own", "front_1", "rear_1.known", "urgency", "rear_1.load"]
MINE = '''
import numpy as np
import ethbrake_marl as eb


def urgency(worlds, vehicle):
    """Own speed for each metre to the vehicle ahead; 0 for the first."""
    if vehicle == 0:
        return np.zeros(worlds.n)
    return worlds.speeds_mps[:, vehicle] / (1.0 + worlds.gaps_m[:, vehicle - 1])


def load(worlds, vehicle, neighbour):
    """Mass of the neighbour for each tonne of the own."""
    return worlds.vehicles.mass_t[:, neighbour] / worlds.vehicles.mass_t[:, vehicle]


eb.register_feature("urgency", urgency, unit="1/s", scale=10.0, low=0.0, high=4.0)
eb.register_feature("load", load, unit="1", scale=1.0, low=0.0, high=8.0, of="neighbour", unknown=1.0)
'''


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    (tmp_path / "my_features.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("my_features")
    sys.modules.pop("my_features")


def steady(worlds: Any, vehicle: int) -> Any:
    """Always one."""
    return np.ones(worlds.n)


def register(function: Any = steady, name: str = "mine", **changes: Any) -> None:
    eb.register_feature(name, function, **{"unit": "1", "scale": 2.0, "low": -1.0, "high": 1.0, **changes})


def test_feature__of_the_users_file_trains_and_is_evaluated(mine: Any, tmp_path: Path) -> None:
    content = {**TINY_PPO.model_dump(mode="json"), "name": "mine", "observation": LISTED, "total_steps": 2048}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    recipe = load_recipe(tmp_path / "mine.yaml")
    result = train(recipe, SCENARIO, tmp_path / "run")
    policy = load_policy(result.directory)
    names = policy.manifest.observation.features
    assert names[-3:] == ("rear_1.known", "urgency", "rear_1.load") and len(names) == 20
    worlds = SCENARIO.sample(10, 7)
    agents = {"mine": LearnedAgent(policy, "mine"), "shipped": eb.make_agent("ppo@shipped", scenario=SCENARIO)}
    first = eb.evaluate(worlds, agents, scenario=SCENARIO)
    harm = first.outcome("mine").first_impact_harm
    assert harm.mean() == pytest.approx(min(e["first_impact_harm"] for e in result.evaluations))

    register()  # others may be added, and the scenario may declare another observation
    other = SCENARIO.replace(observation=["mine", "own"])
    again = eb.evaluate(other.sample(10, 7), {"mine": LearnedAgent(load_policy(result.directory))}, scenario=other)
    assert again.outcome("mine").first_impact_harm.tolist() == harm.tolist()


def test_training__with_a_feature_goes_on_bit_for_bit_after_a_stop(mine: Any, tmp_path: Path) -> None:
    recipe = TINY_PPO.replace(observation=["own", "urgency"], total_steps=1024)
    whole = train(recipe, SCENARIO, tmp_path / "whole", measure=None)

    def ctrl_c(progress: Progress) -> None:
        if progress.updates == 3:
            signal.raise_signal(signal.SIGINT)

    assert train(recipe, SCENARIO, tmp_path / "run", measure=None, on_progress=ctrl_c).status == "interrupted"
    assert resume(tmp_path / "run", measure=None).status == "finished"
    weights = [
        (folder / "policy" / "weights.safetensors").read_bytes() for folder in (tmp_path / "run", whole.directory)
    ]
    assert weights[0] == weights[1]


def test_observation__is_the_same_in_every_interface(mine: Any, tmp_path: Path) -> None:
    declared = SCENARIO.replace(observation=LISTED)
    env = eb.parallel_env(scenario=declared)
    seen, _ = env.reset(seed=1)
    assert env.observation_space("vehicle_2").shape == (20,)
    single = gymnasium.make("EthBrake-v0", scenario=SCENARIO, observation=LISTED)
    vector = gymnasium.make_vec("EthBrake-v0", num_envs=2, scenario=declared)
    batch = eb.make_sb3_vec_env(SCENARIO, 2, seed=1, observation=eb.choose_observation(LISTED))
    wanted = seen["vehicle_2"].tobytes()
    assert single.reset(seed=1)[0].tobytes() == wanted
    assert vector.reset(seed=1)[0][0].tobytes() == wanted
    assert batch.reset()[0].tobytes() == wanted
    with pytest.raises(InvalidInput, match="unknown feature 'fornt_1'; did you mean 'front_1'"):
        eb.parallel_env(scenario=SCENARIO, observation=["own", "fornt_1"])


def test_columns__are_those_of_the_whole_observation_and_of_the_functions(mine: Any) -> None:
    worlds = SCENARIO.sample(50, 3).worlds
    whole = observe(worlds, 1, eb.ObservationSpec())
    names = [feature.name for feature in eb.ObservationSpec().features]
    spec = eb.choose_observation(["rear_1.gap", "urgency", "own", "front_1.load"])
    seen = observe(worlds, 1, spec)
    columns = [names.index("rear_1.gap"), *range(7)]
    assert seen[:, [0, *range(2, 9)]].tobytes() == whole[:, columns].tobytes()
    assert seen[:, 1] == pytest.approx(np.clip(mine.urgency(worlds, 1) / 10.0, 0.0, 4.0), rel=1e-6)
    known = whole[:, names.index("front_1.known")] == 1.0
    mass = worlds.vehicles.mass_t
    assert seen[:, 9] == pytest.approx(np.where(known, mass[:, 0] / mass[:, 1], 1.0), rel=1e-6)
    assert (observe(worlds, 0, eb.choose_observation(["front_1.load"])) == 1.0).all()  # nobody is there
    assert eb.choose_observation(["own", "front_1", "rear_1"]) == eb.ObservationSpec()


def test_feature_of_a_neighbour__is_masked_where_the_channel_hides_it(mine: Any) -> None:
    silent = SCENARIO.replace(v2x={"hears": "front", "senses": "none"})
    engine = eb.make_sb3_vec_env(silent, 20, seed=1, observation=["rear_1.known", "rear_1.load"]).unwrapped.engine
    seen = engine.observe(1)
    assert not seen[:, 0].any() and (seen[:, 1] == 1.0).all()


def test_policy__whose_feature_is_missing_or_was_changed_is_refused_by_name(mine: Any, tmp_path: Path) -> None:
    recipe = TINY_PPO.replace(observation=["own", "urgency", "front_1.load"], total_steps=1024)
    folder = train(recipe, SCENARIO, tmp_path / "run", measure=None).directory
    entries = dict(FEATURES)
    del FEATURES["load"]
    with pytest.raises(InvalidInput, match="the policy observes 'load', which is not registered; import the file"):
        load_policy(folder)
    register(mine.load, "load", of="neighbour", unknown=1.0, scale=3.0, low=0.0, high=8.0)
    with pytest.raises(InvalidInput, match=r"observes 'load', whose scale was 1.0 when it was trained and is 3.0 now"):
        load_policy(folder)
    FEATURES.clear()
    FEATURES["load"] = entries["load"]
    register(lambda_free, "urgency", unit="1/s", scale=10.0, low=0.0, high=4.0)
    with pytest.raises(InvalidInput, match="observes 'urgency', whose function gives other numbers"):
        load_policy(folder)
    FEATURES.update(entries)
    assert load_policy(folder).manifest.observation.registered[0].name == "urgency"


def lambda_free(worlds: Any, vehicle: int) -> Any:
    """Another function under the same name."""
    return worlds.speeds_mps[:, vehicle]


def test_feature__that_is_not_finite_is_named_with_world_and_step() -> None:
    def late(worlds: Any, vehicle: int) -> Any:
        """Fails in the second world after a while."""
        return np.where((worlds.time_s > 1.0) & (np.arange(worlds.n) == 1), np.inf, 0.0)

    register(late)
    engine = eb.make_sb3_vec_env(SCENARIO, 3, seed=1, observation=["own", "mine"]).unwrapped.engine
    with pytest.raises(
        InvalidInput, match=r"'mine': is inf for vehicle_2 in world 1 at \d.* s after step \d+; must be"
    ):
        for _ in range(20):
            engine.step(-np.ones((3, 1)))
            engine.observe(1)


def test_feature__cannot_change_the_worlds() -> None:
    def greedy(worlds: Any, vehicle: int) -> Any:
        """Changes what it is given."""
        worlds.speeds_mps[:] = 0.0
        return worlds.time_s

    with pytest.raises(InvalidInput, match=r"feature 'mine': its function fails .*read-only"):
        register(greedy)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"name": "own"}, AlreadyExists, "feature 'own' is registered already"),
        ({"name": "front_1"}, AlreadyExists, "feature 'front_1' is registered already"),
        ({"name": "gap"}, AlreadyExists, "feature 'gap' is registered already"),
        ({"name": "front_1.gap"}, InvalidInput, "must be 1 to 64 of a-z"),
        ({"function": 3}, InvalidInput, "needs a function with a docstring"),
        ({"function": lambda worlds, vehicle: 1.0}, InvalidInput, "needs a function with a docstring"),
        ({"scale": 0.0}, InvalidInput, "scale = 0: must be above 0"),
        ({"low": 1.0}, InvalidInput, r"low = 1: must be below high \(1\)"),
        ({"high": float("nan")}, InvalidInput, "high = nan: must be a finite number"),
        ({"of": "both"}, InvalidInput, "must be own, or neighbour"),
        ({"unknown": 1.0}, InvalidInput, "must be own, or neighbour"),
        ({"of": "neighbour"}, InvalidInput, "its function fails for a line of three vehicles: TypeError"),
    ],
)
def test_register_feature__refuses_what_cannot_be_used(changes: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        register(**changes)
    assert set(FEATURES) == {"age"}


def test_register_feature__refuses_another_shape_and_what_is_not_finite() -> None:
    def flat(worlds: Any, vehicle: int) -> Any:
        """One number for all."""
        return 1.0

    def broken(worlds: Any, vehicle: int) -> Any:
        """Not a number."""
        return np.full(worlds.n, np.nan)

    with pytest.raises(InvalidInput, match=r"feature 'mine': gave float64 of shape \(\); must be numbers of shape"):
        register(flat)
    with pytest.raises(InvalidInput, match="feature 'mine': is nan for vehicle_1 in world 0 at 0 s; must be finite"):
        register(broken)


def test_register_feature__twice_is_once() -> None:
    register()
    register()
    with pytest.raises(AlreadyExists, match="'mine' is registered already"):
        register(scale=3.0)


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        (["own", "own.speed"], "own.speed is listed twice"),
        ([], "must be a list of groups and features"),
        ("own", "must be a list of groups and features"),
        (["urgncy"], "unknown feature 'urgncy'; did you mean 'urgency'"),
        (["load"], "feature 'load' is of a neighbour: write front_1.load or rear_1.load"),
        (["front_1.gp"], "did you mean 'front_1.gap'"),
        ([5], "5: must be the name of a group or a feature"),
    ],
)
def test_observation__that_cannot_be_one_is_refused(listed: Any, message: str, mine: Any, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=message):
        SCENARIO.replace(observation=listed)
    (tmp_path / "r.yaml").write_text(yaml.safe_dump({**TINY_PPO.model_dump(mode="json"), "observation": listed}))
    with pytest.raises(InvalidInput, match=rf"r.yaml, line \d+: observation.*{message}"):
        load_recipe(tmp_path / "r.yaml")
    with pytest.raises(InvalidInput, match=message):
        eb.choose_observation(listed)


def test_feature__that_is_not_registered_is_told_with_groups_and_the_plug_in_in_a_short_line() -> None:
    with pytest.raises(
        UnknownName, match=r"known: .*front_1, .*own, .*; one of your own file needs --plugin"
    ) as caught:
        eb.choose_observation(["own", "zzz"])
    assert len(str(caught.value)) < 400


def test_observation__has_its_place_in_the_schema_and_none_in_the_plain_dump(mine: Any) -> None:
    items = scenario_json_schema()["properties"]["observation"]["items"]["anyOf"][0]["enum"]
    assert {"urgency", "front_1.load", "own"} <= set(items)
    assert "observation" not in SCENARIO.model_dump() and "observation" not in TINY_PPO.model_dump()
    with pytest.raises(UnknownName, match="unknown feature"):
        eb.choose_observation(["nothing of the kind"])
