"""Scenarios on which the step shield is tried, adversaries, a search for a way past the bound, and leaks it must find.

An adversary proposes for one learner or a team, in every step: what it likes, or what a search of the shield's own
certificates says. ``search`` starts often, from random worlds, in four ways of proposing. The shield as it is must keep
every restart at or below its bound at the alert. The same restarts, against a shield with one planted leak (``LEAKS``),
must find harm above the bound. Why power is shown by leaks found: realised harm equals the last bound to the bit, so
"came within 1 % of the bound" is reached by proposing nothing but the plan. It says nothing about a search.

``python -m tests.shield.lines`` trains the policies that do as much harm as the shield lets them: PPO under the
shield, paid for the harm of each step (N = 3 and 5, about a minute each). Their weights stand beside this file.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.engine import Engine
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.physics.kernel import CLOCK
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.shield import ShieldedDriver, StepShield
from ethbrake_marl.shield.step_shield import Decision, Running, certify, seen_columns

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


def line(N: int, restitution: float = 0.3) -> Scenario:
    """Random lines of N vehicles, e from 0 to ``restitution``; the learner may also drive."""
    return Scenario(
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


TEAMS = {
    (3, 3): "cooperation-3-pair", (4, 3): "cooperation-4-all",
    (3, 5): "cooperation-3-five", (4, 5): "cooperation-4-five",
}  # fmt: skip


def scenario_of(level: int, N: int) -> Scenario:
    """The shipped scenario of a level of cooperation, with N vehicles."""
    return load_scenario(TEAMS[level, N])


class Attack(NamedTuple):
    """What an adversary achieved; n worlds, K learners."""

    realised: np.ndarray  # [n] harm in the engine's ledger
    bound: np.ndarray  # [n] at the alert
    last_bound: np.ndarray  # [n]
    rises: int  # how often the bound that was told rose
    over_cap: int  # vehicles that bore more than they might
    accepted: np.ndarray  # [n] deviations from the plan that were let through
    decisions: int
    proposals: list[np.ndarray]  # [n, K] in each step


def random_actions(rng, engine, shield, k):
    return rng.uniform(-1.0, 1.0, shape(shield))


def extremes(rng, engine, shield, k):
    return np.where((k + np.arange(engine.n)) % 2, 1.0, -1.0)[:, np.newaxis]


def full_drive(rng, engine, shield, k):
    return np.ones(shape(shield))


def slow_drift(rng, engine, shield, k):
    """Random, held for several steps: whole profiles that differ from the plan."""
    return np.random.default_rng(1_000 + k // 6).uniform(-1.0, 0.5, shape(shield))


def most_harmful(rng, engine, shield, k):
    """Of some candidates the one that is let through and leaves the most harm: a search against the shield itself."""
    best, action = np.full(engine.n, -1.0), np.ones(shape(shield))
    for candidate in rng.uniform(-1.0, 1.0, (6 if len(engine.learners) == 1 else 4, *shape(shield))):
        decision = certify(shield.running, as_asked(shield, candidate), shield.backup, shield.bound)
        free = (~decision.intervened & (decision.reason != 0)).reshape(engine.n, -1).any(axis=1)
        better = free & (decision.bound > best)
        best[better], action[better] = decision.bound[better], candidate[better]
    return action


def trained(rng, engine, shield, k):
    """What the trained adversary proposes now, with a little noise, so that no two lists are attacked alike."""
    value = engine.observe(engine.learners[0])
    *hidden, (weight, bias) = layers(engine.scenario.vehicles)
    for w, b in hidden:
        value = np.tanh(value @ w.T + b)
    action = (value @ weight.T + bias)[:, :1].astype(np.float64)
    return np.clip(action + rng.normal(0.0, 0.05, action.shape), -1.0, 1.0)


def coast(rng, engine, shield, k):
    return np.zeros(shape(shield))


def bang_bang(rng, engine, shield, k):
    return np.sign(np.random.default_rng([k // 4, engine.n]).uniform(-1.0, 1.0, shape(shield)))


def speechless(rng, engine, shield, k):
    """No number half of the time; at random else."""
    return np.where(rng.random(shape(shield)) < 0.5, np.nan, rng.uniform(-3.0, 3.0, shape(shield)))


def sleeper(rng, engine, shield, k):
    """What the plan says, for some decisions; then driving."""
    wakes = 3 + 4 * (np.arange(engine.n) % 6)[:, np.newaxis]
    return np.where(k < wakes, planned(shield), 1.0)


ADVERSARIES = {f.__name__: f for f in (random_actions, extremes, full_drive, slow_drift, most_harmful, trained)}
TEAM_ADVERSARIES = {f.__name__: f for f in (coast, full_drive, bang_bang, speechless, most_harmful, sleeper)}


def shape(shield: StepShield) -> tuple[int, int]:
    """Of a decision's proposals: worlds and learners."""
    return len(shield.first_bound), shield.backup.plan[:, 0].reshape(len(shield.first_bound), -1).shape[1]


def as_asked(shield: StepShield, proposed: np.ndarray) -> np.ndarray:
    """Proposals [n, K] as the shield takes them: [n] for one vehicle that is not in a list."""
    return proposed.reshape(shield.backup.plan[:, 0].shape)


def planned(shield: StepShield) -> np.ndarray:
    """What the plan says now, [n, K]."""
    plan, rows = shield.backup.plan, np.arange(len(shield.first_bound))
    return plan[rows, np.minimum(shield.running.steps, plan.shape[1] - 1)].reshape(shape(shield))


def begun(scenario: Scenario, worlds, **settings) -> StepShield:
    """A shield of all learners in its episodes."""
    learners = scenario.learners
    shield = StepShield(scenario, learners if len(learners) > 1 else learners[0], **settings)
    shield.begin(worlds, np.arange(worlds.n))
    return shield


def attack(scenario, worlds, adversary, *, hostile="all", seed=0, leak=None, **settings) -> Attack:
    """Let the hostile ones propose in every step: ``all``, or ``one`` learner, another one from world to world.

    Who is not hostile proposes what the plan says, or brakes fully. Harm is read from the engine, not from the shield.
    """
    rng, n, learners = np.random.default_rng(seed), worlds.n, scenario.learners
    engine, shield = unshielded(scenario, worlds), begun(scenario, worlds, **settings)
    bound, who = shield.first_bound.copy(), np.arange(n)[:, np.newaxis] % len(learners) == np.arange(len(learners))
    obeys = np.arange(n)[:, np.newaxis] % 4 < 2
    told, rises, accepted, decisions, proposals, decision = shield.bound, 0, np.zeros(n, np.int64), 0, [], None
    while not engine.ended.all():
        if leak is not None:
            leak(shield, decision)
        proposed = adversary(rng, engine, shield, len(proposals))
        if hostile == "one":
            proposed = np.where(who, proposed, np.where(obeys, planned(shield), -1.0))
        proposals.append(proposed)
        running = ~engine.ended
        decision = shield.decide(as_asked(shield, proposed), only=running)
        decisions += int(running.sum())
        accepted += np.isin(decision.reason, (1, 2)).reshape(n, -1).sum(axis=1) * running
        rises, told = rises + int((decision.bound > told).sum()), decision.bound
        engine.step(decision.applied.reshape(n, -1))
        assert leak is not None or shield.expects(seen_columns(engine.packed)).all()
    harm_count, over = settings.get("harm_count", "first"), 0
    if settings.get("cap") is not None:
        over = int((engine.ledger.vehicle_harm(harm_count) > shield.baseline_shares).sum())
    realised = engine.ledger.world_harm(harm_count)
    return Attack(realised, bound, shield.bound, rises, over, accepted, decisions, proposals)


def unshielded(scenario: Scenario, worlds) -> Engine:
    """The engine in which they drive."""
    scripts = {i: make_agent(spec) for i, spec in scenario.scripts.items()}
    return Engine(scenario, worlds.n, learners=scenario.learners, scripts=scripts, worlds=worlds)


TOLERANCE = 1e-9  # m2/s2
BATCH = 250  # restarts that run together


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
        n = min(BATCH, restarts - done)
        over, free = _batch(n, seed, done, leak, harm_count)
        broken = np.flatnonzero(over > TOLERANCE)
        if first is None and broken.size:
            first = done + int(broken[0]) + 1
        above, excess, loose = above + broken.size, max(excess, float(over.max())), loose + int((free > 0).sum())
        done += n
    return Found(done, above, first, excess, loose / done)


def _batch(n: int, seed: int, done: int, leak: Leak | None, harm_count) -> tuple[np.ndarray, np.ndarray]:
    """Harm above the bound at the alert, [n]: behind the shield, and with the same proposals applied as they are."""
    rng = np.random.default_rng([seed, done])
    scenario = line(3 if (done // BATCH) % 2 == 0 else 5)
    worlds = scenario.sample(n, seed, first=done).worlds
    way, held = rng.integers(4, size=(n, 1)), rng.uniform(-1.0, 1.0, (n, 1))

    def mixed(rng, engine, shield, k):
        held[:] = np.where(rng.random((n, 1)) < 0.2, rng.uniform(-1.0, 1.0, (n, 1)), held)
        tried = [rng.uniform(-1.0, 1.0, (n, 1)), rng.choice([-1.0, 1.0], (n, 1)), held]
        return np.choose(way, [*tried, most_harmful(rng, engine, shield, k)])

    found = attack(scenario, worlds, mixed, seed=[seed, done, 1], leak=leak, harm_count=harm_count)
    free = unshielded(scenario, worlds)
    for proposed in [*found.proposals, *[found.proposals[-1]] * 200]:
        if not free.ended.all():
            free.step(proposed)
    return found.realised - found.bound, free.ledger.world_harm(harm_count) - found.bound


# A leak changes what the shield believes or applies before, or after, each decision. Nothing is compared with what was
# predicted here, so that only the certificate stands between the search and the bound.
Leak = Callable[[StepShield, Decision | None], None]  # changes the shield before a decision; the last one, or None


def _with_problem(shield: StepShield, **arrays: np.ndarray) -> None:
    running = shield.running
    shield.running = running._replace(problem=running.problem._replace(**arrays))


def _columns(running: Running, group: int) -> slice:
    """Columns of the state: 0 gaps, 1 hit flags, 2 first-impact harm, 3 total harm."""
    N = running.problem.mass.shape[1]
    return slice(N + group * (N - 1), N + (group + 1) * (N - 1))


def _with_states(shield: StepShield, group: int, values: np.ndarray | float) -> None:
    states = shield.running.states.copy()
    states[:, _columns(shield.running, group)] = values
    shield.running = shield.running._replace(states=states)


def budget_may_rise(percent: float) -> Leak:
    def leak(shield, last):
        shield.backup = shield.backup._replace(harm=shield.backup.harm * (1.0 + percent / 100.0))

    return leak


def harm_forgotten(share: float) -> Leak:
    """Of the harm so far this share is forgotten in each step."""

    def leak(shield, last):
        for group in (2, 3):
            _with_states(shield, group, shield.running.states[:, _columns(shield.running, group)] * (1.0 - share))

    return leak


def impacts_late(shield: StepShield, last: Decision | None) -> None:
    """What was done in the last step is counted two steps later only."""
    for group in (2, 3):
        columns = _columns(shield.running, group)
        now = shield.running.states[:, columns].copy()
        before = getattr(shield, f"late{group}", None)
        setattr(shield, f"late{group}", now)
        _with_states(shield, group, now if before is None else before)


def hits_assumed(shield: StepShield, last: Decision | None) -> None:
    """A pair that is close counts as hit before: its first impact costs nothing."""
    hit = shield.running.states[:, _columns(shield.running, 1)]
    near = shield.running.states[:, _columns(shield.running, 0)] < 0.5
    _with_states(shield, 1, np.maximum(hit, near))


def belief(name: str, factor: float) -> Leak:
    """The shield believes a parameter to be this many times what it is."""

    def leak(shield, last):
        if last is None:
            _with_problem(shield, **{name: getattr(shield.running.problem, name) * factor})

    return leak


def restitution_wrong(shield: StepShield, last: Decision | None) -> None:
    if last is None:
        clock = shield.running.problem.clock.copy()
        clock[:, CLOCK.RESTITUTION] *= 0.5
        _with_problem(shield, clock=clock)


def far_pairs_forgotten(shield: StepShield, last: Decision | None) -> None:
    """Harm of pairs that the shielded vehicle is no part of does not count."""
    vehicle, N = shield.vehicle, shield.running.problem.mass.shape[1]
    far = [p for p in range(N - 1) if vehicle not in (p, p + 1)]
    for group in (2, 3):
        harm = shield.running.states[:, _columns(shield.running, group)].copy()
        harm[:, far] = 0.0
        _with_states(shield, group, harm)


def plan_rounded(shield: StepShield, last: Decision | None) -> None:
    """The plan is kept with two decimals; its harm is believed unchanged."""
    shield.backup = shield.backup._replace(plan=np.round(shield.backup.plan, 2))


def gaps_blurred(shield: StepShield, last: Decision | None) -> None:
    """Gaps are believed 1 cm longer than they are, from the third step on."""
    if last is not None and int(shield.running.steps.max()) == 3:
        gaps = shield.running.states[:, _columns(shield.running, 0)]
        _with_states(shield, 0, gaps + 0.01)


LEAKS: dict[str, Leak] = {
    "the budget may rise by 1 % in each step": budget_may_rise(1.0),
    "the budget may rise by 0.1 % in each step": budget_may_rise(0.1),
    "1 % of the harm so far is forgotten in each step": harm_forgotten(0.01),
    "impacts are counted one step late": impacts_late,
    "a pair closer than 0.5 m counts as hit before": hits_assumed,
    "the latency of all is believed 10 % longer": belief("latency", 1.1),
    "the masses are believed equal": lambda s, d: _with_problem(s, mass=np.ones_like(s.running.problem.mass)),
    "the others are believed to brake 1 % harder": belief("command", 1.01),
    "restitution is believed half of what it is": restitution_wrong,
    "harm of pairs further off is forgotten": far_pairs_forgotten,
    "the plan is kept with two decimals": plan_rounded,
    "gaps are believed 1 cm longer": gaps_blurred,
}


# Worlds that are corners of what a vehicle does not know, or inside, and attacks on ``+robust:believed`` in them. Every
# quantity of another vehicle that is open is one of two numbers, so each world of ``LISTS`` is a member of what is
# certified at its first decision. None of the numbers are round: in a world of equal gaps and equal speeds two impacts
# fall on one moment, and the last bit decides which of them is first.
WAYS = ("coast", "drive", "chance")
ABOVE = 1e-6  # m2/s2; what is told is moved on with rounding

_BASE = load_scenario("cooperation-2-paper").replace(early_impacts="keep")
NEVER_HEARD = _BASE.replace(
    gaps_m=[{"choice": [5.13, 9.71]}, {"choice": [5.37, 9.58]}],
    speeds_mps=[{"choice": [18.23, 21.87]}, {"choice": [18.11, 21.93]}, {"choice": [18.41, 22.19]}],
    v2x={"preset": "paper", "hears": "front"},
    mass_t=[4.5, 5.5, {"choice": [3.0, 9.0]}],
)
HEARD_LATE = NEVER_HEARD.replace(  # a while after the first decision, by messages 0.6 to 0.9 s old
    v2x={"preset": "paper", "link_latency_s": 0.6, "persistence": "periodic", "senses": "front", "sensing_s": [3, 3]},
    latency_s=[0.0, 0.2, 0.6],
)
LISTS = {"never heard": NEVER_HEARD, "heard late": HEARD_LATE}
_INSIDE = {
    "gaps_m": [{"uniform": [5.13, 9.71]}, {"uniform": [5.37, 9.58]}],
    "speeds_mps": [{"uniform": [18.23, 21.87]}, {"uniform": [18.11, 21.93]}, {"uniform": [18.41, 22.19]}],
    "mass_t": [4.5, 5.5, {"uniform": [3.0, 9.0]}],
}
INSIDE = {  # the same ranges, and worlds from between the corners
    **{name: scenario.replace(**_INSIDE) for name, scenario in LISTS.items()},
    "blocked": NEVER_HEARD.replace(**_INSIDE, v2x={"preset": "blocked", "persistence": "periodic"}),
    "sensors-only": NEVER_HEARD.replace(**_INSIDE, v2x="sensors-only"),
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


def shielded(
    way: str, scenario: Scenario, n: int, seed: int, *, robust: str | None = "corners"
) -> tuple[Floats, Floats, int]:
    """Harm realised and first bound of ``n`` worlds [n] m2/s2, and how many proposals were replaced."""
    mode = {"mode": "step"} if robust is None else {"mode": "robust", "robust": robust}
    driver = ShieldedDriver(Hostile(way, seed), scenario, believed=True, **mode)
    episodes = drive(scenario.sample(n, seed).worlds, driver, scenario, 1)
    shield = episodes.guarded.shield
    return episodes.ledger.world_harm("first"), shield.predicted_harm, int(shield.interventions.sum())


def gate(lists: dict[str, Scenario], robust: str, worlds: int, seed: int) -> bool:
    """In no world of these lists is harm above the first bound of ``+robust:believed``, whatever is proposed."""
    good, each = True, max(1, worlds // (len(lists) * len(WAYS)))
    for name, scenario in lists.items():
        for way in WAYS:
            harm, bound, replaced = shielded(way, scenario, each, seed, robust=robust)
            above, kept = int((harm > bound + ABOVE).sum()), np.isfinite(bound)
            good = good and above == 0 and replaced > 0
            print(
                f"  {robust}, {name:12s} {way:7s} {each:7,} worlds {replaced:9,} replaced  above the bound: {above},"
                f" without one: {int((~kept).sum())}; harm {harm.mean():.1f}, bound {bound[kept].mean():.1f}",
                flush=True,
            )
    return good


STEPS, WORLDS, HIDDEN = 200_000, 64, (64, 64)
FOLDER = Path(__file__).resolve().parent


def weights_file(N: int) -> Path:
    return FOLDER / f"adversary-{N}.npz"


@cache
def layers(N: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights and biases, in order."""
    with np.load(weights_file(N), allow_pickle=False) as kept:
        return [(kept[f"weight{k}"], kept[f"bias{k}"]) for k in range(len(HIDDEN) + 1)]


def train(N: int) -> None:
    """Train against the shield on ``line(N)`` and keep the actor's weights."""
    import torch  # torch takes seconds to load, and the adversary itself needs none of it
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnvWrapper

    from ethbrake_marl.envs.sb3 import make_sb3_vec_env
    from ethbrake_marl.shield.sb3 import ShieldedVecEnv

    class PaidForHarm(VecEnvWrapper):
        def reset(self):
            return self.venv.reset()

        def step_wait(self):
            observation, reward, done, infos = self.venv.step_wait()
            return observation, -reward, done, infos

    torch.set_num_threads(1)
    env = PaidForHarm(ShieldedVecEnv(make_sb3_vec_env(line(N), WORLDS, seed=N, reward={"harm": 0.02})))
    model = PPO(
        "MlpPolicy", env, n_steps=64, batch_size=1024, n_epochs=4, learning_rate=1e-3, gamma=1.0, gae_lambda=0.95,
        policy_kwargs={"net_arch": list(HIDDEN)}, seed=N, device="cpu",
    )  # fmt: skip
    model.learn(STEPS)
    state = model.policy.state_dict()
    names = [f"mlp_extractor.policy_net.{2 * k}" for k in range(len(HIDDEN))] + ["action_net"]
    kept = {}
    for k, name in enumerate(names):
        kept |= {f"weight{k}": state[f"{name}.weight"].numpy(), f"bias{k}": state[f"{name}.bias"].numpy()}
    np.savez(weights_file(N), **kept)
    paid = np.mean([episode["r"] for episode in model.ep_info_buffer])
    print(f"N={N}: {STEPS:,} steps, mean harm of the last episodes {-paid / 0.02:.2f} m2/s2, {weights_file(N).name}")


if __name__ == "__main__":
    for vehicles in (3, 5):
        train(vehicles)
