"""Episodes as a Parquet file, and the page's example for Minari."""

from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.extensions import datasets
from ethbrake_marl.extensions.datasets import to_parquet
from tests.first_edition.contract.interfaces import PAPER

PAIR = eb.load_scenario("cooperation-3-pair")
DOCS = Path(__file__).resolve().parents[3] / "docs" / "extensions" / "datasets.md"
parquet = pytest.importorskip("pyarrow.parquet")


@pytest.mark.parametrize("agent", ["full_brake", "e_v2x_bm", "full_brake+step"])
def test_file__replays_bit_for_bit_in_an_environment(agent: str, tmp_path: Path) -> None:
    reward = {"harm": 1.0, "jerk": 0.1}
    to_parquet(tmp_path / "a.parquet", agent, scenario=PAIR, episodes=5, reward=reward)
    rows = iter(parquet.read_table(tmp_path / "a.parquet").to_pylist())
    env = eb.parallel_env(scenario=PAIR, reward=reward)
    names = [feature.name for feature in env.engine.observation.features]
    for world in range(5):
        seen, infos = env.reset(options={"listed_world": {"seed": 7, "number": world}})
        decision = 0
        while env.agents:
            row = next(rows)
            assert (row["agent"], row["world"], row["decision"]) == (agent, world, decision)
            assert row["time_s"] == infos["vehicle_1"]["time_s"]
            assert [row[f"speed_{i}_mps"] for i in (1, 2, 3)] == env.engine.worlds.speeds_mps[0].tolist()
            assert [row[f"gap_{p}_m"] for p in (1, 2)] == env.engine.worlds.gaps_m[0].tolist()
            for i in (2, 3):
                observed = [row[f"observation_{i}.{name}"] for name in names]
                assert np.array_equal(np.array(observed, np.float32), seen[f"vehicle_{i}"])
            actions = {f"vehicle_{i}": np.array([row[f"action_{i}"]], np.float32) for i in (2, 3)}
            seen, rewards, terminated, truncated, infos = env.step(actions)
            for i, name in ((2, "vehicle_2"), (3, "vehicle_3")):
                told = row[f"reward_{i}"], row["terminated"], row["truncated"]
                assert told == (rewards[name], terminated[name], truncated[name])
            decision += 1
    assert next(rows, None) is None


def test_file__has_the_episodes_of_an_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For agents whose commands are float32 actions; in whole episodes, batch by batch."""
    monkeypatch.setattr(datasets, "_BATCH", 3)
    to_parquet(tmp_path / "a.parquet", "full_brake,ppo", scenario=PAPER, episodes=5)
    table = parquet.read_table(tmp_path / "a.parquet")
    result = eb.evaluate(PAPER.sample(5, 7), "full_brake,ppo", scenario=PAPER)
    for agent in ("full_brake", "ppo"):
        own = table.filter(table["agent"].to_numpy(zero_copy_only=False) == agent)
        harm = [-sum(own.filter(own["world"].to_numpy() == k)["reward_2"].to_pylist()) for k in range(5)]
        assert harm == pytest.approx(result.outcome(agent).first_impact_harm.tolist(), abs=1e-9)
        assert own["world"].to_pylist() == sorted(own["world"].to_pylist())


def test_file__is_refused_before_anything_is_written(empty_folder: Path) -> None:
    for wrong in ({"episodes": 0}, {"agents": {}}, {"scenario": PAPER.with_learners([])}):
        with pytest.raises(InvalidInput, match="at least one of each"):
            to_parquet("a.parquet", **{"agents": "full_brake", "scenario": PAPER, "episodes": 2, **wrong})
    assert list(empty_folder.iterdir()) == []
    Path("a.parquet").write_text("mine")
    with pytest.raises(AlreadyExists):
        to_parquet("a.parquet", "full_brake", scenario=PAPER, episodes=2)
    assert Path("a.parquet").read_text() == "mine"


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
def test_page__records_with_minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for library in ("minari", "h5py", "jax"):
        pytest.importorskip(library)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    program = DOCS.read_text("utf-8").partition("```python\n")[2].partition("```")[0]
    assert "minari.DataCollector" in program
    exec(compile(program.replace("range(100)", "range(2)"), "datasets.md", "exec"), {})
