"""The step shield: the harm of an episode is at most the bound announced at the alert, whatever is proposed.

**Claim.** Let B be the price of the plan made at the alert. Whatever actions are proposed, the harm at the end of the
episode is at most B, and the bound that is announced never rises. An episode ends at rest or at the horizon; the claim
does not cover what happens later.

**Induction.** A *plan* is an action of every learner for every decision up to the horizon. Its *price* is the harm of
the whole episode if it is followed from now on. The price is computed by the episode's own step, so it is this harm to
the last bit. Between two decisions the shield holds a plan; let c be its price. At the first decision c = B.

1. *Proposals are applied* only if some plan that begins with them has a price of at most c. This plan is now held.
2. *Otherwise the plan's own actions are applied.* Its play, which gave c, went through this very step, so the rest of
   the plan still costs c.

So c never rises. At the end no action is left, and c is the harm of the episode. The proof asks nothing of who
proposes, or of how plans are found: a bad search replaces more actions, and does no more harm. ∎

**Several learners.** An action is then one number per learner. The shield first tries all proposals together. If they
are rejected it tries them one by one, front to rear, and keeps those that are accepted. Before and after each trial it
holds a plan with a price of at most c.

**Caps.** With a cap, a plan must also keep the harm that each vehicle bears within what it bears under the best
constant actions of the alert, which is the first plan. A play knows both, so the induction holds for all numbers at
once.

**Allowance.** With an allowance A > 0, a plan may cost up to max(c, B + A), which is then the bound until the end.

It assumes that the physics of the state is true, and that all others follow the game's scripts; a script may look at
the state, but must decide alike whenever it is asked alike. Every learner is shielded: a game has one shield.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.drive import MODEL, Agent, propose
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.play import played
from ethbrake_marl.episode.state import State, take
from ethbrake_marl.episode.step import begin
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import FORCE, SPEED, Bools, Floats, Ints
from ethbrake_marl.registry import Part
from ethbrake_marl.shields.decision import ShieldReason, check_harm_count, check_learners, checked_drivers, spread
from ethbrake_marl.shields.fallbacks import best_constant, first_plans, rollout
from ethbrake_marl.shields.named import NamedShield

NEARLY = 1e-9  # harm (m2/s2) by which a fallback's estimate may be too high, because it is rounded differently


NO_DECISION, SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED, POLICY_ROLLOUT = map(
    int, ShieldReason
)


class Memory(NamedTuple):
    plan: Floats  # [n, T, L] actions at every decision; only those from now on count
    price: Floats  # [n] harm of the episode under the plan (m2/s2)
    first: Floats  # [n] price at the alert (m2/s2)
    caps: Floats | None  # [n, N] harm that each vehicle may bear (m2/s2)
    settles: Bools  # [n] whether all vehicles come to rest under the plan of the alert
    agents: tuple[Any, ...]  # memory of each agent of the shield's own team
    proposed: Floats  # [n, L] last proposals; NaN: none
    applied: Floats  # [n, L] last actions
    reason: Ints  # [n, L] why
    margin: Floats  # [n, L] bound minus the least price or estimate tried after the proposal (m2/s2)
    intervened: Bools  # [n, N] whether the last proposal was replaced
    replaced: Ints  # [n] number of actions that have been replaced
    members: Any = None  # what a subclass remembers of the states that a world may be in


# What may follow an action: its reason, and (shield, game, states after the action, plans, most) -> actions of every
# decision, [n, T or 1, L], and their harm, [n], or less where it is not known yet. What seems to cost more than `most`
# is not priced.
Fallback = tuple[int, Callable[["StepShield", Game, State, Floats, Floats], tuple[Floats, Floats]]]


class StepShield:
    """Shield of all learners of a game.

    Args:
        drivers: body -> agent: the learners' agents, for a shield that proposes by itself or rolls them out; or empty.
        harm_count: what is bounded: ``first``, ``total`` or ``honest`` (``episode.counts``).
        allowance: harm by which the bound is loosened, for fewer replaced actions (m2/s2).
        cap: ``baseline``: no vehicle bears more harm than under the best constant actions of the alert; None: no caps.

    """

    knows = MODEL

    def __init__(
        self,
        drivers: Mapping[int, Agent] | None = None,
        *,
        harm_count: str = "first",
        allowance: float = 0.0,
        cap: str | None = None,
    ) -> None:
        check_harm_count(harm_count)
        if isinstance(allowance, bool) or not isinstance(allowance, int | float) or not 0.0 <= allowance < np.inf:
            raise InvalidInput(f"shield: allowance = {allowance!r}: must be a finite number, at least 0 m2/s2")
        if cap not in (None, "baseline"):
            raise InvalidInput(f"shield: cap = {cap!r}: must be 'baseline' or None")
        self.drivers, self.count, self.allowance, self.cap = checked_drivers(drivers), harm_count, float(allowance), cap
        self.rests: list[Fallback] = [(CONSTANT, constant)]
        if drivers:
            self.rests.append((POLICY_ROLLOUT, agents_drive))

    # A subclass for worlds that may be in one of M states overrides the next two; ``first_memory`` gets the states.

    def seen(self, state: State, memory: Memory) -> State:
        """Return the states that the worlds may be in now, M rows for each world, the nominal one first."""
        return state

    def price(self, game: Game, states: State, plans: Floats, most: Any = np.inf, caps: Floats | None = None) -> Floats:
        """Return the harm of plans, [n] m2/s2: the largest over the M ``states`` of each world, or above ``most``.

        It is infinite where a vehicle would bear more than its cap (``caps`` [n, N] m2/s2).
        """
        last, harm = played(game, states, plans, self.count, most)
        if caps is not None:
            harm[(last.borne_harm(self.count) > caps).any(axis=1)] = np.inf
        return harm

    def rolled_out(self, game: Game, state: State, plans: Floats, most: Any = np.inf) -> Floats:
        """Return the plans if the shield's agents drive on from the nominal ``state``, as long as harm <= ``most``."""
        return rollout(game, self.drivers, state, plans, self.count, most)

    def bound(self, memory: Memory) -> Floats:
        return np.maximum(memory.price, memory.first + self.allowance) if self.allowance else memory.price

    def begin(self, game: Game, alert: State, state: State) -> Memory:
        return self.first_memory(game, alert, state, state, self.agents_at(game, alert))

    def agents_at(self, game: Game, alert: State) -> dict[int, Any]:
        """Return body -> memory of the shield's agents for new episodes."""
        return {body: begin(agent, alert, body) for body, agent in game.agents(self.drivers).items()}

    def plans(self, game: Game, alert: State, state: State, states: State) -> list[Floats]:
        """Return the constant actions from which the first plan is chosen, [n, T, L] each."""
        return first_plans(game, alert, state, self.count)

    def first_memory(self, game: Game, alert: State, state: State, states: State, agents: dict[int, Any]) -> Memory:
        """Return the memory at the first decision: the best constant actions, or the agents' own play."""
        rows, plans = np.arange(state.n), self.plans(game, alert, state, states)
        prices = np.stack([self.price(game, states, plan) for plan in plans])
        plan, harm = np.stack(plans)[prices.argmin(axis=0), rows], prices.min(axis=0)
        caps = played(game, state, plan, self.count)[0].borne_harm(self.count) if self.cap else None
        if agents:
            check_learners(game, agents)
            own = self.rolled_out(game, state._replace(memories={**state.memories, **agents}), plan)
            value = self.price(game, states, own, caps=caps)
            better = value <= harm
            plan[better], harm[better] = own[better], value[better]
        last, _ = played(game, state, plan, self.count)
        settles: Bools = (last.line[:, SPEED] == 0.0).all(axis=1) & (last.line[:, FORCE] <= 0.0).all(axis=1)
        nothing = np.zeros((state.n, len(game.rules.learners)))
        return Memory(
            plan, harm, harm.copy(), caps, settles, tuple(agents.values()), nothing, nothing,
            np.full(nothing.shape, NO_DECISION), nothing, np.zeros((state.n, state.vehicles), np.bool_),
            np.zeros(state.n, np.int64),
        )  # fmt: skip

    def decide(self, game: Game, state: State, proposed: Floats | None, *, donate: bool) -> tuple[Floats, Memory]:
        """Return the actions to apply, [n, L], and the new memory."""
        memory: Memory = state.memories["shield"]
        proposed, state = self.asked(game, state, proposed)
        if not donate:
            memory = memory._replace(plan=memory.plan.copy(), price=memory.price.copy())
        each, now = np.arange(state.n), np.minimum(state.steps, memory.plan.shape[1] - 1)
        planned, silent, bound = memory.plan[each, now], np.isnan(proposed), self.bound(memory)
        tried, running = np.where(silent, planned, proposed), ~state.ended[:, np.newaxis]
        deviates = (tried != planned) & running
        reason = np.where(deviates, NO_CERTIFICATE, np.where(silent, NOT_A_NUMBER, SAME_AS_PLAN))
        margin = np.repeat((bound - memory.price)[:, np.newaxis], proposed.shape[1], axis=1)
        rejected = deviates.any(axis=1).nonzero()[0]
        for columns in trials(proposed.shape[1]):
            if not len(rejected):
                break
            mine, wanted, together = deviates[rejected] & columns, tried[rejected], columns.all()
            actions = np.where(mine, wanted, memory.plan[rejected, now[rejected]])
            new = mine.any(axis=1)
            if not together:
                new &= (actions != wanted).any(axis=1)  # what was rejected together is not tried again
            rows, mine = rejected[new], mine[new]
            if len(rows):
                rests = self.rests if together else self.rests[:1]  # what the agents propose, they propose together
                why, least = self.accept(game, state, memory, rows, actions[new], now[rows], rests)
                reason[rows] = np.where(mine, why[:, np.newaxis], reason[rows])
                margin[rows] = np.where(mine, (bound[rows] - least)[:, np.newaxis], margin[rows])
                if together:
                    rejected = rows[why == NO_CERTIFICATE]
        applied = memory.plan[each, now]
        differ = (applied != proposed) & running
        return applied, memory._replace(
            agents=tuple(state.memories[body] for body in self.drivers), proposed=proposed, applied=applied,
            intervened=spread(game, state, differ, False), replaced=memory.replaced + differ.sum(axis=1),
            reason=np.where(running, reason, ENDED), margin=margin,
        )  # fmt: skip

    def asked(self, game: Game, state: State, proposed: Floats | None) -> tuple[Floats, State]:
        """Return the proposals, [n, L], NaN for none, and the state with the memories of the shield's agents.

        The agents propose where nobody else does. If one has a memory, they are asked at every decision.
        """
        memories = {who: kept for who, kept in state.memories.items() if who != "shield"}
        own = dict(zip(self.drivers, state.memories["shield"].agents, strict=True))
        if proposed is None:
            if not own:
                raise InvalidInput("step: actions = None: this shield has no agents that could propose any")
            proposed = np.full((state.n, len(own)), np.nan)
        if own and (np.isnan(proposed).any() or any(each is not None for each in own.values())):
            theirs, own = propose(game.agents(self.drivers), state, own)
            proposed = np.where(np.isnan(proposed), theirs, proposed)
        return proposed, state._replace(memories={**memories, **own})

    def accept(
        self, game: Game, state: State, memory: Memory, rows: Ints, actions: Floats, now: Ints, rests: list[Fallback]
    ) -> tuple[Ints, Floats]:
        """Hold a plan that begins with the ``actions`` in each of the worlds ``rows`` where one keeps the bound.

        Returns the reasons and the least price that was tried, [len(rows)] each.
        """
        most, plans = self.bound(memory)[rows], memory.plan[rows]
        plans[np.arange(len(rows)), now] = actions
        seen = self.seen(state, memory)
        M = seen.n // state.n
        before = part(seen, rows, M)
        least = self.price(game, before, plans, most, take(memory.caps, rows))
        reason = np.where(least <= most, PLAN_REMAINS, NO_CERTIFICATE)
        for code, rest in rests:
            left = (reason == NO_CERTIFICATE).nonzero()[0]
            if not len(left):
                break
            here = part(before, left, M)
            after, _ = game.follow(here, actions[left].repeat(M, axis=0))
            later, value = rest(self, game, after, plans[left], most[left])
            hopeful = (value <= most[left] + NEARLY).nonzero()[0]
            if len(hopeful):
                at = left[hopeful]
                tried = np.empty((len(at), *plans.shape[1:]))
                tried[:] = later[hopeful]
                tried[np.arange(len(at)), now[at]] = actions[at]
                states, caps = part(here, hopeful, M), take(memory.caps, rows[at])
                value[hopeful] = self.price(game, states, tried, most[at], caps)
                good = value[hopeful] <= most[at]
                plans[at[good]], reason[at[good]] = tried[good], code
            least[left] = np.minimum(least[left], value)
        good = (reason != NO_CERTIFICATE).nonzero()[0]
        if len(good):
            memory.plan[rows[good]], memory.price[rows[good]] = plans[good], least[good]
        return reason, least

    def infos(self, game: Game, state: State) -> dict[str, Any]:
        """Return name -> [n] or [n, N]."""
        memory: Memory = state.memories["shield"]
        borne = {}
        if memory.caps is not None:
            last, _ = played(game, state, memory.plan, self.count)
            borne = {"own_harm": last.borne_harm(self.count), "baseline_own_harm": memory.caps}
        return {
            **borne,
            "bound_harm": self.bound(memory),
            "settles": memory.settles,
            "proposed_action": spread(game, state, memory.proposed),
            "applied_action": spread(game, state, memory.applied),
            "intervened": memory.intervened,
            "reason": spread(game, state, memory.reason, NO_DECISION),
            "margin": spread(game, state, memory.margin),
        }


def part(states: State, rows: Ints, M: int) -> State:
    """Return the M states of each of the worlds ``rows``, which increase."""
    if len(rows) * M == states.n:
        return states
    return states.take(rows if M == 1 else (rows[:, np.newaxis] * M + np.arange(M)).ravel())


@cache
def trials(learners: int) -> Bools:
    """Return which of L proposals are tried together, [1 or 1 + L, L]: all of them, then one by one from the front."""
    alone = np.eye(learners, dtype=np.bool_)
    return alone if learners == 1 else np.concatenate([alone.any(axis=0, keepdims=True), alone])


def constant(shield: StepShield, game: Game, after: State, plans: Floats, most: Floats) -> tuple[Floats, Floats]:
    """Fallback: the best constant actions. Where scripts look at the state, nothing is known before the play."""
    plans, estimate = best_constant(game, after, plans, shield.count)
    return plans, np.zeros(len(plans)) if game.scripts else estimate


def agents_drive(shield: StepShield, game: Game, after: State, plans: Floats, most: Floats) -> tuple[Floats, Floats]:
    """Fallback: the shield's own agents drive on, from the nominal state."""
    nominal = after if after.n == len(plans) else after.take(np.arange(0, after.n, after.n // len(plans)))
    return shield.rolled_out(game, nominal, plans, most), np.zeros(len(plans))


STEP = Part(NamedShield(StepShield), form="step", about="shield: every action is certified, or replaced", knows=MODEL)
