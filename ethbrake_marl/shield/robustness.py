"""The cost of not knowing: robust mode's price, and harm where the truth is not what the shield believes."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.rollout import drive
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Ints, LeftOutRows, Worlds, measured_without_failed
from ethbrake_marl.scenario.task import Task
from ethbrake_marl.shield.agents import StepShieldAgent
from ethbrake_marl.shield.interior import CORNERS, checked_robust
from ethbrake_marl.shield.uncertainty import Uncertainty

WIDTHS = (0.0, 0.25, 0.5, 1.0, 2.0)  # of a curve, in units of the intervals that are given
TRUTHS = ("as told", "inside", "corner")  # the world that was told; one evenly out of its box; one of the box's corners
MODES = ("step", "robust")

Progress = Callable[[str, int], None]  # what is driven, worlds done so far


class RobustnessPoint(NamedTuple):
    """How one shield did at one width of the intervals, in one kind of truth; means are over all worlds."""

    mode: str  # one of MODES; step mode believes what it is told
    truth: str  # one of TRUTHS
    width: float  # in units of the intervals that were given
    harm: float  # mean realised (m2/s2)
    bound: float  # mean stated at the alert (m2/s2)
    above: float  # share of worlds that realise more than the bound stated at the alert
    excess: float  # mean of how much more, 0 where it is not (m2/s2)
    distrusted: float  # share of worlds in which the shield noticed
    left_out: LeftOutRows = ()  # worlds that could not be advanced: in no point, whichever shield and truth met them


def robustness(
    worlds: Worlds,
    policy: Agent,
    task: Task,
    uncertainty: Uncertainty,
    *,
    widths: Sequence[float] = WIDTHS,
    seed: int = 0,
    robust: str = CORNERS,
    on_progress: Progress | None = None,
) -> list[RobustnessPoint]:
    """Both shields around ``policy`` in every kind of truth at each width; ``worlds`` is what the shields are told.

    The engine runs the truth, and the policy sees it; the shields begin with what they are told and see what happens.
    The numbers that place a truth in its box are those of ``seed``, the same for all widths. ``robust`` says what the
    robust shield certifies of a box, as in ``ShieldOptions``. A world that cannot be advanced in one of the cases is
    left out of all, and named in ``left_out``. Raises ``InvalidInput`` for no width or a negative one, ``UnknownName``
    for another ``robust``, ``PhysicsError`` where no world is left, and what ``StepShieldAgent`` raises.
    """
    checked_robust(robust, "robustness")
    if not widths or not all(0.0 <= width < np.inf for width in widths):
        raise InvalidInput(f"robustness: widths {tuple(widths)}: at least one is needed, each at least 0")
    try:
        uncertainty.scaled(max(widths)).draw(worlds, np.random.default_rng(seed))
    except InvalidInput as error:
        raise InvalidInput(f"{error}; widths of up to {max(widths):g} times those given are measured") from None

    def measured(at: Ints) -> list[RobustnessPoint]:
        points, known, told = [], dict[tuple[float, str, str], RobustnessPoint](), worlds.take(at)
        for width, truth, mode in itertools.product(map(float, widths), TRUTHS, MODES):
            alike = width == 0.0 or (mode, truth) == ("step", "as told")  # what is told is all that matters
            key = (0.0, "as told", "step") if alike else (width, truth, mode)
            if key not in known:
                intervals = uncertainty.scaled(width)
                shielded = StepShieldAgent(
                    copy.deepcopy(policy), task.scenario, harm_count=task.harm_count, believed=told,
                    uncertainty=intervals if mode == "robust" else None,
                    robust=robust if mode == "robust" else CORNERS,
                )  # fmt: skip
                driven = worlds
                if key[1] != "as told":  # drawn for all worlds: a truth does not depend on which of them are left out
                    driven = intervals.draw(worlds, np.random.default_rng(seed), corners=truth == "corner")
                known[key] = _point(driven.take(at), shielded, task)
            points.append(known[key]._replace(mode=mode, truth=truth, width=width))
            if on_progress is not None:
                on_progress(f"{mode}, {truth}, width {width:g}", worlds.n)
        return points

    found, _, left_out = measured_without_failed(measured, worlds.n)
    return [point._replace(left_out=left_out) for point in found]


def _point(worlds: Worlds, shielded: StepShieldAgent, task: Task) -> RobustnessPoint:
    """What a shield makes of the worlds that it is driven through; which case that is, the caller says."""
    harm = drive(worlds, shielded, task.scenario, task.vehicle).ledger.world_harm(task.harm_count)
    bound, shield = shielded.predicted_harm, shielded.shield
    assert shield is not None
    above = np.maximum(harm - bound, 0.0)
    return RobustnessPoint(
        mode="",
        truth="",
        width=0.0,
        harm=float(harm.mean()),
        bound=float(bound.mean()),
        above=float((above > 0.0).mean()),
        excess=float(above.mean()),
        distrusted=float(shield.distrusted.mean()),
    )
