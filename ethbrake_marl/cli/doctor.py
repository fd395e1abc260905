"""The command ``doctor``: check this installation's versions and folders, and its physics on known results."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import typer

from ethbrake_marl import __version__
from ethbrake_marl.cli.command import JsonOption, Out
from ethbrake_marl.errors import EXTRA_OF
from ethbrake_marl.kernel_cache import UNSTORED, cache_folder, delete_damaged, obstacle
from ethbrake_marl.parallel import VARIABLE, chosen_threads, usable_cores

_PACKAGE = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, slots=True)
class Check:
    name: str  # name of the checked item, such as a package
    ok: bool  # whether the check succeeded
    detail: str  # version, folder or error, for the user


def diagnose() -> list[Check]:
    return [
        Check("ethbrake_marl", True, f"{__version__} in {_PACKAGE}"),
        Check("python", True, f"{platform.python_version()} at {sys.executable}"),
        *_dependencies(),
        _check("processor", _processor),
        _check("kernel cache", _kernel_cache),
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
    """Packages of extras may be missing."""
    from packaging.requirements import Requirement

    for requirement in map(Requirement, requires("ethbrake-marl") or []):
        marker = requirement.marker
        is_optional = marker is not None and any(marker.evaluate({"extra": each}) for each in EXTRA_OF.values())
        if marker and not is_optional:  # for development, or for another Python
            continue
        try:
            installed = version(requirement.name)
        except PackageNotFoundError:
            yield Check(requirement.name, is_optional, f"is not installed; needs {requirement.specifier}")
            continue
        fits = requirement.specifier.contains(installed, prereleases=True)
        yield Check(requirement.name, fits, installed if fits else f"{installed}; needs {requirement.specifier}")


def _processor() -> tuple[bool, str]:
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    return True, (
        f"{usable_cores()} of {os.cpu_count()} cores usable; {chosen_threads(None)} used unless you ask for more"
        f" (--jobs, {VARIABLE}); OMP_NUM_THREADS {threads}; training uses one torch thread"
    )


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


def doctor_command(as_json: JsonOption = False) -> None:
    """Check this installation: versions, folders, physics.

    Prints one line per check, with OK or FAIL. The exit status is 1 if a check failed.
    """
    with Out(as_json=as_json) as out:
        checks = diagnose()
        width = max(len(check.name) for check in checks)
        lines = (f"{'OK' if check.ok else 'FAIL':4}  {check.name:{width}}  {check.detail}" for check in checks)
        out.result([asdict(check) for check in checks], *lines)
        if not all(check.ok for check in checks):
            raise typer.Exit(1)
