"""train/clone.py: from a dataset to a policy that any command takes."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput

SCRIPT = Path(__file__).resolve().parents[2] / "train" / "clone.py"
PAPER = eb.load_scenario("paper-random")
PAIR = eb.load_scenario("cooperation-3-pair")


@pytest.fixture
def script() -> ModuleType:
    pytest.importorskip("pyarrow")
    spec = importlib.util.spec_from_file_location("clone", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def share(agents: dict[str, eb.Agent | eb.Team], worlds: int) -> dict[str, float]:
    """Of the harm that could be saved, from full braking to the best known, how much each agent saves."""
    ends = {name: eb.make_agent(name, scenario=PAPER) for name in ("full_brake", "best_harm")}
    found = eb.evaluate(PAPER.sample(worlds, 7), {**ends, **agents}, scenario=PAPER, aftermath=False)
    harm = {name: float(found.outcome(name).first_impact_harm.mean()) for name in found.outcomes}
    return {name: (harm["full_brake"] - harm[name]) / (harm["full_brake"] - harm["best_harm"]) for name in agents}


@pytest.mark.parametrize(
    ("episodes", "least"),
    [pytest.param(1000, 0.9, marks=pytest.mark.slow), pytest.param(10_000, 0.98, marks=pytest.mark.long)],
)
def test_clone__of_ppo_reaches_its_share_in_other_worlds(
    script: ModuleType, tmp_path: Path, episodes: int, least: float
) -> None:
    threads = torch.get_num_threads()
    ppo = eb.make_agent("ppo@shipped", scenario=PAPER)
    eb.write_dataset(tmp_path / "ppo.parquet", {"ppo": ppo}, scenario=PAPER, episodes=episodes, seed=1)
    script.train(tmp_path / "ppo.parquet", 0, tmp_path / "clone")
    torch.set_num_threads(threads)
    clone = eb.make_agent(f"{SCRIPT}:make_agent:{tmp_path / 'clone'}", scenario=PAPER)
    found = share({"ppo": ppo, "clone": clone}, 500)
    assert found["clone"] >= least * found["ppo"] > 0.8


def test_bundle__drives_as_the_network_itself(script: ModuleType, tmp_path: Path) -> None:
    agents = {"full_brake": eb.make_agent("full_brake")}
    eb.write_dataset(tmp_path / "a.parquet", agents, scenario=PAPER, episodes=10, seed=1)
    seen, done, told = script.read_dataset(tmp_path / "a.parquet")
    assert (seen.shape[1], done.shape[1], seen.dtype) == (27, 1, torch.float32) and bool((done == -1.0).all())
    network = script.clone(seen, done, 0)
    policy = script.as_policy(network, told, 0)
    rows = seen[:50].numpy()
    with torch.no_grad():
        theirs = network(seen[:50]).clamp(-1.0, 1.0).numpy()
    assert np.allclose(policy(rows), theirs, atol=1e-5)
    worlds = PAPER.sample(5, 7)
    both = {"bundle": eb.LearnedAgent(policy), "network": eb.policy_agent(network, clip=True)}
    found = eb.evaluate(worlds, both, scenario=PAPER)
    assert found.outcome("bundle").first_impact_harm == pytest.approx(
        found.outcome("network").first_impact_harm, abs=1e-2
    )


def test_script__refuses_what_it_cannot_clone(script: ModuleType, tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table({"a": [1]}), tmp_path / "a.parquet")
    (tmp_path / "b.parquet").write_text("no")
    for name in ("a.parquet", "b.parquet"):
        with pytest.raises(InvalidInput, match="is no dataset of `ethbrake watch dataset`"):
            script.train(tmp_path / name, 0, tmp_path / "clone")
    agents = {"full_brake": eb.make_agent("full_brake")}
    eb.write_dataset(tmp_path / "two.parquet", agents, scenario=PAIR, episodes=1)
    with pytest.raises(InvalidInput, match="holds 2 learners, one is needed"):
        script.train(tmp_path / "two.parquet", 0, tmp_path / "clone")
    assert not (tmp_path / "clone").exists()
    with pytest.raises(InvalidInput, match="say which clone drives"):
        eb.make_agent(f"{SCRIPT}:make_agent", scenario=PAPER)
