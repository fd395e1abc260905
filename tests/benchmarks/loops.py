"""What ``make bench-peers`` measures: this project and other simulators, in one loop. Run by ``peers.py``.

``python tests/benchmarks/loops.py NAME`` prints one line of JSON: the version of what was measured, and its rates. Each
name runs in a process of its own, in whatever environment holds the simulator, hence the imports inside functions.
Work is counted per second of this process's processor time, all its threads together.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import NamedTuple

# One thread for every library, before any of them is imported: threads that wait also cost processor time.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
for _threads in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_threads] = "1"

Work = Callable[[], int]  # does some work and says how many worlds it advanced by a step

REPETITIONS, SECONDS = 5, 1.0


def rates(work: Work, repetitions: int = REPETITIONS, seconds: float = SECONDS) -> list[float]:
    """Units of work per second of processor time, ascending; the first round does not count."""
    work()
    found = []
    for _ in range(repetitions):
        done, spent, begin = 0, 0.0, time.process_time()
        while spent < seconds:
            done += work()
            spent = time.process_time() - begin
        found.append(done / spent)
    return sorted(found)


def our_parallel() -> Work:
    """This project: one world through PettingZoo's parallel API."""
    from ethbrake_marl.studies import speed as benchmark

    return benchmark.parallel(1)


def our_vec_env() -> Work:
    """This project: 512 worlds through the Stable-Baselines3 ``VecEnv``."""
    from ethbrake_marl.studies import speed as benchmark

    return benchmark.vec_env(512)


def our_engine() -> Work:
    """This project: 4,096 worlds in the engine."""
    from ethbrake_marl.studies import speed as benchmark

    return benchmark.stepping(4096)


def highway_env(vehicles: int) -> Work:
    """highway-v0, the ego vehicle and others on one lane; one step is one decision (1 s: 15 steps of the dynamics)."""
    import gymnasium
    import highway_env  # noqa: F401  # registers its environments

    config = {"lanes_count": 1, "vehicles_count": vehicles - 1, "duration": 40}
    environment = gymnasium.make("highway-v0", config=config)
    environment.reset(seed=7)

    def work() -> int:
        for _ in range(10):
            *_, terminated, truncated, _ = environment.step(1)
            if terminated or truncated:
                environment.reset()
        return 10

    return work


def mpe2_parallel() -> Work:
    """simple_spread with three agents through PettingZoo's parallel API, resets included."""
    from mpe2 import simple_spread_v3

    environment = simple_spread_v3.parallel_env(N=3)
    environment.reset(seed=7)

    def work() -> int:
        environment.reset()
        steps = 0
        while environment.agents:
            environment.step(dict.fromkeys(environment.agents, 1))
            steps += 1
        return steps

    return work


def supersuit_mpe2(n: int) -> Work:
    """The same, n copies as one vector environment by SuperSuit in one process."""
    import numpy
    import supersuit
    from mpe2 import simple_spread_v3

    single = supersuit.pettingzoo_env_to_vec_env_v1(simple_spread_v3.parallel_env(N=3))
    environment = supersuit.concat_vec_envs_v1(single, n, num_cpus=0, base_class="gymnasium")
    environment.reset(seed=7)
    actions = numpy.ones(3 * n, numpy.int64)

    def work() -> int:
        for _ in range(10):
            environment.step(actions)
        return 10 * n

    return work


def vmas(n: int) -> Work:
    """VMAS's simple_spread with three agents, n worlds in one batch on the processor; a reset every 100 steps."""
    import torch
    import vmas as simulator

    torch.set_num_threads(1)
    environment = simulator.make_env("simple_spread", num_envs=n, n_agents=3, device="cpu", seed=7)
    actions = [torch.zeros(n, 2) for _ in range(3)]

    def work() -> int:
        environment.reset()
        for _ in range(100):
            environment.step(actions)
        return 100 * n

    return work


def gymnax_cartpole(n: int) -> Work:
    """CartPole in jax, n worlds, 100 steps with automatic resets compiled as one loop."""
    import gymnax
    import jax

    environment, params = gymnax.make("CartPole-v1")
    keys = jax.random.split(jax.random.key(7), n)
    _, state = jax.vmap(environment.reset, (0, None))(keys, params)
    actions = jax.numpy.ones(n, jax.numpy.int32)

    def one(state: object, key: object) -> tuple[object, object]:
        many = jax.random.split(key, n)
        observation, state, reward, *_ = jax.vmap(environment.step, (0, 0, 0, None))(many, state, actions, params)
        return state, (observation.sum(), reward.sum())

    run = jax.jit(lambda state: jax.lax.scan(one, state, jax.random.split(jax.random.key(8), 100)))

    def work() -> int:
        jax.block_until_ready(run(state))
        return 100 * n

    return work


class Loop(NamedTuple):
    """Something to measure."""

    distribution: str
    what: str
    make: Callable[[], Work]
    beside: str | None = None  # the name of our loop to compare with; None: it is one of ours


OURS = "ethbrake-marl"
LOOPS: dict[str, Loop] = {
    "parallel": Loop(OURS, "PettingZoo parallel, one world", our_parallel),
    "vec-env": Loop(OURS, "Stable-Baselines3 VecEnv, n = 512", our_vec_env),
    "engine": Loop(OURS, "engine step, n = 4,096", our_engine),
    "highway-3": Loop("highway-env", "highway-v0, 3 vehicles, Gymnasium", lambda: highway_env(3), "parallel"),
    "highway-50": Loop("highway-env", "highway-v0, 50 vehicles, Gymnasium", lambda: highway_env(50), "parallel"),
    "mpe2": Loop("mpe2", "simple_spread, PettingZoo parallel", mpe2_parallel, "parallel"),
    "supersuit": Loop("supersuit", "mpe2 simple_spread, 64 copies", lambda: supersuit_mpe2(64), "vec-env"),
    "vmas-1024": Loop("vmas", "simple_spread, n = 1,024", lambda: vmas(1024), "engine"),
    "vmas-30000": Loop("vmas", "simple_spread, n = 30,000", lambda: vmas(30_000), "engine"),
    "gymnax": Loop("gymnax", "CartPole, n = 4,096", lambda: gymnax_cartpole(4096), "engine"),
}


def main(name: str) -> None:
    """Measure one loop and print what was found."""
    loop = LOOPS[name]
    print(json.dumps({"version": version(loop.distribution), "rates": rates(loop.make())}))


if __name__ == "__main__":
    main(sys.argv[1])
