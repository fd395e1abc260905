"""Kinds of faults that users met, each at the public surface with several inputs of its kind."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections import UserDict, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from tests.refused import refused

FIRST_USES = """
import threading

import ethbrake_marl as eb

uses = [
    lambda: eb.parallel_env("paper-random"),
    lambda: eb.parallel_env("cooperation-3-pair"),
    lambda: eb.make_agent("ppo"),
    lambda: eb.make_agent("e_v2x_bm", scenario="paper-random"),
    lambda: eb.load_recipe("ppo"),
    lambda: eb.summarise(eb.evaluate("paper-random", "full_brake", episodes=3)),
    lambda: eb.list_scenarios(),
]
failed = []


def call(use):
    try:
        use()
    except Exception as error:
        failed.append(error)


threads = [threading.Thread(target=call, args=(use,)) for use in uses * 2]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert not failed, failed
"""


def test_first_uses__may_come_from_several_threads() -> None:
    subprocess.run([sys.executable, "-c", FIRST_USES], check=True, timeout=300)


HOME = {
    "scenario": lambda: eb.load_scenario("~/x.yaml"),
    "recipe": lambda: eb.load_recipe("~/x.yaml"),
    "policy": lambda: eb.load_policy("~/x"),
    "agent": lambda: eb.make_agent("policy@~/x"),
    "worlds": lambda: eb.read_worlds("paper-random", "~/x.csv"),
    "result": lambda: eb.read_result("~/x.json"),
    "run": lambda: eb.resume("~/x"),
}


@pytest.mark.parametrize("read", HOME.values(), ids=HOME)
def test_tilde__is_the_home_folder(read: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    with refused(str(tmp_path / "x"), eb.EthBrakeError):
        read()


def test_tilde__is_the_home_folder_of_what_is_written_and_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "own.py").write_text(
        "import ethbrake_marl as eb\n\ndef gap(game, alert, last):\n    '''Last gap.'''\n    return last.gaps_m[:, 0]\n"
        "\ndef brake():\n    return eb.make_agent('full_brake')\n"
    )
    result = eb.evaluate("paper-random", "~/own.py:brake", episodes=2, measures="~/own.py:gap")
    eb.load_shipped("ppo").save("~/policy")
    (tmp_path / "out").mkdir()
    written = eb.write_results("~/out", eb.summarise(result), result, rows="csv")
    assert [path.parent for path in written] == [tmp_path / "out"] * 2
    assert eb.make_agent("policy@~/policy").name == "policy@~/policy" and not os.path.lexists("~")


def test_values__that_came_from_an_object_go_back_into_it() -> None:
    for name in ("paper-random", "paper-random-obstacle", "cooperation-2-five"):
        scenario = eb.load_scenario(name)
        same = {key: getattr(scenario, key) for key in ("observation", "objective", "horizon_s", "time_step_s")}
        assert scenario.replace(**same) == scenario
    recipe = eb.load_recipe("ppo")
    assert recipe.replace(**{key: getattr(recipe, key) for key in type(recipe).model_fields}) == recipe


def test_containers__of_other_libraries_are_lists_and_mappings() -> None:
    plain = eb.load_scenario("paper-random")
    given = UserDict(plain.declared() | {"roles": UserDict(plain.declared()["roles"])})
    env = eb.parallel_env(given, observation=deque(["own", "front_1"]), reward=UserDict({"harm": 1.0}))
    same = eb.parallel_env("paper-random", observation=["own", "front_1"], reward={"harm": 1.0})
    for one, other in zip(env.reset(seed=3), same.reset(seed=3), strict=True):
        np.testing.assert_equal(one, other)
    assert eb.load_recipe("ppo").replace(reward=UserDict({"harm": 0.5})).reward.harm == 0.5


def no_number(observation: Any) -> Any:
    return np.full((len(observation), 1), np.nan)


def no_key(observation: Any) -> Any:
    return {}["action"]


@pytest.mark.parametrize("function", [no_number, no_key])
def test_errors__have_no_circle_of_causes_and_can_be_sent(function: Any) -> None:
    with pytest.raises(eb.EthBrakeError) as caught:
        eb.evaluate("paper-random", {"mine": eb.policy_agent(function)}, episodes=2)
    chain: list[BaseException] = []
    error: BaseException | None = caught.value
    while error is not None:
        assert error not in chain
        chain.append(error)
        error = error.__cause__ or error.__context__
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_observations__of_a_model_are_those_it_was_trained_with(tmp_path: Path) -> None:
    from stable_baselines3 import PPO

    for observation in (["own", "rear_1", "front_1"], ["own"], ["front_1.gap", "own.speed"]):
        env = eb.make_sb3_vec_env("paper-random", 4, seed=1, observation=observation)
        PPO("MlpPolicy", env, n_steps=8, batch_size=32, device="cpu", seed=0).save(tmp_path / "model")
        model = PPO.load(tmp_path / "model")

        def ask(seen: Any, model: Any = model) -> Any:
            return model.predict(seen, deterministic=True)[0]

        agents = {"model": eb.policy_agent(model, clip=True), "function": eb.policy_agent(ask, observation=observation)}
        result = eb.evaluate("paper-random", agents, episodes=10)
        np.testing.assert_array_equal(result["model"]["total_harm"], result["function"]["total_harm"])


@pytest.mark.parametrize(
    "closed", [">&- 2>&-", *(pytest.param(each, marks=pytest.mark.slow) for each in (">&-", "2>&-"))]
)
def test_command__whose_streams_are_closed_does_its_work(closed: str, tmp_path: Path) -> None:
    command = f"'{sys.executable}' -m ethbrake_marl evaluate --episodes 2 --output '{tmp_path}/out' {closed}"
    assert subprocess.run(command, shell=True, check=False, timeout=300).returncode == 0
    assert (tmp_path / "out/results.json").exists()
