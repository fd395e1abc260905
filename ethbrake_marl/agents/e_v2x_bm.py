"""E-V2X-BM: brakes with the constant deceleration that does the least harm, chosen at the alert.

``pairwise`` is the paper's closed form. ``coupled`` simulates the whole line with the physics of the episode, so it
predicts the harm that happens.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.pairwise import ConstantDeceleration, closed_form, pairwise
from ethbrake_marl.agents.team import NO_BODIES, PREDICTED
from ethbrake_marl.episode.counts import FIRST_IMPACTS, HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.hold import hold
from ethbrake_marl.episode.layer import MODEL, STATE
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import StepSettings, failure, first_decision, step
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part
from ethbrake_marl.worlds.roles import HOLDING_SCRIPTS, LEARNER

FIRST_PARTS = 64  # number of cells into which the range of decelerations is divided first
SUBCELLS = 8  # number of cells into which a cell is divided
NARROWEST_MPS2 = 1e-5  # narrower cells are not divided
LEAST_GAIN = 1e-3  # a gain in harm (m2/s2) too small to search for
TIE_MARGIN = 1e-9  # harms (m2/s2) closer than this count as equal


def coupled(
    alert: State, body: int, harm_count: AnyCount = HONEST, horizon_s: float | Floats = 8.0
) -> ConstantDeceleration:
    """Constant deceleration of vehicle ``body`` that does the least simulated harm, and this harm, in every world.

    All other vehicles hold ``alert.wanted``. ``harm_count``: harm to minimise (``episode.counts``). ``horizon_s``: time
    until which harm counts, one number or [n]. Ties: the closed form's deceleration if it does no harm; then the harm
    in a second count (``HarmCount.tie_breaker``); then the middle one. Harm has kinks and jumps, so a deceleration
    between two samples may do less.
    """
    count, until_s = HarmCount.of(harm_count), np.full(alert.n, horizon_s, np.float64)
    braking = np.maximum(-alert.wanted, 0.0)
    braking[:, body] = alert.braking_capacity_mps2[:, body - 1]
    best = closed_form(alert, braking, body).deceleration_mps2
    harm = harms(alert, body, best[:, np.newaxis], count, until_s)[:, :, 0]
    rows = np.flatnonzero(harm.any(axis=0))
    if len(rows):
        best[rows], harm[0, rows], _ = search_deceleration(alert.take(rows), body, count, until_s[rows]).T
    failed = np.flatnonzero(np.isinf(harm[0]))  # for every deceleration
    if len(failed):
        raise failure(alert, failed[0], alert.time_s[failed[0]], until_s[failed[0]])
    return ConstantDeceleration(best, harm[0])


def harms(alert: State, body: int, decelerations: Floats, count: HarmCount, until_s: Floats) -> Floats:
    """Harm if vehicle ``body`` holds each of C ``decelerations`` [n, C] (m/s2), [2, n, C] m2/s2.

    Row 0 is the harm in ``count``, row 1 the harm in the count that breaks ties.
    """
    return hold(alert, alert.wanted, [body], -decelerations[:, :, np.newaxis], until_s, count)


def search_deceleration(alert: State, body: int, count: HarmCount, until_s: Floats) -> Floats:
    """Best constant deceleration of vehicle ``body`` (m/s2), with its harm as in ``harms`` (m2/s2), [n, 3].

    Divides the range into ``FIRST_PARTS`` cells, then again and again every cell that may contain a better
    deceleration. Rounding cannot carry the result across a jump of the harm, unless the jump is within rounding of an
    end of a first cell.
    """
    best = np.full((alert.n, 3), np.inf)
    rows, step = np.arange(alert.n), alert.braking_capacity_mps2[:, body - 1] / FIRST_PARTS
    at = step[:, np.newaxis] * np.arange(FIRST_PARTS + 1)
    harm = harms(alert, body, at, count, until_s)
    while len(rows):
        cells = np.empty((2, at.size), np.int64)
        row, part = cells[:, : find_cells(rows, at, harm, step, best, cells)]
        left, right = harm[:, row, part, np.newaxis], harm[:, row, part + 1, np.newaxis]
        rows, step = rows[row], step / SUBCELLS
        at = at[row, part, np.newaxis] + step[rows, np.newaxis] * np.arange(SUBCELLS + 1)
        inside = harms(alert.take(rows), body, at[:, 1:-1], count, until_s[rows])
        harm = np.concatenate([left, inside, right], axis=2)
    return best


@large
def find_cells(rows, at, harm, step, best, cells):
    """Update ``best``; return the number of cells that may contain a better deceleration.

    A cell is the interval between two neighbouring samples. It may contain a better deceleration if the smaller harm at
    its ends, minus the largest change of harm in this cell and its two neighbours, is below the best harm. Row j of
    ``at`` [m, C] (m/s2) and ``harm`` [2, m, C] (m2/s2) has the samples of the world ``rows[j]``, ``step[rows[j]]`` m/s2
    apart. ``best`` [n, 3]: as in ``search_deceleration``. ``cells`` [2, .] receives j and the number of the cell in row
    j.
    """
    count, last = 0, at.shape[1] - 1
    for j in range(at.shape[0]):
        best_so_far, better = best[rows[j]], False
        for c in range(last + 1):
            if compare_harm(harm[:, j, c], best_so_far) < 0:
                best_so_far[1], best_so_far[2], better = harm[0, j, c], harm[1, j, c], True
        if better:
            take_middle(at[j], harm[:, j], best_so_far)
    for j in range(at.shape[0]):
        if step[rows[j]] <= NARROWEST_MPS2:
            continue
        for c in range(last):
            change = 0.0
            for beside in range(max(c - 1, 0), min(c + 2, last)):
                change = max(change, abs(harm[0, j, beside + 1] - harm[0, j, beside]))
            if min(harm[0, j, c], harm[0, j, c + 1]) - change < best[rows[j], 1] - LEAST_GAIN:
                cells[0, count], cells[1, count] = j, c
                count += 1
    return count


@kernel
def take_middle(at, harm, best_so_far):
    """Set ``best_so_far[0]`` to the middle one of the decelerations ``at`` [C] whose ``harm`` [2, C] equals
    ``best_so_far[1:]``.
    """
    ties = 0
    for c in range(len(at)):
        ties += 1 if compare_harm(harm[:, c], best_so_far) == 0 else 0
    for c in range(len(at)):
        ties -= 2 if compare_harm(harm[:, c], best_so_far) == 0 else 0
        if ties <= 0:
            best_so_far[0] = at[c]
            return


@kernel
def compare_harm(harm, best_so_far):
    """-1 if ``harm`` [2] is less than ``best_so_far[1:]``, 0 if equal, 1 if more; the second number breaks ties."""
    for count in range(2):  # the other count decides ties
        if abs(harm[count] - best_so_far[count + 1]) > TIE_MARGIN:
            return -1 if harm[count] < best_so_far[count + 1] else 1
    return 0


class BaselineMemory(NamedTuple):
    command: Floats  # [n] m/s2
    predicted_harm: Floats  # [n] m2/s2


class Predicting:
    """Base class of agents whose memory has ``predicted_harm``, which evaluations report where it is finite."""

    def measures(self, last: State, memory: Any, body: int) -> dict[str, Floats]:
        return {PREDICTED: memory.predicted_harm} if np.isfinite(memory.predicted_harm).all() else {}


class EV2XBM(Predicting):
    """Brakes with the deceleration of ``coupled``, assuming that the other learners brake fully.

    If they do, the predicted harm is, to the last bit, the harm of the episode. ``agents``: vehicle (1: Vehicle 1) ->
    role, for vehicles whose commands are not known at the alert.
    """

    name, knows = "e_v2x_bm", MODEL

    def __init__(
        self, settings: StepSettings, agents: Mapping[int, str] = MappingProxyType({}), harm_count: AnyCount = HONEST
    ) -> None:
        self.settings, self.agents, self.harm_count = settings, dict(agents), HarmCount.of(harm_count)

    def begin(self, alert: State, body: int) -> BaselineMemory:
        """Command for the whole episode, and its predicted harm. Raises ``InvalidInput`` if another vehicle is in
        ``agents``.
        """
        for vehicle, role in self.agents.items():
            if vehicle != body:
                raise InvalidInput(
                    f"agent {self.name!r}: vehicle_{vehicle} is driven by {role!r}, whose commands are not known at the"
                    " alert; use e_v2x_bm:pairwise, which assumes that its neighbours brake fully"
                )
        wanted, learners = alert.wanted.copy(), self.settings.learners
        wanted[:, learners] = -alert.braking_capacity_mps2[:, learners - 1]
        alert = alert._replace(wanted=wanted)
        command = -coupled(alert, body, self.harm_count, self.settings.horizon_s).deceleration_mps2
        wanted[:, body] = command
        return BaselineMemory(command, last_if_held(alert, self.settings).harm(self.harm_count))

    def act(self, state: State, memory: BaselineMemory, body: int) -> tuple[Floats, BaselineMemory]:
        return memory.command, memory


class EV2XBMPairwise(Predicting):
    """Brakes with the deceleration of ``pairwise``, the paper's closed form."""

    name, knows, harm_count = "e_v2x_bm:pairwise", STATE, FIRST_IMPACTS

    def begin(self, alert: State, body: int) -> BaselineMemory:
        """Command and predicted harm. Raises ``InvalidInput`` where the closed form does not hold (``pairwise``)."""
        deceleration, harm = pairwise(alert, body)
        return BaselineMemory(-deceleration, harm)

    def act(self, state: State, memory: BaselineMemory, body: int) -> tuple[Floats, BaselineMemory]:
        return memory.command, memory


def last_if_held(alert: State, settings: StepSettings) -> State:
    state = first_decision(alert, settings.learners, settings)
    settings, nothing = settings._replace(learners=NO_BODIES), np.zeros((alert.n, 0))
    while not state.ended.all():
        state, _ = step(settings, {}, state, nothing, donate=True)
    return state


def make_e_v2x_bm(argument: str | None, settings: Any) -> EV2XBM | EV2XBMPairwise:
    """Agent ``e_v2x_bm``, or ``e_v2x_bm:pairwise`` for the argument ``pairwise``."""
    if argument == "pairwise":
        return EV2XBMPairwise()
    if argument is not None:
        raise InvalidInput(f"agent {settings.spec!r}: must be e_v2x_bm or e_v2x_bm:pairwise")
    scenario = settings.needed_scenario()
    roles = dict(enumerate(scenario.roles.values(), 1))
    agents = {body: role for body, role in roles.items() if role.partition(":")[0] not in (LEARNER, *HOLDING_SCRIPTS)}
    step_settings = StepSettings(np.array(scenario.learners, np.int64), scenario.time_step_s, scenario.horizon_s)
    return EV2XBM(step_settings, agents, settings.harm_count)


E_V2X_BM = Part(
    make_e_v2x_bm,
    form="e_v2x_bm[:pairwise]",
    about="the constant deceleration of least simulated harm; pairwise: the paper's closed form, from the true state",
    knows=MODEL,
)
