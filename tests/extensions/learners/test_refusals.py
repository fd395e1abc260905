"""What recipes and trainings of these algorithms refuse."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.extensions.learners.start_weights import widened
from ethbrake_marl.training.recipe import load_recipe
from ethbrake_marl.training.session import train
from ethbrake_marl.training.training import Training
from tests.extensions.learners.tiny import TINY_COUNTERFACTUAL, TINY_MODES, TINY_OPTIONS
from tests.fixtures.policies import make_policy
from tests.refused import refused

PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")


def modes(**changes: Any) -> Any:
    """The recipe of several networks, with changes in how they are trained."""
    return TINY_MODES.replace(modes=TINY_MODES.model_dump(mode="json")["modes"] | changes)


def test_observation_and_network__hold_those_of_the_policy_to_start_from() -> None:
    turned = load_recipe("counterfactual").replace(observation=["own", "front_1", "contact"])
    with refused("observation: lacks rear_1.known, rear_1.gap, rear_1.closing_speed, rear_1.acceleration"):
        widened(eb.load_shipped("ppo"), Training.of(turned, PAPER))
    smaller = load_recipe("counterfactual").replace(network={"policy": [64, 64]})
    with refused(
        "network: policy_hidden is (64, 64), but (128, 128) in the policy to start from; they must be the same"
    ):
        widened(eb.load_shipped("ppo"), Training.of(smaller, PAPER))


def test_policy_to_start_from__has_one_network(empty_folder: Path) -> None:
    several = {"networks": 3, "gate_hidden": (6,), "value_hidden": ()}
    several = make_policy(eb.ObservationSpec(), {"name": "paper-random"}, "counterfactual", **several)
    several.save(Path("first"))
    with refused("recipe 'counterfactual': start: has 3 networks; give a policy of one"):
        train(TINY_MODES.replace(start="counterfactual@first"), PAPER, Path("run"))


def test_tried_actions__are_at_most_the_decisions_of_an_update() -> None:
    assert TINY_COUNTERFACTUAL.replace(counterfactuals=32).counterfactuals == 8 * 4
    with refused("counterfactuals = 33: must be at most n_envs x n_steps = 32"):
        TINY_COUNTERFACTUAL.replace(counterfactuals=33)
    assert TINY_OPTIONS.replace(tried=32, memory=99).tried == 8 * 4
    with refused("tried = 33: must be at most n_envs x n_steps = 32"):
        TINY_OPTIONS.replace(tried=33, memory=99)


REFUSED: dict[str, Callable[[], object]] = {
    "algorithm = trpo: must be one of counterfactual, options, ppo, sac": lambda: TINY_OPTIONS.replace(
        algorithm="trpo"
    ),
    "recipe 'options': averaging = 1: must be less than 1": lambda: load_recipe("options").replace(averaging=1.0),
    "recipe 'options': near = [{smallest: 0.1, largest: 1}, {smallest: 0.1, largest: 1}...": lambda: load_recipe(
        "options"
    ).replace(near=[{"smallest": 0.1, "largest": 1.0}] * 9),
    "recipe 'counterfactual': reward.shaping = 0.1: must be 0: what is tried is played to the end": lambda: (
        TINY_COUNTERFACTUAL.replace(reward={"harm": 1.0, "shaping": 0.1})
    ),
    "recipe 'counterfactual': offset.largest = 0.1: must be at least smallest = 0.3": lambda: (
        TINY_COUNTERFACTUAL.replace(offset={"smallest": 0.3, "largest": 0.1})
    ),
    "recipe 'counterfactual': gradient_limit = often: must be auto or a finite number above 0": lambda: (
        TINY_COUNTERFACTUAL.replace(gradient_limit="often")
    ),
    "start = sac@x: must be the name of a shipped policy, for instance ppo, or": lambda: TINY_COUNTERFACTUAL.replace(
        start="sac@x"
    ),
    "'ppo@shipped' is now written ppo": lambda: TINY_COUNTERFACTUAL.replace(start="ppo@shipped"),
    "n_envs x n_steps = 16777216 decisions per update; at most": lambda: TINY_COUNTERFACTUAL.replace(n_envs=2**22),
    "must be single, shared, independent or centralised": lambda: TINY_COUNTERFACTUAL.replace(scheme="centralized"),
    "recipe 'options': memory = 15: must be at least tried = 16": lambda: TINY_OPTIONS.replace(memory=15),
    "must hold a range where there are neither fixed": lambda: TINY_OPTIONS.replace(near=[], fixed=[], drawn=0),
    "recipe 'counterfactual': modes.networks = 1: must be greater than or equal to 2": lambda: modes(networks=1),
    "recipe 'counterfactual': modes.shares = {alone: 0.5, further: 0.5, gate: 0.5, together: 0}: alone": lambda: modes(
        shares={"alone": 0.5, "further": 0.5, "gate": 0.5, "together": 0.0}
    ),
    "recipe 'counterfactual': modes.gat: unknown key; did you mean gate?": lambda: modes(gat=[8]),
    "runs/mine: is not a folder; give a policy bundle (manifest.json, weights.safetensors) or a run": lambda: train(
        load_recipe("counterfactual").replace(start="ppo@runs/mine"), "cooperation-2-five", "run", steps=1
    ),
    "recipe 'options': drawn = 2: must be at most the 1 of among": lambda: train(
        load_recipe("options").replace(among=["ppo"]), "paper-random", "new"
    ),
    "'policy@shipped/ppo' is now written ppo": lambda: train(
        load_recipe("options").replace(among=["policy@shipped/ppo"], drawn=1), "paper-random", "new"
    ),
    "recipe 'counterfactual': modes: are for one learner, not for 2": lambda: train(TINY_MODES, PAIR, Path("run")),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", REFUSED)
def test_recipe_or_training__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()


def test_policy_to_choose_among__is_one_that_ships(empty_folder: Path) -> None:
    with refused("unknown shipped policy 'nobody'", UnknownName):
        train(load_recipe("options").replace(among=["nobody"], drawn=1), "paper-random", "new")
