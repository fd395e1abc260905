"""Bundles: written and read to the bit; whatever is damaged, foreign or hostile is refused in one line, and not run."""

import hashlib
import json
import os
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from ethbrake_marl.episode.features import FEATURES, known_names, register_feature
from ethbrake_marl.episode.observe import View
from ethbrake_marl.errors import AlreadyExists, CorruptBundle, InvalidInput
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.policies.bundle import (
    load_drivers,
    load_named_policy,
    load_policy,
    load_shipped,
    save_drivers,
    shipped_policies,
)
from ethbrake_marl.policies.manifest import content_sha256
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from tests.policies.test_networks import FIELDS, network, observations, tensors_for
from tests.refused import refused


def make_policy(view: View | None = None, seed: int = 0, **changes: Any) -> Policy:
    view = view or View()
    spec = network("clip", observation_size=len(view.features))
    return Policy.make(tensors_for(spec, seed), network=spec, observation=view, **{**FIELDS, **changes})


@pytest.fixture
def policy() -> Policy:
    return make_policy()


def test_bundle__is_read_as_it_was_written_and_always_has_the_same_bytes(policy: Policy, tmp_path: Path) -> None:
    for name in ("a", "run/policy"):
        policy.save(tmp_path / name)
    (tmp_path / "link").symlink_to(tmp_path / "a")
    for place in (tmp_path / "link", str(tmp_path / "run")):
        other = load_policy(place)
        assert other.manifest == policy.manifest and other.observation == policy.observation
        assert np.array_equal(other(observations(50)), policy(observations(50)))
        assert not any(tensor.flags.writeable for tensor in other.tensors.values())
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["manifest.json", "weights.safetensors"]
    for file in ("manifest.json", "weights.safetensors"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "run" / "policy" / file).read_bytes()
    content = json.loads((tmp_path / "a" / "manifest.json").read_text())
    assert content["versions"]["physics"] == physics_digest() and "registered" not in content["observation"]
    other = pickle.loads(pickle.dumps(policy))
    assert np.array_equal(other(observations(5)), policy(observations(5)))


def test_existing_folder__is_replaced_only_on_request(policy: Policy, tmp_path: Path) -> None:
    policy.save(tmp_path / "a")
    other = make_policy(seed=5)
    with refused("a: already exists; give another name", AlreadyExists):
        other.save(tmp_path / "a")
    other.save(tmp_path / "a", replace=True)
    assert load_policy(tmp_path / "a").manifest == other.manifest != policy.manifest


def test_drivers__are_one_bundle_or_one_for_each_learner(tmp_path: Path) -> None:
    both = make_policy(learners=("vehicle_2", "vehicle_3"))
    each = {f"vehicle_{k}": make_policy(seed=k, learners=(f"vehicle_{k}",)) for k in (2, 10, 3)}
    save_drivers(dict.fromkeys(both.manifest.learners, both), tmp_path / "shared")
    save_drivers(each, tmp_path / "each")
    shared, apart = load_drivers(tmp_path / "shared"), load_drivers(tmp_path / "each")
    assert list(shared) == ["vehicle_2", "vehicle_3"] and shared["vehicle_2"] is shared["vehicle_3"]
    assert list(apart) == ["vehicle_2", "vehicle_3", "vehicle_10"]
    assert all(apart[name].manifest == each[name].manifest for name in each)
    for place in (tmp_path / "each", tmp_path / "run"):
        save_drivers(each, tmp_path / "run" / "policy", replace=True)
        with refused("has one policy for each learner; give the path of one, for instance"):
            load_policy(place)


@pytest.mark.parametrize(("name", "path"), shipped_policies().items())
def test_shipped_policy__loads_by_its_name_and_has_a_card(name: str, path: Path) -> None:
    policy = load_shipped(name)
    assert load_named_policy(name).manifest == load_named_policy(str(path)).manifest == policy.manifest
    assert (path / "card.md").read_text("utf-8").startswith(f"# {name}\n") and policy.manifest.steps > 0
    assert policy.manifest.versions.get("physics", physics_digest()) == physics_digest()  # the oldest have none


def test_shipped_policies__are_small_together() -> None:
    assert sum((path / "policy" / "weights.safetensors").stat().st_size for path in shipped_policies().values()) < 5e6


# ---------------------------------------------------------------- hostile bundles

Spoil = Callable[[Path], Any]


class Payload:
    def __reduce__(self) -> tuple[Any, ...]:
        return (exec, ("raise RuntimeError('code of the bundle was run')",))


def edit(*, rehash: bool = True, **changes: Any) -> Spoil:
    """Change entries of the manifest, ``a__b`` one level down; its hash agrees, unless not ``rehash``."""

    def spoil(folder: Path) -> None:
        manifest = json.loads((folder / "manifest.json").read_bytes())
        for key, value in changes.items():
            outer, _, inner = key.rpartition("__")
            (manifest[outer] if outer else manifest)[inner] = value
        if rehash:
            manifest["manifest_sha256"] = content_sha256(manifest)
        (folder / "manifest.json").write_text(json.dumps(manifest))

    return spoil


def change(file: str, how: Callable[[bytes], bytes]) -> Spoil:
    return lambda folder: (folder / file).write_bytes(how((folder / file).read_bytes()))


def manifest(how: Callable[[bytes], bytes]) -> Spoil:
    return change("manifest.json", how)


def weights(how: Callable[[bytes], bytes]) -> Spoil:
    """Change the weights, and their hash with them, as an attacker would."""

    def spoil(folder: Path) -> None:
        change("weights.safetensors", how)(folder)
        digest = hashlib.sha256((folder / "weights.safetensors").read_bytes()).hexdigest()
        edit(weights_sha256=digest)(folder)

    return spoil


def tensors(how: Callable[[dict[str, Any]], dict[str, Any]]) -> Spoil:
    return weights(
        lambda data: safetensors.numpy.save(how({k: np.array(v) for k, v in safetensors.numpy.load(data).items()}))
    )


def instead(name: str, make: Callable[[Path], object]) -> Spoil:
    """Make something else in the place of a file, which is moved out of the folder."""

    def spoil(folder: Path) -> None:
        (folder / name).rename(folder.parent / f"moved-{name}")
        make(folder / name)

    return spoil


def link(path: Path) -> None:
    path.symlink_to(path.parents[1] / f"moved-{path.name}")


def other_digit(name: str) -> Spoil:
    def spoil(folder: Path) -> None:
        digest = json.loads((folder / "manifest.json").read_bytes())[name]
        edit(rehash=name != "manifest_sha256", **{name: digest[:-1] + ("0" if digest[-1] != "0" else "1")})(folder)

    return spoil


SPOILED: dict[str, tuple[Spoil, str]] = {
    "no_manifest": (lambda f: (f / "manifest.json").unlink(), "manifest.json: is missing from the policy bundle"),
    "extra_file": (lambda f: (f / "policy.pkl").write_bytes(pickle.dumps(Payload())), "policy.pkl: does not belong"),
    "manifest_link": (instead("manifest.json", link), "manifest.json: is a symbolic link"),
    "pipe": (instead("manifest.json", os.mkfifo), "manifest.json: is a device, a pipe or a socket"),
    "large": (manifest(lambda data: data + b" " * (1 << 20)), "manifest.json: is larger than 1 MiB"),
    "key_twice": (
        manifest(lambda data: data.replace(b"{", b'{"algorithm": "ppo",', 1)),
        "manifest.json: a JSON object contains the key 'algorithm' twice",
    ),
    "unknown_key": (edit(loader="os.system"), "manifest.json: loader: is an unknown key"),
    "dotted_algorithm": (edit(algorithm="subprocess.Popen"), "manifest.json: algorithm: must be 1 to 64 lower case"),
    "future_version": (edit(format_version=6), "manifest.json: format_version: must be 2"),
    "wrong_type": (edit(steps="many"), "manifest.json: steps: must be a whole number"),
    "giant_layer": (edit(network__policy_hidden=[10**9]), "manifest.json: network.policy_hidden.0"),
    "more_features": (
        edit(observation__features=["own.speed"]),
        "manifest.json: observation.features: has 1 features; must have 27, the observation_size",
    ),
    "unknown_features": (
        edit(observation__features=[f"own.{k}" for k in range(27)]),
        "manifest.json: observation: unknown feature 'own.0'",
    ),
    "group_as_feature": (
        edit(observation__features=["rear_2", *View().names[1:]]),
        "manifest.json: observation: this version of the package computes or scales features differently",
    ),
    "other_scaling": (
        edit(observation__scaling_sha256="0" * 64), "manifest.json: observation: this version of the package computes",
    ),
    "forecasts_without_a_step": (
        edit(observation__features=["contact.brake_front_time", *View().names[1:]], scenario={"name": "x"}),
        "manifest.json: scenario: time_step_s = None: must be a number of seconds above 0, because the policy observes",
    ),
    "path_as_learner": (edit(learners=["../../vehicle_2"]), "manifest.json: learners.0: must match"),
    "other_steps": (edit(rehash=False, steps=999_999_999), "manifest.json: the content has SHA-256"),
    "weights_hash": (other_digit("weights_sha256"), "weights.safetensors: the file has SHA-256"),
    "bit_flip": (
        change("weights.safetensors", lambda d: d[:-3] + bytes([d[-3] ^ 1]) + d[-2:]),
        "weights.safetensors: the file has SHA-256",
    ),
    "pickle": (weights(lambda _: pickle.dumps(Payload())), "weights.safetensors: not a safetensors file"),
    "extra_tensor": (
        tensors(lambda t: {**t, "policy.9.bias": np.zeros(3, "f4")}),
        "tensor 'policy.9.bias': must not be in this file",
    ),
    "wrong_shape": (
        tensors(lambda t: {**t, "policy.0.bias": np.zeros(14, "f4")}),
        "tensor 'policy.0.bias' has type float32 and shape [14]; must have type float32 and shape [13]",
    ),
    "nan_weight": (
        tensors(lambda t: {**t, "value.0.bias": np.append(t["value.0.bias"][1:], np.float32(np.nan))}),
        "tensor 'value.0.bias': contains a number that is not finite",
    ),
}  # fmt: skip

watching: list[str] = []  # the folder that may be read; a hook of the interpreter stays as long as that
events: list[str] = []


def note(event: str, args: tuple[Any, ...]) -> None:
    for root in watching:
        inside = event == "open" and (isinstance(args[0], int) or str(args[0]).startswith(root)) and not args[2] & 3
        if not inside and event not in ("os.listdir", "object.__getattr__", "sys._getframe"):
            events.append(f"{event} {args!r:.200}")


sys.addaudithook(note)


@pytest.mark.parametrize("name", SPOILED)
def test_damaged_bundle__is_refused_and_runs_and_opens_nothing_else(name: str, policy: Policy, tmp_path: Path) -> None:
    spoil, message = SPOILED[name]
    policy.save(tmp_path / "good")
    load_policy(tmp_path / "good")
    assert known_names()  # the extensions with features are imported before
    policy.save(tmp_path / "policy")
    spoil(tmp_path / "policy")
    events.clear()
    watching.append(str(tmp_path))
    try:
        with refused(message, CorruptBundle) as caught:
            load_policy(tmp_path / "policy")
    finally:
        watching.clear()
    assert events == []
    text = str(caught.value)
    assert text.startswith(str(tmp_path / "policy")) and "\n" not in text and len(text) < 2000


FOLDERS: dict[str, Callable[[], Any]] = {
    "/dev/zero: is not a folder; give the folder of a policy bundle": lambda: load_policy("/dev/zero"),
    "nowhere: is not a folder": lambda: load_drivers(Path("nowhere")),
    "empty: contains no policy; give the folder": lambda: load_policy("empty"),
    "unknown shipped policy 'vine-papre'; did you mean 'vine-paper'?": lambda: load_shipped("vine-papre"),
}


@pytest.mark.parametrize("message", FOLDERS)
def test_folder_without_a_policy__is_refused(message: str, empty_folder: Path) -> None:
    Path("empty").mkdir()
    with refused(message):
        FOLDERS[message]()


MADE: dict[str, Callable[[Policy], Any]] = {
    "policy: steps: must be greater than or equal to 0": lambda policy: make_policy(steps=-1),
    "policy: seed: is an unknown key": lambda policy: make_with(seed=1),
    "policy: tensor 'policy.0.bias': contains a number": lambda policy: make_with(
        {**policy.tensors, "policy.0.bias": np.full(13, np.nan, np.float32)}
    ),
    "policy: observation.features: has 27 features; must have 26": lambda policy: make_with(
        spec=network("clip", observation_size=26)
    ),
}


def make_with(given: dict[str, Any] | None = None, spec: NetworkSpec | None = None, **more: Any) -> Policy:
    spec = spec or network("clip")
    return Policy.make(given or tensors_for(spec), network=spec, observation=View(), **FIELDS, **more)


@pytest.mark.parametrize("message", MADE)
def test_policy__is_made_of_finite_tensors_and_possible_fields(message: str, policy: Policy) -> None:
    with refused(message):
        MADE[message](policy)


# ---------------------------------------------------------------- features of others


def register(factor: float = 1.0, **changes: Any) -> None:
    def speed(state: Any, body: int) -> Any:
        """Own speed."""
        return factor * state.speeds_mps[:, body - 1]

    speed.__module__ = "somebody_elses"
    FEATURES.loaded.pop("their_speed", None)
    settings: dict[str, Any] = {"unit": "m/s", "scale": 10.0, "low": 0.0, "high": 9.0}
    register_feature("their_speed", speed, **{**settings, **changes})


@pytest.fixture
def observing(tmp_path: Path) -> Any:
    register()
    make_policy(View(["own", "their_speed"])).save(tmp_path / "policy")
    assert load_policy(tmp_path / "policy").observation == View(["own", "their_speed"])
    yield tmp_path / "policy"
    FEATURES.loaded.pop("their_speed", None)


def test_registered_feature__must_be_what_it_was(observing: Path) -> None:
    register(1.001)
    with refused("'their_speed', whose value in a few worlds was (2.0, 0.9", InvalidInput):
        load_policy(observing)
    for key, value in {"unit": "km/h", "scale": 11.0, "low": -1.0, "high": 8.0}.items():
        register(**{key: value})
        with refused(f"'their_speed', whose {key} was", InvalidInput):
            load_policy(observing)
    FEATURES.loaded.pop("their_speed")
    with refused("the policy observes the feature 'their_speed', which is not registered; install the", InvalidInput):
        load_policy(observing)
    register()
    assert load_policy(observing).manifest.observation.registered[0].name == "their_speed"
