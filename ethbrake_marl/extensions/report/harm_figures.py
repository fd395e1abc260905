"""Figures of harm: its mean, its distribution, and how it depends on the gaps at the alert."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter

from ethbrake_marl.episode.counts import COLUMN, HARM
from ethbrake_marl.evaluation.captions import caption, ranges_of
from ethbrake_marl.evaluation.compared import Compared
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.rendering.picture import COLOURS
from ethbrake_marl.extensions.report.best_known import BestKnown, shown_counts
from ethbrake_marl.extensions.report.curves import curves_figure
from ethbrake_marl.extensions.report.style import (
    TITLES,
    finish,
    in_our_style,
    label_text,
    new_panels,
    plain,
    series_style,
)

SLIM_IN = 3.8  # a figure of this width can be read on a phone without scrolling
POINTS = 250  # of a curve; more would not be visible
BINS = 12  # groups of worlds with similar gaps


@in_our_style
def harm_by_agent(compared: Compared, others: Mapping[str, Compared]) -> Figure:
    """Draw the mean harm of each agent as a bar with its 95 % interval.

    A vertical line shows the mean best known harm. Marks show the agents' means in other tests, title -> results.
    """
    count, result, known = compared.harm_count, compared.result, BestKnown.of(compared.result)
    agents = list(result.columns)
    figure, (axes,) = new_panels((SLIM_IN, 0.9 + 0.24 * len(agents)))
    for k, agent in enumerate(agents):
        harm = mean(result[agent][COLUMN[count]], result.clusters)
        axes.barh(k, harm.value, height=0.62, color=COLOURS[2])
        axes.hlines(k, *harm.ends, color=COLOURS[0], linewidth=1.6)
    if known is not None and count in known.harm:
        best = float(known.harm[count].mean())
        axes.axvline(best, color=COLOURS[3], linewidth=1.6, linestyle="--", label="best known")
    for number, (title, other) in enumerate(others.items(), 4):
        means = {agent: own[COLUMN[count]].mean() for agent, own in other.result.columns.items()}
        places = [k for k, agent in enumerate(agents) if agent in means]
        style = series_style(number) | {"linestyle": "none", "markersize": 6.0}
        axes.plot([means[agents[k]] for k in places], places, label=label_text(title.lower(), 22), **style)
    axes.set_yticks(range(len(agents)), [label_text(agent, 22) for agent in agents])
    axes.invert_yaxis()
    axes.set(xlabel=TITLES[count], xlim=(0.0, None))
    axes.tick_params(labelsize=8)
    named = axes.get_legend_handles_labels()
    figure.legend(*named, loc="outside upper right", ncols=3, fontsize=8, handletextpad=0.4, columnspacing=1)
    return figure


@in_our_style
def harm_above(compared: Compared) -> Figure:
    """Draw, for every x, the share of worlds in which an agent's regret (or harm, if no best is known) is above x."""
    result, known, counts = compared.result, BestKnown.of(compared.result), shown_counts(compared)
    figure, panels = new_panels((10.0, 3.8), columns=len(counts), sharey=True)
    for axes, (count, harm) in zip(panels, counts.items(), strict=True):
        for number, agent in enumerate(result.columns):
            ordered = np.sort(result[agent][harm] if known is None else known.regret(result, agent, count))
            chosen = np.linspace(0, len(ordered) - 1, min(POINTS, len(ordered))).astype(np.int64)
            at = np.append(0.0, ordered[chosen])
            share = 1.0 - np.searchsorted(ordered, at, "right") / len(ordered)
            axes.plot(at, share, label=label_text(agent), **series_style(number), markevery=40)
        axes.set_xscale("symlog", linthresh=1.0, linscale=0.4)
        axes.xaxis.set_major_formatter(FuncFormatter(plain))
        what = "Harm" if known is None else "Regret"
        axes.set(xlabel=f"{what}, {TITLES[count][0].lower()}{TITLES[count][1:]}", xlim=(0.0, None), ylim=(0.0, 1.0))
    panels[0].set_ylabel("Worlds above this value")
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    note = f"Linear up to 1 m²/s², logarithmic beyond. {line(result)}."
    return finish(figure, note, panels[0], columns=5)


def harm_against_total_gap(result: Result) -> Figure:
    """Draw each agent's mean harm, with 95 % intervals, against the sum of the gaps at the alert.

    Worlds are grouped by this sum, in ``BINS`` intervals of equal width. If agents minimise the honest cost, a third
    panel shows it.
    """
    minimised = result.about.get("agent_settings", {}).get("harm_count", "first")
    counts = ({**HARM, minimised: COLUMN[minimised]}).items()
    names = [name for name in result.worlds if name.startswith("gap_")]
    gap, by = np.sum([result.worlds[name] for name in names], axis=0), result.clusters
    part = np.minimum(((gap - gap.min()) / (np.ptp(gap) or 1.0) * BINS).astype(np.int64), BINS - 1)
    groups = [part == k for k in np.unique(part)]
    panels = {
        TITLES[count]: {
            agent: {
                float(gap[group].mean()): mean(columns[harm][group], None if by is None else by[group])
                for group in groups
            }
            for agent, columns in result.columns.items()
        }
        for count, harm in counts
    }
    sums = " + ".join(f"d{p + 1}" for p in range(len(names))) if len(names) <= 3 else f"d1 + … + d{len(names)}"
    note = f"Mean over worlds with similar gaps; bands: 95 % intervals. {line(result)}."
    return curves_figure(panels, f"Total gap at the alert, {sums} (m)", note, y_label="Harm (m²/s²)")


def line(result: Result) -> str:
    by = result.clusters
    recordings = {} if by is None else {"recordings": len(np.unique(by))}
    return caption({**result.about, **recordings, **ranges_of(result.worlds)})
