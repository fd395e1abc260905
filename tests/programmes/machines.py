"""The same bits on other processors: computes recorded results again under settings of nine older processors.

It computes one hash per recorded result: worlds of every shipped scenario, physics, episodes with rewards and
observations, E-V2X-BM, searches, bounds, decisions of the shield, tallies, intervals and actions of policies. First it
uses this machine as it is. Then it uses one process per setting below, in which numpy, the C library, OpenBLAS or numba
behave as on an older processor.
"""

import hashlib
import json
import math
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ethbrake_marl import make_sb3_vec_env
from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.evaluation.chunks import Lineup, tally_list
from ethbrake_marl.evaluation.seeds import mean_over_seeds
from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.game.harm import injury_probability
from ethbrake_marl.policies.shipped import load_shipped, shipped_policies
from ethbrake_marl.scenario.catalogue import list_scenarios, load_scenario
from tests.golden.test_golden import SHIELDS, decisions_hash, figures, sampled
from tests.programmes import Cases, Given, Told, watched

SETTINGS: dict[str, dict[str, str]] = {
    "numpy without AVX-512": {"NPY_DISABLE_CPU_FEATURES": "X86_V4"},
    "numpy without AVX-512, AVX2, FMA": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3"},
    "C library without FMA, AVX2, AVX": {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-AVX"},
    "OpenBLAS for Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "OpenBLAS for Zen": {"OPENBLAS_CORETYPE": "Zen"},
    "all of these at once": {
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-AVX",
        "OPENBLAS_CORETYPE": "Nehalem",
    },
    "kernels for x86-64-v3": {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""},
    "kernels for x86-64-v2": {"NUMBA_CPU_NAME": "x86-64-v2", "NUMBA_CPU_FEATURES": ""},
    "kernels for x86-64": {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""},
}
HARD = ("stress-wide", "realistic-mixed", "paper-random")  # the distributions of the first two use our own functions


def digest(*columns: Any) -> str:
    """Return the first 16 digits of a hash of these arrays."""
    found = hashlib.sha256()
    for column in columns:
        found.update(np.ascontiguousarray(column).tobytes())
    return found.hexdigest()[:16]


def episodes() -> dict[str, str]:
    """Return hashes of observations and rewards for random actions, with all reward terms and an angle as objective."""
    reward = {"harm": 1.0, "risk": 1.0, "jerk": 1e-5, "collision": 1.0, "shaping": 1.0, "objective": "social:37"}
    found = {}
    for name in HARD:
        env, rng = make_sb3_vec_env(name, 32, seed=0, reward=reward), np.random.default_rng(0)
        columns = [env.reset()]
        for _ in range(40):
            observed, rewards, *_ = env.step(rng.uniform(-1, 1, (32, 1)).astype(np.float32))
            columns += [observed, rewards]
        found[f"episodes {name}"] = digest(*columns)
    return found


def searches() -> dict[str, str]:
    found = {}
    for name in HARD:
        scenario = load_scenario(name)
        worlds = scenario.sample(20, 7).worlds
        found[f"e_v2x_bm {name}"] = digest(*optimise_coupled(worlds, 1, harm_count="total"))
        best = best_harm(scenario, worlds, counts=("total",), budget=200, threads=1).best["total"]
        found[f"search {name}"] = digest(best.harm, *best.profiles)
        found[f"bound {name}"] = digest(lower_bound(worlds, 1, harm_count="total").harm)
    return found


def tallies() -> dict[str, str]:
    found = {}
    for name in HARD[:2]:
        lineup = Lineup.of(("full_brake", "e_v2x_bm", "universal"), load_scenario(name), harm_count="total")
        found[f"tally {name}"] = hashlib.sha256(repr(tally_list(lineup, 200, 11)).encode()).hexdigest()[:16]
    rng = np.random.default_rng(0)
    estimate = mean_over_seeds(rng.random((3, 400)), rng.random((3, 400)))
    found["interval over seeds"] = digest(estimate.value, estimate.interval)
    found["injury"] = digest(injury_probability(rng.uniform(-30, 30, 1_000), "front"))
    return found


def actions() -> dict[str, str]:
    rng, found = np.random.default_rng(0), {}
    for name in shipped_policies():
        policy = load_shipped(name)
        observed = rng.normal(size=(256, policy.manifest.network.observation_size)).astype(np.float32)
        found[f"policy {name}"] = digest(policy(observed))
    return found


KINDS: tuple[Callable[[], dict[str, str]], ...] = (
    lambda: {f"list {entry.name}": json.dumps(sampled(entry.name)) for entry in list_scenarios()},
    lambda: {"physics": str(figures("few")["sha256"])},
    episodes,
    searches,
    lambda: {f"shield {name}": decisions_hash(make()[0], 10) for name, make in SHIELDS.items()},
    tallies,
    actions,
)


TELL = "from tests.programmes import machines; machines.tell()"


OPTIONS = {"--sample": {"action": "store_true", "help": "skip settings that compile all kernels again"}}


def cases(given: Given) -> Cases:
    here: dict[str, str] = {}

    def differing(setting: dict[str, str]) -> Told:
        here.update(here or measured({}))
        found = measured(setting)
        other = [key for key in here if found[key] != here[key]]
        return Told(not other, ", ".join(other) or f"all {len(here)} hashes equal")

    for name, setting in SETTINGS.items():
        if not (given.sample and "NUMBA_CPU_NAME" in setting):
            yield name, partial(differing, setting)


def tell() -> None:
    """Print the hashes of this process as JSON."""
    print(json.dumps({name: value for kind in KINDS for name, value in kind().items()}))


def measured(setting: dict[str, str]) -> dict[str, str]:
    """Return all hashes, computed in a separate process with this ``setting``."""
    status, told = watched([sys.executable, "-c", TELL], math.inf, **setting)
    assert status == 0, f"exit status {status}\n{told}"
    return json.loads(told.splitlines()[-1])
