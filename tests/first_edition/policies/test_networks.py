"""What a policy's networks compute, by hand, gated, as ONNX; its bundle, refused when damaged; those that ship."""

import hashlib
import json
import os
import pickle
import re
import stat
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import safetensors.numpy
import torch
from torch import nn

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.first_edition.evaluation.identity import scenario_sha256
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.game.features import FEATURES
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.game.observations import observe
from ethbrake_marl.first_edition.policies.actor import Actor
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.layers import squash
from ethbrake_marl.first_edition.policies.manifest import content_sha256
from ethbrake_marl.first_edition.policies.network_spec import NetworkSpec
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.policies.shipped import load_named_policy, shipped_policies
from tests.docs.site import DOCS
from tests.first_edition.rest.fixture_policies import make_policy

RandomTensors = Callable[[NetworkSpec], dict[str, np.ndarray]]


def _observations(n: int, size: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-2.0, 2.0, (n, size)).astype(np.float32)


@pytest.mark.parametrize(
    ("output", "last", "expected", "tensors"),
    [
        ("clip", [[1.0, -2.0]], [1.0, -0.5, -1.0, 0.0], 9),
        ("tanh", [[1.0, -2.0]], np.tanh([3.0, -0.5, -4.0, 0.0]), 10),
        # of five actions from -1 to 1 that of the highest score, and the lowest of equal ones; without a critic
        ("choice", [[0.0, 0.0], [1.0, 0.0], [0.0, 3.0], [2.0, 0.0], [2.0, 0.0]], [0.5, 0.0, 0.0, -1.0], 4),
    ],
)
def test_actor__relu_then_output_by_hand(output: str, last: Any, expected: Any, tensors: int) -> None:
    spec = NetworkSpec(
        observation_size=1, action_size=1, policy_hidden=(2,), value_hidden=() if output == "choice" else (1,),
        activation="relu", output=output, choices=5 if output == "choice" else None,
    )  # fmt: skip
    weights = {row.name: np.zeros(row.shape, np.float32) for row in spec.tensors}
    weights["policy.0.weight"][:, 0] = [1.0, -1.0]  # hidden: max(x, 0), max(-x, 0)
    weights["policy.output.weight"][:] = last
    action = Actor(spec, weights)(np.array([[3.0], [-0.25], [-2.0], [0.0]], np.float32))
    np.testing.assert_allclose(action[:, 0], expected, rtol=1e-6)
    assert len(weights) == tensors


@pytest.mark.parametrize(
    ("hidden", "activation", "output"),
    [
        ((256, 256), "relu", "clip"),
        ((256, 256), "tanh", "clip"),
        ((64,), "tanh", "tanh"),
        ((64,), "relu", "choice"),
        (None, "relu", "clip"),  # a mixture of experts
    ],
)
def test_actor__action_is_bitwise_independent_of_the_batch_around_it(
    hidden: tuple[int, ...] | None, activation: str, output: str, random_tensors: RandomTensors, mixture: Policy
) -> None:
    actor: Any = mixture
    if hidden is not None:
        spec = NetworkSpec(
            observation_size=27, action_size=1, policy_hidden=hidden, value_hidden=(8,) if output == "clip" else (),
            activation=activation, output=output, choices=801 if output == "choice" else None,
        )  # fmt: skip
        actor = Actor(spec, random_tensors(spec))
    seen = _observations(500, 27)
    together = actor(seen)
    assert np.unique(together).size > (100 if output == "choice" else 200)  # else equality below would show nothing
    for first in (0, 1, 3, 17, 63, 64, 255, 256, 300):
        for n in (0, 1, 2, 5, 63, 64, 65, 200):
            assert np.array_equal(actor(seen[first : first + n]), together[first : first + n]), (first, n)
    shuffled = np.random.default_rng(2).permutation(500)
    assert np.array_equal(actor(seen[shuffled]), together[shuffled])


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_actor__agrees_with_torch(activation: str, random_tensors: RandomTensors) -> None:
    spec = eb.load_recipe("ppo-paper").network_spec(27).model_copy(update={"activation": activation})
    tensors, seen = random_tensors(spec), _observations(1000, 27)
    x, function = torch.from_numpy(seen), nn.functional.relu if activation == "relu" else torch.tanh
    for name in ("policy.0", "policy.1", "policy.output"):
        y = nn.functional.linear(x, torch.tensor(tensors[f"{name}.weight"]), torch.tensor(tensors[f"{name}.bias"]))
        x = function(y)
    np.testing.assert_allclose(Actor(spec, tensors)(seen), y.clip(-1.0, 1.0).numpy(), rtol=0.0, atol=1e-6)


def test_squash__is_the_rounded_hyperbolic_tangent() -> None:
    x = np.concatenate([np.linspace(-12.0, 12.0, 200_001), np.logspace(-30, 0, 2000), [0.0, -0.0, 1e30, -1e30]])
    single = x.astype(np.float32)[np.newaxis]
    actual = single.copy()
    squash(actual)
    exact = np.tanh(single.astype(np.float64))
    spacing = np.spacing(np.abs(exact).astype(np.float32)).astype(np.float64)
    assert (np.abs(actual - exact) <= 0.5001 * spacing).all()
    assert actual[0, -2:].tolist() == [1.0, -1.0]


SCENARIO = eb.load_scenario("paper-random")


def another(policy: Policy, tensors: Mapping[str, np.ndarray], **changes: Any) -> Policy:
    """A policy with these tensors and what else is changed of this one."""
    names = set(type(policy.manifest).model_fields) - {"weights_sha256", "manifest_sha256"}
    return Policy.make(tensors, **{**{name: getattr(policy.manifest, name) for name in names}, **changes})


def test_mixture__acts_as_the_network_that_the_gate_chooses_the_first_of_equal_scores(mixture: Policy) -> None:
    seen, network = _observations(300, 27), mixture.manifest.network
    hidden = np.maximum(seen @ mixture.tensors["gate.0.weight"].T + mixture.tensors["gate.0.bias"], 0.0)
    scores = hidden @ mixture.tensors["gate.output.weight"].T + mixture.tensors["gate.output.bias"]
    chosen = scores.argmax(axis=1)
    assert len(set(chosen)) > 1
    one = network.model_copy(update={"networks": 1, "gate_hidden": ()})
    for number in range(3):
        own = f"network_{number + 1}."
        tensors = {name.replace(own, "policy."): each for name, each in mixture.tensors.items() if name.startswith(own)}
        rows = chosen == number
        alone = Actor(one, {**tensors, "policy.log_std": np.zeros(1, np.float32)})
        assert np.array_equal(mixture(seen)[rows], alone(seen)[rows])
    equal = {name: each * np.float32(not name.startswith("gate.output")) for name, each in mixture.tensors.items()}
    assert (another(mixture, equal)._actor.choose(np.ascontiguousarray(seen.T)) == 0).all()


def test_among__acts_as_the_policy_or_the_action_of_the_highest_score(
    mixture: Policy, random_tensors: RandomTensors, tmp_path: Path
) -> None:
    """Policies first: one of three networks, one of a squashed actor; then full braking, coasting, full driving."""
    squashed = NetworkSpec(observation_size=27, action_size=1, policy_hidden=(7,), value_hidden=(), activation="tanh",
                           output="tanh")  # fmt: skip
    among = (mixture.manifest.network, squashed)
    spec = squashed.model_copy(update={"output": "choice", "choices": 3, "activation": "relu", "among": among})
    tensors = random_tensors(spec)
    tensors["policy.output.weight"] -= tensors["policy.output.weight"].mean(axis=0)  # so that each is chosen somewhere
    tensors["policy.output.bias"] *= np.float32(0.0)
    tensors |= {f"among_1.{name}": tensor for name, tensor in mixture.tensors.items()}
    another(mixture, tensors, network=spec, algorithm="rollout-classification").save(tmp_path / "among")
    policy, seen = load_policy(tmp_path / "among"), _observations(2000, 27)
    assert policy.manifest.format_version == 5
    hidden = np.maximum(seen @ tensors["policy.0.weight"].T + tensors["policy.0.bias"], 0.0)
    chosen = (hidden @ tensors["policy.output.weight"].T + tensors["policy.output.bias"]).argmax(axis=1)
    own = {name.removeprefix("among_2."): tensor for name, tensor in tensors.items() if name.startswith("among_2.")}
    every = [mixture(seen), Actor(squashed, own)(seen), *(np.full((2000, 1), a, np.float32) for a in (-1.0, 0.0, 1.0))]
    assert len(set(chosen)) == 5
    assert np.array_equal(policy(seen), np.choose(chosen[:, np.newaxis], every))
    (action,) = onnx_of(policy).run(["action"], {"observation": seen})
    np.testing.assert_allclose(action, policy(seen), rtol=0.0, atol=1e-5)
    for wrong, why in (
        ({"output": "clip", "choices": None}, "among: needs output = 'choice', and a policy in this list"),
        ({"among": (spec,)}, "must not have a key among"),
        (
            {"among": (squashed.model_copy(update={"observation_size": 26}),)},
            r"among\[0\]: observation_size and action_size are",
        ),
    ):
        with pytest.raises(ValueError, match=why):
            NetworkSpec(**{**dict(spec), **wrong})


@pytest.mark.parametrize("around", ["+episode", "+step"])
def test_mixture__drives_shielded(around: str, mixture: Policy, tmp_path: Path) -> None:
    check_mixture("policy", around, mixture, tmp_path)


def check_mixture(kind: str, around: str, mixture: Policy, tmp_path: Path) -> None:
    mixture.save(tmp_path / "mixture")
    assert eb.load_policy(tmp_path / "mixture").manifest == mixture.manifest
    spec = f"{kind}@{tmp_path / 'mixture'}"
    agents = {name: eb.make_agent(name, scenario=SCENARIO) for name in (spec, spec + around)}
    found = eb.evaluate(SCENARIO.sample(4, seed=7).worlds, agents, scenario=SCENARIO)
    alone, harm = (found.outcome(name).first_impact_harm for name in agents)
    assert np.isfinite(harm).all() and ((harm <= alone).all() or "search" not in around)


def onnx_of(policy: Policy) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(policy.to_onnx(), providers=["CPUExecutionProvider"])


@pytest.mark.parametrize(
    ("output", "activation"), [("clip", "relu"), ("tanh", "relu"), ("clip", "tanh"), ("choice", "relu")]
)
def test_onnx__asks_for_the_same_acceleration_in_10_000_states(
    output: str, activation: str, policy: Policy, random_tensors: RandomTensors
) -> None:
    spec = NetworkSpec(
        observation_size=27, action_size=1, policy_hidden=(64, 48), value_hidden=(), activation=activation,
        output=output, choices=33 if output == "choice" else None,
    )  # fmt: skip
    tensors = random_tensors(spec)
    tensors["policy.output.weight"] *= 3.0  # so that some actions reach the bounds
    ours = another(
        policy, tensors, network=spec, algorithm={"tanh": "sac", "choice": "rollout-classification"}.get(output, "ppo")
    )
    worlds = SCENARIO.replace(driving_capacity_mps2={"uniform": [1, 3]}).sample(10_000, 5).worlds
    rng = np.random.default_rng(0)
    command = -rng.uniform(0.0, 1.0, worlds.speeds_mps.shape) * worlds.vehicles.braking_capacity_mps2
    worlds, _ = eb.advance(worlds, command, until_s=rng.uniform(0.0, 6.0, worlds.n))
    seen, expected = observe(worlds, 1, ours.observation), eb.LearnedAgent(ours).act(worlds, 1)
    action, acceleration = onnx_of(ours).run(["action", "acceleration_mps2"], {"observation": seen})
    assert np.ptp(expected) > 4.0 and (expected > 0.5).any()
    np.testing.assert_allclose(action, ours(seen), rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(acceleration[:, 0], expected, rtol=0.0, atol=1e-4)


# ---------------------------------------------------------------- bundles


Spoil = Callable[[Path], None]


class _Payload:
    def __reduce__(self) -> tuple[Any, ...]:
        return (exec, ("raise RuntimeError('code of the bundle was run')",))


def _edit(*, rehash: bool = True, **changes: Any) -> Spoil:
    """Change manifest fields, a dotted key ``a__b`` one level down; its hash agrees, unless not ``rehash``."""

    def spoil(folder: Path) -> None:
        manifest = json.loads((folder / "manifest.json").read_bytes())
        for key, value in changes.items():
            outer, _, inner = key.rpartition("__")
            (manifest[outer] if outer else manifest)[inner] = value
        if rehash:
            manifest["manifest_sha256"] = content_sha256(manifest)
        (folder / "manifest.json").write_text(json.dumps(manifest))

    return spoil


def _manifest(change: Callable[[bytes], bytes]) -> Spoil:
    return lambda folder: _replace(folder / "manifest.json", change)


def _weights(change: Callable[[bytes], bytes]) -> Spoil:
    """Change the weights file and make the manifest's hash agree, as an attacker would."""

    def spoil(folder: Path) -> None:
        _replace(folder / "weights.safetensors", change)
        digest = hashlib.sha256((folder / "weights.safetensors").read_bytes()).hexdigest()
        _edit(weights_sha256=digest)(folder)

    return spoil


def _tensors(change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> Spoil:
    return _weights(
        lambda data: safetensors.numpy.save(change({k: np.array(v) for k, v in safetensors.numpy.load(data).items()}))
    )


def _replace(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(change(path.read_bytes()))


def _header(change: Callable[[dict[str, Any]], None]) -> Spoil:
    def rewrite(data: bytes) -> bytes:
        length = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + length])
        change(header)
        text = json.dumps(header).encode()
        return len(text).to_bytes(8, "little") + text + data[8 + length :]

    return _weights(rewrite)


def _instead(name: str, make: Callable[[Path], object]) -> Spoil:
    """Make something else in the place of a file, which is moved out of the folder."""

    def spoil(folder: Path) -> None:
        (folder / name).rename(folder.parent / f"moved-{name}")
        make(folder / name)

    return spoil


def _link(path: Path) -> None:
    path.symlink_to(path.parents[1] / f"moved-{path.name}")


def _last_digit_of(name: str) -> Spoil:
    """Change the last digit of a hash, and nothing else that the manifest's own hash does not follow."""

    def spoil(folder: Path) -> None:
        digest = json.loads((folder / "manifest.json").read_bytes())[name]
        changed = digest[:-1] + ("0" if digest[-1] != "0" else "1")
        _edit(rehash=name != "manifest_sha256", **{name: changed})(folder)

    return spoil


def _endless_device(path: Path) -> None:
    """A file that never ends: a device where that may be made, else a huge file without blocks."""
    try:
        os.mknod(path, 0o600 | stat.S_IFCHR, os.makedev(1, 5))
    except PermissionError:
        path.touch()
        os.truncate(path, 1 << 40)


def _first_tensor(**changes: Any) -> Spoil:
    return _header(lambda h: h["policy.0.bias"].update(changes))


def _raw_header(text: bytes) -> Spoil:
    return _weights(lambda data: len(text).to_bytes(8, "little") + text + data[-400:])


SPOILED: dict[str, tuple[Spoil, str]] = {
    "no_manifest": (lambda f: (f / "manifest.json").unlink(), r"manifest.json: is missing"),
    "extra_file": (lambda f: (f / "policy.pkl").write_bytes(pickle.dumps(_Payload())), r"policy.pkl: does not belong"),
    "manifest_link": (_instead("manifest.json", _link), r"manifest.json: is a symbolic link"),
    "pipe": (_instead("manifest.json", os.mkfifo), r"manifest.json: is a (device|folder)"),
    "key_twice": (
        _manifest(lambda data: data.replace(b"{", b'{"algorithm": "ppo",', 1)),
        r"manifest.json: a JSON object contains the key 'algorithm' twice",
    ),
    "nan": (_manifest(lambda data: data.replace(b"1024", b"NaN")), r"manifest.json: NaN is not a JSON number"),
    "deep": (_manifest(lambda _: b"[" * 200_000), r"manifest.json: nested too deeply"),
    "large": (_manifest(lambda data: data + b" " * (1 << 20)), r"manifest.json: is larger than 1 MiB"),
    "unknown_key": (_edit(loader="os.system"), r"manifest.json: loader: is an unknown key"),
    "dotted_algorithm": (_edit(algorithm="subprocess.Popen"), r"manifest.json: algorithm: must be 1 to 64 lower case"),
    "future_version": (_edit(format_version=6), r"manifest.json: format_version: must be 2, 3, 4 or 5"),
    "several_networks_without_a_gate": (
        _edit(format_version=3, network__networks=2, network__value_hidden=[]),
        r"manifest.json: network: gate_hidden = \[\]: must have a layer if networks is above 1",
    ),
    "choice_among_nothing": (
        _edit(format_version=4, network__output="choice", network__value_hidden=[]),
        r"manifest.json: network: choices = None: must be a number if output is 'choice'",
    ),
    "networks_without_their_tensors": (
        _edit(format_version=3, network__networks=2, network__gate_hidden=[4], network__value_hidden=[]),
        r"weights.safetensors: the file does not contain the tensor 'gate.0.bias'",
    ),
    "wrong_type": (_edit(steps="many"), r"manifest.json: steps: must be a whole number"),
    "giant_layer": (_edit(network__policy_hidden=[10**9]), r"manifest.json: network.policy_hidden.0"),
    "other_features": (_edit(observation__features=[f"own.{k}" for k in range(27)]), r"manifest.json: observation: "),
    "other_scaling": (
        _edit(observation__scaling_sha256="0" * 64),
        r"manifest.json: observation: this version of the package computes",
    ),
    "other_steps": (_edit(rehash=False, steps=999_999_999), r"manifest.json: the content has SHA-256"),
    "learner_beyond_the_line": (
        _edit(learners=["vehicle_9"], scenario={"name": "x", "vehicles": 3}),
        r"manifest.json: learners: vehicle_9: must be one of the 3 vehicles",
    ),
    "learner_with_a_script": (
        _edit(scenario={"name": "x", "roles": {"vehicle_2": "coast"}}),
        r"manifest.json: learners: vehicle_2: must be a learner",
    ),
    "last_digit_of_the_weights_hash": (
        _last_digit_of("weights_sha256"),
        r"weights.safetensors: the file has SHA-256 [0-9a-f]{64}, but",
    ),
    "last_digit_of_the_own_hash": (_last_digit_of("manifest_sha256"), r"manifest.json: the content has SHA-256"),
    "bit_flip": (
        lambda f: _replace(f / "weights.safetensors", lambda d: d[:-3] + bytes([d[-3] ^ 1]) + d[-2:]),
        r"weights.safetensors: the file has SHA-256 [0-9a-f]{64}, but",
    ),
    "endless_device": (
        _instead("weights.safetensors", _endless_device),
        r"weights.safetensors: is (a device|larger than)",
    ),
    "sparse_giant": (lambda f: os.truncate(f / "weights.safetensors", 1 << 40), r"weights.safetensors: is larger than"),
    "hidden_file": (lambda f: (f / ".weights.py").write_text("raise SystemExit"), r".weights.py: does not belong"),
    "path_as_learner": (_edit(learners=["../../vehicle_2"]), r"manifest.json: learners: '../../vehicle_2': must be"),
    "unknown_activation": (_edit(network__activation="gelu"), r"manifest.json: network.activation: must be"),
    "tensor_path": (
        _header(lambda h: h.update({"../../policy.0.bias": h.pop("policy.0.bias")})),
        r"the file does not contain the tensor 'policy.0.bias'",
    ),
    "object_dtype": (_first_tensor(dtype="O"), r"tensor 'policy.0.bias' has type O and shape"),
    "negative_shape": (_first_tensor(shape=[-13]), r"tensor 'policy.0.bias' has type F32 and shape \[-13\]"),
    "overflowing_shape": (
        _first_tensor(shape=[2**63, 2]),
        r"tensor 'policy.0.bias' has type F32 and shape \[9223372036854775808, 2\]",
    ),
    "offsets_beyond": (_first_tensor(data_offsets=[0, 2**40]), r"weights.safetensors: not a safetensors file"),
    "deep_header": (_raw_header(b"[" * 200_000), r"weights.safetensors: nested too deeply"),
    "pickle": (_weights(lambda _: pickle.dumps(_Payload())), r"weights.safetensors: not a safetensors file"),
    "cut_short": (_weights(lambda data: data[:-5]), r"weights.safetensors: not a safetensors file"),
    "trailing_bytes": (_weights(lambda data: data + b"more"), r"weights.safetensors: not a safetensors file"),
    "long_header": (_weights(lambda data: b"\xff" * 8 + data[8:]), r"weights.safetensors: not a safetensors file"),
    "metadata": (
        _header(lambda h: h.update(__metadata__={"a": "b"})),
        r"tensor '__metadata__' must not be in this file",
    ),
    "overlap": (
        _header(lambda h: h["policy.0.bias"].update(data_offsets=h["policy.0.weight"]["data_offsets"])),
        r"weights.safetensors: not a safetensors file",
    ),
    "missing_tensor": (
        _tensors(lambda t: {name: t[name] for name in t if name != "policy.1.bias"}),
        r"the file does not contain the tensor 'policy.1.bias'",
    ),
    "extra_tensor": (
        _tensors(lambda t: {**t, "policy.9.bias": np.zeros(3, "f4")}),
        r"tensor 'policy.9.bias' must not be in this file",
    ),
    "wrong_shape": (
        _tensors(lambda t: {**t, "policy.0.bias": np.zeros(14, "f4")}),
        r"tensor 'policy.0.bias' has type F32 and shape \[14\]; must have type F32 and shape \[13\]",
    ),
    "wrong_dtype": (
        _tensors(lambda t: {**t, "policy.0.bias": np.zeros(13, "f8")}),
        r"tensor 'policy.0.bias' has type F64 and shape \[13\]; must have type F32 and shape \[13\]",
    ),
    "nan_weight": (
        _tensors(lambda t: {**t, "value.0.bias": np.append(t["value.0.bias"][1:], np.float32(np.nan))}),
        r"tensor 'value.0.bias': contains a number that is not",
    ),
}


def test_bundle__round_trip_is_exact_and_always_of_the_same_bytes(policy: Policy, tmp_path: Path) -> None:
    """Also without the critic, as policies ship; a second name of a file, as installers make one, is no sign of it."""
    for name in ("a", "run/policy"):
        policy.save(tmp_path / name)
    (program,) = re.findall("```python\n(.*?)```", (DOCS / "internals" / "releasing.md").read_text("utf-8"), re.DOTALL)
    exec(program.replace("runs/mine", str(tmp_path / "a")).replace("mine/policy", str(tmp_path / "shipped")), {})
    os.link(tmp_path / "a" / "weights.safetensors", tmp_path / "elsewhere")
    one, other, shipped = (load_policy(tmp_path / name) for name in ("a", "run", "shipped"))
    assert one.manifest == other.manifest == policy.manifest and one.tensors.keys() == policy.tensors.keys()
    assert all(np.array_equal(one.tensors[name], policy.tensors[name]) for name in policy.tensors)
    seen = np.random.default_rng(0).normal(size=(50, policy.observation.size)).astype(np.float32)
    expected = policy(seen)
    assert all(np.array_equal(each(seen), expected) for each in (one, other, shipped)) and np.unique(expected).size > 10
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["manifest.json", "weights.safetensors"]
    for file in ("manifest.json", "weights.safetensors"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "run" / "policy" / file).read_bytes()
    network = json.loads((tmp_path / "a" / "manifest.json").read_text())["network"]
    assert not {"networks", "gate_hidden"} & network.keys()  # of which earlier versions of the package know nothing
    assert not any(name.startswith("value") for name in shipped.tensors)
    assert shipped.manifest.scenario == policy.manifest.scenario


_watching: list[str] = []  # the folder that may be read; a hook of the interpreter stays as long as that
_events: list[str] = []


def _note(event: str, args: tuple[Any, ...]) -> None:
    for root in _watching:
        inside = event == "open" and (isinstance(args[0], int) or str(args[0]).startswith(root)) and not args[2] & 3
        if not inside and event not in ("os.scandir", "object.__getattr__", "sys._getframe"):
            _events.append(f"{event} {args!r:.200}")


sys.addaudithook(_note)


@pytest.mark.parametrize("name", SPOILED)
def test_load_policy__refuses_a_damaged_bundle_and_runs_and_opens_nothing_else(
    name: str, policy: Policy, tmp_path: Path
) -> None:
    spoil, message = SPOILED[name]
    policy.save(tmp_path / "good")
    load_policy(tmp_path / "good")
    policy.save(tmp_path / "policy")
    spoil(tmp_path / "policy")
    _events.clear()
    _watching.append(str(tmp_path))
    try:
        with pytest.raises(CorruptBundle, match=message) as caught:
            load_policy(tmp_path / "policy")
    finally:
        _watching.clear()
    assert _events == []
    told = str(caught.value)
    assert told.startswith(str(tmp_path / "policy")) and "\n" not in told


@pytest.mark.parametrize(("name", "path"), shipped_policies().items())
def test_shipped_policies__each_that_ships_is_small_and_has_a_card(name: str, path: Path, tmp_path: Path) -> None:
    manifest = load_named_policy(name).manifest
    trained = eb.load_scenario(str(manifest.scenario["name"]))
    assert scenario_sha256(eb.Scenario.of_dump(manifest.scenario)) == scenario_sha256(trained) and manifest.steps > 0
    load_named_policy(name).save(tmp_path / "copy")  # whatever version wrote it
    assert load_policy(tmp_path / "copy").manifest.manifest_sha256 == manifest.manifest_sha256
    card = (path / "card.md").read_text("utf-8")
    assert card.startswith(f"# {name}\n") and (name == "universal" or "\nNot `universal`: " in card)


def test_shipped_policies__are_small_together() -> None:
    assert (
        sum((path / "policy" / "weights.safetensors").stat().st_size for path in shipped_policies().values())
        < 5_000_000
    )


@pytest.mark.parametrize("harm_count", HARM_COUNTS)
@pytest.mark.parametrize("test", ["paper-random", "paper-random-brake-only", "paper-random-obstacle"])
def test_shipped__drives_each_of_the_three_tests_alone_and_behind_its_shield(test: str, harm_count: HarmCount) -> None:
    scenario = eb.load_scenario(test)
    lineup = make_lineup(["universal", "universal+episode"], scenario, harm_count=harm_count)
    result = evaluate(scenario.sample(20, 7), lineup, scenario=scenario, seed=7)
    alone, shielded = (result.outcome(spec).ledger.world_harm(harm_count) for spec in lineup)
    assert shielded.mean() <= alone.mean()
    assert (shielded <= result.outcome("universal+episode").predicted_harm + 1e-9).all()


@pytest.mark.parametrize(
    ("level", "name", "share_of_full_braking", "collisions"),
    [
        ("cooperation-1-front", "vine-front", 0.60, 0.80),
        ("cooperation-2-paper", "universal", 0.29, 0.70),
        ("cooperation-2-blocked", "universal", 0.52, 0.87),
        ("cooperation-3-pair", "vine-pair", 0.33, 0.70),
        ("cooperation-4-all", "vine-all", 0.03, 0.15),
    ],
)
def test_shipped__drives_all_learners_of_a_level_of_cooperation(
    level: str, name: str, share_of_full_braking: float, collisions: float
) -> None:
    """At least as well as docs/cooperation.md says, by and large: level 3 collides no more often than level 2."""
    scenario = eb.load_scenario(level)
    assert eb.load_shipped(name).manifest.learners == tuple(scenario.vehicle_names[i] for i in scenario.learners)
    lineup = make_lineup(["full_brake", name], scenario)
    result = evaluate(scenario.sample(300, 7), lineup, scenario=scenario, seed=7, aftermath=False)
    braking, policy = (result.outcome(spec) for spec in lineup)
    assert policy.first_impact_harm.mean() <= share_of_full_braking * braking.first_impact_harm.mean()
    assert policy.collided.mean() <= collisions


def test_load_policy__refuses_a_registered_feature_that_differs_by_a_thousandth(tmp_path: Path) -> None:
    def register(factor: float) -> None:
        def speed(worlds: Any, vehicle: int) -> Any:
            """Own speed."""
            return factor * worlds.speeds_mps[:, vehicle]

        FEATURES.loaded.pop("mine", None)
        eb.register_feature("mine", speed, unit="m/s", scale=10.0, low=0.0, high=9.0)

    register(1.0)
    make_policy(eb.choose_observation(["own", "mine"]), {"name": "paper-random"}).save(tmp_path / "policy")
    load_policy(tmp_path / "policy")
    register(1.001)
    with pytest.raises(InvalidInput, match="'mine', whose function now returns other numbers than in training"):
        load_policy(tmp_path / "policy")
