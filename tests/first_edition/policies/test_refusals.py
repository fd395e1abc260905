"""What policies, their folders and their observations may not be."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import AlreadyExists, CorruptBundle, UnknownName
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.policies.actor import Actor
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.policies.shipped import load_named_policy, load_shipped, shipped_policies
from ethbrake_marl.first_edition.training.recipe import load_recipe
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
SHIPPED = load_named_policy("ppo")


@cache
def actor() -> Actor:
    """An actor of four features whose weights are 0."""
    spec = load_recipe("ppo-paper").network_spec(4)
    return Actor(spec, {row.name: np.zeros(row.shape, np.float32) for row in spec.tensors})


POLICIES: dict[str, Callable[[], object]] = {
    "/dev/zero: is not a folder; give the": lambda: load_policy("/dev/zero"),
    "policy = None: must be the path of a": lambda: load_policy(None),
    "observation: has type float32 and shape": lambda: actor()(np.zeros((3, 5), np.float32)),
    "observation[1, 2] = nan: must be finite": lambda: actor()(np.array([[0, 0, 0, 0], [0, 0, np.nan, 0]], np.float32)),
    "': the policy was trained by sac; write": lambda: make_lineup([f"ppo@{shipped_policies()['sac']}"], PAPER),
    "unknown shipped policy": lambda: load_shipped("ppo-paper-random-obstacle"),
    "'team@shipped' is now written universal": lambda: make_lineup(["team@shipped+step"], PAPER),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", POLICIES)
def test_policy__is_refused(message: str) -> None:
    with refused(message):
        POLICIES[message]()


def test_folder_of_a_policy__holds_one_and_replaces_none(empty_folder: Path) -> None:
    Path("empty").mkdir()
    with refused("empty: contains no policy; give the folder of a policy bundle"):
        load_policy("empty")
    with refused("empty: already exists; give another name", AlreadyExists):
        SHIPPED.save(Path("empty"))


@pytest.mark.parametrize("link", ["policy", "run/policy"])
def test_folder_of_a_policy__is_no_link(link: str, empty_folder: Path) -> None:
    SHIPPED.save(Path("elsewhere"))
    Path("run").mkdir()
    Path(link).symlink_to(Path("elsewhere").absolute())
    with refused(f"{link}: is a symbolic link; give the folder to which the link points", CorruptBundle):
        load_policy(link.removesuffix("/policy"))


def test_policy__is_made_of_finite_numbers_and_possible_fields() -> None:
    fields = {name: getattr(SHIPPED.manifest, name) for name in type(SHIPPED.manifest).model_fields}
    fields = {name: value for name, value in fields.items() if not name.endswith("_sha256")}
    with refused("policy: steps: must be greater than or equal to 0"):
        Policy.make(SHIPPED.tensors, **{**fields, "steps": -1})
    bias = np.full_like(SHIPPED.tensors["policy.0.bias"], np.nan)
    with refused("policy: tensor 'policy.0.bias': contains a number that is not finite"):
        Policy.make({**SHIPPED.tensors, "policy.0.bias": bias}, **fields)


def test_shipped_policy__is_told_what_is_near() -> None:
    with refused("unknown shipped policy 'universel'; did you mean 'universal'?", UnknownName):
        load_shipped("universel")
