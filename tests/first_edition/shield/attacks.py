"""Who tries to get above the bound of a shield, and how: lines, adversaries, attacks, leaks, and the search for a way.

Harm is read from the engine's ledger, not from the shield. A search that finds nothing is worth what it finds where
there is something: ``LEAKS`` are twelve leaks that a step shield could have, small ones among them, and the same
search must find harm above the bound through each. (Why not "came within 1 % of the bound"? Realised harm equals the
last bound to the bit, so that is reached by proposing nothing but the plan.)
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive, script_agents
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.episode import CLOCK
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.shields.certify import Decision, certify
from ethbrake_marl.first_edition.shields.comparison import seen_columns
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.step import StepShield

# ---------------------------------------------------------------- lines

_ROLES = {
    3: {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "constant:5"},
    5: {
        "vehicle_1": "constant:6",
        "vehicle_2": "full_brake",
        "vehicle_3": "learner",
        "vehicle_4": "constant:4",
        "vehicle_5": "coast",
    },
}


def line(N: int, restitution: float = 0.3) -> eb.Scenario:
    """Random lines of N vehicles, e from 0 to ``restitution``; the learner may also drive."""
    return eb.Scenario(
        name=f"line-{N}",
        vehicles=N,
        gaps_m={"uniform": [2, 12]},
        speeds_mps={"uniform": [10, 20]},
        braking_capacity_mps2={"uniform": [6, 9]},
        driving_capacity_mps2={"uniform": [0, 4]},
        mass_t={"uniform": [1, 8]},
        latency_s={"uniform": [0, 0.7]},
        restitution={"uniform": [0, restitution]},
        roles=_ROLES[N],
        early_impacts="keep",
    )


TEAMS = {  # by cooperation level and number of vehicles
    (3, 3): "cooperation-3-pair", (4, 3): "cooperation-4-all",
    (3, 5): "cooperation-3-five", (4, 5): "cooperation-4-five",
}  # fmt: skip

# ---------------------------------------------------------------- adversaries: what all learners propose, [n, K]

Adversary = Callable[[np.random.Generator, eb.Engine, StepShield, int], Floats]  # ..., number of the step
Leak = Callable[[StepShield, Decision | None], None]  # changes the shield before a decision; the last one, or None


def worst_case(rng, engine, shield, k, candidates=8):
    """Of some candidates the accepted one that leaves the most harm: a search against the shield itself."""
    n, K = shape(shield)
    best, action = np.full(n, -1.0), np.ones((n, K))
    for middle in np.linspace(-1.0, 1.0, candidates):
        candidate = middle + rng.uniform(-0.1, 0.1, (n, K)) if K == 1 else rng.uniform(-1.0, 1.0, (n, K))
        decision = certify(shield.memory.running, as_asked(shield, candidate), shield.memory.backup, shield.bound)
        reason = decision.reason.reshape(n, K)
        better = ((reason == 1) | (reason == 2)).any(axis=1) & (decision.bound > best)
        best[better], action[better] = decision.bound[better], np.clip(candidate[better], -1.0, 1.0)
    return action


def sleeper(rng, engine, shield, k):
    """What the plan says, for some decisions; then driving."""
    wakes = 3 + 4 * (np.arange(shape(shield)[0]) % 6)[:, np.newaxis]
    return np.where(k < wakes, planned(shield), 1.0)


@cache
def layers(N: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights and biases of the trained adversary, in order; ``docs/studies/shield_adversary.py`` made them."""
    with np.load(Path(__file__).with_name(f"adversary-{N}.npz"), allow_pickle=False) as kept:
        return [(kept[f"weight{k}"], kept[f"bias{k}"]) for k in range(len(kept.files) // 2)]


def trained(rng, engine, shield, k):
    """A policy that was paid for harm under the shield, with a little noise: no two lists are attacked alike."""
    value = engine.observe(engine.learners[0])
    *hidden, (weight, bias) = layers(engine.scenario.vehicles)
    for w, b in hidden:
        value = np.tanh(value @ w.T + b)
    action = (value @ weight.T + bias).astype(np.float64)
    return np.clip(action + rng.normal(0.0, 0.05, action.shape), -1.0, 1.0)


# Slow drift and bang-bang are held for several steps: whole profiles that differ from the plan.
TEAM_ADVERSARIES: dict[str, Adversary] = {
    "random_actions": lambda rng, engine, shield, k: rng.uniform(-1.0, 1.0, shape(shield)),
    "extremes": lambda rng, engine, shield, k: np.where((np.indices(shape(shield))[0] + k) % 2, 1.0, -1.0),
    "coast": lambda rng, engine, shield, k: np.zeros(shape(shield)),
    "full_drive": lambda rng, engine, shield, k: np.ones(shape(shield)),
    "slow_drift": lambda rng, engine, shield, k: np.random.default_rng(1_000 + k // 6).uniform(-1, 0.5, shape(shield)),
    "bang_bang": lambda rng, engine, shield, k: np.sign(
        np.random.default_rng([k // 4, shape(shield)[0]]).uniform(-1.0, 1.0, shape(shield))
    ),
    "speechless": lambda rng, engine, shield, k: np.where(  # no number half of the time; at random else
        rng.random(shape(shield)) < 0.5, np.nan, rng.uniform(-3.0, 3.0, shape(shield))
    ),
    "worst_case": worst_case,
    "sleeper": sleeper,
}
ADVERSARIES: dict[str, Adversary] = {**TEAM_ADVERSARIES, "trained": trained}


def shape(shield: StepShield) -> tuple[int, int]:
    """Of a decision's proposals: worlds, vehicles."""
    return len(shield.memory.first_bound), len(shield.vehicles)


def as_asked(shield: StepShield, proposed: Floats) -> Floats:
    """Proposals [n, K] as this shield takes them: [n] where it shields one vehicle."""
    return proposed if isinstance(shield.vehicle, tuple) else proposed[:, 0]


def planned(shield: StepShield) -> Floats:
    """What the plan says now, [n, K]."""
    plan, (n, K) = shield.memory.backup.plan, shape(shield)
    return plan[np.arange(n), np.minimum(shield.memory.running.steps, plan.shape[1] - 1)].reshape(n, K)


# ---------------------------------------------------------------- attacks


class Attack(NamedTuple):
    """What an adversary achieved; n worlds."""

    realised: Floats  # harm in the engine's ledger
    bound: Floats  # at the alert
    last_bound: Floats
    accepted: Floats  # deviations from the plan that were let through
    rises: int  # how often the bound that was told rose
    over_cap: int  # vehicles that bore more than they might
    decisions: int


def attack(
    scenario: eb.Scenario, worlds: Worlds, adversary: Adversary, *, hostile="all", harm_count="first", allowance=0.0,
    cap=None, leak: Leak | None = None, seed=0, uncertain: Any = None,
) -> Attack:  # fmt: skip
    """Let the hostile learners propose in every step: ``all``, or ``one``, another one from world to world.

    Who is not hostile proposes what the plan says, or brakes fully. A ``leak`` changes the shield before each decision.
    ``uncertain`` is a class of shields and an uncertainty: the worlds are what such a shield is told, and the truth is
    a corner.
    """
    rng, learners = np.random.default_rng(seed), scenario.learners
    truth = worlds if uncertain is None else uncertain[1].draw(worlds, rng, corners=True)
    engine, sound = plain_engine(scenario, truth), leak is None and uncertain is None
    kind, settings = (StepShield, {}) if uncertain is None else (uncertain[0], {"uncertainty": uncertain[1]})
    shield = begun(scenario, worlds, kind, harm_count=harm_count, allowance=allowance, cap=cap, **settings)
    first_bound, told, decision = shield.memory.first_bound.copy(), shield.bound, None
    rows = np.arange(worlds.n)[:, np.newaxis]
    who, obeys = rows % len(learners) == np.arange(len(learners)), rows % 4 < 2
    accepted, rises, decisions, k = np.zeros(worlds.n, np.int64), 0, 0, 0
    while not engine.ended.all():
        if leak is not None:
            leak(shield, decision)
        proposed = adversary(rng, engine, shield, k)
        if hostile == "one":
            proposed = np.where(who, proposed, np.where(obeys, planned(shield), -1.0))
        decision = shield.decide(as_asked(shield, proposed), only=~engine.ended)
        decisions += int((~engine.ended).sum())
        reason = decision.reason.reshape(shape(shield))
        accepted += (((reason == 1) | (reason == 2)) & ~engine.ended[:, np.newaxis]).sum(axis=1)
        rises, told = rises + int((decision.bound > told).sum()), decision.bound
        engine.step(decision.applied.reshape(shape(shield)))
        assert not sound or shield.expects(seen_columns(engine.packed)).all()
        k += 1
    assert not sound or not shield.memory.distrusted.any()
    over = 0 if cap is None else int((engine.ledger.vehicle_harm(harm_count) > shield.memory.baseline_shares).sum())
    realised = engine.ledger.world_harm(harm_count)
    return Attack(realised, first_bound, shield.bound, accepted, rises, over, decisions)


def begun(scenario: eb.Scenario, worlds: Worlds, kind: type[StepShield] = StepShield, **settings) -> StepShield:
    """A shield of all learners in its episodes."""
    learners = scenario.learners
    shield = kind(scenario, learners[0] if len(learners) == 1 else learners, **settings)
    shield.begin(worlds, np.arange(worlds.n))
    return shield


def plain_engine(scenario: eb.Scenario, worlds: Worlds) -> eb.Engine:
    """Without a shield."""
    scripts = script_agents(scenario)
    return eb.Engine(scenario, worlds.n, learners=scenario.learners, scripts=scripts, worlds=worlds)


def all_infos(env: Any, actions: Any, **reset: Any) -> list[Any]:
    """All that an episode of a parallel environment tells, from its reset on, if the same is proposed in each step."""
    infos = [env.reset(**reset)[1]]
    while env.agents:
        infos.append(env.step(actions)[-1])
    return infos


def above_later(proposer: str, worlds: int) -> tuple[float, float]:
    """Share of ``paper-random``'s worlds above their bound at a horizon of 3 s, and once all stand.

    From the horizon on everybody brakes fully.
    """
    scenario = eb.load_scenario("paper-random").replace(horizon_s=3.0)
    episodes = drive(scenario.sample(worlds, 7).worlds, ShieldedDriver(make_agent(proposer), scenario), scenario, 1)
    final, bound = episodes.final, episodes.guarded.shield.predicted_harm
    _, impacts = advance(final, -final.vehicles.braking_capacity_mps2, until_s=np.full(worlds, 8.0))
    now, later = (ledger.world_harm("first") for ledger in (episodes.ledger, episodes.ledger.add(impacts)))
    return float((now > bound).mean()), float((later > bound + 1e-9).mean())


# ---------------------------------------------------------------- the search

TOLERANCE = 1e-9  # m2/s2
BATCH = 250  # restarts that run together


class Restarts:
    """Random ways to propose, one for each world: at random, at the extremes, held for a time, the worst allowed."""

    def __init__(self, seed: list[int], n: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.way, self.held = self.rng.integers(4, size=n), self.rng.uniform(-1.0, 1.0, n)
        self.proposals: list[Floats] = []

    def __call__(self, _, engine, shield, k):
        rng, n = self.rng, len(self.way)
        self.held = np.where(rng.random(n) < 0.2, rng.uniform(-1.0, 1.0, n), self.held)
        worst = worst_case(rng, engine, shield, k, 6)[:, 0]
        tried = [rng.uniform(-1.0, 1.0, n), rng.choice([-1.0, 1.0], n), self.held, worst]
        self.proposals.append(np.choose(self.way, tried)[:, np.newaxis])
        return self.proposals[-1]


class Found(NamedTuple):
    """What the restarts achieved."""

    restarts: int
    above: int  # restarts that ended above the bound at the alert
    first: int | None  # number of the first of them, from 1
    excess: float  # largest harm above the bound (m2/s2)
    loose: float  # share of the restarts that would end above the bound if their proposals were applied unshielded


def search(
    restarts: int, seed: int, leak: Leak | None = None, *, until_found: bool = False, harm_count="first"
) -> Found:
    """Attack the shield, or one with a leak, from many random starts."""
    above, first, excess, loose, done = 0, None, -np.inf, 0, 0
    while done < restarts and not (until_found and first is not None):
        n, scenario = min(BATCH, restarts - done), line(3 if (done // BATCH) % 2 == 0 else 5)
        worlds, ways = scenario.sample(n, seed, first=done).worlds, Restarts([seed, done], n)
        found = attack(scenario, worlds, ways, harm_count=harm_count, leak=leak)
        over, free = found.realised - found.bound, plain_engine(scenario, worlds)
        proposals = iter(ways.proposals)
        while not free.ended.all():
            free.step(next(proposals, ways.proposals[-1]))
        broken = np.flatnonzero(over > TOLERANCE)
        if first is None and broken.size:
            first = done + int(broken[0]) + 1
        above, excess = above + broken.size, max(excess, float(over.max()))
        loose, done = loose + int((free.ledger.world_harm(harm_count) > found.bound).sum()), done + n
    return Found(done, above, first, excess, loose / done)


# ---------------------------------------------------------------- leaks


def _of_pairs(change: Callable[[StepShield, np.ndarray], None]) -> Leak:
    """A leak that changes the state of pairs [n, 4, pairs]: 0 gap, 1 hit flag, 2 first-impact harm, 3 total harm."""

    def leak(shield, last):
        states, N = shield.memory.running.states.copy(), shield.memory.running.problem.mass.shape[1]
        change(shield, states[:, N : N + 4 * (N - 1)].reshape(-1, 4, N - 1))
        shield.memory = shield.memory._replace(running=shield.memory.running._replace(states=states))

    return leak


def budget_may_rise(percent: float) -> Leak:
    def leak(shield, last):
        shield.memory = shield.memory._replace(
            backup=shield.memory.backup._replace(harm=shield.memory.backup.harm * (1.0 + percent / 100.0))
        )

    return leak


@_of_pairs
def harm_forgotten(shield: StepShield, pairs: np.ndarray) -> None:
    pairs[:, 2:] *= 0.99


@_of_pairs
def impacts_late(shield: StepShield, pairs: np.ndarray) -> None:
    """What was done in the last step is counted two steps later only."""
    now = pairs[:, 2:].copy()
    pairs[:, 2:] = getattr(shield, "late", now)
    shield.late = now


@_of_pairs
def hits_assumed(shield: StepShield, pairs: np.ndarray) -> None:
    """A pair that is close counts as hit before: its first impact costs nothing."""
    pairs[:, 1] = np.maximum(pairs[:, 1], pairs[:, 0] < 0.5)


def misjudged(name: str, estimated: Callable[[np.ndarray], np.ndarray]) -> Leak:
    """The shield estimates a parameter to be something else."""

    def leak(shield, last):
        if last is None:
            problem = shield.memory.running.problem
            changed = problem._replace(**{name: estimated(getattr(problem, name).copy())})
            shield.memory = shield.memory._replace(running=shield.memory.running._replace(problem=changed))

    return leak


def half_restitution(clock: np.ndarray) -> np.ndarray:
    clock[:, CLOCK.RESTITUTION] *= 0.5
    return clock


@_of_pairs
def far_pairs_forgotten(shield: StepShield, pairs: np.ndarray) -> None:
    """Harm of pairs that the shielded vehicle is no part of does not count."""
    pair = np.arange(pairs.shape[2])
    pairs[:, 2:, (pair != shield.vehicle) & (pair + 1 != shield.vehicle)] = 0.0


def plan_rounded(shield: StepShield, last: Decision | None) -> None:
    """The plan is kept with two decimals; its harm is taken as unchanged."""
    shield.memory = shield.memory._replace(
        backup=shield.memory.backup._replace(plan=np.round(shield.memory.backup.plan, 2))
    )


@_of_pairs
def gaps_blurred(shield: StepShield, pairs: np.ndarray) -> None:
    """Gaps are estimated 1 cm longer than they are, from the third step on."""
    if int(shield.memory.running.steps.max()) == 3:
        pairs[:, 0] += 0.01


LEAKS: dict[str, Leak] = {
    "the budget may rise by 1 % in each step": budget_may_rise(1.0),
    "the budget may rise by 0.1 % in each step": budget_may_rise(0.1),
    "1 % of the harm so far is forgotten in each step": harm_forgotten,
    "impacts are counted one step late": impacts_late,
    "a pair closer than 0.5 m counts as hit before": hits_assumed,
    "the latency of all is estimated 10 % longer": misjudged("latency", lambda latency: latency * 1.1),
    "the masses are estimated equal": misjudged("mass", np.ones_like),
    "the others are estimated to brake 1 % harder": misjudged("command", lambda command: command * 1.01),
    "restitution is estimated half of what it is": misjudged("clock", half_restitution),
    "harm of pairs further off is forgotten": far_pairs_forgotten,
    "the plan is kept with two decimals": plan_rounded,
    "gaps are estimated 1 cm longer": gaps_blurred,
}


class Hostile:
    """Proposes what does harm: full driving, nothing at all, or chance."""

    knows = "own sensors"

    def __init__(self, way: str, seed: int = 5) -> None:
        self.name, self.rng = way, np.random.default_rng(seed)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The proposal, [n] m/s2."""
        vehicles = worlds.vehicles
        low, high = -vehicles.braking_capacity_mps2[:, vehicle], vehicles.driving_capacity_mps2[:, vehicle]
        if self.name == "chance":
            return self.rng.uniform(low, high)
        return high.copy() if self.name == "drive" else np.zeros(worlds.n)
