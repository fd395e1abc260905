"""The convergence of the paper's fixed-step map to the exact harm as its step shrinks: table and figure.

Both integrators take the same worlds, under the same constant commands, to the scenario's horizon; Vehicle 2 is driven
by one agent, all others brake fully. An error is the sampled harm minus the exact one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ethbrake_marl.agents.registry import make_single_agent
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.identity import identity_line
from ethbrake_marl.figures.curves import draw_errors
from ethbrake_marl.figures.style import Figure, write_picture
from ethbrake_marl.harm import empty_ledger
from ethbrake_marl.physics import Bools, Floats, ImpactRows, Impacts, Worlds, advance, advance_sampled
from ethbrake_marl.scenario import load_scenario

STEPS_S = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
FITTED_UP_TO_S = 0.1  # at 0.2 s Vehicle 3's latency falls between two samples, which is an error of another kind
CONTROLS = ("full_brake", "constant:5")

_VEHICLE = 1
_MOMENTUM_TOLERANCE = 1e-9  # t m/s


@dataclass(frozen=True, slots=True)
class StepErrors:
    """Errors at one step over all worlds unless said otherwise, m2/s2."""

    first_mean: float
    total_mean: float
    first_median: float  # of the absolute error
    total_median: float  # of the absolute error
    unchained_total: float  # mean of the absolute error over the worlds without a chain impact
    other_pairs: float  # share of worlds in which other pairs are hit


@dataclass(frozen=True, slots=True)
class Convergence:
    """One control of Vehicle 2: the exact harms, and the errors at every step."""

    agent: str
    first_mean: float  # exact mean first-impact harm
    total_mean: float
    chained: float  # share of worlds with a chain impact
    steps_s: tuple[float, ...]
    errors: tuple[StepErrors, ...]

    def column(self, name: str) -> Floats:
        """One field of the errors, by step."""
        return np.array([getattr(row, name) for row in self.errors])

    def order(self, name: str) -> float | None:
        """Slope of log |error| over log step, by least squares for steps up to ``FITTED_UP_TO_S``.

        None where the error changes its sign or is zero, so that it has no order.
        """
        steps = np.array(self.steps_s)
        fitted = steps <= FITTED_UP_TO_S
        errors = self.column(name)[fitted]
        if fitted.sum() < 2 or not ((errors > 0.0).all() or (errors < 0.0).all()):
            return None
        return float(np.polyfit(np.log(steps[fitted]), np.log(np.abs(errors)), 1)[0])


def chain_impacts(worlds: Worlds, rows: ImpactRows) -> Bools:
    """Worlds in which an impact moved a third vehicle, [n]: the momentum of the two that met did not stay theirs."""
    mass = worlds.vehicles.mass_t
    front = mass[rows.world, rows.pair] * rows.front_speed_change_mps
    rear = mass[rows.world, rows.pair + 1] * rows.rear_speed_change_mps
    chained = np.zeros(worlds.n, np.bool_)
    chained[rows.world[np.abs(front + rear) > _MOMENTUM_TOLERANCE]] = True
    return chained


def convergence(worlds: Worlds, agent: str, *, until_s: float = 8.0, steps_s: Sequence[float] = STEPS_S) -> Convergence:
    """Exact and sampled harm of ``worlds`` (at the alert) up to ``until_s``, for every step."""
    command = -worlds.vehicles.braking_capacity_mps2
    driver = make_single_agent(agent)
    driver.begin(worlds, _VEHICLE, np.arange(worlds.n))
    command[:, _VEHICLE] = driver.act(worlds, _VEHICLE)
    _, exact = advance(worlds, command, until_s=until_s, record=True)
    assert exact.rows is not None
    chained = chain_impacts(worlds, exact.rows)
    errors = tuple(
        _errors(worlds, advance_sampled(worlds, command, until_s=until_s, step_s=step)[1], exact, chained)
        for step in steps_s
    )
    ledger = empty_ledger(worlds).add(exact)
    return Convergence(
        agent,
        float(ledger.world_harm("first").mean()),
        float(ledger.world_harm("total").mean()),
        float(chained.mean()),
        tuple(steps_s),
        errors,
    )


def _errors(worlds: Worlds, sampled: Impacts, exact: Impacts, chained: Bools) -> StepErrors:
    ledger, reference = empty_ledger(worlds).add(sampled), empty_ledger(worlds).add(exact)
    first = ledger.world_harm("first") - reference.world_harm("first")
    total = ledger.world_harm("total") - reference.world_harm("total")
    other = ((sampled.count > 0) != (exact.count > 0)).any(axis=1)
    return StepErrors(
        float(first.mean()),
        float(total.mean()),
        float(np.median(np.abs(first))),
        float(np.median(np.abs(total))),
        float(np.abs(total[~chained]).mean()),
        float(other.mean()),
    )


def convergence_table(study: Convergence) -> str:
    """One study as a Markdown table, a line per step and the fitted order below."""
    lines = [
        f"`{study.agent}`: exact mean harm {study.first_mean:.3f} (first-impact) and {study.total_mean:.3f} (total);"
        f" chain impacts in {study.chained:.1%} of the worlds.",
        "",
        "| step (s) | first-impact, mean | total, mean | first-impact, median abs. | total, median abs."
        " | total, mean abs., no chains | other pairs hit |",
        "| ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for step, row in zip(study.steps_s, study.errors, strict=True):
        means = (f"{value:+.4f}" for value in (row.first_mean, row.total_mean))
        sizes = (f"{value:.4f}" for value in (row.first_median, row.total_median, row.unchained_total))
        lines.append("| " + " | ".join([f"{step:g}", *means, *sizes, f"{row.other_pairs:.2%}"]) + " |")
    orders = (study.order(f.name) for f in fields(StepErrors))
    lines.append("| order | " + " | ".join("–" if order is None else f"{order:.2f}" for order in orders) + " |")
    return "\n".join(lines)


_SERIES = (
    ("first_mean", "first-impact harm, error of the mean"),
    ("total_mean", "total harm, error of the mean"),
    ("first_median", "first-impact, median over worlds"),
    ("total_median", "total, median over worlds"),
    ("unchained_total", "total, mean over worlds without chain impacts"),
)


def convergence_figure(studies: Sequence[Convergence], caption: str) -> Figure:
    """Absolute errors over the step, one panel per study."""
    panels = {
        f"Vehicle 2: {study.agent}": [(label, np.abs(study.column(name))) for name, label in _SERIES]
        for study in studies
    }
    return draw_errors(panels, steps_s=studies[0].steps_s, caption=caption)


def sampling_report(figure_path: str | Path, *, scenario: str = "paper-random", n: int = 2000, seed: int = 7) -> str:
    """Run the whole study, write its figure and return its tables as Markdown; an older figure is overwritten."""
    chosen = load_scenario(scenario)
    sample = chosen.sample(n, seed)
    studies = [convergence(sample.worlds, agent, until_s=chosen.horizon_s) for agent in CONTROLS]
    caption = (
        f"{scenario}: {count_of(n, 'world')}, seed {seed}; Vehicles 1 and 3 brake fully. Error: sampled minus"
        " exact harm. At 0.2 s the latency of Vehicle 3 falls between two samples, so it brakes 0.1 s late."
    )
    write_picture(figure_path, convergence_figure(studies, caption), force=True)
    return "\n\n".join([*(convergence_table(study) for study in studies), identity_line(chosen, sample)])
