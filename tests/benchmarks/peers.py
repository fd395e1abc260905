"""Speed of other simulators, measured as ``ethbrake bench`` measures ours: work per second of processor time.

Runs in an environment of its own, without this project in it: docs/speed.md says how. Prints one line for each, also
for those that are not installed. The time of all threads counts, so the figures are per second of one core.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

Work = Callable[[], int]

REPETITIONS, SECONDS = 5, 1.0


def rates(work: Work) -> list[float]:
    """Units of work per second of processor time, ascending; the first round does not count."""
    work()
    found = []
    for _ in range(REPETITIONS):
        done, spent, begin = 0, 0.0, time.process_time()
        while spent < SECONDS:
            done += work()
            spent = time.process_time() - begin
        found.append(done / spent)
    return sorted(found)


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


SINGLE, MANY, BATCH = "PettingZoo parallel", "Stable-Baselines3 VecEnv", "engine step"

# distribution, what is stepped, our figure to compare with, how to make it
PEERS: tuple[tuple[str, str, str, Callable[[], Work]], ...] = (
    ("highway-env", "highway-v0, 3 vehicles", SINGLE, lambda: highway_env(3)),
    ("highway-env", "highway-v0, 50 vehicles", SINGLE, lambda: highway_env(50)),
    ("mpe2", "simple_spread, 3 agents, PettingZoo parallel", SINGLE, mpe2_parallel),
    ("supersuit", "mpe2 simple_spread, 3 agents, 64 copies", MANY, lambda: supersuit_mpe2(64)),
    ("vmas", "simple_spread, 3 agents, n = 1,024", BATCH, lambda: vmas(1024)),
    ("vmas", "simple_spread, 3 agents, n = 30,000", BATCH, lambda: vmas(30_000)),
    ("gymnax", "CartPole, n = 4,096", BATCH, lambda: gymnax_cartpole(4096)),
)


def our_rates(file: str | None) -> dict[str, float]:
    """Our rates of world-steps by name, from the output of ``ethbrake bench --json``; the last of equal names."""
    if file is None:
        return {}
    figures = json.loads(Path(file).read_text("utf-8"))["figures"]
    return {figure["name"]: figure["value"] for figure in figures}


def main() -> None:
    """Measure every peer that is installed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ours", metavar="FILE", help="output of `ethbrake bench --json`: print ratios, too")
    parser.add_argument("--only", metavar="NAME", action="append", help="measure this distribution alone")
    arguments = parser.parse_args()
    ours = our_rates(arguments.ours)
    for distribution, what, counterpart, make in PEERS:
        if arguments.only and distribution not in arguments.only:
            continue
        try:
            name = f"{distribution} {version(distribution)}"
        except PackageNotFoundError:
            print(f"{distribution:19} {what:45} not installed", flush=True)
            continue
        found = rates(make())
        middle = statistics.median(found)
        line = f"{name:19} {what:45} {middle:13,.0f} world-steps/s ({found[0]:,.0f} - {found[-1]:,.0f})"
        if counterpart in ours:
            ratio = ours[counterpart] / middle
            line += (
                f"; ours ({counterpart}): {ratio:,.0f} times"
                if ratio > 20
                else f"; ours ({counterpart}): {ratio:.2g} times"
            )
        print(line, flush=True)


if __name__ == "__main__":
    main()
