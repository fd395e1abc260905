"""What recipes and trainings of these algorithms refuse."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.extensions.learners.start_weights import widened
from ethbrake_marl.first_edition.training.recipe import load_recipe
from ethbrake_marl.first_edition.training.session import train
from ethbrake_marl.first_edition.training.settings import read_settings
from ethbrake_marl.first_edition.training.training import Training
from tests.extensions.learners.tiny import TINY_EXPERTS, TINY_ROLLOUTS, TINY_VINE
from tests.fixtures.policies import make_policy
from tests.refused import refused

PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")


def experts(**changes: Any) -> Any:
    """The recipe of a mixture of experts, with changes."""
    return TINY_EXPERTS.replace(experts=TINY_EXPERTS.model_dump(mode="json")["experts"] | changes)


def test_observation_and_network__hold_those_of_the_policy_to_start_from() -> None:
    turned = load_recipe("vine").replace(observation=["own", "front_1", "contact"])
    with refused("observation lacks the features rear_1.known, rear_1.gap, rear_1.closing_speed, rear_1.acceleration"):
        widened(eb.load_shipped("ppo"), Training.of(turned, PAPER))
    smaller = load_recipe("vine").replace(network={"policy": [64, 64]})
    with refused(
        "network.policy_hidden is (64, 64), but must be (128, 128), as in the policy that the key start names"
    ):
        widened(eb.load_shipped("ppo"), Training.of(smaller, PAPER))


def test_policy_to_start_from__has_one_network(empty_folder: Path) -> None:
    several = {"networks": 3, "gate_hidden": (6,), "value_hidden": ()}
    several = make_policy(eb.ObservationSpec(), {"name": "paper-random"}, "vine", **several)
    several.save(Path("first"))
    with refused("recipe 'vine': start: the policy that this key names is a mixture of 3 networks"):
        train(TINY_EXPERTS.replace(start="vine@first"), PAPER, Path("run"))


def test_tried_actions__are_at_most_the_decisions_of_an_update() -> None:
    assert TINY_VINE.replace(tried=32).tried == 8 * 4
    with refused("tried = 33: must be at most n_envs x n_steps = 32"):
        TINY_VINE.replace(tried=33)
    assert TINY_ROLLOUTS.replace(tried=32, memory=99).tried == 8 * 4
    with refused("tried = 33: must be at most n_envs x n_steps = 32"):
        TINY_ROLLOUTS.replace(tried=33, memory=99)


REFUSED: dict[str, Callable[[], object]] = {
    "algorithm = trpo: must be one of ppo, rollout-classification, sac, vine": lambda: TINY_ROLLOUTS.replace(
        algorithm="trpo"
    ),
    "averaging = 1: must be less than 1": lambda: load_recipe("rollout-classification").replace(averaging=1.0),
    "near = [{smallest: 0.1, largest: 1}, {smallest: 0.1, largest: 1}...": lambda: TINY_ROLLOUTS.replace(
        near=[{"smallest": 0.1, "largest": 1.0}] * 9
    ),
    "recipe 'vine': reward.shaping = 0.1: must be 0: this algorithm plays tried actions to the end": lambda: (
        TINY_VINE.replace(reward={"harm": 1.0, "shaping": 0.1})
    ),
    "recipe 'vine': offset.largest = 0.1: must be at least the value of the key smallest, 0.3": lambda: (
        TINY_VINE.replace(offset={"smallest": 0.3, "largest": 0.1})
    ),
    "recipe 'vine': gradient_limit = often: must be 'auto' or a finite number above 0": lambda: TINY_VINE.replace(
        gradient_limit="often"
    ),
    "start = sac@x: must be the name of a shipped policy, for instance ppo, or": lambda: TINY_VINE.replace(
        start="sac@x"
    ),
    "'ppo@shipped' is now written ppo": lambda: TINY_VINE.replace(start="ppo@shipped"),
    "n_envs x n_steps = 16777216 decisions per update are too many (at most 4194304)": lambda: TINY_VINE.replace(
        n_envs=2**22
    ),
    "must be single, shared, independent or centralised": lambda: TINY_VINE.replace(scheme="centralized"),
    "memory = 15: must be at least tried, which is 16": lambda: TINY_ROLLOUTS.replace(memory=15),
    "must contain a range, because the recipe has no fixed": lambda: TINY_ROLLOUTS.replace(near=[], fixed=[], drawn=0),
    "recipe 'vine': experts.networks = 1: must be greater than or equal to 2": lambda: experts(networks=1),
    "shares of all updates: they must sum to 1, but sum to 1.5": lambda: experts(
        shares={"pretraining_first": 0.5, "pretraining_others": 0.5, "gating": 0.5, "joint": 0.0}
    ),
    "recipe 'vine': experts.gatin: unknown key; did you mean gating?": lambda: experts(gatin=[8]),
    "runs/mine: is not a folder; give the folder of a policy bundle (manifest.json, weights.safetensors)": lambda: (
        train(load_recipe("vine").replace(start="ppo@runs/mine"), "cooperation-2-five", "run", steps=1)
    ),
    "drawn = 2: drawn must be at most 1, the number of policies": lambda: train(
        load_recipe("rollout-classification").replace(policies=["ppo"]), "paper-random", "new"
    ),
    "'policy@shipped/ppo' is now written ppo": lambda: train(
        load_recipe("rollout-classification").replace(policies=["policy@shipped/ppo"], drawn=1), "paper-random", "new"
    ),
    "recipe 'vine': experts: a mixture of experts can drive only one learner": lambda: train(
        TINY_EXPERTS, PAIR, Path("run")
    ),
}


RENAMED: dict[str, Callable[[], object]] = {
    "unknown recipe 'modes'; it is now called 'experts'": lambda: load_recipe("modes"),
    "recipe 'vine': algorithm = options: is now called rollout-classification": lambda: TINY_VINE.replace(
        algorithm="options"
    ),
    "recipe 'vine': counterfactuals: unknown key; it is now called tried": lambda: TINY_VINE.replace(counterfactuals=8),
    "recipe 'vine': experts.gate_states: unknown key; it is now called gating_states": lambda: experts(gate_states=8),
    "unknown agent 'counterfactual'; it is now called 'vine'": lambda: eb.make_agent("counterfactual@runs/mine"),
    "unknown setting 'modes'; it is now called 'experts'": lambda: read_settings(["modes.worlds=9"], [TINY_VINE]),
}


@pytest.mark.parametrize("message", RENAMED)
def test_old_name__is_refused_with_the_new_one(message: str) -> None:
    with refused(message):
        RENAMED[message]()


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", REFUSED)
def test_recipe_or_training__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


def test_policy_to_choose_among__is_one_that_ships(empty_folder: Path) -> None:
    with refused("unknown shipped policy 'nobody'", UnknownName):
        train(load_recipe("rollout-classification").replace(policies=["nobody"], drawn=1), "paper-random", "new")
