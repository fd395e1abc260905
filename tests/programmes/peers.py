"""Speed of other simulators and of this one, measured with the same loop on this machine.

Each other simulator has its own environment in ``.venvs/``, because some have licences or dependencies that this
project does not want. If one cannot be installed or measured, the reason is printed. A rate is work per second of
processor time (all threads) of a process that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from tests.docs.site import load
from tests.programmes import Cases, Given, NotInstalled, Told, ready_python, watched

Work = Callable[[], int]  # does some work and says how many worlds it advanced by a step

REPETITIONS, SECONDS = 5, 1.0
MOST_SECONDS = 900.0  # that a measurement may take
VERSIONS = Path(__file__).with_name("peers.txt")
SETTINGS = {  # one thread for every library: threads that wait also cost processor time
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
}


def rates(work: Work, repetitions: int = REPETITIONS, seconds: float = SECONDS) -> list[float]:
    """Units of work per second of processor time, ascending. The first round does not count."""
    work()
    found = []
    for _ in range(repetitions):
        done, spent, begin = 0, 0.0, time.process_time()
        while spent < seconds:
            done += work()
            spent = time.process_time() - begin
        found.append(done / spent)
    return sorted(found)


def ours(name: str, n: int) -> Work:
    """Loop of ``docs/studies/speed.py``."""
    work: Work = getattr(load("../studies/speed"), name)(n)
    return work


def highway_env(vehicles: int) -> Work:
    """highway-v0 with other vehicles on one lane; one step is one decision (1 s, 15 steps of the motion)."""
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
    """simple_spread with three agents, with PettingZoo's parallel API, including resets."""
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
    """simple_spread, n copies as one vector environment of SuperSuit in one process."""
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
    """CartPole in jax, n worlds; 100 steps with automatic resets are compiled as one loop."""
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
    """A loop that can be measured."""

    distribution: str
    what: str
    make: Callable[[], Work]
    beside: str = ""  # the name of our loop to compare with; empty: it is one of ours


OURS = "ethbrake-marl"
LOOPS: dict[str, Loop] = {
    "parallel": Loop(OURS, "PettingZoo parallel, one world", partial(ours, "parallel", 1)),
    "vec-env": Loop(OURS, "Stable-Baselines3 VecEnv, n = 512", partial(ours, "vec_env", 512)),
    "engine": Loop(OURS, "engine step, n = 4,096", partial(ours, "stepping", 4096)),
    "highway-3": Loop("highway-env", "highway-v0, 3 vehicles, Gymnasium", partial(highway_env, 3), "parallel"),
    "highway-50": Loop("highway-env", "highway-v0, 50 vehicles, Gymnasium", partial(highway_env, 50), "parallel"),
    "mpe2": Loop("mpe2", "simple_spread, PettingZoo parallel", mpe2_parallel, "parallel"),
    "supersuit": Loop("supersuit", "mpe2 simple_spread, 64 copies", partial(supersuit_mpe2, 64), "vec-env"),
    "vmas-1024": Loop("vmas", "simple_spread, n = 1,024", partial(vmas, 1024), "engine"),
    "vmas-30000": Loop("vmas", "simple_spread, n = 30,000", partial(vmas, 30_000), "engine"),
    "gymnax": Loop("gymnax", "CartPole, n = 4,096", partial(gymnax_cartpole, 4096), "engine"),
}
NEEDS = {"supersuit": ("supersuit", "mpe2")}  # what a peer's environment holds beside it


def tell(name: str) -> None:
    """Measure one loop in this process, and print its rates as JSON."""
    loop = LOOPS[name]
    print(json.dumps({"version": version(loop.distribution), "rates": rates(loop.make())}))


def measured(name: str, medians: dict[str, float]) -> Told:
    """Report the rate of a loop; for another simulator also how many times faster our loop is."""
    loop = LOOPS[name]
    pins = ["-c", str(VERSIONS)]
    try:
        python = Path(sys.executable)
        if loop.distribution != OURS:
            holds = NEEDS.get(loop.distribution, (loop.distribution,))
            python = ready_python(holds[-1], [*pins, *holds], project=False, torch=loop.distribution == "vmas")
    except NotInstalled as reason:
        return Told(None, f"not installed: {reason}")
    status, told = watched([str(python), "-m", "tests.programmes.peers", name], MOST_SECONDS, **SETTINGS)
    last = (told.strip().splitlines() or [""])[-1]
    if status != 0:
        return Told(None, f"not measured: {last or f'ended with status {status}'}")
    found = json.loads(last)
    medians[name] = statistics.median(found["rates"])
    text = f"{found['version']}   {plain(medians[name])}   {plain(found['rates'][0])} - {plain(found['rates'][-1])}"
    beside = f"   ours: {plain(medians[loop.beside] / medians[name])} x" if loop.beside in medians else ""
    return Told(True, text + beside)


def plain(value: float) -> str:
    """Number with three digits, and with commas from 1,000 on."""
    return f"{float(f'{value:.3g}'):,.{0 if value >= 99.95 else 1 if value >= 9.995 else 2}f}"


def cases(given: Given) -> Cases:
    """Yield all loops: world-steps per second of processor time, as median, lowest and highest of ``REPETITIONS``."""
    medians: dict[str, float] = {}
    for name, loop in LOOPS.items():
        yield f"{name}: {loop.distribution}, {loop.what}", partial(measured, name, medians)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=[*LOOPS], help="simulator")
    tell(parser.parse_args().name)
