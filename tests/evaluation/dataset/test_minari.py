"""Datasets of Minari: replayed in the environment that they recover, to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import ethbrake_marl as eb
from ethbrake_marl.evaluation.episodes import Task, env_spec
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.rewards import reward_params
from tests.contract.interfaces import FIVE, PAPER

LINKED = eb.load_scenario("cooperation-3-congested")


def test_spec__survives_json_and_makes_the_same_environment() -> None:
    spec = eb.choose_observation(["own", "front_1.gap"])
    made = env_spec(Task(FIVE, 7, reward_params({"harm": 2.0, "jerk": 0.5}), spec))
    env: Any = EnvSpec.from_json(made.to_json()).make().unwrapped
    assert (env.engine.scenario, env.engine.observation, env.learner) == (FIVE, spec, 3)
    assert env.engine.reward == reward_params({"harm": 2.0, "jerk": 0.5})


@pytest.mark.parametrize(
    ("scenario", "agents", "reward"),
    [
        (PAPER, "best_harm,ppo@shipped", "harm"),
        (FIVE, "full_brake", {"harm": 1.0, "shaping": 0.05, "jerk": 0.1}),
        (LINKED.with_learners(["vehicle_2"]), "full_brake", "total-harm"),
    ],
    ids=["paper", "five", "linked"],
)
def test_replay__gives_the_recorded_bits(
    scenario: eb.Scenario, agents: str, reward: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    lineup = make_lineup(agents.split(","), scenario)
    summary = eb.write_dataset("brakes-v0", lineup, scenario=scenario, episodes=4, seed=11, reward=reward)
    dataset = minari.load_dataset("brakes-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (4 * len(lineup), summary.decisions)
    env = dataset.recover_environment()
    beside = dataset.storage.get_episode_metadata(range(dataset.total_episodes))
    for k, (episode, told) in enumerate(zip(dataset.iterate_episodes(), beside, strict=True)):
        assert (told["agent"], told["options"]["listed_world"]["number"]) == ([*lineup][k // 4], k % 4)
        seen, info = env.reset(seed=told["seed"], options=told["options"])
        infos, rewards, ends = [info], [], []
        assert np.array_equal(seen, episode.observations[0])
        for t, action in enumerate(episode.actions):
            seen, gained, *ended, info = env.step(action)
            assert np.array_equal(seen, episode.observations[t + 1])
            rewards.append(gained)
            ends.append(ended)
            infos.append(info)
        assert rewards == episode.rewards.tolist() and episode.rewards.dtype == np.float64
        assert ends == np.stack([episode.terminations, episode.truncations], axis=1).tolist() and any(ends[-1])
        assert set(infos[0]) == set(episode.infos)
        for name, values in episode.infos.items():
            assert np.array_equal([each[name] for each in infos], values), name
        assert info["world_first_impact_harm"] == told["first_impact_harm"]
        assert info["world_total_harm"] == told["total_harm"]


def test_folder__is_replaced_when_asked_and_only_then(tmp_path: Path) -> None:
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    agents = {"coast": eb.make_agent("coast")}
    path = tmp_path / "brakes-v0"
    for episodes, force in ((2, False), (3, True)):
        eb.write_dataset(path, agents, scenario=PAPER, episodes=episodes, force=force)
        assert minari.MinariDataset(path / "data").total_episodes == episodes
    with pytest.raises(eb.EthBrakeError, match="is there already"):
        eb.write_dataset(path, agents, scenario=PAPER, episodes=1)
    assert [entry.name for entry in tmp_path.iterdir()] == ["brakes-v0"]
