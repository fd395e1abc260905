"""On a GPU: the bits of a processor, speed, search and training. Without one the same code runs on a processor.

A GPU needs torch alone if the folder of the machine code (``NUMBA_CACHE_DIR``) comes from a machine with numba-cuda
on which ``--only "machine code"`` has filled it: the kernels are compiled there for the GPU ``--capability``.
"""

from __future__ import annotations

import tempfile
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch

import ethbrake_marl as eb
from ethbrake_marl.extensions.cuda.device import like
from ethbrake_marl.extensions.cuda.machine_code import ptx_of
from ethbrake_marl.extensions.cuda.profiles import search, searched_worlds, started
from ethbrake_marl.extensions.cuda.worlds import Worlds
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.search import PROFILES
from tests.extensions.cuda.test_worlds import SIX, whole_episodes
from tests.programmes import Cases, Given, Told

OPTIONS = {
    "--device": {"default": "cuda" if torch.cuda.is_available() else "cpu"},
    "--worlds": {"type": int, "default": 20_000, "help": "in which bits are compared"},
    "--capability": {"default": "9.0", "help": "of the GPU for which code is made"},
}


def cases(given: Given) -> Cases:
    yield "machine", partial(machine, given.device)
    for name in SIX.values():
        yield f"machine code: {name}", partial(code_of, name, given.capability)
    for kind, name in SIX.items():
        yield f"bits: {kind} ({name})", partial(same_bits, name, given)
    for name in SIX.values():
        yield f"speed: {name}", partial(speed, name, given.device)
    for restarts, rounds in ((2, 1), (4, 2), (16, 4)):
        yield f"search: {restarts} threads a world, {rounds} rounds", partial(searched, restarts, rounds, given.device)
    yield "vine", partial(trained, given)


def machine(device: str) -> Told:
    if device == "cpu":
        return Told(None, f"no GPU is used; torch {torch.__version__}")
    name, count = torch.cuda.get_device_name(device), torch.cuda.device_count()
    return Told(True, f"{name}, {count} of them, torch {torch.__version__}, CUDA {torch.version.cuda}")


def code_of(name: str, capability: str) -> Told:
    """Make the code of both kernels, if there is a compiler, and keep it."""
    if find_spec("numba_cuda") is None:
        return Told(None, "numba-cuda is not installed")
    major, minor = (int(part) for part in capability.split("."))
    scenario, game = eb.open_game(name)
    worlds = Worlds(scenario, 2, 4, "cpu")
    problem = problem_of(game, scenario.sample(2, seed=7), [int(game.rules.learners[0])])
    actions = torch.zeros(2, len(game.rules.learners))
    on, sizes = torch.device("cpu"), []
    asked, kernel = searched_worlds(problem, on)
    plans = started(problem, None, 2, 0, on)
    for each, arguments in (
        (worlds.kernel, worlds.arguments(actions, 0)),
        (kernel, (asked, plans, torch.from_numpy(PROFILES.copy()), 1, 1)),
    ):
        code = ptx_of(each.name, each.thread, (*like(arguments), 0), (major, minor))
        sizes.append(f"{each.name} {len(code) >> 10:,} KiB, {code.count('fma.rn.f64')} fused multiply-adds")
        if "fma.rn.f64" in code:
            return Told(False, "; ".join(sizes))
    return Told(True, "; ".join(sizes))


def same_bits(name: str, given: Given) -> Told:
    decisions = whole_episodes(name, given.worlds, given.device)
    return Told(True, f"{given.worlds:,} whole episodes, {decisions:,} decisions, all bits the same")


def speed(name: str, device: str) -> Told:
    """Time bare steps with random actions; episodes that end are replaced."""
    parts = []
    for n in (1 << 14, 1 << 17, 1 << 20) if device != "cpu" else (1 << 12,):
        worlds = Worlds(name, n, 1 << 14, device)
        worlds.reset()
        actions = torch.rand(10, n, len(worlds.game.rules.learners), device=worlds.device) * 2.0 - 1.0
        seconds = []
        for _ in range(5):
            wait(device)
            begun = time.perf_counter()
            for action in actions:
                worlds.step(action)
            wait(device)
            seconds.append(time.perf_counter() - begun)
        worlds.check()
        parts.append(f"{n:,} worlds {10 * n / min(seconds) / 1e6:,.1f} M steps/s")
    return Told(True, ", ".join(parts))


def searched(restarts: int, rounds: int, device: str) -> Told:
    scenario, game = eb.open_game("paper-random")
    n = 10_000 if device != "cpu" else 500
    problem = problem_of(game, scenario.sample(n, seed=7))
    asked = {"restarts": restarts, "device": device}
    search(problem.take(slice(0, 1)), rounds=1, drawn=1, changes=1, **asked)
    wait(device)
    begun = time.perf_counter()
    _, values = search(problem, rounds=rounds, **asked)
    return Told(True, f"{n:,} worlds, mean {values['first'].mean():.4f} after {time.perf_counter() - begun:.2f} s")


def trained(given: Given) -> Told:
    """Train a policy by the recipe for a GPU, and evaluate it on 1,000 worlds."""
    with tempfile.TemporaryDirectory() as folder:
        small = {"n_envs": 256, "tried": 256, "batch_size": 64, "total_steps": 100_000}
        recipe = eb.load_recipe("quick-cuda").replace(**small if given.device == "cpu" else {})
        begun = time.perf_counter()
        result = eb.train(recipe, "paper-random", Path(folder) / "run", device=given.device, on_progress=None)
        took = time.perf_counter() - begun
        harm = eb.evaluate(scenario="paper-random", agents=result.agent, episodes=1000, seed=7)
        table = str(eb.summarise(harm)).splitlines()
    return Told(True, f"{result.steps:,} decisions in {took:.1f} s; {table[-1]}")


def wait(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize(device)
