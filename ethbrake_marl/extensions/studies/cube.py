"""A scenario's worlds as points of a unit cube, with one coordinate for each random number that a world depends on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import Bools, Floats
from ethbrake_marl.worlds.quantities import Place
from ethbrake_marl.worlds.sampling import draw_once, has_early_impact
from ethbrake_marl.worlds.scenario import Scenario

_UNUSED = 0.5  # value of a random number without effect
_TRIAL_WORLDS = 16  # random worlds in which the effect of a number is looked for: a load matters for some types only


class Cube(NamedTuple):
    """Unit cube of a scenario. ``places``: the random number (stream and column) that each coordinate sets."""

    scenario: Scenario
    places: tuple[Place, ...]

    def worlds(self, points: Floats) -> State:
        """Worlds at the alert for ``points`` of the cube, [n, d] in [0, 1)."""
        index = np.arange(len(points), dtype=np.int64)

        def numbers(width: int, stream: tuple[int, ...]) -> Floats:
            uniforms = np.full((len(points), width), _UNUSED)
            for (of, column), u in zip(self.places, points.T, strict=True):
                if of == stream:
                    uniforms[:, column] = u
            return uniforms

        return draw_once(self.scenario, numbers, index).worlds

    def accepts(self, worlds: State) -> Bools:
        """Whether the scenario accepts a world, [n]; it may reject worlds with an impact before a learner can act."""
        if self.scenario.early_impacts == "keep" or not self.scenario.learners:
            return np.ones(worlds.n, np.bool_)
        return ~has_early_impact(self.scenario, worlds)


def cube_of(scenario: Scenario) -> Cube:
    """Unit cube of a scenario, with one coordinate for every random number that can change a world.

    Raises ``InvalidInput`` if nothing is random, for a mixture of scenarios, and for a V2X channel with random delays
    or losses, which a table of worlds cannot store.
    """
    if scenario.members:
        members = ", ".join(member.name for member in scenario.members)
        raise InvalidInput(f"scenario {scenario.name!r}: is a mixture; use one of its scenarios: {members}")
    if scenario.v2x.drawn:
        raise InvalidInput(
            f"scenario {scenario.name!r}: its v2x channel has random delays or losses, which a table of worlds cannot"
            " store; use v2x: paper (--set v2x=paper)"
        )
    widths: dict[tuple[int, ...], int] = {}

    def note_width(width: int, stream: tuple[int, ...]) -> Floats:
        widths[stream] = width
        return np.full((1, width), _UNUSED)

    draw_once(scenario, note_width, np.zeros(1, np.int64))
    places = [(stream, column) for stream in sorted(widths) for column in range(widths[stream])]
    points = np.random.default_rng(0).random((2, len(places), _TRIAL_WORLDS, len(places)))
    points[1] = points[0]
    for k in range(len(places)):
        points[1, k, :, k] = (points[0, k, :, k] + 0.5) % 1.0
    worlds = Cube(scenario, tuple(places)).worlds(points.reshape(2 * len(places) * _TRIAL_WORLDS, len(places)))
    half = worlds.n // 2
    differ = ((array[:half] != array[half:]).any(axis=(1, 2)) for array in (worlds.line, worlds.car))
    matters = np.logical_or(*differ).reshape(len(places), _TRIAL_WORLDS).any(axis=1)
    if not matters.any():
        raise InvalidInput(
            f"scenario {scenario.name!r}: no quantity is random, so all its worlds are the same; give at least one"
            " quantity a distribution"
        )
    return Cube(scenario, tuple(place for place, is_effective in zip(places, matters, strict=True) if is_effective))
