"""Step shield for uncertain worlds: it certifies plans in the corners of the box of possible worlds, or in the whole
box.

The *members* of a world are the worlds in which ``StepShield`` certifies a plan. For this shield the members are the
reported world and the corners of an ``Uncertainty``. With ``robust="interior"`` the shield also bounds the harm of
every plan over the whole box between the corners (``enclosure.Boxes``), at the alert and at every decision.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ethbrake_marl.engine.profiles import ProfileProblem
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput, renumbered
from ethbrake_marl.extensions.certified.enclosure import CORNERS, INTERIOR, Boxes, checked_robust
from ethbrake_marl.extensions.certified.uncertainty import Uncertainty
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shields.certify import Backup, Decision, certify
from ethbrake_marl.shields.reasons import NO_CERTIFICATE
from ethbrake_marl.shields.running import Running
from ethbrake_marl.shields.step import StepShield
from ethbrake_marl.shields.step_memory import StepMemory


class RobustShield(StepShield):
    """``StepShield`` whose bound on harm holds in every corner of the box of possible worlds, or in the whole box.

    Args:
        scenario: the scenario of all worlds.
        vehicle: index of the shielded vehicle; with an uncertainty there may be only one.
        uncertainty: intervals around the reported quantities; None: the caller passes the ``possible`` worlds to
            ``begin``.
        robust: worlds to certify: ``corners`` or ``interior``.
        harm_count: impacts that count: ``first`` (first impact of each pair) or ``total`` (every impact).
        others: scripts of the other vehicles; the keys are vehicle indices. None: the scripts of the scenario.
        settings: further keyword arguments of ``StepShield``.

    Raises ``InvalidInput`` in three cases: where ``StepShield`` raises it, if an uncertainty is combined with several
    vehicles or a cap, and for settings that ``interior`` cannot certify.

    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int | Sequence[int],
        *,
        uncertainty: Uncertainty | None = None,
        robust: str = CORNERS,
        harm_count: HarmCount = "first",
        others: Mapping[int, Script] | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(scenario, vehicle, harm_count=harm_count, others=others, **settings)
        if uncertainty is not None and (len(self.vehicles) > 1 or self.cap is not None):
            what = "several vehicles" if self.cap is None else "a cap"
            raise InvalidInput(
                f"shield: an uncertainty cannot be combined with {what}; shield one vehicle without a cap"
            )
        self.uncertainty, self.robust = uncertainty, checked_robust(robust, "shield")
        Boxes.check_possible(self.robust, scenario, harm_count, self._others)

    @property
    def possible_are(self) -> str:  # type: ignore[override]  # a constant there
        """Text in error messages that says which worlds are the members (possible worlds), such as "uncertainty:
        gaps_m=0.5".
        """
        return f"uncertainty: {self.uncertainty}"

    def members_of(self, worlds: Worlds) -> Worlds:
        """Return the members of worlds at the alert, [n * M]: each world followed by the corners of its uncertainty."""
        return worlds if self.uncertainty is None else self.uncertainty.members(worlds)

    @property
    def boxes(self) -> Boxes | None:
        """In interior mode, the boxes (smallest and largest value of every number of each world) once episodes have
        begun; otherwise None.
        """
        boxes: Boxes | None = self.memory.enclosure
        return boxes

    def _bound_at_alert(
        self, possible: Worlds, problem: ProfileProblem, rows: Ints, plan: Floats, harm: Floats
    ) -> tuple[Floats, Boxes | None]:
        """Return the bound on the harm of each plan at the alert, [m] m2/s2, and the boxes of all episodes.

        In interior mode the bound covers all worlds of each box. In corners mode it covers only the members (the
        reported world and the corners of its box), and the boxes are None.

        Args:
            possible: [m * M] members of the new worlds, M consecutive ones for each world.
            problem: the same worlds as a table with one row for each world.
            rows: [m] indices of the new episodes.
            plan: [m, L] action at each decision.
            harm: [m] largest harm of the plan in any member, m2/s2.

        """
        if possible.n == len(rows) or self.robust != INTERIOR:
            return harm, self.boxes
        boxes = Boxes.of(possible, problem, len(rows), self.scenario, self._others)
        return boxes.at_alert(plan, harm), boxes.placed(self.boxes, rows)

    def _also_certified(
        self, now: Running, memory: StepMemory, budget: Floats, decision: Decision, asked: Bools
    ) -> Decision:
        """Return the decision; in interior mode every new plan must be certified for all worlds of its box.

        A plan without this certificate is replaced by the plan from before the decision.

        Args:
            now: state of the members (the corners of the boxes) before the decision.
            memory: memory of the shield.
            budget: [n] largest harm that a new plan may have, m2/s2.
            decision: the present decision, whose plans are certified only in the members.
            asked: [n] True for episodes that have a decision now.

        """
        boxes = memory.enclosure
        return decision if boxes is None else certify_inside(boxes, now, memory.backup, budget, decision, asked)

    def _leaves_range(self, running: Running) -> Bools:
        """Return a mask [n] of the reported worlds in whose box some world may leave the range between the members. The
        members are the reported world and the corners of its box; ``running`` has their states. The mask is True where
        ``StepShield`` returns True, and in worlds in which the shielded vehicle's latency is uncertain, because
        decisions then fall at different times in the worlds of a box. The mask is True everywhere if one uncertain
        number (friction) changes several quantities.
        """
        leaves, boxes = super()._leaves_range(running), self.boxes
        if boxes is not None:
            own = 2 * boxes.limit.shape[1] + boxes.vehicle
            leaves |= boxes.high[:, own] > boxes.low[:, own]
        if self.uncertainty is not None and self.uncertainty.moves_together:
            leaves[:] = True
        return leaves


def certify_inside(
    boxes: Boxes, running: Running, held: Backup, budget: Floats, decision: Decision, asked: Bools
) -> Decision:
    """Return the decision with the old plan in place of each new plan that is not certified in all worlds of its box.

    Args:
        boxes: smallest and largest value of every number of each world.
        running: state of the members (corners of the boxes) before the decision.
        held: plans and bounds from before the decision.
        budget: [n] largest harm that a new plan may have, m2/s2.
        decision: the present decision, whose plans are certified only in the corners.
        asked: [n] True for episodes that have a decision now. In interior mode an episode ends only at the horizon,
            because a box may contain moving worlds when all its corners are at rest.

    """
    plan, other = decision.backup.plan.copy(), (decision.backup.plan != held.plan).any(axis=1)
    bound = np.where(asked & ~other, held.harm, decision.bound)  # the bound of an unchanged plan does not change
    changed = np.flatnonzero(asked & other)
    bounds = boxes.bound(changed, plan[changed], budget[changed], only_enough=True)
    least = np.where(decision.intervened, held.harm, budget)[changed]
    good = bounds <= least
    bound[changed[good]] = bounds[good]
    known = np.isfinite(bounds)
    decision.margin[changed[known]] = (budget[changed] - bounds)[known]
    bad = changed[~good]
    plan[bad], bound[bad] = held.plan[bad], held.harm[bad]
    decision = decision._replace(bound=bound, backup=decision.backup._replace(plan=plan, harm=bound))
    refused = bad[~decision.intervened[bad]]
    if refused.size:  # apply the action of the plan from before the decision
        part, plan = running.take(refused), held.plan[refused]
        action, harm = plan[np.arange(len(plan)), part.steps], held.harm[refused]
        with renumbered(refused):
            instead = certify(part, action, Backup(plan, harm, held.constants), harm)
        every, reason = np.ones(len(refused), np.bool_), np.full(len(refused), NO_CERTIFICATE)
        instead = instead._replace(intervened=every, reason=reason, margin=decision.margin[refused])
        decision = decision.put(refused, instead, np.arange(len(refused)))
    after = decision.after
    over = np.repeat(after.steps, after.members) >= after.problem.last_step
    each = np.repeat(asked, after.members)
    return decision._replace(after=after._replace(ended=np.where(each, over, after.ended)))
