"""The command ``ethbrake bench``: measure, print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.machine import this_machine
from ethbrake_marl.cli.options import JsonOption
from ethbrake_marl.cli.terminal import interruptible, progress_bars, result_console, show, write_json
from ethbrake_marl.errors import need

if TYPE_CHECKING or LATE:
    from ethbrake_marl.studies.speed import BENCHMARKS, FULL, QUICK, WORLD_STEPS, Speed, measure


def bench_command(
    quick: Annotated[bool, typer.Option("--quick", help="In about 20 s instead of a minute or two; coarser.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure speed on this machine, per second of processor time on one core.

    Medians over repetitions. Other programs that run at the same time make all figures worse.
    """
    need("stable_baselines3")  # one of the figures does; before minutes are spent on the others
    machine = this_machine()
    with interruptible("nothing was written"), progress_bars() as bars:
        speeds: list[Speed] = []
        for speed in measure(QUICK if quick else FULL):
            speeds.append(speed)
            bars.show("bench", len(speeds), len(BENCHMARKS))
    if as_json:
        write_json({"machine": asdict(machine), "figures": [asdict(speed) for speed in speeds]})
        return
    result_console().print(speed_table(speeds))
    show(f"Machine: {machine}")


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
