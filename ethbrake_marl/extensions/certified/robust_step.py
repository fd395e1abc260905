"""Step shield for uncertain worlds: it certifies plans in the corners of the box of possible worlds, or in the whole
box.

``StepShield`` certifies each plan in several possible worlds, which are called the *members* of a world. For a
``RobustShield`` the members are the reported world and the corners of an ``Uncertainty``. With ``robust="interior"``
the shield also bounds the harm of every plan over the whole box between the corners (``enclosure.Boxes``), at the alert
and at every decision.
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
        vehicle: index of the shielded vehicle, or several indices; if ``uncertainty`` is given, only one vehicle is
            possible.
        uncertainty: intervals around the reported quantities. If ``uncertainty`` is None, the caller must pass the
            possible worlds to ``begin`` (argument ``possible``).
        robust: ``corners`` or ``interior`` (the whole box).
        harm_count: ``first`` or ``total``.
        others: scripts of the other vehicles by vehicle index; None: the scripts of the scenario.
        settings: further keyword arguments of ``StepShield``.

    Raises ``InvalidInput`` in three cases: if ``StepShield`` raises this error, if an uncertainty is combined with
    several vehicles or with a cap, or if ``robust="interior"`` cannot certify the settings.

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
            what = "several shielded vehicles" if self.cap is None else "a cap"
            raise InvalidInput(
                f"shield: uncertainty cannot be combined with {what}; shield one vehicle without a cap, or leave"
                " uncertainty out"
            )
        self.uncertainty, self.robust = uncertainty, checked_robust(robust, "shield")
        Boxes.check_possible(self.robust, scenario, harm_count, self._others)

    @property
    def possible_are(self) -> str:  # type: ignore[override]  # a constant there
        """Text in error messages that says which worlds are the members, such as "uncertainty: gaps_m=0.5"."""
        return f"uncertainty: {self.uncertainty}"

    def members_of(self, worlds: Worlds) -> Worlds:
        """Return the members of worlds at the alert, [n * M]: each world followed by the corners of its box."""
        return worlds if self.uncertainty is None else self.uncertainty.members(worlds)

    @property
    def boxes(self) -> Boxes | None:
        """The boxes in interior mode; None in corners mode and before the first episode."""
        boxes: Boxes | None = self.memory.enclosure
        return boxes

    def _bound_at_alert(
        self, possible: Worlds, problem: ProfileProblem, rows: Ints, plan: Floats, harm: Floats
    ) -> tuple[Floats, Boxes | None]:
        """Return, for each new episode, a bound on the harm of its plan at the alert, [m] m2/s2; also return the boxes
        of all episodes.

        In interior mode the bound covers all worlds of each box. In corners mode the bound covers only the members, and
        the function returns None instead of boxes.

        Args:
            possible: [m * M] worlds: M consecutive members for each new world.
            problem: table with one row for each world in ``possible``.
            rows: [m] indices of the new episodes.
            plan: [m, L] action of the shielded vehicle at each decision.
            harm: [m] largest harm of each world's plan over the members of this world, m2/s2.

        """
        if possible.n == len(rows) or self.robust != INTERIOR:
            return harm, self.boxes
        boxes = Boxes.of(possible, problem, len(rows), self.scenario, self._others)
        return boxes.at_alert(plan, harm), boxes.placed(self.boxes, rows)

    def _also_certified(
        self, now: Running, memory: StepMemory, budget: Floats, decision: Decision, asked: Bools
    ) -> Decision:
        """Return ``decision``; in interior mode, the plan from before the decision replaces each of its plans that is
        not certified for all worlds of its box.

        ``now`` and ``memory`` are from before the decision. ``budget`` and ``asked`` are as in ``certify_inside``.
        """
        boxes = memory.enclosure
        return decision if boxes is None else certify_inside(boxes, now, memory.backup, budget, decision, asked)

    def _leaves_range(self, running: Running) -> Bools:
        """Return a mask [n]: True for each reported world whose box may contain a world outside the range of the
        members.

        The mask is True where the method of the same name in ``StepShield`` returns True. In interior mode the mask is
        also True where the latency of the shielded vehicle is uncertain, because the worlds of a box then have their
        decisions at different times. If the friction is uncertain, so that one uncertain number changes several
        quantities, the mask is True for all worlds.
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
    """Return ``decision``, but keep the old plan wherever the new plan is not certified for all worlds of its box.

    Args:
        boxes: box of each world.
        running: states of the members before the decision.
        held: for each world, the plan from before the decision and the bound on its harm.
        budget: [n] largest harm that a new plan may have, m2/s2.
        decision: the present decision; its plans are certified for the members, but not yet for all worlds of the
            boxes.
        asked: [n] True for episodes that have a decision now. In interior mode an episode ends only at the horizon,
            because vehicles may still move in some world of a box when all vehicles are at rest in the corners of the
            box.

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
