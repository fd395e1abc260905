"""Attacks on shields through every interface: lines, ways to propose, and plays that report bounds and harm."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agent_names import open_game, register_agent
from ethbrake_marl.agents.team import Team, play
from ethbrake_marl.episode.state import State
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.faces.shield import shield
from ethbrake_marl.faces.vector import EthBrakeVectorEnv
from ethbrake_marl.motion.layout import BRAKING, DRIVING, GAP, SPEED, Floats
from ethbrake_marl.shields.step import StepShield
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario


class Follower:
    """A script that reacts: the intelligent driver model, within the vehicle's capacities."""

    name, knows = "following", "messages"

    def begin(self, alert: State, body: int) -> None:
        """Remember nothing."""

    def act(self, state: State, memory: None, body: int) -> tuple[Floats, None]:
        speed, gap = state.line[:, SPEED, body], np.maximum(state.line[:, GAP, body - 1], 0.1)
        closing = speed - state.line[:, SPEED, body - 1]
        wanted = 2.0 + np.maximum(speed + speed * closing / (2.0 * np.sqrt(1.5 * 3.0)), 0.0)
        command = 1.5 * (1.0 - (speed / 30.0) ** 4 - (wanted / gap) ** 2)
        return np.clip(command, -state.car[:, BRAKING, body], np.minimum(state.car[:, DRIVING, body], 1.5)), None


def make_follower(argument: str | None, settings: Any) -> Follower:
    return Follower()


RATES = {"brake_rate_mps3": {"uniform": [5, 40]}, "release_rate_mps3": {"uniform": [5, 60]}}


def line(name: str, **roles: str) -> Scenario:
    """Shipped scenario; with ``-rates`` behind its name, brakes build up; ``roles`` change vehicles."""
    register_agent("following", make_follower, form="following")
    scenario = load_scenario(name.removesuffix("-rates"))
    scenario = scenario.replace(**RATES) if name.endswith("-rates") else scenario
    return scenario.replace(roles={**scenario.roles, **roles}, early_impacts="keep") if roles else scenario


ONE: dict[str, Callable[[], Scenario]] = {
    "paper": lambda: line("paper-random"),
    "obstacle": lambda: line("paper-random-obstacle"),
    "build-up": lambda: line("realistic-truck-buildup"),
    "build-up, obstacle": lambda: line("paper-random-obstacle-rates"),
    "follower": lambda: line("paper-random", vehicle_3="following"),
    "follower, obstacle": lambda: line("paper-random-obstacle", vehicle_3="following"),
}
TEAMS: dict[str, Callable[[], Scenario]] = {
    "pair": lambda: line("cooperation-3-pair"),
    "all": lambda: line("cooperation-4-all"),
    "five": lambda: line("cooperation-3-five"),
    "build-up, all": lambda: line("cooperation-4-all-rates"),
    "follower, pair": lambda: line("cooperation-3-pair", vehicle_1="following"),
}
LINES = ONE | TEAMS
REACTING = [name for name in LINES if "follower" in name]

Way = Callable[[np.random.Generator, int, tuple[int, int]], Floats]  # generator, number of the step, [n, L]
WAYS: dict[str, Way] = {
    "random": lambda rng, k, shape: rng.uniform(-1.0, 1.0, shape),
    "drive": lambda rng, k, shape: np.ones(shape),
    "coast": lambda rng, k, shape: np.zeros(shape),
    "alternate": lambda rng, k, shape: np.where((np.indices(shape)[0] + k) % 2, 1.0, -1.0),
    "held": lambda rng, k, shape: np.random.default_rng(k // 5).uniform(-1.0, 1.0, shape),
    "sleeper": lambda rng, k, shape: np.ones(shape) if k > 12 else np.full(shape, np.nan),
    "silent": lambda rng, k, shape: np.where(rng.random(shape) < 0.5, np.nan, np.sign(rng.uniform(-1.0, 1.0, shape))),
}


class Episode(NamedTuple):
    """What an interface reported of some episodes, [n] each."""

    first: Floats  # bound at the alert
    last: Floats  # bound at the end
    harm: Floats  # at the end
    rises: int  # how often a reported bound rose
    decisions: int


def harm_of(info: Any, count: str) -> Any:
    return info["world_total_harm" if count == "total" else "world_first_impact_harm"]


def parallel(scenario: Scenario, count: str, way: Way, seed: int, worlds: int) -> Iterator[Episode]:
    env, rng = shield(EthBrakeParallelEnv(scenario, agents="learners"), harm_count=count), np.random.default_rng(seed)
    for episode in range(worlds):
        infos, k, rises = env.reset(seed=seed if episode == 0 else None)[1], 0, 0
        agent = env.possible_agents[0]
        first = bound = infos[agent]["shield_bound_harm"]
        while env.agents:
            proposed = way(rng, k, (1, len(env.agents)))[0]
            actions = {a: [u] for a, u in zip(env.agents, proposed, strict=True) if not np.isnan(u)}
            info = env.step(actions)[4][agent]
            rises, bound, k = rises + (info["shield_bound_harm"] > bound), info["shield_bound_harm"], k + 1
        yield Episode(np.array([first]), np.array([bound]), np.array([harm_of(info, count)]), rises, k)


def vector(scenario: Scenario, count: str, way: Way, seed: int, worlds: int) -> Iterator[Episode]:
    n, rng = min(worlds, 256), np.random.default_rng(seed)
    env = shield(EthBrakeVectorEnv(n, scenario, autoreset_mode="SameStep"), harm_count=count)
    bound, k, done = env.reset(seed=seed)[1]["shield_bound_harm"].copy(), 0, 0
    first = bound.copy()
    while done < worlds:
        *_, ended, cut, infos = env.step(way(rng, k, (n, 1)))
        over, k = ended | cut, k + 1
        last = np.where(
            over, infos["final_info"]["shield_bound_harm"] if over.any() else 0.0, infos["shield_bound_harm"]
        )
        harm = harm_of(infos["final_info"], count)[over] if over.any() else np.zeros(0)
        yield Episode(first[over], last[over], harm, int((last > bound).sum()), n)
        bound, done = infos["shield_bound_harm"].copy(), done + int(over.sum())
        first[over] = bound[over]


def vec_env(scenario: Scenario, count: str, way: Way, seed: int, worlds: int) -> Iterator[Episode]:
    n, rng, L = min(worlds, 256), np.random.default_rng(seed), len(scenario.learners)
    env = shield(make_sb3_vec_env(scenario, n, seed), harm_count=count)
    env.reset()
    first = np.array([info["shield_bound_harm"] for info in env.reset_infos[::L]])
    bound, k, done = first.copy(), 0, 0
    while done < worlds:
        _, _, over, infos = env.step(way(rng, k, (n, L)).reshape(-1, 1))
        last, rows = np.array([info["shield_bound_harm"] for info in infos[::L]]), np.flatnonzero(over[::L])
        harm, k, done = np.array([harm_of(infos[row * L], count) for row in rows]), k + 1, done + len(rows)
        yield Episode(first[rows], last[rows], harm, int((last > bound).sum()), n)
        if len(rows):
            again = env.reset_infos
            first[rows] = last[rows] = [again[row * L]["shield_bound_harm"] for row in rows]
        bound = last


class Proposer:
    """An agent that proposes as it likes."""

    knows = "own sensors"

    def __init__(self, way: Way, seed: int) -> None:
        self.name, self.way, self.rng = "attack", way, np.random.default_rng(seed)

    def begin(self, alert: State, body: int) -> None:
        """Remember nothing."""

    def act(self, state: State, memory: None, body: int) -> tuple[Floats, None]:
        u = np.nan_to_num(self.way(self.rng, int(state.steps.max()), (state.n, 1))[:, 0], nan=-0.3)
        return np.where(u < 0.0, state.car[:, BRAKING, body], state.car[:, DRIVING, body]) * u, None


def driven(scenario: Scenario, count: str, way: Way, seed: int, worlds: int) -> Iterator[Episode]:
    """A team that proposes by itself, as in evaluations; its next rollout never proposes the same again."""
    loaded, game = open_game(scenario)
    drivers = {body: Proposer(way, seed + body) for body in game.settings.learners.tolist()}
    team = Team("attack", drivers, StepShield(drivers, harm_count=count))
    for begin in range(0, worlds, 500):
        n, decisions, rises, bound = min(500, worlds - begin), 0, 0, None
        for _, state in play(game, loaded.sample(n, seed, first=begin), team, donate=True):
            memory = state.memories["shield"]
            rises += 0 if bound is None else int((memory.price > bound).sum())
            bound, decisions = memory.price.copy(), decisions + int((~state.ended).sum())
        yield Episode(memory.first, memory.price, state.harm(count), rises, decisions)


def searched(scenario: Scenario, count: str, way: Way, seed: int, worlds: int) -> Iterator[Episode]:
    """The dearest accepted of eight proposals at every decision: a search against the shield itself."""
    loaded, game = open_game(scenario)
    guard, rng, L = StepShield(harm_count=count), np.random.default_rng(seed), len(game.settings.learners)
    game = game._replace(shield=guard)
    state, decisions = game.reset(loaded.sample(worlds, seed)), 0
    while not state.ended.all():
        best, dearest = np.ones((worlds, L)), np.full(worlds, -1.0)
        for _ in range(8):
            proposed = rng.uniform(-1.0, 1.0, (worlds, L))
            _, memory = guard.decide(game, state, proposed, donate=False)
            better = ~memory.intervened.any(axis=1) & (memory.price > dearest)
            best[better], dearest[better] = proposed[better], memory.price[better]
        decisions += 9 * int((~state.ended).sum())
        state, _ = game.step(state, best)
    memory = state.memories["shield"]
    yield Episode(memory.first, memory.price, state.harm(count), 0, decisions)


Play = Callable[[Scenario, str, Way, int, int], Iterator[Episode]]
PLAYS: dict[str, Play] = {
    "parallel": parallel,
    "vector": vector,
    "VecEnv": vec_env,
    "drive": driven,
    "search": searched,
}
ONLY_ONE = ("vector",)  # interfaces for one learner


class Total(NamedTuple):
    """Result of an attack."""

    episodes: int
    decisions: int
    above: int  # episodes whose harm is above the bound at the alert
    unequal: int  # episodes whose harm is not the certified harm
    rises: int

    @property
    def held(self) -> bool:
        return self.episodes > 0 and self.above == self.unequal == self.rises == 0


def attack(play: str, name: str, count: str, way: str, worlds: int, seed: int = 1) -> Total:
    found = list(PLAYS[play](LINES[name](), count, WAYS[way], seed, worlds))
    first, last, harm = (np.concatenate([getattr(each, key) for each in found]) for key in ("first", "last", "harm"))
    rises, decisions = sum(each.rises for each in found), sum(each.decisions for each in found)
    return Total(len(harm), decisions, int((~(harm <= first)).sum()), int((harm != last).sum()), rises)
