"""Step mode for a batch of running episodes: what ``certify`` decides, kept from step to step, watched and logged."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.rollout import script_agents
from ethbrake_marl.engine.stream import Script
from ethbrake_marl.errors import InvalidInput, renumbered, unknown_name
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.episode import number_of_decisions
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search.problem import PER_WORLD as OF_PROBLEM
from ethbrake_marl.shield import interior
from ethbrake_marl.shield.alert import CAPS, Cap, Settings, Start, start_of
from ethbrake_marl.shield.certify import Backup, Decision, Running, certify, from_now, plan_harm
from ethbrake_marl.shield.certify_kernel import ENDED, NO_CERTIFICATE
from ethbrake_marl.shield.interventions import Intervention, interventions, write_down
from ethbrake_marl.shield.rollouts import Proposer, certify_rollouts, merged, put
from ethbrake_marl.shield.settings import check_amount, check_scenario, checked_vehicles, policies_of
from ethbrake_marl.shield.shares import borne_under
from ethbrake_marl.shield.uncertainty import Uncertainty

BROKEN = ENDED + 1  # a reason that the kernel does not know
PER_WORLD = (  # a shield's arrays [n, ...]
    "first_bound", "alone_harm", "settles", "replaced", "distrusted", "episode", "baseline_shares",
)  # fmt: skip


class Certified(NamedTuple):
    """A decision that was made, and is not carried out yet."""

    decision: Decision
    asked: Bools  # [n] worlds that it is about; the others stay as they are
    before: Running  # what it was made from
    after: StepShield  # the shield as it will be once the decision was carried out

    def carried_out(self) -> StepShield:
        """The shield now that the decision was carried out."""
        after = self.after
        if after.log is not None:
            write_down(after.log, after.found, self.before, after.episode)
        return after


class StepShield:
    """Guarantees the harm of a batch: ``begin`` when episodes start, ``propose`` and ``commit`` in every step.

    What ``propose`` certifies changes nothing yet: ``commit`` it when the engine has made that step, and not otherwise.
    Whatever fails before (or interrupts) leaves bound, plan and trust as they were.

    The bound starts as the harm of the coupled optimum, realised decision by decision, or as that of a ``policy``
    rolled out from the alert where that is lower, and only ever falls; ``allowance`` (m2/s2) is what the budget grants
    above it (0: none), and the bound is then that budget until the episode ends. It bounds the harm up to the
    scenario's horizon and says nothing of what still moves then, or of what happens afterwards (``settles`` [n]: where
    the plan held at the alert leaves nothing moving). The other vehicles follow ``others``
    (default: the scenario's scripts), whose commands must be fixed at the alert. What happens is compared with what was
    predicted, bit by bit: where it differs (a vehicle that brakes beyond its capacity, a number that is none, a message
    that never came) ``distrusted`` [n] is set, nothing is guaranteed any more, and for the rest of the episode the
    fallback ``best constant`` drives: the better one of the plan's rest and the constants, chosen again after every
    surprise. With an ``uncertainty`` (robust mode) all of this holds for the worst member of each world, and what is
    seen must lie within the range of their predictions. Raises ``InvalidInput`` for an unknown count or vehicle, a
    negative allowance, others whose commands are not fixed, or what ``robust`` interior cannot certify.
    """

    fallback = "best constant"

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int | Sequence[int],
        *,
        harm_count: HarmCount = "first",
        allowance: float = 0.0,
        others: Mapping[int, Script] | None = None,
        uncertainty: Uncertainty | None = None,
        cap: Cap | None = None,
        robust: str = interior.CORNERS,
        logging: bool = False,
    ) -> None:
        check_harm_count(harm_count)
        check_scenario(scenario, "shield")
        check_amount("allowance", allowance, "shield", " m2/s2")
        self.vehicle = checked_vehicles(vehicle, scenario)
        self.vehicles = (self.vehicle,) if isinstance(self.vehicle, int) else self.vehicle
        if uncertainty is not None and (len(self.vehicles) > 1 or cap is not None):
            what = "several vehicles" if cap is None else "a cap"
            raise InvalidInput(f"shield: uncertainty: {what} with it: not covered; mode robust shields one vehicle")
        if cap not in (None, *CAPS):
            raise unknown_name("shield cap", cap, CAPS)
        self.scenario, self.harm_count, self.allowance = scenario, harm_count, allowance
        self.uncertainty, self.cap = uncertainty, cap
        self.robust = interior.checked_robust(robust, "shield")
        self.boxes: interior.Boxes | None = None  # where every world of them is certified
        self.log: list[Intervention] | None = [] if logging else None
        self.found: list[Intervention] = []  # in the last decision
        self.running: Running | None = None
        self.backup = Backup(np.zeros((0, 0)), np.zeros(0))
        self.first_bound: Floats = np.zeros(0)  # [n] harm of the backup at the first decision
        self.alone_harm: Floats = np.zeros(0)  # [n] of the policy rolled out; infinity without one
        self.settles: Bools = np.zeros(0, np.bool_)  # [n] under the plan of the first decision all rest at the horizon
        self.replaced: Ints = np.zeros(0, np.int64)  # [n] or [n, K] actions so far in the running episodes
        self.episode: Ints = np.zeros(0, np.int64)  # [n] number of each row's running episode
        self.distrusted: Bools = np.zeros(0, np.bool_)
        self.baseline_shares: Floats = np.zeros((0, 0))  # [n, N] what each vehicle bears under the best constants
        scripts = script_agents(scenario, except_for=self.vehicles) if others is None else others
        self._others = {i: script for i, script in scripts.items() if i not in self.vehicles}
        interior.check_possible(self.robust, scenario, harm_count, self._others)
        self._width = int(number_of_decisions(np.zeros(1), scenario.time_step_s, scenario.horizon_s)[0]) + 1

    @property
    def bound(self) -> Floats:
        """Harm of each running episode is at most this, [n] m2/s2: what certificates may reach."""
        if self.running is None or self.allowance == 0.0:
            return self.backup.harm
        granted = np.where(self.running.finished, 0.0, self.first_bound + self.allowance)
        return np.maximum(self.backup.harm, granted)

    @property
    def interventions(self) -> Ints:
        """Actions that were replaced so far in each running episode, of all vehicles together, [n]."""
        every: Ints = self.replaced.reshape(len(self.replaced), -1).sum(axis=1)
        return every

    def shares(self) -> Floats:
        """What each vehicle bears of the harm if the plan that is held now is executed, [n, N] m2/s2."""
        if self.running is None:
            raise InvalidInput("shield: shares, but no episode has begun; call begin first")
        return borne_under(self.running.nominal(), self.backup.plan)[:, -self.scenario.vehicles :]

    def begin(self, worlds: Worlds, rows: Ints, policy: Agent | Mapping[int, Agent] | None = None) -> None:
        """New episodes start in these rows; ``worlds`` holds those rows only, at the alert, as they are believed.

        The ``policy`` that proposes (of several vehicles: one for each, by index) is rolled out from there.
        Rows 0 to k - 1 together may also begin a larger batch. Raises ``InvalidInput`` for rows that are not there.
        """
        running_rows = len(self.first_bound)
        if not (rows < running_rows).all() and sorted(rows.tolist()) != list(range(len(rows))):
            raise InvalidInput(
                f"shield: begin in row {rows.max()} of a batch of {running_rows}: a larger batch begins with all of its"
                " rows at once"
            )
        settings = Settings(
            self.scenario, self.vehicle, self.harm_count, self._others, self.uncertainty, self.cap, self._width
        )
        new = copy.copy(self)
        start = start_of(settings, worlds, policies_of(policy, self.vehicle))
        if start.running.members > 1 and self.robust == interior.INTERIOR:
            assert self.uncertainty is not None
            boxes = interior.boxes_of(self.uncertainty.members(worlds), start.running, self.scenario, self._others)
            harm = interior.bounds_at_alert(boxes, start.backup.plan, start.backup.harm)
            start = start._replace(backup=start.backup._replace(harm=harm))
            new.boxes = interior.placed(self.boxes, boxes, rows)
        new._place(rows, start)
        self.__dict__.update(new.__dict__)

    def propose(
        self,
        proposed: Floats,
        *,
        seen: Floats | None = None,
        only: Bools | None = None,
        proposer: Proposer | None = None,
    ) -> Certified:
        """Decide in every running episode, or ``only`` in some; the others stay as they are. Changes nothing.

        ``seen`` [n, columns]: the worlds as they are now, in the first columns of ``Running.states``. Where nothing
        else certifies a proposal, the ``proposer`` (if given) is rolled out from the state after it.
        """
        if self.running is None:
            raise InvalidInput("shield: decide, but no episode has begun; call begin first")
        if np.shape(proposed) != (shape := (*self.distrusted.shape, *self.backup.plan.shape[2:])):
            raise InvalidInput(f"shield: proposed {np.shape(proposed)}; {shape} is needed")
        asked = ~self.running.finished if only is None else only
        after = copy.copy(self)
        decision = after._decided(proposed, seen, asked, proposer)
        return Certified(decision, asked & ~self.running.finished, self.running, after)

    def commit(self, certified: Certified) -> None:
        """The decision was carried out. Raises ``InvalidInput`` for one that was not made from here."""
        if certified.before is not self.running:
            raise InvalidInput("shield: commit of a decision that was made from another state; propose again")
        self.__dict__.update(certified.carried_out().__dict__)  # in one piece: not even an interrupt comes between

    def decide(
        self,
        proposed: Floats,
        *,
        seen: Floats | None = None,
        only: Bools | None = None,
        proposer: Proposer | None = None,
    ) -> Decision:
        """``propose`` and ``commit`` at once: where nothing can fail before the decision is carried out."""
        certified = self.propose(proposed, seen=seen, only=only, proposer=proposer)
        self.commit(certified)
        return certified.decision

    def _decided(self, proposed: Floats, seen: Floats | None, asked: Bools, proposer: Proposer | None) -> Decision:
        """Decide, and become the shield as it will be once that was carried out."""
        assert self.running is not None
        if seen is not None:
            self._compare(seen, asked)
        before = self.running
        asked = asked & ~before.finished
        each = np.repeat(asked, before.members)
        now = before._replace(ended=before.ended | ~each)
        given = np.array(proposed, np.float64)
        given[self.distrusted] = np.nan
        held, budget = self.backup, self.bound
        decision = certify(now, given, held, budget)
        rejected = (decision.reason == NO_CERTIFICATE).reshape(len(asked), -1).any(axis=1)
        if proposer is not None and (rows := np.flatnonzero(rejected)).size:
            decision = merged(decision, rows, certify_rollouts(now, given, rows, budget, held.plan, proposer))
        decision = interior.certify_inside(self.boxes, now, held, budget, decision, asked & ~self.distrusted)
        decision.reason[asked & self.distrusted] = BROKEN
        self.replaced = self.replaced + (decision.intervened.T & asked).T
        self.running = decision.after._replace(ended=np.where(each, decision.after.ended, before.ended))
        self.backup = decision.backup
        decision = decision._replace(bound=self.bound)
        if self.log is not None:
            self.found = interventions(now, self.episode, self.vehicles, proposed, decision, held)
        return decision

    def keep(self, n: int) -> None:
        """Keep the first ``n`` rows only: a smaller batch has begun."""
        assert self.running is not None
        backup = self.backup._replace(plan=self.backup.plan[:n], harm=self.backup.harm[:n])
        rows = {name: getattr(self, name)[:n] for name in PER_WORLD}
        self.boxes = self.boxes and self.boxes.take(np.arange(n))
        self.__dict__.update(rows | {"running": self.running.take(np.arange(n)), "backup": backup})

    def _compare(self, seen: Floats, asked: Bools) -> None:
        """Find the worlds that did not do what was predicted, and choose anew there from what is seen."""
        assert self.running is not None
        running, columns = self.running, seen.shape[1]
        surprising = asked & ~interior.expects(self.boxes, running, seen)
        if not surprising.any():
            return
        self.distrusted = self.distrusted | surprising
        rows = np.flatnonzero(surprising & np.isfinite(seen).all(axis=1))  # others: what was predicted goes on
        states, ended, at = running.states.copy(), running.ended.copy(), running.rows_of(rows)
        states[at, :columns] = np.repeat(seen[rows], running.members, axis=0)
        ended[at] = np.repeat(running.steps[rows], running.members) >= running.problem.last_step[at]
        self.running = running._replace(states=states, ended=ended)
        plan, harm, held = self.backup.plan.copy(), self.backup.harm.copy(), self.backup.plan
        harm[rows] = np.inf
        for constant in (None, *self.backup.constants):
            trial = held if constant is None else from_now(held, constant, running.steps)
            found = _harm_of(self.running, trial, rows)
            better = rows[found < harm[rows]]
            harm[rows] = np.minimum(found, harm[rows])
            plan[better] = trial[better]
        self.backup = self.backup._replace(plan=plan, harm=harm)

    def _place(self, rows: Ints, start: Start) -> None:
        """Keep new episodes in these rows."""
        count, old, running, backup = len(rows), self.running, start.running, start.backup
        new: dict[str, NDArray[Any]] = {
            "first_bound": backup.harm, "alone_harm": start.alone, "settles": start.settles,
            "replaced": np.zeros((count, *backup.plan.shape[2:]), np.int64), "distrusted": np.zeros(count, np.bool_),
            "baseline_shares": start.baseline,
        }  # fmt: skip
        if old is None or count >= old.n:
            order = np.argsort(rows)
            self.running = running.take(order)
            self.backup = backup._replace(plan=backup.plan[order], harm=backup.harm[order])
            self.episode = np.full(count, self.episode.max(initial=-1) + 1)
            for name, values in new.items():
                setattr(self, name, values[order])
            return
        at = old.rows_of(rows)
        arrays: dict[str, Any] = {
            name: put(getattr(old.problem, name), at, getattr(running.problem, name)) for name in OF_PROBLEM
        }
        self.running = Running(
            replace(old.problem, **arrays),
            put(old.states, at, running.states),
            put(old.steps, rows, running.steps),
            put(old.ended, at, running.ended),
            put(old.caps, at, running.caps) if old.caps.size else old.caps,
        )
        plan, harm = put(self.backup.plan, rows, backup.plan), put(self.backup.harm, rows, backup.harm)
        self.backup = self.backup._replace(plan=plan, harm=harm)
        for name, values in {**new, "episode": self.episode[rows] + 1}.items():
            setattr(self, name, put(getattr(self, name), rows, values))


def _harm_of(running: Running, plan: Floats, rows: Ints) -> Floats:
    """Harm of the plans in some of the worlds."""
    with renumbered(rows):
        return plan_harm(running.take(rows), plan[rows])
