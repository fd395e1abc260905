"""`train/clone.py`: a clone of a dataset."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.datasets import to_parquet
from tests.docs.site import load

TRAIN = Path(__file__).resolve().parents[3] / "train"


@pytest.fixture
def clone() -> ModuleType:
    pytest.importorskip("pyarrow")
    return load("../../train/clone")


@pytest.mark.slow
def test_clone__of_ppo_saves_most_of_what_ppo_saves(clone: ModuleType, tmp_path: Path) -> None:
    """Of full braking's harm, in other worlds."""
    to_parquet(tmp_path / "ppo.parquet", "ppo", scenario="paper-random", episodes=1000, seed=1)
    clone.train(tmp_path / "ppo.parquet", 0, tmp_path / "clone")
    agents = {"full_brake": "full_brake", "ppo": "ppo"}
    agents["clone"] = f"{TRAIN / 'clone.py'}:make_agent:{tmp_path / 'clone'}"
    result = eb.evaluate("paper-random", agents, episodes=500)
    worst, shipped, cloned = (result[name]["first_impact_harm"].mean() for name in agents)
    assert worst - cloned >= 0.9 * (worst - shipped) > 0.0


def test_clone__drives_as_the_network_itself(clone: ModuleType, tmp_path: Path) -> None:
    to_parquet(tmp_path / "a.parquet", "full_brake", scenario="paper-random", episodes=10, seed=1)
    seen, done, about = clone.read_dataset(tmp_path / "a.parquet")
    assert (seen.shape[1], done.shape[1], seen.dtype) == (27, 1, torch.float32) and bool((done == -1.0).all())
    network = clone.clone(seen, done, 0)
    policy = clone.as_policy(network, about, 0)
    with torch.no_grad():
        theirs = network(seen[:50]).clamp(-1.0, 1.0).numpy()
    assert np.allclose(policy(seen[:50].numpy()), theirs, atol=1e-5)


def test_clone__needs_a_dataset_of_one_learner(clone: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "no.parquet").write_text("no")
    to_parquet(tmp_path / "two.parquet", "full_brake", scenario="cooperation-3-pair", episodes=1)
    for name, words in (("no", "must be a Parquet file"), ("two", "has 2 learners")):
        with pytest.raises(InvalidInput, match=words):
            clone.train(tmp_path / f"{name}.parquet", 0, tmp_path / "clone")
    assert not (tmp_path / "clone").exists()
