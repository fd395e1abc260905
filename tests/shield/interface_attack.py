"""The same attack through every interface of the shield: what was realised against the bound at the alert."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from ethbrake_marl.agents.registry import drive
from ethbrake_marl.envs.interfaces import EthBrakeVectorEnv, parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.shield import HybridShield, ShieldedDriver, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from ethbrake_marl.shield.sb3 import ShieldedVecEnv
from tests.shield.lines import line

ROWS = 250  # worlds that batched interfaces advance together
Harms = tuple[list[float], list[float], int]  # realised, bound at the alert, decisions


class Proposals:
    """What is proposed, in every row its own way: at random, at the extremes, or one value held for some steps."""

    def __init__(self, seed: int, rows: int) -> None:
        self.rng, self.rows, self.held = np.random.default_rng(seed), rows, np.zeros(rows)

    def next(self) -> np.ndarray:
        drawn = self.rng.uniform(-1.0, 1.0, (3, self.rows))
        self.held = np.where(self.rng.random(self.rows) < 0.2, drawn[1], self.held)
        return np.choose(np.arange(self.rows) % 3, [drawn[0], np.sign(drawn[2]), self.held])


def parallel(worlds: int, seed: int) -> Harms:
    env = HybridShield(parallel_env(line(3)), mode="step")
    told: Harms = ([], [], 0)
    for k in range(worlds):
        env.reset(seed=seed + k)
        bound, proposals, steps = env.attached.shield.first_bound[0], Proposals(seed + k, 3), 0
        while env.agents:
            env.step({"vehicle_2": proposals.next()[[k % 3]]})
            steps += 1
        told = _with(told, env.unwrapped.engine, bound, steps)
    return told


def aec(worlds: int, seed: int) -> Harms:
    env = shielded_aec(parallel_env(line(3)), mode="step")
    shielded: Any = env
    while not isinstance(shielded, HybridShield):
        shielded = shielded.env
    told: Harms = ([], [], 0)
    for k in range(worlds):
        env.reset(seed=seed + k)
        bound, proposals, steps = shielded.attached.shield.first_bound[0], Proposals(seed + k, 3), 0
        for agent in env.agent_iter():
            *_, terminated, truncated, _ = env.last()
            env.step(None if terminated or truncated else proposals.next()[[k % 3]].astype(np.float32))
            steps += agent == "vehicle_2" and not (terminated or truncated)
        told = _with(told, shielded.unwrapped.engine, bound, steps)
    return told


def single(worlds: int, seed: int) -> Harms:
    env = ShieldedEnv(gymnasium.make("EthBrake-v0", scenario=line(3)).unwrapped)
    told: Harms = ([], [], 0)
    for k in range(worlds):
        env.reset(seed=seed + k)
        bound, proposals, steps, over = env.attached.shield.first_bound[0], Proposals(seed + k, 3), 0, False
        while not over:
            *_, terminated, truncated, _ = env.step(proposals.next()[[k % 3]])
            over, steps = terminated or truncated, steps + 1
        told = _with(told, env.attached.engine, bound, steps)
    return told


def vector(worlds: int, seed: int) -> Harms:
    env = ShieldedVectorEnv(EthBrakeVectorEnv(ROWS, line(3), autoreset_mode="SameStep"))
    env.reset(seed=seed)

    def step(actions: np.ndarray) -> tuple[np.ndarray, Any]:
        _, _, terminated, truncated, infos = env.step(actions)
        over = terminated | truncated
        return over, infos["final_info"]["world_first_impact_harm"][over] if over.any() else []

    return _batched(env.attached, step, worlds, seed)


def sb3(worlds: int, seed: int) -> Harms:
    env = ShieldedVecEnv(make_sb3_vec_env(line(3), ROWS, seed=seed))
    env.reset()

    def step(actions: np.ndarray) -> tuple[np.ndarray, Any]:
        _, _, over, infos = env.step(actions)
        return over, [infos[k]["world_first_impact_harm"] for k in np.flatnonzero(over)]

    return _batched(env.attached, step, worlds, seed)


class Proposing:
    """An agent of a batched evaluation; it drives by chance, so its rollouts say little about what it will do."""

    name = "proposing"

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def begin(self, alert: Any, vehicle: int, scripts: Any) -> Any:
        proposals = Proposals(self.seed, alert.n)
        return np.stack([proposals.next() for _ in range(200)], axis=1), np.zeros(alert.n, np.int64)

    def act(self, worlds: Any, memory: Any, vehicle: int) -> Any:
        proposals, step = memory
        share = proposals[np.arange(worlds.n), step % proposals.shape[1]]
        return share * worlds.vehicles.braking_capacity_mps2[:, vehicle], (proposals, step + 1)


def evaluation(worlds: int, seed: int) -> Harms:
    told: Harms = ([], [], 0)
    scenario = line(3)
    for first in range(0, worlds, ROWS):
        driver = ShieldedDriver(Proposing(seed + first), scenario)
        found = drive(scenario.sample(min(ROWS, worlds - first), seed, first=first).worlds, driver, scenario, 1)
        shield = found.guarded.shield
        realised, steps = found.ledger.world_harm("first").tolist(), int(shield.running.steps.sum())
        told = told[0] + realised, told[1] + shield.first_bound.tolist(), told[2] + steps
    return told


def _with(told: Harms, engine: Any, bound: float, steps: int) -> Harms:
    return [*told[0], float(engine.ledger.world_harm("first")[0])], [*told[1], float(bound)], told[2] + steps


def _batched(attached: Any, step: Any, worlds: int, seed: int) -> Harms:
    """An interface that renews its rows by itself: until so many episodes have ended."""
    realised: list[float] = []
    bounds: list[float] = []
    proposals, decisions = Proposals(seed, ROWS), 0
    while len(realised) < worlds:
        before = attached.shield.first_bound.copy()  # of the shield as it is now: each step puts another one in place
        over, harm = step(proposals.next()[:, np.newaxis].astype(np.float32))
        decisions += ROWS
        realised += [float(h) for h in harm]
        bounds += before[over].tolist()
    return realised, bounds, decisions


INTERFACES = {f.__name__: f for f in (parallel, aec, single, vector, sb3, evaluation)}
