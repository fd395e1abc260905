"""Figures of harm: its mean, its distribution, and how it depends on the gaps at the alert."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.captions import caption, ranges_of
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.evaluation.summary import SummaryTable
from ethbrake_marl.extensions.rendering.picture import COLOURS
from ethbrake_marl.extensions.report.best_known import HARM, BestKnown
from ethbrake_marl.extensions.report.page import SLIM_IN
from ethbrake_marl.extensions.report.style import (
    TITLES,
    band,
    finish,
    in_our_style,
    label_text,
    name_axes,
    new_panels,
    plain,
    series_style,
)

POINTS = 250  # of a curve; more would not be visible


@in_our_style
def harm_by_agent(
    table: SummaryTable,
    count: str = "first",
    known: BestKnown | None = None,
    elsewhere: Mapping[str, SummaryTable] | None = None,
) -> Figure:
    """Draw the mean harm of each agent as a bar with its 95 % interval, narrow enough for a phone.

    A vertical line is the mean best known harm. Marks are the agents' means in other tests, title -> table.
    """
    figure, (axes,) = new_panels((SLIM_IN, 0.9 + 0.24 * len(table)))
    for k, row in enumerate(table):
        estimate = row.estimates[HARM[count]]
        assert estimate is not None
        axes.barh(k, estimate.value, height=0.62, color=COLOURS[2])
        axes.hlines(k, *estimate.ends, color=COLOURS[0], linewidth=1.6)
    if known is not None:
        best = float(known.harm[count].mean())
        axes.axvline(best, color=COLOURS[3], linewidth=1.6, linestyle="--", label="best known")
    for number, (title, other) in enumerate((elsewhere or {}).items()):
        harms = {row.agent: each.value for row in other if (each := row.estimates[HARM[count]]) is not None}
        places = [k for k, row in enumerate(table) if row.agent in harms]
        style = series_style(number + 4) | {"linestyle": "none", "markersize": 6.0}
        axes.plot([harms[table[k].agent] for k in places], places, label=label_text(title.lower(), 22), **style)
    name_axes(axes, x=TITLES[count])
    axes.set_xlim(left=0.0)
    _name_rows(axes, [row.agent for row in table], most=22)
    axes.tick_params(labelsize=8)
    named = axes.get_legend_handles_labels()
    figure.legend(
        *named, loc="outside upper right", ncols=3, frameon=False, fontsize=8, handletextpad=0.4, columnspacing=1
    )
    return figure


def _name_rows(axes: Axes, agents: Sequence[str], most: int = 40) -> None:
    axes.set_yticks(range(len(agents)), [label_text(agent, most) for agent in agents])
    axes.invert_yaxis()


@in_our_style
def harm_above(result: Result) -> Figure:
    """Draw, for every x, the share of worlds in which an agent's regret is above x; its harm if no best is known."""
    known = BestKnown.of(result)
    figure, panels = new_panels((10.0, 3.8), columns=2, sharey=True)
    for axes, (count, harm) in zip(panels, HARM.items(), strict=True):
        for number, agent in enumerate(result.columns):
            ordered = np.sort(result[agent][harm] if known is None else known.regret(result, agent, count))
            chosen = np.unique(np.linspace(0, len(ordered) - 1, min(POINTS, len(ordered))).astype(np.int64))
            at = np.concatenate([[0.0], ordered[chosen]])
            share = [float((ordered > value).mean()) for value in at]
            axes.plot(at, share, label=label_text(agent), **series_style(number), markevery=40)
        axes.set_xscale("symlog", linthresh=1.0, linscale=0.4)
        axes.xaxis.set_major_formatter(FuncFormatter(plain))
        axes.set_xlim(left=0.0)
        axes.set_ylim(0.0, 1.0)
        name_axes(axes, x=f"{'Harm' if known is None else 'Regret'}, {TITLES[count][0].lower()}{TITLES[count][1:]}")
    name_axes(panels[0], y="Worlds above this value")
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    note = f"Linear up to 1 m²/s², logarithmic beyond. {line(result)}."
    return finish(figure, note, panels[0], columns=5)


@in_our_style
def harm_against_total_gap(result: Result, *, bins: int = 12) -> Figure:
    """Draw each agent's mean harm, with 95 % intervals, against the sum of the gaps at the alert.

    ``bins``: intervals of equal width into which the sums are divided. Raises ``InvalidInput`` for less than 1.
    """
    if not bins >= 1:
        raise InvalidInput(f"harm_against_total_gap: bins = {bins}: the number of bins must be at least 1")
    by, names = result.clusters, [name for name in result.worlds if name.startswith("gap_")]
    gap = np.sum([result.worlds[name] for name in names], axis=0)
    part = np.minimum(((gap - gap.min()) / (np.ptp(gap) or 1.0) * bins).astype(np.int64), bins - 1)
    groups = [part == k for k in np.unique(part)]
    at = [float(gap[group].mean()) for group in groups]
    sums = " + ".join(f"d{p + 1}" for p in range(len(names))) if len(names) <= 3 else f"d1 + … + d{len(names)}"
    figure, panels = new_panels((10.0, 4.6), columns=2, sharey=True)
    for axes, (count, harm) in zip(panels, HARM.items(), strict=True):
        for number, agent in enumerate(result.columns):
            values, style = result[agent][harm], series_style(number)
            estimates = [mean(values[group], None if by is None else by[group]) for group in groups]
            axes.plot(at, [each.value for each in estimates], label=label_text(agent), **style)
            low, high = zip(*(each.ends for each in estimates), strict=True)
            if len(groups) > 1:
                band(axes, at, low, high, style)
            else:
                axes.vlines(at, low, high, color=str(style["color"]), linewidth=1.2)
        name_axes(axes, TITLES[count], f"Total gap at the alert, {sums} (m)")
    panels[0].set_ylim(bottom=0.0)  # after all curves are drawn; of both panels
    note = f"Mean over worlds with similar gaps; bands: 95 % intervals. {line(result)}."
    return finish(figure, note, panels[0])


def line(result: Result) -> str:
    """Return the worlds of a result in one line."""
    by = result.clusters
    recordings = {} if by is None else {"recordings": len(np.unique(by))}
    return caption({**result.about, **recordings, **ranges_of(result.worlds)})
