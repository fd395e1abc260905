"""Reward terms from the user's own file: in recipes, infos of every interface, and refused where they are wrong."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName
from ethbrake_marl.learning.runs import train
from ethbrake_marl.learning.training import TrainingRecipe, load_recipe
from ethbrake_marl.policies import load_policy
from ethbrake_marl.rewards import TERMS, StepOutcome, reward_params
from tests.learning.tiny import TINY_PPO

SCENARIO = eb.load_scenario("paper-random")
MINE = '''
import numpy as np
import ethbrake_marl as eb


def calm(step):
    """Minus the own deceleration, per step."""
    return np.minimum(step.command_mps2, 0.0)


def hurry(step):
    """Minus the mean speed of the line."""
    return -step.speeds_mps.mean(axis=1)


eb.register_term("calm", calm, unit="m/s2")
eb.register_term("hurry", hurry, weight=0.0, unit="m/s")
'''


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    (tmp_path / "my_terms.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("my_terms")
    sys.modules.pop("my_terms")


def one(step: StepOutcome) -> Any:
    """One for all."""
    return np.ones(len(step.time_s))


def engine_with(function: Any, worlds: int = 3, **learners: Any) -> Any:
    eb.register_term("mine", function)
    return eb.make_sb3_vec_env(SCENARIO, worlds, reward={"harm": 1.0, "mine": 2.0}, **learners).unwrapped.engine


def test_term__of_the_users_file_trains_and_is_told(mine: Any, tmp_path: Path) -> None:
    content = {**TINY_PPO.model_dump(mode="json"), "name": "mine", "reward": {"harm": 1.0, "calm": 0.5, "hurry": 0.01}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    recipe = load_recipe(tmp_path / "mine.yaml")
    assert recipe.reward.terms == {"calm": 0.5, "hurry": 0.01}
    result = train(recipe, SCENARIO, tmp_path / "run", steps=2048)
    plain = train(recipe.replace(reward={"harm": 1.0}), SCENARIO, tmp_path / "plain", steps=2048)
    policy = load_policy(result.directory)
    assert policy.manifest.reward["terms"] == {"calm": 0.5, "hurry": 0.01}
    assert "terms" not in load_policy(plain.directory).manifest.reward
    assert any((policy.tensors[name] != load_policy(plain.directory).tensors[name]).any() for name in policy.tensors)


def terms_of(info: dict[str, Any]) -> dict[str, Any]:
    return {name.removeprefix("reward_"): value for name, value in info.items() if name.startswith("reward_")}


def test_term__stands_in_the_infos_of_every_interface(mine: Any) -> None:
    reward = {"harm": 0.0, "calm": 1.0, "hurry": 0.5}
    env = eb.parallel_env(scenario=SCENARIO, reward=reward)
    env.reset(seed=1)
    _, rewards, _, _, infos = env.step({agent: np.array([-0.5], np.float32) for agent in env.agents})
    for agent, info in infos.items():
        told = terms_of(info)
        assert told.keys() == {"calm", "hurry"} and told["hurry"] < 0.0
        assert told["calm"] == min(info["command_in_force_mps2"], 0.0)
        assert rewards[agent] == told["calm"] + 0.5 * told["hurry"]
    single = gymnasium.make("EthBrake-v0", scenario=SCENARIO, reward=reward)
    single.reset(seed=1)
    assert terms_of(single.step(np.array([-0.5], np.float32))[4]) == terms_of(infos["vehicle_2"])
    vector = gymnasium.make_vec("EthBrake-v0", num_envs=2, scenario=SCENARIO, reward=reward)
    vector.reset(seed=1)
    columns = vector.step(np.full((2, 1), -0.5, np.float32))[4]
    assert columns["reward_calm"][0] == infos["vehicle_2"]["reward_calm"]
    batch = eb.make_sb3_vec_env(SCENARIO, 2, seed=1, reward=reward)
    batch.reset()
    assert batch.step(np.full((2, 1), -0.5, np.float32))[1][0] == np.float32(rewards["vehicle_2"])


def test_term__has_its_place_in_the_schema_of_recipes(mine: Any) -> None:
    weights = TrainingRecipe.json_schema()["$defs"]["RewardParams"]["properties"]
    assert weights["calm"]["minimum"] == weights["harm"]["minimum"] == 0


def test_term__per_learner_leaves_the_others_out() -> None:
    eb.register_term("mine", per_learner)
    env = eb.parallel_env(scenario=SCENARIO, reward={"harm": 0.0, "mine": 1.0}, learners=["vehicle_2", "vehicle_3"])
    env.reset(seed=1)
    _, rewards, *_ = env.step({agent: np.zeros(1, np.float32) for agent in env.agents})
    assert list(rewards.values()) == [0.0, 1.0, 2.0]


def per_learner(step: StepOutcome) -> Any:
    """The number of the vehicle."""
    return np.broadcast_to(step.learners, (len(step.time_s), len(step.learners)))


def test_every_built_in_term__is_counted_as_soon_as_it_has_a_weight() -> None:
    for name in TERMS:
        env = eb.parallel_env(scenario=SCENARIO, reward={"harm": 0.0, name: 1.0})
        env.reset(seed=1)
        *_, infos = env.step({agent: np.zeros(1, np.float32) for agent in env.agents})
        assert list(terms_of(infos["vehicle_2"])) == [name]


def test_weight__is_the_usual_one_where_a_reward_does_not_say() -> None:
    eb.register_term("mine", one, weight=0.25)
    assert reward_params({"harm": 1.0}).terms == {"mine": 0.25}
    assert reward_params({"mine": 0.0}).terms == {"mine": 0.0}
    assert reward_params("harm").terms == {}
    settled = eb.RewardParams(harm=1.0, terms={"mine": 3.0})
    assert eb.RewardParams(**settled.model_dump()) == settled and settled.weight("mine") == 3.0
    assert reward_params({"harm": 0.0, "terms": {"mine": 2}}).weights["mine"] == 2.0


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (lambda step: step.speeds_mps[:, :2], r"reward term 'mine': gave float64 of shape \(3, 2\); must be numbers"),
        (lambda step: "no", "reward term 'mine': gave <U2 of shape"),
        (lambda step: None, "reward term 'mine': gave object of shape"),
        (
            lambda step: np.where(np.arange(3) == 2, np.nan, 0.0),
            "'mine': is nan for vehicle_1 in world 2 at step 1; must be finite",
        ),
    ],
)
def test_term__that_is_wrong_is_named_and_the_step_is_not_made(value: Any, message: str) -> None:
    def wrong(step: StepOutcome) -> Any:
        """Wrong."""
        return value(step)

    engine = engine_with(wrong)
    before = engine.packed.state.copy()
    with pytest.raises(InvalidInput, match=message):
        engine.step(np.zeros((3, 1)))
    assert engine.packed.state.tobytes() == before.tobytes()


def test_term__cannot_change_the_worlds() -> None:
    def greedy(step: StepOutcome) -> Any:
        """Changes what it is given."""
        step.speeds_mps[:] = 0.0
        return step.time_s

    with pytest.raises(ValueError, match="read-only"):
        engine_with(greedy).step(np.zeros((3, 1)))


def test_term__counts_in_running_worlds_only() -> None:
    def after(step: StepOutcome) -> Any:
        """Not a number once the line is at rest."""
        return np.where(step.speeds_mps.max(axis=1) > 0.0, 1.0, np.nan)

    engine = engine_with(after, 1)
    with pytest.raises(InvalidInput, match="at step"):
        for _ in range(90):
            engine.step(-np.ones((1, 1)))
    eb.register_term("calm", one)
    ending = eb.make_sb3_vec_env(SCENARIO, 2, reward={"harm": 1.0, "calm": 1.0}).unwrapped.engine
    while not ending.ended.all():
        last = ending.step(-np.ones((2, 1)))
    again = ending.step(-np.ones((2, 1)))
    assert (last.further["calm"][~last.ended] == 0.0).all() and not again.further["calm"].any()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("jerk", one), AlreadyExists, "reward term 'jerk' is registered already"),
        (("k_energy", one), AlreadyExists, "'k_energy' is registered already"),
        (("My term", one), InvalidInput, "reward term 'My term': must be 1 to 64 of a-z"),
        (("mine", 5), InvalidInput, "reward term 'mine': needs a function with a docstring"),
        (("mine", lambda step: step), InvalidInput, "needs a function with a docstring"),
        (("mine", one, -1.0), InvalidInput, r"reward term 'mine': weight = -1.0: must be a number, at least 0"),
    ],
)
def test_register_term__refuses_what_cannot_be_used(arguments: Any, error: Any, message: str) -> None:
    name, function, *weight = arguments
    with pytest.raises(error, match=message):
        eb.register_term(name, function, **({"weight": weight[0]} if weight else {}))


def test_register_term__twice_is_once() -> None:
    eb.register_term("mine", one)
    eb.register_term("mine", one)
    with pytest.raises(AlreadyExists, match="'mine' is registered already"):
        eb.register_term("mine", per_learner)


def test_misspelt_term__gets_a_suggestion(mine: Any, tmp_path: Path) -> None:
    content = {**TINY_PPO.model_dump(mode="json"), "reward": {"harm": 1.0, "calmm": 0.5}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InvalidInput, match=r"mine.yaml, line \d+: reward.calmm: unknown key; did you mean calm\?"):
        load_recipe(tmp_path / "mine.yaml")
    with pytest.raises(UnknownName, match="setting of a reward 'hury'; did you mean 'hurry'"):
        reward_params({"hury": 1.0})
    with pytest.raises(InvalidInput, match="unknown reward term 'hury'; did you mean 'hurry'"):
        reward_params({"terms": {"hury": 1.0}})
    with pytest.raises(InvalidInput, match=r"reward: calm = -1.0: must be greater than or equal to 0"):
        reward_params({"calm": -1.0})


def test_term__that_raises_is_one_error_with_its_name_and_step() -> None:
    def broken(step: Any) -> Any:
        """Something that cannot be told."""
        return step.speed_mps  # there is no such quantity

    eb.register_term("broken", broken)
    env = eb.parallel_env(scenario=SCENARIO, reward={"harm": 1.0, "broken": 1.0})
    env.reset(seed=1)
    with pytest.raises(InvalidInput, match=r"reward term 'broken', at step \d+: AttributeError: .*test_terms.py, line"):
        env.step({agent: np.zeros(1, np.float32) for agent in env.agents})
