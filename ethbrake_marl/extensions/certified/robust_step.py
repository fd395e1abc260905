"""A step shield for uncertain worlds: it certifies in the corners of an uncertainty, or in its whole interior.

``StepShield`` proves its bound for the members of a world, and takes them as a list. Here they are the corners of an
``Uncertainty``. ``interior`` also bounds the harm of every plan over the whole box around the corners
(``enclosure.Boxes``), at the alert and in every decision.
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
from ethbrake_marl.shield.certify import Backup, Decision, certify
from ethbrake_marl.shield.reasons import NO_CERTIFICATE
from ethbrake_marl.shield.running import Running
from ethbrake_marl.shield.step import StepShield
from ethbrake_marl.shield.step_memory import StepMemory


class RobustShield(StepShield):
    """A ``StepShield`` whose bound holds for every corner of an uncertainty, or for its whole interior.

    Args:
        scenario: of all worlds.
        vehicle: index of the shielded vehicle; one, since several are not covered.
        uncertainty: what is not known; None: ``begin`` is given the ``possible`` worlds.
        robust: ``corners``, or ``interior``.
        settings: further keywords of ``StepShield``.

    Raises ``InvalidInput`` as that does, for several vehicles, and for what ``interior`` cannot certify.

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
            raise InvalidInput(f"shield: uncertainty: {what} with it: not covered; mode robust shields one vehicle")
        self.uncertainty, self.robust = uncertainty, checked_robust(robust, "shield")
        Boxes.check_possible(self.robust, scenario, harm_count, self._others)

    @property
    def possible_are(self) -> str:  # type: ignore[override]  # a constant there
        """What messages say of a world's members."""
        return f"uncertainty: {self.uncertainty}"

    def members_of(self, worlds: Worlds) -> Worlds:
        """The members of worlds at the alert, [n * M]: each world, then its corners."""
        return worlds if self.uncertainty is None else self.uncertainty.members(worlds)

    @property
    def boxes(self) -> Boxes | None:
        """The boxes of ``interior``, once episodes have begun; else None."""
        boxes: Boxes | None = self.memory.enclosure
        return boxes

    def _bound_at_alert(
        self, possible: Worlds, problem: ProfileProblem, rows: Ints, plan: Floats, harm: Floats
    ) -> tuple[Floats, Boxes | None]:
        """In interior mode the bound over all worlds of each box."""
        if possible.n == len(rows) or self.robust != INTERIOR:
            return harm, self.boxes
        boxes = Boxes.of(possible, problem, len(rows), self.scenario, self._others)
        return boxes.at_alert(plan, harm), boxes.placed(self.boxes, rows)

    def _also_certified(
        self, now: Running, memory: StepMemory, budget: Floats, decision: Decision, asked: Bools
    ) -> Decision:
        """In interior mode what is certified for all worlds of each box."""
        boxes = memory.enclosure
        return decision if boxes is None else certify_inside(boxes, now, memory.backup, budget, decision, asked)

    def _leaves_range(self, running: Running) -> Bools:
        """Worlds [n] that may leave the range of their members.

        Also those in which the own latency is uncertain (a decision falls at another time in each world of the box), or
        one uncertain number moves several quantities (friction).
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
    """A decision that the corners allow, refused where its plan is not certified for every world of the box.

    ``held`` is the backup before it. A plan without a certificate never replaces the held one. Episodes end at the
    horizon: that all corners rest does not mean that every world does.
    """
    plan, other = decision.backup.plan.copy(), (decision.backup.plan != held.plan).any(axis=1)
    bound = np.where(asked & ~other, held.harm, decision.bound)  # of the corners alone, where the plan is the same
    changed = np.flatnonzero(asked & other)
    found = boxes.bound(changed, plan[changed], budget[changed], only_enough=True)
    least = np.where(decision.intervened, held.harm, budget)[changed]
    good = found <= least
    bound[changed[good]] = found[good]
    known = np.isfinite(found)
    decision.margin[changed[known]] = (budget[changed] - found)[known]
    bad = changed[~good]
    plan[bad], bound[bad] = held.plan[bad], held.harm[bad]
    decision = decision._replace(bound=bound, backup=decision.backup._replace(plan=plan, harm=bound))
    refused = bad[~decision.intervened[bad]]
    if refused.size:  # the held plan's action instead
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
