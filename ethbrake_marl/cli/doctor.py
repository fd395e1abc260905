"""The command ``doctor``: check this installation's versions and folders, and its physics on known results."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from ethbrake_marl import __version__
from ethbrake_marl.cli.command import JsonOption, Out
from ethbrake_marl.kernel_cache import UNSTORED, cache_folder, delete_damaged, obstacle

EXTRAS = ("train", "report", "marl", "export", "data", "render", "cluster", "tune", "cuda")

_TINY = ("--set=n_envs=16", "--set=n_steps=8", "--set=tried=16", "--set=evaluation.worlds=10")

_LINEUP = "ladder,ppo,ppo+episode,full_brake+step"

# Small calls of the usual commands, which compile the kernels that they use. The call with a single world compiles
# kernels for another memory layout.
_DOORS = (
    ("run", "--steps", "128", "--episodes", "20", "--output", "run", *_TINY),
    ("evaluate", "--agents", _LINEUP, "--episodes", "20"),
    ("evaluate", "--agents", "full_brake,ppo+episode,full_brake+step", "--episodes", "1"),
)

_IN_PYTHON = """
import ethbrake_marl as eb
for reward in ("honest", "shaped"):
    env = eb.parallel_env(agents="learners", reward=reward)
    env.reset(seed=0)
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
"""

_PACKAGE = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, slots=True)
class Check:
    name: str  # name of the checked item, such as a package
    ok: bool  # whether the check succeeded
    detail: str  # version, folder or error, for the user


def diagnose(*, compile_all: bool = False) -> list[Check]:
    """Results of all checks, in the order in which the user should solve problems.

    ``compile_all``: also compile the numba kernels (``compile_ahead``).
    """
    has_torch = find_spec("torch") is not None
    return [
        Check("ethbrake_marl", True, f"{__version__} in {_PACKAGE}"),
        Check("python", True, f"{platform.python_version()} at {sys.executable}"),
        *dict.fromkeys(_dependencies()),  # torch once: two extras install it
        _check("processor", _processor),
        _check("kernel cache", _kernel_cache),
        *([_check("compile", lambda: compile_ahead(training=has_torch))] if compile_all else []),
        _check("scenarios", _scenarios),
        _check("physics", _golden_impact),
        _check("baseline", _golden_baseline),
    ]


def _check(name: str, look: Callable[[], tuple[bool, str]]) -> Check:
    try:
        return Check(name, *look())
    except Exception as error:
        return Check(name, False, f"{type(error).__name__}: {error}")


def _dependencies() -> Iterator[Check]:
    """Check that each required package is installed, in a version that fits; and those of the extras."""
    from packaging.requirements import Requirement

    from ethbrake_marl.faces.rendering import RENDERERS, why_not

    requirements = [Requirement(line) for line in requires("ethbrake-marl") or []]
    groups = {extra: [r for r in requirements if r.marker and r.marker.evaluate({"extra": extra})] for extra in EXTRAS}
    for extra, needed in {"": [r for r in requirements if r.marker is None], **groups}.items():
        for requirement in needed:
            # The package pygame has a module of the same name, and the last one installed is there.
            is_checked = requirement.name == "pygame-ce" and "human" in RENDERERS and find_spec("pygame") is not None
            if is_checked and (reason := why_not("human")):
                yield Check(requirement.name, False, reason)
                continue
            try:
                installed = version(requirement.name)
            except PackageNotFoundError:
                why = f"the extra {extra} installs it" if extra else f"needs {requirement.specifier}"
                yield Check(requirement.name, bool(extra), f"is not installed; {why}")
                continue
            fits = requirement.specifier.contains(installed, prereleases=True)
            yield Check(requirement.name, fits, installed if fits else f"{installed}; needs {requirement.specifier}")


def _processor() -> tuple[bool, str]:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    return True, f"{usable} of {os.cpu_count()} cores usable; OMP_NUM_THREADS {threads}; training uses one torch thread"


def _kernel_cache() -> tuple[bool, str]:
    reason, (damaged, remaining) = obstacle(), delete_damaged()
    notes = f"; damaged files: {damaged}, of which {damaged - remaining} are deleted now" if damaged else ""
    return not remaining, (f"{reason}; {UNSTORED}" if reason else str(cache_folder())) + notes


def _scenarios() -> tuple[bool, str]:
    from ethbrake_marl.worlds.catalogue import list_scenarios, shipped_folder

    shipped = [entry for entry in list_scenarios() if entry.shipped]
    return len(shipped) > 0, f"{len(shipped)} in {shipped_folder()}"


def _golden_impact() -> tuple[bool, str]:
    """Check the physics: a car at 10 m/s, 8 m behind a standing car, brakes with 5 m/s2.

    The exact harm, the square of the impact speed, is ``10^2 - 2 * 5 * 8 = 20`` m2/s2.
    """
    from ethbrake_marl.agent_names import make_teams, open_game
    from ethbrake_marl.agents.team import play_to_end
    from ethbrake_marl.worlds.user_worlds import worlds_from_state

    scenario, game = open_game(
        {
            "name": "check", "vehicles": 2, "gaps_m": 8, "speeds_mps": [0, 10], "braking_capacity_mps2": 5,
            "driving_capacity_mps2": 5, "latency_s": 0, "mass_t": 5,
        }
    )  # fmt: skip
    team = make_teams("full_brake", scenario)["full_brake"]
    harm = float(play_to_end(game, worlds_from_state(scenario, {}), team).harm("total")[0])
    text = f"car at 10 m/s, braking with 5 m/s2, 8 m behind a standing car: harm {harm:.9g} (exact: 20)"
    return abs(harm - 20.0) < 1e-9, text


def _golden_baseline() -> tuple[bool, str]:
    """Check the baseline E-V2X-BM in the paper's distance scenario with gaps of 7 m and 7 m.

    The known result is a deceleration of 5.17021 m/s2 and a harm of 4.03447 m2/s2.
    """
    from ethbrake_marl.agents.pairwise import pairwise
    from ethbrake_marl.worlds.catalogue import load_scenario
    from ethbrake_marl.worlds.user_worlds import worlds_from_state

    scenario = load_scenario("paper-distance").replace(gaps_m=7.0)
    best = pairwise(worlds_from_state(scenario, {}), 2)
    computed = f"{float(best.deceleration_mps2[0]):.6g} m/s2, harm {float(best.harm[0]):.6g}"
    expected = "5.17021 m/s2, harm 4.03447"
    return computed == expected, f"E-V2X-BM with gaps of 7 m and 7 m: {computed} (known result: {expected})"


def compile_ahead(*, training: bool) -> tuple[bool, str]:
    """Compile and store the numba kernels of the usual commands, by running these commands on a few worlds.

    ``training``: also run ``ethbrake run``, which needs torch. Returns whether all commands succeeded, and a message
    for the user.
    """
    if reason := obstacle():
        return False, f"{reason}; {UNSTORED}"
    begun = perf_counter()
    doors = [("-m", "ethbrake_marl", *door) for door in _DOORS if training or door[0] != "run"]
    with tempfile.TemporaryDirectory() as folder:
        failed = [reason for door in [*doors, ("-c", _IN_PYTHON)] if (reason := _call(door, folder))]
    return not failed, "; ".join(failed) or f"all kernels compiled in {perf_counter() - begun:.0f} s"


def _call(arguments: tuple[str, ...], folder: str) -> str:
    process = subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    return (process.stderr.strip().splitlines() or [f"status {process.returncode}"])[-1] if process.returncode else ""


def doctor_command(
    compile_all: Annotated[
        bool, typer.Option("--compile", help="Compile the physics now, so that no later command has to wait for it.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check this installation: versions, folders, physics.

    Prints one line per check, with OK or FAIL. The exit status is 1 if a check failed.
    """
    with Out(as_json=as_json) as out:
        checks = diagnose(compile_all=compile_all)
        width = max(len(check.name) for check in checks)
        lines = (f"{'OK' if check.ok else 'FAIL':4}  {check.name:{width}}  {check.detail}" for check in checks)
        out.result([asdict(check) for check in checks], *lines)
        if not all(check.ok for check in checks):
            raise typer.Exit(1)
