"""The term shaping of rewards: how a step changes a potential, minus the least harm that constant braking can reach.

With the discount d, the sum of ``d^t shaping`` over an episode is minus its first potential, whatever the learners do.
So shaping leaves the optimal policy unchanged (Ng, Harada and Russell 1999) if the learners have the discount d, too. A
learner with a larger discount is paid for states of large predicted harm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import COUNTED_ROWS
from ethbrake_marl.episode.hold import descend_worlds, memory_for
from ethbrake_marl.episode.state import END, ENDED, HORIZON, TIME, State, require
from ethbrake_marl.episode.step import StepSettings
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import Floats

BRAKING_SHARES = np.linspace(0.0, 1.0, 9)
STRONGEST_FIRST = BRAKING_SHARES[::-1].copy()
COUNTED = np.array(COUNTED_ROWS)


@large
def shape_worlds(line, car, clock, learners, shares, rounds, weights, working, discount, before, potentials, value):
    """Write the potential of each world (``potential``) to ``potentials`` [n], the term to ``value`` [n, N] (m2/s2).

    ``line``, ``car`` and ``clock`` are arrays of a ``State``; ``working`` is working memory; ``before`` [n] are the
    potentials before the step.
    """
    present, commands, trials, moments, harm, best, memory = working
    for k in range(len(potentials)):
        harm[0] = 0.0
        if clock[k, ENDED] == 0.0:
            for i in range(line.shape[2]):
                for row in range(line.shape[1]):
                    present[0, row, i] = line[k, row, i]
                for row in COUNTED:
                    present[0, row, i] = 0.0
            moments[0], moments[1], moments[2] = clock[k, TIME], clock[k, END], clock[k, HORIZON]
            times = moments[:1], moments[1:2], moments[2:]
            world = present, car[k : k + 1], commands, learners, trials, *times, memory
            descend_worlds(world, shares, rounds, weights, best, harm)
        potentials[k] = -harm[0]
        for body in learners:
            value[k, body - 1] = discount * potentials[k] - before[k]


def potential(settings: StepSettings, state: State) -> Floats:
    """Minus the least further harm that constant decelerations of the learners can reach, [n] m2/s2.

    The learners choose in turn, front to rear, among nine shares of their braking capacity (several learners: in two
    rounds); all other vehicles brake fully. Harm is counted as in the reward. The potential of an episode that has
    ended is 0.
    """
    return _shaped(settings, 1.0, np.zeros(state.n), state)[1]


def _shaped(settings: StepSettings, discount: float, before: Floats, state: State) -> tuple[Floats, Floats]:
    """Value of the term after a step to ``state``, [n, N], and the potential of ``state``, [n] m2/s2.

    ``before`` [n] is the potential before the step.
    """
    require(state, "the term shaping", simulates=True)
    learners, (_, rows, bodies) = settings.learners, state.line.shape
    # With one learner only the least harm counts: full braking comes first, which often does no more harm.
    shares, rounds = (STRONGEST_FIRST, 1) if len(learners) == 1 else (BRAKING_SHARES, 2)
    working = (
        np.empty((1, rows, bodies)), np.empty((1, bodies)), np.empty((1, len(shares), 1)), np.empty(3), np.empty(1),
        np.zeros(1, np.int64), memory_for(bodies),
    )  # fmt: skip
    value, potentials = np.zeros((state.n, bodies - 1)), np.empty(state.n)
    shape_worlds(
        state.line, state.car, state.clock, learners, shares, rounds, settings.harm_count.weight_array, working,
        discount, before, potentials, value,
    )  # fmt: skip
    return value, potentials


class Shaping(NamedTuple):
    """The term shaping. Its memory is the potential of the present state, [n] m2/s2."""

    settings: StepSettings
    discount: float

    def begin(self, state: State) -> Floats:
        return potential(self.settings, state)

    def value(self, before: State, after: State) -> tuple[Floats, Floats]:
        """Value of the term, [n, N] m2/s2, and the new memory, [n] m2/s2."""
        return _shaped(self.settings, self.discount, before.memories["shaping"], after)
