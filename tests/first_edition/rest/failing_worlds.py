"""A planted world that the physics cannot advance: a stand-in for defects of the kernel that are not known yet."""

from dataclasses import replace

import numpy as np

from ethbrake_marl.first_edition.physics.state import Ints, Worlds
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario


def plant(worlds: Worlds, rows: list[int]) -> Worlds:
    """These worlds, in ``rows`` with vehicles 2 and 3 overlapping by 1 m when vehicle 2 meets vehicle 1.

    No advance could have left such a state; the kernel says that a contact was missed.
    """
    planted = worlds.take(np.arange(worlds.n))
    planted.gaps_m[rows] = [0.5, -1.0]
    planted.speeds_mps[rows] = [10.0, 20.0, 16.0]
    return planted


def planted_list(scenario: Scenario, n: int, seed: int, rows: list[int]) -> Sample:
    """A list of the scenario with failing worlds in it."""
    sample = scenario.sample(n, seed)
    return replace(sample, worlds=plant(sample.worlds, rows))


def without(n: int, rows: list[int]) -> Ints:
    """The other rows."""
    return np.setdiff1d(np.arange(n), rows)
