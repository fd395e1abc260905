"""Datasets as Parquet: one row per agent, world and decision."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.evaluation import episodes
from ethbrake_marl.evaluation.episodes import KEY, Recording, Task, decision_columns, record_episodes
from ethbrake_marl.rewards import reward_params
from tests.contract.interfaces import PAPER

PAIR = eb.load_scenario("cooperation-3-pair")
DOCS = Path(__file__).resolve().parents[3] / "docs" / "datasets.md"


def record(scenario: eb.Scenario, n: int = 5) -> Recording:
    task = Task(scenario, 7, reward_params({"harm": 1.0, "jerk": 0.1}), eb.observation_for(scenario))
    return record_episodes(scenario.sample(n, 7), eb.make_agent("full_brake"), "full_brake", task)


def test_columns__tell_two_learners_step_by_step() -> None:
    columns = decision_columns(record(PAIR))
    env = eb.parallel_env(scenario=PAIR, reward={"harm": 1.0, "jerk": 0.1})
    row = 0
    for world in range(5):
        seen, infos = env.reset(options={"listed_world": {"seed": 7, "number": world}})
        decision = 0
        while env.agents:
            told: dict[str, Any] = {name: column[row] for name, column in columns.items()}
            assert (told["world"], told["decision"]) == (world, decision)
            assert told["time_s"] == infos["vehicle_1"]["time_s"]
            for i in (1, 2, 3):
                assert told[f"command_in_force_{i}_mps2"] == infos[f"vehicle_{i}"]["command_in_force_mps2"]
            observed = {i: [told[f"observation_{i}.{f.name}"] for f in env.engine.observation.features] for i in (2, 3)}
            actions = {f"vehicle_{i}": told[f"action_{i}"] for i in (2, 3)}
            for i in (2, 3):
                assert np.array_equal(observed[i], seen[f"vehicle_{i}"])
            seen, rewards, terminated, truncated, infos = env.step(actions)
            for i in (2, 3):
                info = infos[f"vehicle_{i}"]
                assert told[f"reward_{i}"] == rewards[f"vehicle_{i}"]
                assert told[f"reward_harm_{i}"] == info["reward_harm"]
                assert told[f"reward_jerk_{i}"] == info["reward_jerk"]
                assert told[f"chosen_command_{i}_mps2"] == info["chosen_command_mps2"]
                assert told["cost"] == info["cost"]
                assert (told["terminated"], told["truncated"]) == (
                    terminated[f"vehicle_{i}"],
                    truncated[f"vehicle_{i}"],
                )
            row, decision = row + 1, decision + 1
        info = infos["vehicle_1"]
        assert columns["first_impact_harm"][row - 1] == info["world_first_impact_harm"]
        assert columns["total_harm"][row - 1] == info["world_total_harm"]
    assert {len(column) for column in columns.values()} == {row}


def test_page__lists_every_column() -> None:
    text = DOCS.read_text("utf-8")
    for name in decision_columns(record(PAPER, 1)):
        listed = name.replace("_1_", "_I_").replace("_2_", "_I_").replace("_3_", "_I_")
        listed = "observation_I.FEATURE" if "." in name else listed
        listed = f"{listed[:-2]}_I" if listed.endswith("_2") else listed
        listed = "reward_TERM_I" if listed in ("reward_harm_I", "reward_jerk_I") else listed
        assert f"`{listed}`" in text, name


def test_file__has_the_columns_in_row_groups_and_tells_what_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(episodes, "BATCH", 3)
    agents = {name: eb.make_agent(name) for name in ("full_brake", "coast")}
    path = tmp_path / "a.parquet"
    summary = eb.write_dataset(path, agents, scenario=PAPER, episodes=5)
    file = parquet.ParquetFile(path)
    assert (file.metadata.num_row_groups, file.metadata.num_rows) == (4, summary.decisions)
    table = file.read()
    worlds = [int(w) for w in table["world"].to_numpy()[table["decision"].to_numpy() == 0]]
    assert worlds == [0, 1, 2, 3, 4] * 2
    assert sorted(set(table["agent"].to_pylist())) == ["coast", "full_brake"]
    assert table["action_2"].type == "float" and table["reward_2"].type == "double"
    told = json.loads(file.metadata.metadata[KEY.encode()])
    assert eb.Scenario(**told["scenario"]) == PAPER
    assert told["agents"] == {"full_brake": {"vehicle_2": None}, "coast": {"vehicle_2": None}}
    assert (told["seed"], told["episodes"], told["left_out"]) == (7, 5, [])
    assert told["off_by"] == {"full_brake": 0.0, "coast": 0.0}
    assert told["versions"]["ethbrake-marl"] == eb.__version__
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.parquet"]


def test_file__appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(episodes, "BATCH", 3)

    def stop(agent: str, done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        eb.write_dataset(
            tmp_path / "a.parquet", {"coast": eb.make_agent("coast")}, scenario=PAPER, episodes=5, on_progress=stop
        )
    assert list(tmp_path.iterdir()) == []
