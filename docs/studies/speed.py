"""Speed of the package per second of processor time: ``python docs/studies/speed.py [--quick] [--json]``.

Every rate is a median over repetitions: work per second of this process's processor time, on one core, after a first
round that does not count (it compiles and fills caches). Other programs on the machine have little effect, because
only caches and memory are shared. ``relative`` is a rate of world-steps divided by the rate of the calibration in the
same run. The calibration is a very simple loop, whose rate depends almost only on the machine.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.files.sheet import Column, Sheet, terminal_text
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import Floats

SCENARIO = "paper-random"
SEED = 7
_VEHICLES = 3
STEP_S = 0.1
SHARE = 0.75  # a learner brakes with this share of its braking capacity
WORLD_STEPS = "world-steps/s"
MOST_STEPS = 1000  # limit, in case some world never comes to rest

Work = Callable[[], int]  # does some work, and returns its amount


class Effort(NamedTuple):
    """Effort per measurement: number of repetitions, and least processor seconds of each repetition."""

    repetitions: int
    seconds: float


QUICK = Effort(3, 0.1)
FULL = Effort(7, 0.4)


@dataclass(frozen=True, slots=True)
class Speed:
    """One measurement."""

    name: str
    workload: str
    worlds: int  # simulated together
    vehicles: int  # per world
    unit: str
    value: float  # median over repetitions
    lowest: float
    highest: float
    floor: float | None = None  # aim of the project: at least this rate, at most this number of seconds
    relative: float | None = None  # rate of world-steps / rate of the calibration


def rates(work: Work, effort: Effort) -> Floats:
    """Units of work per second of processor time, one value per repetition, ascending."""
    work()
    found = []
    for _ in range(effort.repetitions):
        done, spent, begin = 0, 0.0, time.process_time()
        while spent < effort.seconds:
            done += work()
            spent = time.process_time() - begin
        found.append(done / spent)
    return np.sort(found)


@dataclass(frozen=True, slots=True)
class Benchmark:
    name: str
    workload: str
    unit: str
    worlds: int
    floor: float | None
    look: Callable[[Effort], Floats]  # returns one value per repetition, ascending

    def measure(self, effort: Effort) -> Speed:
        """Run the measurement."""
        found = self.look(effort)
        low, middle, high = float(found[0]), float(np.median(found)), float(found[-1])
        return Speed(self.name, self.workload, self.worlds, _VEHICLES, self.unit, middle, low, high, self.floor)


def measure(*, quick: bool = False) -> list[Speed]:
    """Run all measurements of ``BENCHMARKS``, in order. The first one is the calibration, used for ``relative``."""
    found = [benchmark.measure(QUICK if quick else FULL) for benchmark in BENCHMARKS]
    first = found[0].value
    return [replace(speed, relative=speed.value / first) if speed.unit == WORLD_STEPS else speed for speed in found]


def braking(n: int, share: float) -> Work:
    """Steps from the first decision until all worlds are at rest; Vehicle 2 brakes with a share of its capacity."""
    scenario, game = eb.open_game(SCENARIO)
    return until_rest(game, game.reset(scenario.sample(n, SEED)), np.full((n, 1), -share))


def until_rest(game: eb.Game, begun: eb.State, actions: Floats) -> Work:
    """``Game.step``: motion, harm, rewards and ends of episodes, with constant actions, until all have ended.

    Only steps of running episodes count: a step of an episode that has ended costs almost nothing.
    """
    state, running = begun, []
    while not state.ended.all() and len(running) < MOST_STEPS:
        running.append(int((~state.ended).sum()))
        state, _ = game.step(state, actions)

    def work() -> int:
        now = begun
        for _ in running:
            now, _ = game.step(now, actions)
        return sum(running)

    return work


def stepping(n: int, steps: int = 100) -> Work:
    """Steps of all worlds: motion, harm, rewards, ends of episodes, the learner's observation, and new episodes."""
    _, game = eb.open_game(SCENARIO)
    state, actions = game.reset(game.draw(n, SEED, 0)), np.full((n, 1), -SHARE)
    first = n

    def work() -> int:
        nonlocal state, first
        for _ in range(steps):
            state, _ = game.step(state, actions, donate=True)
            rows = np.flatnonzero(state.ended)
            if len(rows):
                state = state.put(rows, game.reset(game.draw(len(rows), SEED, first)), donate=True)
                first += len(rows)
            game.observe(state, game.settings.learners)
        return steps * n

    return work


def vec_env(n: int, steps: int = 100) -> Work:
    """Steps of the Stable-Baselines3 ``VecEnv``: the engine's step, infos, and automatic new episodes."""
    environment = eb.make_sb3_vec_env(SCENARIO, n, seed=SEED, reward="honest")  # imports torch, hence only now
    environment.reset()
    actions = np.full((n, 1), -SHARE, np.float32)

    def work() -> int:
        for _ in range(steps):
            environment.step(actions)
        return steps * n

    return work


def parallel(n: int, episodes: int = 20) -> Work:
    """Whole episodes of one world (``n`` is 1) with PettingZoo's parallel API, including resets."""
    environment = eb.parallel_env(SCENARIO, agents="learners", reward="honest")
    actions = {name: np.array([-SHARE], np.float32) for name in environment.possible_agents}
    environment.reset(seed=SEED)

    def work() -> int:
        steps = 0
        for _ in range(episodes):
            environment.reset()
            while environment.agents:
                environment.step(actions)
                steps += 1
        return steps * n

    return work


def _sampling(n: int) -> Work:
    scenario = eb.load_scenario(SCENARIO)
    return lambda: scenario.sample(n, SEED).n


def _optimise(optimise: Callable[..., Any], n: int) -> Work:
    worlds = eb.load_scenario(SCENARIO).sample(n, SEED)
    return lambda: len(optimise(worlds, 2).harm)


def _forecast(n: int, candidates: int = 16) -> Work:
    scenario = eb.load_scenario(SCENARIO)
    worlds = scenario.sample(n, SEED)
    wanted = np.hstack([np.zeros((n, 1)), -worlds.braking_capacity_mps2])
    tried = (wanted[:, [2]] * np.linspace(0.0, 1.0, candidates))[:, :, np.newaxis]
    return lambda: eb.hold(worlds, wanted, [2], tried, scenario.horizon_s, "first")[0].size


def _calibration(n: int) -> Work:
    speeds, ways = np.full((n, 3), 20.0), np.zeros((n, 3))
    return lambda: int(brake_apart(speeds, ways, 1000))


@large
def brake_apart(speeds, ways, steps):
    """Run the calibration: vehicles brake independently, and restart when they are at rest. Return the world-steps."""
    for _ in range(steps):
        for k in range(speeds.shape[0]):
            for i in range(speeds.shape[1]):
                after = max(speeds[k, i] - 0.5, 0.0)
                ways[k, i] += 0.05 * (speeds[k, i] + after)
                speeds[k, i] = after if after > 0.0 else 20.0
    return steps * len(speeds)


_START = """
import ethbrake_marl
environment = ethbrake_marl.parallel_env(reward="honest")
environment.reset(seed=7)
environment.step({"vehicle_2": [-1.0]})
"""


def _start_seconds(effort: Effort) -> Floats:
    """Processor seconds of a new Python process that makes one world and steps it, with compiled kernels."""
    found = []
    for _ in range(effort.repetitions + 1):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", _START], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return np.sort(found[1:])


_BRAKING = "first decision to rest in steps of 0.1 s; Vehicle 2 brakes with {:.0%} of its capacity, all others fully"
_DRIVING = "Vehicle 2 brakes with 75% of its capacity; new episodes as old ones end"


def _rate_of(
    name: str, workload: str, make: Callable[[int], Work], n: int, floor: float | None = None, unit: str = WORLD_STEPS
) -> Benchmark:
    return Benchmark(name, workload, unit, n, floor, lambda effort: rates(make(n), effort))


# The calibration comes first, because other rates are divided by its rate.
BENCHMARKS: tuple[Benchmark, ...] = (
    _rate_of("calibration", "constant deceleration, no event", _calibration, 1024),
    *(
        _rate_of(f"step, {share:.0%}", _BRAKING.format(share), partial(braking, share=share), n, 15e6)
        for n in (1024, 4096)
        for share in (SHARE, 1.0)
    ),
    _rate_of("step with new episodes", _DRIVING, stepping, 1024, 8e6),
    _rate_of("step with new episodes", _DRIVING, stepping, 4096, 8e6),
    _rate_of("Stable-Baselines3 VecEnv", _DRIVING, vec_env, 512, 4e6),
    _rate_of("PettingZoo parallel", "whole episodes, resets included", parallel, 1, 80e3),
    Benchmark(
        "import and first step",
        "a fresh interpreter: import, parallel_env, reset, step; kernels compiled before",
        "s",
        1,
        2.0,
        _start_seconds,
    ),
    _rate_of("sampling", "a list of worlds, refused draws included", _sampling, 10_000, unit="worlds/s"),
    _rate_of("E-V2X-BM (pairwise)", "one optimum per world", partial(_optimise, pairwise), 10_000, unit="worlds/s"),
    _rate_of("E-V2X-BM (coupled)", "one optimum per world", partial(_optimise, coupled), 1000, unit="worlds/s"),
    _rate_of("hold", "16 constant commands per world, to the horizon", _forecast, 1000, unit="runs/s"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarser: about 20 s instead of one to two minutes")
    parser.add_argument("--json", action="store_true", help="print JSON")
    given = parser.parse_args()
    machine, figures = this_machine(), measure(quick=given.quick)
    if given.json:
        print(json.dumps({"machine": machine, "figures": [asdict(speed) for speed in figures]}, indent=2))
        return
    rows = [
        (
            *(speed.name, f"{speed.worlds:,}", f"{plain(speed.value)} {speed.unit.removesuffix('/s')}"),
            f"{plain(speed.lowest)} - {plain(speed.highest)}",
            "" if speed.relative is None else plain(speed.value * speed.vehicles),  # only for world-steps
            "" if speed.floor is None else plain(speed.floor),
        )
        for speed in figures
    ]
    columns: list[Column | str] = ["per CPU-second", *map(Column, ("worlds", "median", "range", "x vehicles", "aim"))]
    print(terminal_text(Sheet("", columns, rows)), end="")
    print("Medians and ranges over repetitions. Aim: at least this rate, at most this number of seconds.")
    print(f"Machine: {machine}")


def plain(value: float) -> str:
    """Number with three digits, and k for thousands, M for millions or G for billions."""
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if value >= size:
            return f"{value / size:#.3g}".removesuffix(".") + letter
    return f"{value:.3g}"


if __name__ == "__main__":
    main()
