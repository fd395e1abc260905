"""The command ``ethbrake bench``: measure, print."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer
from rich.table import Table

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.machine import this_machine
from ethbrake_marl.cli.options import ForceOption, JsonOption
from ethbrake_marl.cli.terminal import interruptible, progress_bars, result_console, say, show, write_json
from ethbrake_marl.errors import need

if TYPE_CHECKING or LATE:
    from ethbrake_marl.cli.results import picture_target
    from ethbrake_marl.studies.speed import BENCHMARKS, FULL, QUICK, WORLD_STEPS, Speed, measure

Measured = TypeVar("Measured")

_NOTHING = "nothing was written"


def bench_command(
    quick: Annotated[bool, typer.Option("--quick", help="In about 20 s instead of a minute or two; coarser.")] = False,
    scaling: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Instead: draw how cost grows with the number of worlds and vehicles."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure speed on this machine, per second of processor time on one core.

    Medians over repetitions. Other programs that run at the same time make all figures worse.
    """
    if scaling is not None:
        _bench_scaling(scaling, quick=quick, force=force, as_json=as_json)
        return
    need("stable_baselines3")  # one of the figures does; before minutes are spent on the others
    machine = this_machine()
    with interruptible(_NOTHING):
        speeds = _watch(measure(QUICK if quick else FULL), len(BENCHMARKS))
    if as_json:
        write_json({"machine": asdict(machine), "figures": [asdict(speed) for speed in speeds]})
        return
    result_console().print(speed_table(speeds))
    show(f"Machine: {machine}")


def _bench_scaling(output: Path, *, quick: bool, force: bool, as_json: bool) -> None:
    target = picture_target(output, force=force)
    # matplotlib takes a second to load, and the table needs none.
    from ethbrake_marl.figures.style import write_picture
    from ethbrake_marl.studies.scaling import (
        EFFORT,
        VEHICLES,
        WORLDS,
        costs_by_vehicles,
        costs_by_worlds,
        scaling_figure,
    )

    machine, effort = this_machine(), QUICK if quick else EFFORT
    with interruptible(_NOTHING):
        by_worlds = _watch(costs_by_worlds(effort), 2 * len(WORLDS))
        by_vehicles = _watch(costs_by_vehicles(effort), 2 * len(VEHICLES))
    caption = f"Processor time, one core, medians. {machine}."
    write_picture(target, scaling_figure(by_worlds, by_vehicles, caption), force=force)
    costs = [*by_worlds, *by_vehicles]
    if as_json:
        write_json({"machine": asdict(machine), "costs": [asdict(cost) for cost in costs]})
    else:
        for cost in costs:
            batch = f"{cost.what:33} n = {cost.worlds:6,}  N = {cost.vehicles:2}"
            share = cost.nanoseconds / cost.vehicles
            show(f"{batch} {cost.nanoseconds:10,.1f} ns per world-step {share:9,.1f} ns per vehicle-step")
    say(f"picture: {target}")


def _watch(measurements: Iterable[Measured], total: int) -> list[Measured]:
    """All of them, with a bar on stderr while they are made."""
    found = []
    with progress_bars() as bars:
        for done, measurement in enumerate(measurements, start=1):
            found.append(measurement)
            bars.show("bench", done, total)
    return found


def speed_table(speeds: Sequence[Speed]) -> Table:
    """One line for each figure: what, how many worlds at once, the median, its range, and the aim."""
    table = Table(caption="Medians over repetitions, and their range. Aim: at least, for seconds at most.")
    table.add_column("per CPU-second", overflow="fold")
    for title in ("worlds", "median", "range", "x vehicles", "aim"):
        table.add_column(title, justify="right", no_wrap=True)
    for speed in speeds:
        steps = speed.unit == WORLD_STEPS
        table.add_row(
            speed.name,
            f"{speed.worlds:,}",
            f"{_plain(speed.value)} {speed.unit.removesuffix('/s')}",
            f"{_plain(speed.lowest)} - {_plain(speed.highest)}",
            _plain(speed.value * speed.vehicles) if steps else "",
            "" if speed.floor is None else _plain(speed.floor),
        )
    return table


def _plain(value: float) -> str:
    """Three digits, with k for thousands, M for millions and G beyond."""
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if value >= size:
            return f"{value / size:#.3g}".removesuffix(".") + letter
    return f"{value:.3g}"
