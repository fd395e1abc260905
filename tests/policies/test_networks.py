"""Policies of several networks and a gate: what they do, as a bundle, as an agent, behind shields, and as ONNX."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

import ethbrake_marl as eb
from ethbrake_marl.policies import NetworkSpec, Policy, load_policy

SCENARIO = eb.load_scenario("paper-random")


def _seen(rows: int) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(rows, 27)).astype(np.float32)


def _alone(mixture: Policy, number: int) -> Policy:
    """One network of a mixture as a policy of its own."""
    network = mixture.manifest.network.model_dump() | {"networks": 1, "gate_hidden": ()}
    own = f"network_{number + 1}."
    tensors = {name.replace(own, "policy."): tensor for name, tensor in mixture.tensors.items() if name.startswith(own)}
    fields = {name: getattr(mixture.manifest, name) for name in type(mixture.manifest).model_fields}
    del fields["weights_sha256"], fields["manifest_sha256"]
    log_std = np.zeros(1, np.float32)
    return Policy.make({**tensors, "policy.log_std": log_std}, **{**fields, "network": NetworkSpec(**network)})


def test_mixture__acts_as_the_network_that_the_gate_chooses(mixture: Policy) -> None:
    seen = _seen(300)
    chosen = mixture._actor.choose(np.ascontiguousarray(seen.T))
    assert len(set(chosen)) > 1
    for number in range(3):
        rows = chosen == number
        assert np.array_equal(mixture(seen)[rows], _alone(mixture, number)(seen)[rows])
    hidden = np.maximum(seen @ mixture.tensors["gate.0.weight"].T + mixture.tensors["gate.0.bias"], 0.0)
    scores = hidden @ mixture.tensors["gate.output.weight"].T + mixture.tensors["gate.output.bias"]
    assert np.array_equal(chosen, scores.argmax(axis=1))


def test_mixture__a_row_depends_on_itself_alone(mixture: Policy) -> None:
    seen = _seen(200)
    whole = mixture(seen)
    order = np.random.default_rng(2).permutation(200)
    assert np.array_equal(mixture(seen[order]), whole[order])
    assert all(np.array_equal(mixture(seen[k : k + 1])[0], whole[k]) for k in range(0, 200, 17))


def test_mixture__the_first_of_equal_scores_acts(mixture: Policy) -> None:
    tensors = dict(mixture.tensors)
    for name in ("gate.output.weight", "gate.output.bias"):
        tensors[name] = np.zeros_like(tensors[name])
    fields = {name: getattr(mixture.manifest, name) for name in type(mixture.manifest).model_fields}
    del fields["weights_sha256"], fields["manifest_sha256"]
    assert (Policy.make(tensors, **fields)._actor.choose(np.ascontiguousarray(_seen(50).T)) == 0).all()


def test_mixture__as_a_bundle(mixture: Policy, tmp_path: Path) -> None:
    mixture.save(tmp_path / "mixture")
    found = load_policy(tmp_path / "mixture")
    seen = _seen(40)
    assert np.array_equal(found(seen), mixture(seen)) and found.manifest == mixture.manifest
    told = json.loads((tmp_path / "mixture" / "manifest.json").read_text())
    assert (told["format_version"], told["network"]["networks"], told["network"]["gate_hidden"]) == (3, 3, [6])
    assert {row.name for row in mixture.manifest.network.tensors} == set(mixture.tensors)


def test_one_network__is_written_as_ever(policy: Policy, tmp_path: Path) -> None:
    """Earlier versions of the package, which know no gate, go on reading it."""
    policy.save(tmp_path / "one")
    told = json.loads((tmp_path / "one" / "manifest.json").read_text())
    assert told["format_version"] == 2 and not {"networks", "gate_hidden"} & told["network"].keys()


@pytest.mark.parametrize("around", ["", "+episode", "+step", "+refined", "+refined:profile"])
def test_mixture__drives_alone_shielded_and_refined(around: str, mixture: Policy, tmp_path: Path) -> None:
    mixture.save(tmp_path / "mixture")
    spec = f"counterfactual@{tmp_path / 'mixture'}"
    worlds = SCENARIO.sample(6, seed=7)
    agents = {name: eb.make_agent(name, scenario=SCENARIO) for name in (spec, spec + around)}
    found = eb.evaluate(worlds, agents, scenario=SCENARIO)
    harm = found.outcome(spec + around).first_impact_harm
    assert np.isfinite(harm).all()
    if "refined" in around:
        assert (harm <= found.outcome(spec).first_impact_harm).all()


def test_mixture__as_onnx(mixture: Policy) -> None:
    session = onnxruntime.InferenceSession(mixture.to_onnx(), providers=["CPUExecutionProvider"])
    seen = _seen(2000)
    (action,) = session.run(["action"], {"observation": seen})
    np.testing.assert_allclose(action, mixture(seen), rtol=0.0, atol=1e-5)
