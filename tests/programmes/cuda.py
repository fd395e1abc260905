"""On a GPU, in fifteen minutes: all tests of the extension, the bits of a processor, speed and training.

If all is good, it writes the table of docs/libraries.md. Without a GPU the same code runs on a processor, and
nothing is written.

A GPU needs torch alone if the folder of the machine code (``NUMBA_CACHE_DIR``) comes from a machine with numba-cuda
on which ``--only "machine code"`` has filled it: the kernels are compiled there for the GPU ``--capability``.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from datetime import date
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch

import ethbrake_marl as eb
from ethbrake_marl.extensions.cuda.device import empty_arrays
from ethbrake_marl.extensions.cuda.machine_code import ptx_of
from ethbrake_marl.extensions.cuda.worlds import Worlds
from tests.extensions.cuda.test_worlds import SIX, whole_episodes
from tests.programmes import ROOT, Cases, Given, Told, watched

LIMIT_S = 900.0  # no case begins later
PAGE, HEADING = "docs/libraries.md", "## How fast\n"
UNTRIED = {  # file -> what it says until this programme has run on a GPU
    "README.md": " It is experimental: only a prototype has run on a GPU, in November 2026.",
    PAGE: "Experimental: not run on a GPU since a prototype in November 2026.\n\n",
}
OPTIONS = {
    "--device": {"default": "cuda" if torch.cuda.is_available() else "cpu"},
    "--worlds": {"type": int, "default": 20_000, "help": "in which bits are compared"},
    "--capability": {"default": "9.0", "help": "of the GPU for which code is made"},
}


def cases(given: Given) -> Cases:
    given.until, found = min(given.until, time.monotonic() + LIMIT_S), dict[str, Told]()
    for name, run in checks(given):
        found[name] = Told(False)
        yield name, partial(noted, found, name, run)
    if given.device != "cpu":
        yield "table of the page", partial(write, found)


def noted(found: dict[str, Told], name: str, run: Callable[[], Told]) -> Told:
    found[name] = run()
    return found[name]


def checks(given: Given) -> Cases:
    yield "machine", partial(machine, given.device)
    yield "tests", partial(tested, given)
    for name in SIX.values():
        yield f"machine code: {name}", partial(code_of, name, given.capability)
    for kind, name in SIX.items():
        yield f"bits: {kind} ({name})", partial(same_bits, name, given)
    for name in SIX.values():
        yield f"speed: {name}", partial(speed, name, given.device)
    yield "vine", partial(trained, given)


def machine(device: str) -> Told:
    if device == "cpu":
        return Told(None, f"no GPU is used; torch {torch.__version__}")
    name, count = torch.cuda.get_device_name(device), torch.cuda.device_count()
    return Told(True, f"{name}, {count} of them, torch {torch.__version__}, CUDA {torch.version.cuda}")


def tested(given: Given) -> Told:
    """Run all tests of the extension, those that need a GPU and the twins on a processor, too."""
    command = (sys.executable, "-m", "pytest", "-q", "--all", "tests/extensions/cuda")
    status, told = watched(command, given.until - time.monotonic())
    return Told(status == 0, told.strip().rpartition("\n")[2] or "not finished in time")


def code_of(name: str, capability: str) -> Told:
    """Make the machine code, if there is a compiler, and keep it."""
    if find_spec("numba_cuda") is None:
        return Told(None, "numba-cuda is not installed")
    major, minor = (int(part) for part in capability.split("."))
    worlds = Worlds(name, 2, 4, "cpu")
    arguments = worlds.arguments(torch.zeros(2, len(worlds.game.settings.learners)), 0)
    code = ptx_of(worlds.kernel.name, worlds.kernel.thread, (*empty_arrays(arguments), 0), (major, minor))
    fused = code.count("fma.rn.f64")
    return Told(not fused, f"{worlds.kernel.name} {len(code) >> 10:,} KiB, {fused} fused multiply-adds")


def same_bits(name: str, given: Given) -> Told:
    decisions = whole_episodes(name, given.worlds, given.device)
    return Told(True, f"{given.worlds:,} whole episodes, {decisions:,} decisions, all bits the same")


def speed(name: str, device: str) -> Told:
    """Time bare steps with random actions; episodes that end are replaced."""
    parts = []
    for n in (1 << 14, 1 << 17, 1 << 20) if device != "cpu" else (1 << 12,):
        worlds = Worlds(name, n, 1 << 14, device)
        worlds.reset()
        actions = torch.rand(10, n, len(worlds.game.settings.learners), device=worlds.device) * 2.0 - 1.0
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


def write(found: dict[str, Told]) -> Told:
    """Write the table of the page, and take away what page and README say of a version that has not run on a GPU."""
    failed = [name for name, told in found.items() if told.good is False]
    if failed:
        return Told(False, f"not written: {', '.join(failed)} failed or did not run")
    for file, untried in UNTRIED.items():
        text = (ROOT / file).read_text("utf-8").replace(untried, "")
        (ROOT / file).write_text(with_table(text, found) if file == PAGE else text, "utf-8")
    return Told(True, f"written to {PAGE}")


def with_table(page: str, found: dict[str, Told]) -> str:
    """Page with a table of what was found in place of its last section."""
    rows = "\n".join(f"| {name} | {told.text} |" for name, told in found.items() if told.good)
    measured = f"Measured: {date.today()}, by `make programme NAME=cuda`."
    return f"{page.partition(HEADING)[0]}{HEADING}\n| check | result |\n|---|---|\n{rows}\n\n{measured}\n"
