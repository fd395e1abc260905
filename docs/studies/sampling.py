"""How the paper's fixed-step map converges to the exact harm with smaller steps: docs/paper.md.

    .venv/bin/python docs/studies/sampling.py docs/figures/sampled-convergence.png

The same agent drives the same worlds in the map (``physics: paper-map``) and in the exact physics, up to the scenario's
horizon. It drives Vehicle 2, all others brake fully. Error: harm in the map minus exact harm.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import ethbrake_marl as eb
from ethbrake_marl.evaluation.provenance import versions, worlds_sha256
from ethbrake_marl.extensions.report.style import GREY, finish, in_our_style, new_panels, series_style, write_picture

SCENARIO, WORLDS, SEED = "paper-random", 2000, 7
STEPS_S = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
FITTED_UP_TO_S = 0.1  # at 0.2 s there is another error: the latency of Vehicle 3 falls between two samples
AGENTS = ("full_brake", "constant:5")
FAR_OFF = 1.0  # error of the total harm of a world (m2/s2) that counts as far off
COLUMNS = {  # column of the table -> label in the figure
    "first-impact, mean": "first-impact harm, error of the mean",
    "total, mean": "total harm, error of the mean",
    "first-impact, median abs.": "first-impact, median over worlds",
    "total, median abs.": "total, median over worlds",
    "total far off": None,
    "other pairs hit": None,
}
CAPTION = (
    f"{SCENARIO}: {WORLDS:,} worlds, seed {SEED}; Vehicles 1 and 3 brake fully. Error: in the map minus exact. At"
    " 0.2 s the latency of Vehicle 3 falls between two samples, so it brakes 0.1 s late."
)


@dataclass(frozen=True)
class Convergence:
    """Exact mean harms with one agent, and the errors for every step."""

    agent: str
    first_mean: float
    total_mean: float
    steps_s: Sequence[float]
    errors: np.ndarray  # [step, column]

    def order(self, column: int) -> float | None:
        """Slope of log |error| over log step, by least squares; None if the error is 0 or changes sign."""
        steps = np.array(self.steps_s)
        errors = self.errors[steps <= FITTED_UP_TO_S, column]
        if len(errors) < 2 or not ((errors > 0.0).all() or (errors < 0.0).all()):
            return None
        return float(np.polyfit(np.log(steps[steps <= FITTED_UP_TO_S]), np.log(np.abs(errors)), 1)[0])


def driven(agent: str, worlds: int, changes: Mapping[str, Any]) -> eb.State:
    """Ends of the first worlds of the list under a changed scenario, with an agent as Vehicle 2."""
    scenario, game = eb.open_game(eb.load_scenario(SCENARIO).replace(**changes), reward="first-impact-harm")
    return eb.play_to_end(game, scenario.sample(worlds, SEED), eb.Team.of({"vehicle_2": eb.make_agent(agent)}, agent))


def convergence(agent: str, worlds: int = WORLDS, steps_s: Sequence[float] = STEPS_S) -> Convergence:
    exact, errors = driven(agent, worlds, {}), []
    for step_s in steps_s:
        last = driven(agent, worlds, {"physics": "paper-map", "time_step_s": step_s})
        first, total = (last.harm(count) - exact.harm(count) for count in ("first", "total"))
        medians = [np.median(np.abs(each)) for each in (first, total)]
        far, other = np.abs(total) > FAR_OFF, (last.pair_hit != exact.pair_hit).any(axis=1)
        errors.append([first.mean(), total.mean(), *medians, far.mean(), other.mean()])
    return Convergence(agent, exact.harm("first").mean(), exact.harm("total").mean(), steps_s, np.array(errors))


def table(study: Convergence) -> str:
    """Results with one agent as a Markdown table: a row per step, and one with the orders."""
    lines = [
        f"`{study.agent}`: exact mean harm {study.first_mean:.3f} (first-impact) and {study.total_mean:.3f} (total).",
        "",
        f"| step (s) | {' | '.join(COLUMNS)} |",
        "| ---: " * (1 + len(COLUMNS)) + "|",
    ]
    for step, (first, total, *medians, far, other) in zip(study.steps_s, study.errors, strict=True):
        cells = [f"{step:g}", f"{first:+.4f}", f"{total:+.4f}", *(f"{size:.4f}" for size in medians)]
        lines.append(f"| {' | '.join([*cells, f'{far:.2%}', f'{other:.2%}'])} |")
    orders = map(study.order, range(len(COLUMNS)))
    return "\n".join(
        [*lines, "| order | " + " | ".join("–" if order is None else f"{order:.2f}" for order in orders) + " |"]
    )


@in_our_style
def draw(studies: Sequence[Convergence]) -> Figure:
    """Draw absolute errors over steps on logarithmic axes: a panel per agent, with a line of order 1."""
    figure, panels = new_panels((7.4, 3.9), columns=len(studies), sharey=True)
    for axes, study in zip(panels, studies, strict=True):
        for number, label in enumerate(filter(None, COLUMNS.values())):
            axes.loglog(study.steps_s, np.abs(study.errors[:, number]), label=label, **series_style(number))
        ends = np.array([min(study.steps_s), max(study.steps_s)])
        axes.loglog(ends, 10.0 * ends, color=GREY, linewidth=0.9, label="order 1")
        axes.set_xticks(study.steps_s, [f"{step:g}" for step in study.steps_s])
        axes.minorticks_off()
        axes.tick_params(labelsize=8)
        axes.set(title=f"Vehicle 2: {study.agent}", xlabel="Step (s)")
    panels[0].set_ylabel("Absolute error of harm (m²/s²)")
    return finish(figure, CAPTION, panels[0], columns=2)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", help="file for the figure")
    given = parser.parse_args()
    studies = [convergence(agent) for agent in AGENTS]
    write_picture(given.picture, draw(studies), force=True)
    worlds = eb.load_scenario(SCENARIO).sample(WORLDS, SEED)
    software = ", ".join(f"{name} {number}" for name, number in versions().items())
    print("\n\n".join([*map(table, studies), f"Worlds: SHA-256 {worlds_sha256(worlds)}; {software}."]))
