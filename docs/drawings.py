"""The drawings of docs/physics.md, from the engine: ``python docs/drawings.py`` writes them to docs/figures."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import ethbrake_marl as eb
from ethbrake_marl.extensions.rendering.picture import PALETTE, vehicle_colour
from ethbrake_marl.extensions.report.style import DASHES, GREY, finish, in_our_style, new_figure, write_picture

FOLDER = Path(__file__).parent / "figures"
SEED = 7
PHASES = {
    "waits for its news": "#c9cdd2",
    "coasts": "#8d949c",
    "drives": "#009E73",
    "brakes": "#b3403a",
    "stands": "#eceef0",
}
CASES = {  # gap (m), closing speed (m/s), closing acceleration (m/s2), how the lines move, what comes of it
    "closing, and slowed in time": (6.0, 4.0, -2.0, "w > 0, D < 0", "no contact"),
    "closing, and not slowed in time": (4.0, 5.0, -2.0, "w > 0, D ≥ 0", "contact at √D"),
    "opening, and pulled back": (2.0, -3.0, 3.0, "w ≤ 0, b > 0", "contact at √D"),
    "opening for good": (2.0, -2.0, -0.5, "w ≤ 0, b ≤ 0", "no contact"),
}


@in_our_style
def draw_timeline(agent: str = "full_brake") -> Figure:
    """What each vehicle does in world 0 of paper-random, its impacts, and its speed."""
    record = eb.record_episode("paper-random", agent, seed=SEED)
    figure = new_figure(8.0, 4.6)
    lanes, speeds = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 1.2))
    names: set[str] = set()
    for i in range(record.speeds_mps.shape[1]):
        latency = float(record.initial.latency_s[0, i])
        for start, end, phase in phases(record.time_s, record.speeds_mps[:, i], record.command_mps2[:, i], latency):
            label = "_" + phase if phase in names else phase
            names.add(phase)
            lanes.barh(i, end - start, left=start, height=0.55, color=PHASES[phase], label=label, edgecolor="white")
        speeds.plot(
            record.time_s,
            record.speeds_mps[:, i],
            color=vehicle_colour(i + 1),
            linestyle=DASHES[i],
            label=f"Vehicle {i + 1}",
        )
    rows = record.impacts
    for time, pair, closing in zip(rows.time_s, rows.pair, rows.closing_speed_mps, strict=True):
        lanes.plot([time, time], [pair - 1, pair], color="black", linewidth=1.4, marker="X", markersize=8)
        lanes.annotate(f" impact, {closing:.1f} m/s", (time, pair - 0.5), fontsize=9, va="center")
    lanes.set_yticks(range(record.speeds_mps.shape[1]), [f"Vehicle {k + 1}" for k in range(record.speeds_mps.shape[1])])
    lanes.invert_yaxis()
    lanes.legend(ncols=len(PHASES), loc="lower left", bbox_to_anchor=(0.0, 1.0))
    speeds.legend()
    speeds.set(xlabel="Time since the alert (s)", ylabel="Speed (m/s)")
    return finish(figure, f"World 0 of paper-random, list of seed {SEED}; {agent} drives Vehicle 2.")


def phases(
    time_s: np.ndarray, speed_mps: np.ndarray, command_mps2: np.ndarray, latency_s: float
) -> Iterator[tuple[float, float, str]]:
    """(start, end, name) of what one vehicle does, from its samples."""
    names = [
        "waits for its news" if time < latency_s - 1e-9
        else "stands" if speed == 0.0
        else "brakes" if command < 0.0
        else "drives" if command > 0.0
        else "coasts"
        for time, speed, command in zip(time_s, speed_mps, command_mps2, strict=True)
    ]  # fmt: skip
    start = 0
    for k in range(1, len(names) + 1):
        if k == len(names) or names[k] != names[start]:
            yield float(time_s[start]), float(time_s[min(k, len(names) - 1)]), names[start]
            start = k


@in_our_style
def draw_regimes() -> Figure:
    """The gap of a pair over time in the four cases of a segment."""
    figure = new_figure(9.6, 2.9)
    for axes, (title, (gap, closing, pull, case, end)) in zip(
        figure.subplots(1, len(CASES), sharey=True), CASES.items(), strict=True
    ):
        time = np.linspace(0.0, 4.0, 401)
        left = gap - (closing + pull * time / 2.0) * time
        met = int(np.argmax(left <= 0.0)) if (left <= 0.0).any() else len(time) - 1
        axes.plot(time[: met + 1], np.maximum(left[: met + 1], 0.0), color=PALETTE[2], linewidth=2.0)
        if (left <= 0.0).any():
            axes.plot(time[met], 0.0, "X", color="black", markersize=9, clip_on=False, zorder=5)
        axes.set_title(title, fontsize=9.5)
        axes.annotate(f"{case}: {end}", (0.02, 0.93), xycoords="axes fraction", fontsize=9, color=GREY)
        axes.set(xlabel="Time in the segment (s)", xlim=(0.0, 4.0), ylim=(0.0, 10.0))
    figure.axes[0].set_ylabel("Gap (m)")
    return figure


@in_our_style
def draw_knowledge() -> Figure:
    """From when on each vehicle acts on news of each: by the paper's rule, and over a channel."""
    paper = eb.load_scenario("paper-random")
    shown = {"`v2x: paper`, the default": paper, "`v2x: congested`": paper.replace(v2x="congested", latency_s=0)}
    figure = new_figure(8.6, 3.4)
    every = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, (title, scenario) in zip(every, shown.items(), strict=True):
        _knowledge(axes, scenario)
        axes.set(title=title.replace("`", ""), xlabel="Time since the alert (s)")
    every[0].set_xlim(0.0, 1.6)
    return finish(
        figure, f"Bars: the row's vehicle acts on news of the other. World 0 of paper-random, list of seed {SEED}."
    )


def _knowledge(axes: Axes, scenario: eb.Scenario) -> None:
    known = scenario.sample(1, SEED).know[0, 1:, 1:]
    labels = []
    for i in range(len(known)):
        for j in (k for k in range(len(known)) if k != i):
            row = len(labels)
            labels.append(f"{i + 1} knows of {j + 1}")
            axes.barh(row, 9.0, left=known[i, j], height=0.6, color=vehicle_colour(j + 1))
            axes.annotate(
                f"{known[i, j]:.2f} s ", (known[i, j], row), fontsize=8.5, va="center",
                ha="right" if known[i, j] > 0.2 else "left", color="black" if known[i, j] > 0.2 else "white",
            )  # fmt: skip
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)


DRAWINGS = {"timeline": draw_timeline, "regimes": draw_regimes, "knowledge": draw_knowledge}

if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for name, draw in DRAWINGS.items():
        write_picture(FOLDER / f"model-{name}.svg", draw(), force=True)
