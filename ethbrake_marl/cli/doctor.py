"""The command ``doctor``: versions, the cache of compiled physics, and one impact whose harm is known."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import typer

from ethbrake_marl import __version__
from ethbrake_marl.cli.command import JsonOption, Out
from ethbrake_marl.errors import EXTRA_OF
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.kernel_cache import cache_fault, cache_folder

Check = tuple[str, bool, str]  # what is checked, whether it is in order, and its version, folder or fault


def doctor_command(as_json: JsonOption = False) -> None:
    """Check versions, the cache of compiled physics, and one impact.

    The exit status is 1 if a check failed.
    """
    with Out(as_json=as_json) as out:
        checks = [*_versions(), ("kernel cache", not cache_fault(), cache_fault() or str(cache_folder())), _impact()]
        rows = [(name, "OK" if ok else "FAIL", detail) for name, ok, detail in checks]
        content = [{"name": name, "ok": ok, "detail": detail} for name, ok, detail in checks]
        out.result(content, Sheet("", ("Check", "State", "Detail"), rows, gap=2))
        if not all(ok for _, ok, _ in checks):
            raise typer.Exit(1)


def _versions() -> Iterator[Check]:
    """Packages of extras may be missing."""
    from packaging.requirements import Requirement

    yield "ethbrake_marl", True, f"{__version__} in {Path(__file__).parents[1]}"
    yield "python", True, f"{sys.version.partition(' ')[0]} at {sys.executable}"
    for requirement in map(Requirement, requires("ethbrake-marl") or ()):
        marker = requirement.marker
        is_optional = marker is not None and any(marker.evaluate({"extra": each}) for each in EXTRA_OF.values())
        try:
            installed = version(requirement.name)
            fits = requirement.specifier.contains(installed, prereleases=True)
        except PackageNotFoundError:
            installed, fits = "is not installed", is_optional
        if is_optional or marker is None:  # not for development, or for another Python
            yield requirement.name, fits, installed + ("" if fits else f"; needs {requirement.specifier}")


def _impact() -> Check:
    """Harm of a car at 10 m/s that brakes with 5 m/s² 8 m behind a standing car: 10² - 2 · 5 · 8 = 20 m²/s²."""
    world = {"vehicles": 2, "gaps_m": 8, "speeds_mps": [0, 10], "latency_s": 0, "mass_t": 5}
    capacities = dict.fromkeys(("braking_capacity_mps2", "driving_capacity_mps2"), 5)
    try:
        from ethbrake_marl.evaluation.evaluate import evaluate

        result = evaluate({"name": "check", **world, **capacities}, "full_brake", episodes=1)
        harm = float(result["full_brake"]["total_harm"][0])
    except Exception as error:  # the versions may say why
        return "physics", False, f"{type(error).__name__}: {error}"
    return "physics", abs(harm - 20.0) < 1e-9, f"harm of one impact {harm:.9g} (exact: 20)"
