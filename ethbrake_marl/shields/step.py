"""The step shield: the harm of an episode never exceeds the bound announced at the alert, whatever is proposed.

**Claim.** Let B be the price of the plan made at the alert. Whatever actions are proposed, the harm at the end of the
episode is at most B, and the bound that is announced never rises. An episode ends at rest or at the horizon; the claim
does not cover what happens later.

**Induction.** A *plan* is an action of every learner for every decision up to the horizon. Its *price* is the harm of
the whole episode if it is followed from now on. The episode's own step computes the price, so it is this harm to the
last bit. Between two decisions the shield holds a plan; let c be its price. At the first decision c = B.

1. *Proposals are applied* only if some plan that begins with them has a price of at most c. The shield now holds this
   plan.
2. *Otherwise the plan's own actions are applied.* The simulation that gave c made this very step, so the rest of the
   plan still costs c.

So c never rises. At the end no action is left, and c is the harm of the episode. The proof does not depend on who
proposes, or on how plans are found: a bad search replaces more actions, and does no more harm. ∎

**Several learners.** The shield first tries all proposals together. If they are rejected it tries them one by one,
front to rear, and keeps those that are accepted. Before and after each trial it holds a plan with a price of at most c.

**Caps.** With a cap, a plan must also keep the harm that each vehicle bears within what it bears under the baseline
plan, the best constant actions at the alert. The simulation of a plan gives both numbers, so the induction holds for
each of them.

**Allowance.** With an allowance A > 0, a plan may cost up to max(c, B + A), which is then the bound until the end.

**Assumptions.** The physics of the state is true, and all other vehicles follow the game's scripts. A script may look
at the state, but must always decide the same in the same state. The state that is priced is the episode's own, with
everything that scripts hear. The shield's agents change nothing in it: their memories, and so the plans that they could
tell, stay outside (``fallbacks.AGENTS``). Every learner is shielded: a game has one shield.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.team import Agent
from ethbrake_marl.episode.counts import HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import MODEL
from ethbrake_marl.episode.play import follow_plans
from ethbrake_marl.episode.script_calls import begin_script
from ethbrake_marl.episode.state import State, take
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import FORCE, SPEED, Bools, Floats, Ints
from ethbrake_marl.registry import Part
from ethbrake_marl.shields.fallbacks import AGENTS, ask_agents, best_constant, first_plans, rollout
from ethbrake_marl.shields.shield import NamedShield, ShieldReason, check_drivers, checked_drivers, report_of, spread

NEARLY = 1e-9  # harm (m2/s2) by which a fallback's estimate may be too high, because it is rounded differently


# the reasons as plain integers, for arrays
NO_DECISION, SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED, POLICY_ROLLOUT = map(
    int, ShieldReason
)


class StepShieldMemory(NamedTuple):
    """What the shield remembers between two decisions."""

    plan: Floats  # [n, T, L] actions at every decision; only those from now on count
    price: Floats  # [n] c, harm of the episode under the plan (m2/s2)
    first: Floats  # [n] B, price at the alert (m2/s2)
    caps: Floats | None  # [n, N] harm that each vehicle may bear (m2/s2)
    settles: Bools  # [n] whether all vehicles come to rest under the plan of the alert
    agents: Mapping[int, Any]  # memory of each agent of the shield's own team
    proposed: Floats  # [n, L] last proposals; NaN: none
    applied: Floats  # [n, L] last actions
    reason: Ints  # [n, L] `ShieldReason` of each last action
    margin: Floats  # [n, L] bound minus the least price or estimate tried after the proposal (m2/s2)
    intervened: Bools  # [n, N] whether the last proposal was replaced
    replaced: Ints  # [n] number of actions that have been replaced
    members: Any = None  # for subclasses: the possible states of each world


# A way to continue after an action: its `ShieldReason`, and a function (shield, game, states after the action, plans,
# most, below) -> actions at every decision, [n, T or 1, L], and an estimate of their harm, [n], never too high (0:
# unknown). Actions with an estimate above `most` are not priced; an estimate of `below` or more has no effect.
Fallback = tuple[int, Callable[["StepShield", Game, State, Floats, Floats, Floats], tuple[Floats, Floats]]]


class StepShield:
    """The step shield of all learners of a game.

    Args:
        drivers: vehicle (1: Vehicle 1) -> agent. They propose where the caller does not, and the shield plans with
            them; None: no agents.
        harm_count: count of harm to bound (``episode.counts``).
        allowance: harm by which the bound is loosened, for fewer replaced actions (m2/s2).
        cap: ``baseline``: no vehicle bears more harm than under the best constant actions at the alert; None: no caps.

    """

    knows = MODEL

    def __init__(
        self,
        drivers: Mapping[int, Agent] | None = None,
        *,
        harm_count: AnyCount = HONEST,
        allowance: float = 0.0,
        cap: str | None = None,
    ) -> None:
        if isinstance(allowance, bool) or not isinstance(allowance, int | float) or not 0.0 <= allowance < np.inf:
            raise InvalidInput(f"shield: allowance = {allowance!r}: must be a finite number, at least 0 m2/s2")
        if cap not in (None, "baseline"):
            raise InvalidInput(f"shield: cap = {cap!r}: must be 'baseline' or None")
        self.drivers, self.harm_count = checked_drivers(drivers), HarmCount.of(harm_count, "shield: harm_count")
        self.allowance, self.cap = float(allowance), cap
        self.rests: list[Fallback] = [(CONSTANT, constant)]
        if drivers:
            self.rests.append((POLICY_ROLLOUT, agents_drive))

    # A subclass for worlds that may be in one of M states overrides the next two; ``first_memory`` gets the states.

    def possible_states(self, state: State, memory: StepShieldMemory) -> State:
        """Possible states of each world, in M consecutive rows; rollouts of agents start from the first. Here M = 1."""
        return state

    def price(self, game: Game, states: State, plans: Floats, most: Any = np.inf, caps: Floats | None = None) -> Floats:
        """Harm of each plan, [n] m2/s2: the largest over the M possible states of a world.

        ``states`` has M rows per world; ``plans`` is [n, T, L]. A simulation stops when its harm is above ``most``
        (m2/s2); the result is then its harm so far. The harm is infinite if a vehicle would bear more than its cap
        (``caps`` [n, N] m2/s2).
        """
        last, harm = follow_plans(game, states, plans, self.harm_count, most)
        if caps is not None:
            harm[(last.borne_harm(self.harm_count) > caps).any(axis=1)] = np.inf
        return harm

    def rolled_out(self, game: Game, state: State, plans: Floats, most: Any = np.inf) -> Floats:
        """Copy of ``plans`` in which the shield's agents drive from ``state`` until the harm is above ``most`` [n]."""
        return rollout(game, self.drivers, state, plans, self.harm_count, most)

    def bound(self, memory: StepShieldMemory) -> Floats:
        return np.maximum(memory.price, memory.first + self.allowance) if self.allowance else memory.price

    def begin(self, game: Game, alert: State, state: State) -> StepShieldMemory:
        return self.first_memory(game, alert, state, state, self.agents_at(game, alert))

    def agents_at(self, game: Game, alert: State) -> dict[int, Any]:
        return {body: begin_script(agent, alert, body) for body, agent in game.agents(self.drivers).items()}

    def plans(self, game: Game, alert: State, state: State, states: State) -> list[Floats]:
        return first_plans(game, alert, state, self.harm_count)

    def cheapest(self, game: Game, states: State, plans: list[Floats]) -> tuple[Floats, Floats]:
        """Plan with the smallest price in each world, [n, T, L], and this price, [n] m2/s2."""
        prices = np.stack([self.price(game, states, plan) for plan in plans])
        return np.stack(plans)[prices.argmin(axis=0), np.arange(prices.shape[1])], prices.min(axis=0)

    def first_memory(
        self, game: Game, alert: State, state: State, states: State, agents: dict[int, Any]
    ) -> StepShieldMemory:
        """Memory at the first decision; its plan is the agents' rollout, or constant actions if they cost less.

        ``alert`` and ``state``: worlds at the alert and at the first decision. ``states``: their possible states
        (``possible_states``). ``agents``: vehicle -> memory at the alert.
        """
        plan, harm = self.cheapest(game, states, self.plans(game, alert, state, states))
        caps = follow_plans(game, state, plan, self.harm_count)[0].borne_harm(self.harm_count) if self.cap else None
        if agents:
            check_drivers(game, agents)
            agent_plan = self.rolled_out(game, state._replace(memories={**state.memories, AGENTS: agents}), plan)
            value = self.price(game, states, agent_plan, caps=caps)
            better = value <= harm
            plan[better], harm[better] = agent_plan[better], value[better]
        last, _ = follow_plans(game, state, plan, self.harm_count)
        settles: Bools = (last.line[:, SPEED] == 0.0).all(axis=1) & (last.line[:, FORCE] <= 0.0).all(axis=1)
        nothing = np.zeros((state.n, len(game.settings.learners)))
        return StepShieldMemory(
            plan, harm, harm.copy(), caps, settles, agents, nothing, nothing,
            np.full(nothing.shape, NO_DECISION), nothing, np.zeros((state.n, state.vehicles), np.bool_),
            np.zeros(state.n, np.int64),
        )  # fmt: skip

    def decide(
        self, game: Game, state: State, proposed: Floats | None, *, donate: bool
    ) -> tuple[Floats, StepShieldMemory]:
        """Actions to apply, [n, L], and the new memory: accepted proposals, or else the plan's actions.

        ``proposed`` [n, L]: NaN for no proposal; None: the shield's agents propose. ``donate``: the old memory may be
        overwritten.
        """
        memory: StepShieldMemory = state.memories["shield"]
        proposed, state = self.collect_proposals(game, state, proposed)
        if not donate:
            memory = memory._replace(plan=memory.plan.copy(), price=memory.price.copy())
        bound, worlds, now, shape = self.bound(memory), np.arange(state.n), state.steps, proposed.shape
        decision, running = np.minimum(now, memory.plan.shape[1] - 1), ~state.ended[:, np.newaxis]
        planned = memory.plan[worlds, decision]
        reason = np.where(proposed == planned, SAME_AS_PLAN, NO_CERTIFICATE)
        reason = np.where(running, np.where(np.isnan(proposed), NOT_A_NUMBER, reason), ENDED)
        deviates = reason == NO_CERTIFICATE
        candidates = np.where(deviates, proposed, planned)
        margin = (bound - memory.price)[:, np.newaxis].repeat(shape[1], axis=1)
        rejected = deviates.any(axis=1).nonzero()[0]
        for number, columns in enumerate(trials(shape[1])):
            if not len(rejected):
                break
            rows, trial_mask, actions = rejected, deviates[rejected] & columns, candidates[rejected]
            if number:
                actions = np.where(trial_mask, actions, memory.plan[rows, now[rows]])
                # what was rejected together is not tried again
                new = trial_mask.any(axis=1) & (actions != candidates[rows]).any(axis=1)
                rows, trial_mask, actions = rows[new], trial_mask[new], actions[new]
            if len(rows):
                rests = self.rests[:1] if number else self.rests  # what the agents propose, they propose together
                why, least = self.accept(game, state, memory, rows, actions, now[rows], rests)
                reason[rows] = np.where(trial_mask, why[:, np.newaxis], reason[rows])
                margin[rows] = np.where(trial_mask, (bound[rows] - least)[:, np.newaxis], margin[rows])
                if number == 0:
                    rejected = rows[why == NO_CERTIFICATE]
        applied = memory.plan[worlds, decision]
        differ = running & (applied != proposed)
        return applied, memory._replace(
            agents=state.memories[AGENTS], proposed=proposed, applied=applied,
            intervened=spread(game, state, differ, False), replaced=memory.replaced + differ.sum(axis=1), reason=reason,
            margin=margin,
        )  # fmt: skip

    def collect_proposals(self, game: Game, state: State, proposed: Floats | None) -> tuple[Floats, State]:
        """Proposed actions, [n, L] (NaN: none), and the state with the new memories of the shield's agents.

        The agents propose where the caller does not. An agent with a memory is asked at every decision, to keep its
        memory up to date.
        """
        memories = {who: memory for who, memory in state.memories.items() if who != "shield"}
        agent_memories = state.memories["shield"].agents
        if proposed is None:
            if not agent_memories:
                raise InvalidInput("step: actions = None: this shield has no agents that could propose any")
            proposed = np.full((state.n, len(agent_memories)), np.nan)
        if agent_memories and (
            np.isnan(proposed).any() or any(memory is not None for memory in agent_memories.values())
        ):
            agent_actions, agent_memories = ask_agents(game.agents(self.drivers), state, agent_memories)
            proposed = np.where(np.isnan(proposed), agent_actions, proposed)
        return proposed, state._replace(memories={**memories, AGENTS: agent_memories})

    def accept(
        self,
        game: Game,
        state: State,
        memory: StepShieldMemory,
        rows: Ints,
        actions: Floats,
        now: Ints,
        rests: list[Fallback],
    ) -> tuple[Ints, Floats]:
        """Search, in R worlds, for plans that begin with ``actions`` and keep the bound; store them in ``memory``.

        ``rows`` [R]: the worlds. ``actions`` [R, L]: actions at the decision with the number ``now`` [R]. The rest of
        the present plan is tried first, then the fallbacks ``rests``. Returns the reasons (``ShieldReason``), and the
        smallest price or estimate among the plans tried (m2/s2), [R] each.
        """
        most, plans = self.bound(memory)[rows], memory.plan[rows]
        plans[np.arange(len(rows)), now] = actions
        possible_states = self.possible_states(state, memory)
        M = possible_states.n // state.n
        before = take_worlds(possible_states, rows, M)
        # First the actions with the rest of the present plan, then, where this is rejected, with each fallback.
        least = self.price(game, before, plans, most, take(memory.caps, rows))
        reason = np.where(least <= most, PLAN_REMAINS, NO_CERTIFICATE)
        for code, rest in rests:
            open_rows = (reason == NO_CERTIFICATE).nonzero()[0]
            if not len(open_rows):
                break
            here = take_worlds(before, open_rows, M)
            after, _ = game.follow(here, actions[open_rows].repeat(M, axis=0))
            # No estimate that is priced or that lowers `least` is above `below`, because `least` is above `most`.
            below = least[open_rows] + 2.0 * NEARLY
            later, value = rest(self, game, after, plans[open_rows], most[open_rows], below)
            # Only plans that the estimate does not rule out are priced.
            hopeful = (value <= most[open_rows] + NEARLY).nonzero()[0]
            if len(hopeful):
                at = open_rows[hopeful]
                trial_plans = np.empty((len(at), *plans.shape[1:]))
                trial_plans[:] = later[hopeful]
                trial_plans[np.arange(len(at)), now[at]] = actions[at]
                states, caps = take_worlds(here, hopeful, M), take(memory.caps, rows[at])
                value[hopeful] = self.price(game, states, trial_plans, most[at], caps)
                good = value[hopeful] <= most[at]
                plans[at[good]], reason[at[good]] = trial_plans[good], code
            least[open_rows] = np.minimum(least[open_rows], value)
        good = (reason != NO_CERTIFICATE).nonzero()[0]
        if len(good):
            memory.plan[rows[good]], memory.price[rows[good]] = plans[good], least[good]
        return reason, least

    def measures(self, game: Game, last: State) -> dict[str, Any]:
        memory: StepShieldMemory = last.memories["shield"]
        replaced = {"actions": memory.replaced, "none": memory.replaced == 0}
        return {"replaced": replaced, **report_of(self.drivers, last, memory.agents)}

    def infos(self, game: Game, state: State) -> dict[str, Any]:
        memory: StepShieldMemory = state.memories["shield"]
        borne = {}
        if memory.caps is not None:
            last, _ = follow_plans(game, state, memory.plan, self.harm_count)
            borne = {"own_harm": last.borne_harm(self.harm_count), "baseline_own_harm": memory.caps}
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


def take_worlds(states: State, rows: Ints, M: int) -> State:
    if len(rows) * M == states.n:
        return states
    return states.take(rows if M == 1 else (rows[:, np.newaxis] * M + np.arange(M)).ravel())


@cache
def trials(learners: int) -> Bools:
    """Whose proposals each trial contains, [1 + L, L]: first all, then each learner's alone; [1, 1] if L = 1."""
    alone = np.eye(learners, dtype=np.bool_)
    return alone if learners == 1 else np.concatenate([alone.any(axis=0, keepdims=True), alone])


def constant(
    shield: StepShield, game: Game, after: State, plans: Floats, most: Floats, below: Floats
) -> tuple[Floats, Floats]:
    """Fallback of ``accept``: plans that continue with the best constant actions, and an estimate of their harm.

    The estimate is 0 (unknown) if scripts look at the state.
    """
    if not game.scripts:
        return best_constant(game, after, plans, shield.harm_count, below)
    plans, _ = best_constant(game, after, plans, shield.harm_count, np.full(len(plans), np.inf))
    return plans, np.zeros(len(plans))


def agents_drive(
    shield: StepShield, game: Game, after: State, plans: Floats, most: Floats, below: Floats
) -> tuple[Floats, Floats]:
    """Fallback of ``accept``: plans in which the shield's agents drive from the states ``after`` on.

    The second result, an estimate of the plans' harm, is 0 (unknown).
    """
    nominal = after if after.n == len(plans) else after.take(np.arange(0, after.n, after.n // len(plans)))
    return shield.rolled_out(game, nominal, plans, most), np.zeros(len(plans))


STEP = Part(NamedShield(StepShield), form="step", about="shield: every action is certified, or replaced", knows=MODEL)
