"""How the paper's fixed-step map converges to the exact harm with smaller steps: docs/extensions/reproduction.md.

    .venv/bin/python docs/studies/sampling.py docs/figures/sampled-convergence.png

The map and the exact physics simulate the same worlds with the same constant commands, up to the scenario's horizon.
One agent drives Vehicle 2, and all other vehicles brake fully. Error: sampled harm minus exact harm.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ethbrake_marl.extensions.report.style import GREY, add_caption, new_figure, series_style, style_axes, write_picture
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.engine.memory import ask_script, begin_script
from ethbrake_marl.first_edition.evaluation.identity import result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.first_edition.game.harm import empty_ledger
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.left_out import ImpactRows, Impacts
from ethbrake_marl.first_edition.physics.paper_map import advance_sampled
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario

SCENARIO, WORLDS, SEED, VEHICLE = "paper-random", 2000, 7, 1
STEPS_S = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
FITTED_UP_TO_S = 0.1  # at 0.2 s there is another error: the latency of Vehicle 3 falls between two samples
CONTROLS = ("full_brake", "constant:5")
COLUMNS = {  # column of the table -> label in the figure
    "first-impact, mean": "first-impact harm, error of the mean",
    "total, mean": "total harm, error of the mean",
    "first-impact, median abs.": "first-impact, median over worlds",
    "total, median abs.": "total, median over worlds",
    "total, mean abs., no chains": "total, mean over worlds without chain impacts",
    "other pairs hit": None,
}
CAPTION = (
    f"{SCENARIO}: {WORLDS:,} worlds, seed {SEED}; Vehicles 1 and 3 brake fully. Error: sampled minus exact harm. At"
    " 0.2 s the latency of Vehicle 3 falls between two samples, so it brakes 0.1 s late."
)


@dataclass(frozen=True)
class Convergence:
    """Results for one agent of Vehicle 2: the exact harms, and the errors for every step length."""

    agent: str
    first_mean: float  # exact mean first-impact harm
    total_mean: float  # exact mean total harm
    chained: float  # share of worlds with a chain impact
    steps_s: Sequence[float]
    errors: Floats  # [step length, column], m2/s2

    def order(self, column: int) -> float | None:
        """Return the slope of log |error| over log step, by least squares for steps up to ``FITTED_UP_TO_S``.

        Return None if the error changes its sign or is zero, because it then has no order.
        """
        steps = np.array(self.steps_s)
        fitted = steps <= FITTED_UP_TO_S
        errors = self.errors[fitted, column]
        if fitted.sum() < 2 or not ((errors > 0.0).all() or (errors < 0.0).all()):
            return None
        return float(np.polyfit(np.log(steps[fitted]), np.log(np.abs(errors)), 1)[0])


def chain_impacts(worlds: Worlds, rows: ImpactRows) -> Bools:
    """Return which worlds have an impact that moved a third vehicle, [n].

    In such an impact the momentum of the two colliding vehicles changes.
    """
    mass = worlds.vehicles.mass_t
    front = mass[rows.world, rows.pair] * rows.front_speed_change_mps
    rear = mass[rows.world, rows.pair + 1] * rows.rear_speed_change_mps
    chained = np.zeros(worlds.n, np.bool_)
    chained[rows.world[np.abs(front + rear) > 1e-9]] = True
    return chained


def convergence(worlds: Worlds, agent: str, until_s: float = 8.0, steps_s: Sequence[float] = STEPS_S) -> Convergence:
    """Compute exact and sampled harm of ``worlds`` (at the alert) up to ``until_s``, for every step length."""
    command = -worlds.vehicles.braking_capacity_mps2
    driver = make_agent(agent)
    command[:, VEHICLE], _ = ask_script(driver, worlds, begin_script(driver, worlds, VEHICLE, {}), VEHICLE)
    _, exact = advance(worlds, command, until_s=until_s, record=True)
    assert exact.rows is not None
    chained = chain_impacts(worlds, exact.rows)
    sampled = (advance_sampled(worlds, command, until_s=until_s, step_s=step)[1] for step in steps_s)
    errors = np.array([errors_of(worlds, each, exact, chained) for each in sampled])
    ledger = empty_ledger(worlds).add(exact)
    first, total = (float(ledger.world_harm(count).mean()) for count in ("first", "total"))
    return Convergence(agent, first, total, float(chained.mean()), steps_s, errors)


def errors_of(worlds: Worlds, sampled: Impacts, exact: Impacts, chained: Bools) -> list[float]:
    """Return the values of all columns for one step length."""
    ledger, reference = empty_ledger(worlds).add(sampled), empty_ledger(worlds).add(exact)
    first = ledger.world_harm("first") - reference.world_harm("first")
    total = ledger.world_harm("total") - reference.world_harm("total")
    other = ((sampled.count > 0) != (exact.count > 0)).any(axis=1)
    medians = [np.median(np.abs(each)) for each in (first, total)]
    return [first.mean(), total.mean(), *medians, np.abs(total[~chained]).mean(), other.mean()]


def table(study: Convergence) -> str:
    """Return the results of one agent as a Markdown table: one row per step length, and a row with the orders."""
    lines = [
        f"`{study.agent}`: exact mean harm {study.first_mean:.3f} (first-impact) and {study.total_mean:.3f} (total);"
        f" chain impacts in {study.chained:.1%} of the worlds.",
        "",
        f"| step (s) | {' | '.join(COLUMNS)} |",
        "| ---: " * (1 + len(COLUMNS)) + "|",
    ]
    for step, (first, total, *sizes, other) in zip(study.steps_s, study.errors, strict=True):
        cells = [f"{step:g}", f"{first:+.4f}", f"{total:+.4f}", *(f"{size:.4f}" for size in sizes), f"{other:.2%}"]
        lines.append(f"| {' | '.join(cells)} |")
    orders = map(study.order, range(len(COLUMNS)))
    return "\n".join(
        [*lines, "| order | " + " | ".join("–" if order is None else f"{order:.2f}" for order in orders) + " |"]
    )


def draw(studies: Sequence[Convergence]) -> Figure:
    """Draw absolute errors over step lengths on logarithmic axes: a panel per agent, with a line of order 1."""
    figure = new_figure(7.4, 3.9)
    places = figure.subplots(1, len(studies), sharey=True, squeeze=False)[0]
    for axes, study in zip(places, studies, strict=True):
        style_axes(axes)
        for number, label in enumerate(filter(None, COLUMNS.values())):
            axes.loglog(study.steps_s, np.abs(study.errors[:, number]), label=label, **series_style(number))
        ends = np.array([min(study.steps_s), max(study.steps_s)])
        axes.loglog(ends, 10.0 * ends, color=GREY, linewidth=0.9, label="order 1")
        axes.set_xticks(study.steps_s, [f"{step:g}" for step in study.steps_s])
        axes.minorticks_off()
        axes.tick_params(labelsize=8)
        axes.set_title(f"Vehicle 2: {study.agent}", loc="left", fontsize=10)
        axes.set_xlabel("Step (s)", fontsize=9)
    places[0].set_ylabel("Absolute error of harm (m²/s²)", fontsize=9)
    handles, labels = places[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=2, frameon=False, fontsize=9)
    add_caption(figure, CAPTION)
    return figure


if __name__ == "__main__":
    scenario = load_scenario(SCENARIO)
    sample = scenario.sample(WORLDS, SEED)
    studies = [convergence(sample.worlds, agent, scenario.horizon_s) for agent in CONTROLS]
    write_picture(sys.argv[1], draw(studies), force=True)
    versions = ", ".join(f"{name} {number}" for name, number in result_versions().items())
    identity = f"Worlds: SHA-256 {worlds_sha256(sample.worlds, sample.index)}; "
    identity += f"scenario: SHA-256 {scenario_sha256(scenario)}; {versions}."
    print("\n\n".join([*map(table, studies), identity]))
