"""The shipped policy for all weights, beside the front and beside full braking."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.fronts.front import amounts_of, search_front

SPEC = "vine-preference"
PAPER = eb.load_scenario("paper-random")
WORLDS = PAPER.sample(300, 990401).worlds


def borne(weights: list[float]) -> np.ndarray:
    scenario = PAPER.replace(harm_weight=weights, objective="preference")
    agent = eb.make_agent(SPEC, scenario=scenario)
    return (
        eb.evaluate(scenario.sample(300, 990401), {"it": agent}, scenario=scenario).outcome("it").vehicle_harm("first")
    )


@pytest.mark.parametrize("weights", [[1, 1, 1], [1, 0.25, 0], [0, 1, 0], [1, 0, 0]])
def test_policy__is_near_the_front_under_its_weights(weights: list[float]) -> None:
    least = search_front(PAPER, WORLDS, [weights], budget=1_000).amounts.mean()
    assert amounts_of(borne(weights), np.array(weights)).mean() <= 1.10 * least


@pytest.mark.parametrize("vehicle", [0, 1, 2])
def test_policy__spares_a_vehicle_the_more_the_more_its_harm_weighs(vehicle: int) -> None:
    """Mean harm of the vehicle falls as its weight grows and the others' stay, up to a hundredth of full braking's."""
    means = []
    for weight in (0.01, 0.1, 0.5, 1.0, 3.0, 10.0, 100.0):
        weights = [1.0, 1.0, 1.0]
        weights[vehicle] = weight
        means.append(borne(weights)[:, vehicle].mean())
    assert (np.diff(means) <= 0.05).all() and means[-1] < means[0]
