"""`train/clone.py`: a clone of a dataset."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.datasets import to_parquet
from tests.docs.site import load

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")

TRAIN = Path(__file__).resolve().parents[3] / "train"


PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")


@pytest.fixture
def clone() -> ModuleType:
    pytest.importorskip("pyarrow")
    return load("../../train/clone")


@pytest.mark.parametrize(
    ("episodes", "least"),
    [pytest.param(1000, 0.9, marks=pytest.mark.slow), pytest.param(10_000, 0.98, marks=pytest.mark.long)],
)
def test_clone__of_ppo_reaches_its_share_in_other_worlds(
    clone: ModuleType, tmp_path: Path, episodes: int, least: float
) -> None:
    """Of the harm that could be saved, from full braking to the best known."""
    names = ("full_brake", "best_harm", "ppo")
    agents = {name: eb.make_agent(name, scenario=PAPER) for name in names}
    ppo = {"ppo": agents["ppo"]}
    to_parquet(tmp_path / "ppo.parquet", ppo, scenario=PAPER, episodes=episodes, seed=1)
    clone.train(tmp_path / "ppo.parquet", 0, tmp_path / "clone")
    agents["clone"] = eb.make_agent(f"{TRAIN / 'clone.py'}:make_agent:{tmp_path / 'clone'}", scenario=PAPER)
    found = eb.evaluate(PAPER.sample(500, 7), agents, scenario=PAPER, aftermath=False)
    worst, best, shipped, cloned = (found.outcome(name).first_impact_harm.mean() for name in agents)
    assert (worst - cloned) >= least * (worst - shipped) > 0.8 * (worst - best)


def test_clone__drives_as_the_network_itself(clone: ModuleType, tmp_path: Path) -> None:
    agents = {"full_brake": eb.make_agent("full_brake")}
    to_parquet(tmp_path / "a.parquet", agents, scenario=PAPER, episodes=10, seed=1)
    seen, done, told = clone.read_dataset(tmp_path / "a.parquet")
    assert (seen.shape[1], done.shape[1], seen.dtype) == (27, 1, torch.float32) and bool((done == -1.0).all())
    network = clone.clone(seen, done, 0)
    policy = clone.as_policy(network, told, 0)
    with torch.no_grad():
        theirs = network(seen[:50]).clamp(-1.0, 1.0).numpy()
    assert np.allclose(policy(seen[:50].numpy()), theirs, atol=1e-5)


def test_clone__needs_a_dataset_of_one_learner(clone: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "no.parquet").write_text("no")
    to_parquet(tmp_path / "two.parquet", "full_brake", scenario=PAIR, episodes=1)
    for name, words in (("no", "must be a Parquet file"), ("two", "has 2 learners")):
        with pytest.raises(InvalidInput, match=words):
            clone.train(tmp_path / f"{name}.parquet", 0, tmp_path / "clone")
    assert not (tmp_path / "clone").exists()
