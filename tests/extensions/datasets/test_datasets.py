"""Episodes as a Parquet file."""

import json
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.extensions import datasets
from ethbrake_marl.extensions.datasets import to_parquet

PAPER, PAIR = "paper-random", "cooperation-3-pair"
parquet = pytest.importorskip("pyarrow.parquet")


@pytest.mark.parametrize("agent", ["full_brake", "e_v2x_bm", "full_brake+step"])
def test_file__replays_bit_for_bit_in_an_environment(agent: str, tmp_path: Path) -> None:
    reward = {"harm": 1.0, "jerk": 0.1}
    to_parquet(tmp_path / "a.parquet", agent, scenario=PAIR, episodes=4, reward=reward)
    rows = iter(parquet.read_table(tmp_path / "a.parquet").to_pylist())
    names = json.loads(parquet.read_metadata(tmp_path / "a.parquet").metadata[b"ethbrake_marl"])["observation"]
    env = eb.parallel_env(scenario=PAIR, reward=reward)
    for world in range(4):
        seen, infos = env.reset(options={"listed_world": {"seed": 7, "number": world}})
        decision = 0
        while env.agents:
            row = next(rows)
            assert (row["agent"], row["world"], row["decision"]) == (agent, world, decision)
            assert row["time_s"] == infos["vehicle_1"]["time_s"]
            assert [row[f"speed_{i}_mps"] for i in (1, 2, 3)] == env.episode.speeds_mps[0].tolist()
            assert [row[f"gap_{p}_m"] for p in (1, 2)] == env.episode.gaps_m[0].tolist()
            actions = {}
            for i, name in ((2, "vehicle_2"), (3, "vehicle_3")):
                observed = [row[f"observation_{i}.{feature}"] for feature in names[name]]
                assert np.array_equal(np.array(observed, np.float32), seen[name])
                actions[name] = np.array([row[f"action_{i}"]], np.float32)
            seen, rewards, terminated, truncated, infos = env.step(actions)
            for i, name in ((2, "vehicle_2"), (3, "vehicle_3")):
                recorded = row[f"reward_{i}"], row["terminated"], row["truncated"]
                assert recorded == (rewards[name], terminated[name], truncated[name])
            decision += 1
    assert next(rows, None) is None


def test_file__has_the_episodes_of_an_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of agents whose commands are float32 actions; batch by batch, one episode after the other."""
    monkeypatch.setattr(datasets, "EPISODES_AT_ONCE", 3)
    to_parquet(tmp_path / "a.parquet", "full_brake,ppo", scenario=PAPER, episodes=5)
    table = parquet.read_table(tmp_path / "a.parquet")
    result = eb.evaluate(PAPER, "full_brake,ppo", episodes=5)
    for agent in ("full_brake", "ppo"):
        own = table.filter(table["agent"].to_numpy(zero_copy_only=False) == agent)
        harm = [-sum(own.filter(own["world"].to_numpy() == k)["reward_2"].to_pylist()) for k in range(5)]
        assert harm == pytest.approx(result[agent]["honest_cost"].tolist(), abs=1e-9)
        assert own["world"].to_pylist() == sorted(own["world"].to_pylist())


def test_actions__are_commands_not_what_slow_brakes_do(tmp_path: Path) -> None:
    to_parquet(tmp_path / "a.parquet", "full_brake", scenario="realistic-truck-buildup", episodes=2)
    table = parquet.read_table(tmp_path / "a.parquet")
    (column,) = [name for name in table.column_names if name.startswith("action_")]
    assert set(table[column].to_pylist()) == {-1.0}


def test_metadata__say_where_the_rows_come_from(tmp_path: Path) -> None:
    scenario = eb.load_scenario(PAPER).replace(observation={"vehicle_2": ["own.speed"], "vehicle_3": ["own.mass"]})
    to_parquet(tmp_path / "a.parquet", {"mine": "coast"}, scenario=scenario, episodes=1, seed=3)
    about = json.loads(parquet.read_metadata(tmp_path / "a.parquet").metadata[b"ethbrake_marl"])
    assert (about["seed"], about["learners"], about["agents"]) == (3, ["vehicle_2"], ["mine"])
    assert about["observation"] == {"vehicle_2": ["own.speed"]}
    assert eb.Scenario(**about["scenario"]) == scenario
    assert eb.RewardParams(**about["reward"]).harm == 1.0 and about["versions"].keys() >= {"python", "numpy"}


def test_file__is_refused_before_anything_is_written(empty_folder: Path) -> None:
    nobody = eb.load_scenario(PAPER).with_learners([])
    for wrong, words in (
        ({"episodes": 0}, "episodes = 0: must be a whole number, at least 1"),
        ({"agents": {}}, "must be names"),
        ({"scenario": nobody}, "'paper-random' has no learner"),
    ):
        with pytest.raises(InvalidInput, match=words):
            to_parquet("a.parquet", **{"agents": "full_brake", "scenario": PAPER, "episodes": 2, **wrong})
    assert list(empty_folder.iterdir()) == []
    Path("a.parquet").write_text("mine")
    with pytest.raises(AlreadyExists):
        to_parquet("a.parquet", "full_brake", scenario=PAPER, episodes=2)
    assert Path("a.parquet").read_text() == "mine"
