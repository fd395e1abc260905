"""Figures of harm, learning curves, decelerations, episodes and worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, MaxNLocator, PercentFormatter

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.pairwise import harm_of_deceleration, pairwise
from ethbrake_marl.episode.counts import FIRST_IMPACTS, HONEST, IMPACT_COUNTS, AnyCount, HarmCount
from ethbrake_marl.episode.hold import hold
from ethbrake_marl.episode.state import NUMBER, State
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.record import EpisodeRecord, record_agents
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.evaluation.summary import caption, ranges_of
from ethbrake_marl.extensions.rendering.picture import PALETTE, Frame, picture, vehicle_colour
from ethbrake_marl.extensions.rendering.scene import AHEAD_M, Scene
from ethbrake_marl.extensions.report.best_known import BestKnown, shown_counts
from ethbrake_marl.extensions.report.style import (
    DASHES,
    GREY,
    axis_title,
    band,
    finish,
    in_our_style,
    label_text,
    new_figure,
    new_panels,
    plain_number,
    quantities,
    series_style,
    write_picture,
)
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.layout import BRAKING, LATENCY, Floats
from ethbrake_marl.worlds.describe import quantities_of
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.quantities import QUANTITIES, Rule
from ethbrake_marl.worlds.sampling import DrawnWorlds
from ethbrake_marl.worlds.scenario import Scenario

LONG = 30  # characters of a label that make a legend narrow
EstimateCurve = Mapping[Any, Estimate]  # x -> estimate; texts stand side by side


def curve_over_seeds(trainings: Sequence[Mapping[Any, float]]) -> EstimateCurve:
    """Mean of several training runs, -+ one standard deviation over the seeds, at the steps that all share."""
    curve = {}
    for step in sorted(set.intersection(*map(set, trainings))):
        values = [training[step] for training in trainings]
        mean, spread = np.mean(values), np.std(values, ddof=1) if len(values) > 1 else 0.0
        curve[float(step)] = Estimate(float(mean), (float(mean - spread), float(mean + spread)))
    return curve


@in_our_style
def curves_figure(
    panels: Mapping[str, Mapping[str, EstimateCurve]],
    x_label: str,
    caption: str,
    *,
    lines: Mapping[str, Mapping[str, float]] | None = None,
    y_label: str = "",
) -> Figure:
    """Draw curves with their intervals as bands, one panel for each title.

    ``panels``: title -> label of a curve -> curve; the first panel must have all labels. ``lines``: title -> label ->
    value of a horizontal line. ``y_label``: label of a shared vertical axis; "": every panel has its own.
    """
    figure, all_axes = new_panels((5.0 * len(panels), 4.2), columns=len(panels), sharey=bool(y_label))
    labels = [*dict.fromkeys(label for curves in panels.values() for label in curves)]
    for axes, (title, curves) in zip(all_axes, panels.items(), strict=True):
        for label, curve in curves.items():
            style, x = series_style(labels.index(label)), list(curve)
            axes.plot(x, [estimate.value for estimate in curve.values()], label=label_text(label), **style)
            low, high = zip(*(estimate.ends for estimate in curve.values()), strict=True)
            band(axes, x, low, high, style)
        for number, (label, value) in enumerate((lines or {}).get(title, {}).items(), len(labels)):
            style = series_style(number) | {"marker": ""}
            axes.axhline(value, label=label_text(label), **style)
        axes.set(title=title, xlabel=x_label)
        if axes.dataLim.xmax >= 1000.0:
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    for axes in all_axes:  # after all curves are drawn
        if axes.dataLim.ymin >= 0.0:
            axes.set_ylim(bottom=0.0)
    all_axes[0].set_ylabel(y_label)
    narrow = len(panels) == 1 or max(map(len, labels), default=0) > LONG
    return finish(figure, caption, all_axes[0], columns=3 if narrow else 5)


SLIM_IN = 3.8  # a figure of this width can be read on a phone without scrolling
POINTS = 250  # of a curve; more would not be visible
BINS = 12  # groups of worlds with similar gaps


@in_our_style
def harm_by_agent(compared: Comparison, tests: Mapping[str, Comparison]) -> Figure:
    """Draw the mean harm of each agent with its 95 % interval, the best known mean, and marks for other ``tests``."""
    count, result, best_known = compared.harm_count, compared.result, BestKnown.of(compared.result)
    agents = list(result.columns)
    figure, (axes,) = new_panels((SLIM_IN, 0.9 + 0.24 * len(agents)))
    for k, agent in enumerate(agents):
        harm = mean(result[agent][count.column], result.clusters)
        axes.barh(k, harm.value, height=0.62, color=PALETTE[2])
        axes.hlines(k, *harm.ends, color=PALETTE[0], linewidth=1.6)
    if best_known is not None and count in best_known.harm:
        best = float(best_known.harm[count].mean())
        axes.axvline(best, color=PALETTE[3], linewidth=1.6, linestyle="--", label="best known")
    for number, (title, comparison) in enumerate(tests.items(), 4):
        means = {agent: columns[count.column].mean() for agent, columns in comparison.result.columns.items()}
        places = [k for k, agent in enumerate(agents) if agent in means]
        style = series_style(number) | {"linestyle": "none", "markersize": 6.0}
        axes.plot([means[agents[k]] for k in places], places, label=label_text(title.lower(), 22), **style)
    axes.set_yticks(range(len(agents)), [label_text(agent, 22) for agent in agents])
    axes.invert_yaxis()
    axes.set(xlabel=axis_title(count), xlim=(0.0, None))
    axes.tick_params(labelsize=8)
    named = axes.get_legend_handles_labels()
    figure.legend(*named, loc="outside upper right", ncols=3, fontsize=8, handletextpad=0.4, columnspacing=1)
    return figure


@in_our_style
def harm_above(compared: Comparison) -> Figure:
    """Draw, for every x, the share of worlds with a regret above x; with a harm above x, if no best harm is known."""
    result, best_known, counts = compared.result, BestKnown.of(compared.result), shown_counts(compared)
    figure, panels = new_panels((10.0, 3.8), columns=len(counts), sharey=True)
    for axes, count in zip(panels, counts, strict=True):
        for number, agent in enumerate(result.columns):
            values = result[agent][count.column] if best_known is None else best_known.regret(result, agent, count)
            ordered = np.sort(values)
            chosen = np.linspace(0, len(ordered) - 1, min(POINTS, len(ordered))).astype(np.int64)
            at = np.append(0.0, ordered[chosen])
            share = 1.0 - np.searchsorted(ordered, at, "right") / len(ordered)
            axes.plot(at, share, label=label_text(agent), **series_style(number), markevery=40)
        axes.set_xscale("symlog", linthresh=1.0, linscale=0.4)
        axes.xaxis.set_major_formatter(FuncFormatter(plain_number))
        what = "Harm" if best_known is None else "Regret"
        axes.set(xlabel=f"{what}, {count.words} (m²/s²)", xlim=(0.0, None), ylim=(0.0, 1.0))
    panels[0].set_ylabel("Worlds above this value")
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    note = f"Linear up to 1 m²/s², logarithmic beyond. {line(result)}."
    return finish(figure, note, panels[0], columns=5)


def harm_against_total_gap(result: Result) -> Figure:
    """Draw each agent's mean harm against the sum of the gaps at the alert, in ``BINS`` groups of equal width."""
    minimised = HarmCount.of(result.about.get("agent_settings", {}).get("harm_count", HONEST))
    names = [name for name in result.worlds if name.startswith("gap_")]
    gap, by = np.sum([result.worlds[name] for name in names], axis=0), result.clusters
    part = np.minimum(((gap - gap.min()) / (np.ptp(gap) or 1.0) * BINS).astype(np.int64), BINS - 1)
    groups = [part == k for k in np.unique(part)]
    panels = {
        axis_title(count): {
            agent: {
                float(gap[group].mean()): mean(columns[count.column][group], None if by is None else by[group])
                for group in groups
            }
            for agent, columns in result.columns.items()
        }
        for count in dict.fromkeys([*IMPACT_COUNTS, minimised])
    }
    sums = " + ".join(f"d{p + 1}" for p in range(len(names))) if len(names) <= 3 else f"d1 + … + d{len(names)}"
    note = f"Mean over worlds with similar gaps; bands: 95 % intervals. {line(result)}."
    return curves_figure(panels, f"Total gap at the alert, {sums} (m)", note, y_label="Harm (m²/s²)")


def line(result: Result) -> str:
    return caption({**result.about, **result.independent, **ranges_of(result.worlds)})


DECELERATION_POINTS = 2001  # evenly spaced decelerations


def harm_of_decelerations(world: State, body: int, at: Floats, horizon_s: float) -> Floats:
    """Harm in one world if vehicle ``body`` holds one of the C decelerations ``at`` (m/s2), [3, C] m2/s2.

    Rows: predicted first-impact harm (closed form); simulated first-impact harm; simulated total harm.
    """
    braking, wait = np.ascontiguousarray(capacities(world.car, BRAKING)[0]), world.car[0, LATENCY].copy()
    priced: Any = harm_of_deceleration
    predicted = [priced(world.line[0], braking, wait, body, float(a)) for a in at]
    return np.stack([predicted, *hold(world, world.wanted, [body], -at[None, :, None], horizon_s, FIRST_IMPACTS)[:, 0]])


@in_our_style
def deceleration_figure(
    world: State, scenario: AnyScenario, *, best_known: Mapping[str, float] | None = None, title: str = ""
) -> Figure:
    """Draw predicted and simulated harm in one world against the constant deceleration of the scenario's learner.

    ``best_known``: least known harm in this world, ``first`` and ``total`` -> m2/s2. Raises ``InvalidInput`` unless
    there are one world, one learner, and no script that looks at the state.
    """
    loaded, game = open_game(scenario)
    if world.n != 1 or len(loaded.learners) != 1 or game.scripts:
        raise InvalidInput(
            f"deceleration_figure: {world.n} worlds, {len(loaded.learners)} learners, {len(game.scripts)} scripts that"
            " look at the state; must be 1, 1 and 0, for instance worlds.take([0]) of paper-random"
        )
    (body,), horizon_s = loaded.learners, loaded.horizon_s
    chosen = float(pairwise(world, body).deceleration_mps2[0])
    at = np.union1d(np.linspace(0.0, world.braking_capacity_mps2[0, body - 1], DECELERATION_POINTS), [chosen])
    predicted, first, total = harm_of_decelerations(world, body, at, horizon_s)
    place = int(np.searchsorted(at, chosen))
    figure, (axes,) = new_panels((8.0, 4.9))
    styles = [series_style(number) | {"marker": "", "linewidth": 1.5} for number in range(3)]
    mark: dict[str, Any] = {"linestyle": "none", "markerfacecolor": "none", "clip_on": False, "zorder": 5}
    axes.plot(at, predicted, label="predicted (pairwise)", **styles[2])
    for count, harm, style in zip(IMPACT_COUNTS, (first, total), styles, strict=False):
        axes.plot(at, harm, label=f"simulated {count.words}", **style)
    axes.vlines(chosen, predicted[place], first[place], color=styles[2]["color"], linewidth=1.0, linestyle=":")
    harms = f"{predicted[place]:.2f} predicted, {first[place]:.2f} simulated"
    axes.plot(
        [chosen], [predicted[place]], label=f"a* = {chosen:.3f} m/s², closed form: {harms}",
        **{**styles[2], **mark, "marker": "D", "markersize": 6},
    )  # fmt: skip
    for count, style, size in zip(IMPACT_COUNTS, styles, (6, 10), strict=False):
        best = coupled(world, body, count, horizon_s)
        a, least = float(best.deceleration_mps2[0]), float(best.harm[0])
        axes.plot(
            [a], [least], label=f"a* = {a:.3f} m/s², coupled, least {count.words}: {least:.2f}",
            **{**style, **mark, "marker": "o", "markersize": size},
        )  # fmt: skip
        if best_known is not None:
            axes.axhline(
                best_known[count.name],
                label=f"best known {count.words}: {best_known[count.name]:.2f}",
                **style | {"linewidth": 0.9},
            )
    axes.set(
        title=title or f"{loaded.name}: one world",
        xlabel=f"Constant deceleration of Vehicle {body} (m/s²)",
        ylabel="Harm (m²/s²)",
        xlim=(0.0, float(at[-1])),
        ylim=(0.0, None),
    )
    note = (
        f"{quantities(world)}. Harm until {horizon_s:g} s. Predicted: closed form for each pair alone. Simulated:"
        " motion of the whole line, with all impacts."
    )
    return finish(figure, note, axes, columns=2, fontsize=8)


NOTE = "Numbers at impacts: closing speed in m/s. Vehicles are drawn without length. Harm in m²/s²."
CORNERS: tuple[dict[str, Any], ...] = (  # places of the numbers of neighbouring pairs, which may strike at one moment
    {"xytext": (-7, 7), "ha": "right", "va": "bottom"},
    {"xytext": (7, -7), "ha": "left", "va": "top"},
    {"xytext": (7, 7), "ha": "left", "va": "bottom"},
    {"xytext": (-7, -7), "ha": "right", "va": "top"},
)
IMPACT: dict[str, Any] = {"marker": "X", "s": 60.0, "edgecolor": "black", "linewidth": 0.8, "zorder": 5}


@in_our_style
def trajectories(
    worlds: AnyScenario | State,
    agents: Any = "full_brake,e_v2x_bm",
    *,
    scenario: AnyScenario | None = None,
    number: int = 0,
    seed: int = 7,
    harm_count: AnyCount = HONEST,
) -> Figure:
    """Draw positions, gaps and commands of agents in one world over time: one column for each agent, equal scales.

    ``agents`` as in ``evaluate``, the other arguments as in ``record_episode``.
    """
    records = record_agents(worlds, agents, scenario=scenario, number=number, seed=seed, harm_count=harm_count)
    first, columns = next(iter(records.values())), len(records)
    figure, panels = new_panels(
        (max(3.4 * columns, 6.4), 7.4), 3, columns, sharex=True, sharey="row", height_ratios=(2.2, 1.0, 1.0)
    )
    for k, (title, record) in enumerate(records.items()):
        for axes, draw in zip(panels[k::columns], (_positions, _gaps, _commands), strict=True):
            draw(axes, record)
        harms = (float(record.last.harm(count)[0]) for count in IMPACT_COUNTS)
        text = "{}\nharm {:.2f} first-impact, {:.2f} total".format(label_text(title), *harms)
        panels[k].set_title(text, fontsize=9.5)
        panels[-1 - k].set_xlabel("Time since Vehicle 1 began to brake (s)")
    positions, gaps, commands = panels[::columns]
    positions.set_xlim(0.0, 1.1 * max(map(_rest_s, records.values())))
    gaps.set_ylim(bottom=0.0)
    commands.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    low, high = commands.get_ylim()
    commands.set_ylim(low, high + 0.35 * (high - low))  # leaves space for texts
    positions.set_ylabel("Position from Vehicle 1's\nat the alert (m)")
    gaps.set_ylabel("Gap ahead (m)")
    numbers = ", ".join(map(str, first.vehicles))
    commands.set_ylabel(f"Command of\nVehicle{'s' * (len(first.vehicles) > 1)} {numbers} (m/s²)")
    return finish(figure, f"{first.scenario}: {quantities(first.initial)}. {NOTE}", positions)


def _rest_s(record: EpisodeRecord) -> float:
    moving = np.flatnonzero((record.speeds_mps != 0.0).any(axis=1))
    return float(record.time_s[min(moving.max(initial=0) + 1, len(record.time_s) - 1)])


def _style(body: int) -> dict[str, Any]:
    return {"color": vehicle_colour(body), "linestyle": DASHES[(body - 1) % len(DASHES)], "linewidth": 1.6}


def _positions(axes: Axes, record: EpisodeRecord) -> None:
    """Draw positions of vehicles and obstacle over time, and impacts; first impacts with their closing speed (m/s)."""
    for i, places in enumerate(record.positions_m.T):
        axes.plot(record.time_s, places, label=f"Vehicle {i + 1}", **_style(i + 1))
    obstacle = float(record.initial.obstacle_gap_m[0])
    if np.isfinite(obstacle):
        axes.axhline(obstacle, color="black", linewidth=2.5, label="obstacle")
    rows, is_first = record.impacts, record.impacts.first_impact_harm > 0.0
    front = np.maximum(rows.pair - 1, 0)  # front vehicle of each impact, from 0; Vehicle 1 at the obstacle
    at = np.array([
        np.interp(t, record.time_s, record.positions_m[:, i]) for t, i in zip(rows.time_s, front, strict=True)
    ])  # fmt: skip
    axes.scatter(rows.time_s[is_first], at[is_first], facecolor="black", label="first impact", **IMPACT)
    later = IMPACT | {"s": 26.0, "zorder": 4}
    axes.scatter(rows.time_s[~is_first], at[~is_first], facecolor="white", label="later impact", **later)
    for k in np.flatnonzero(is_first):
        speed_mps = rows.closing_speed_mps[k]
        axes.annotate(
            f"{speed_mps:.1f}" if speed_mps >= 0.05 else "< 0.1",  # 0.0 would mean no impact
            (rows.time_s[k], at[k]), textcoords="offset points", fontsize=8.5, zorder=6, **CORNERS[rows.pair[k] % 4],
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip


def _gaps(axes: Axes, record: EpisodeRecord) -> None:
    for p, gaps in enumerate(record.gaps_m.T):
        axes.plot(record.time_s, gaps, **_style(p + 2))
    times = record.impacts.time_s[record.impacts.first_impact_harm > 0.0]
    axes.scatter(times, np.zeros(len(times)), facecolor="black", clip_on=False, **IMPACT)


def _commands(axes: Axes, record: EpisodeRecord) -> None:
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    for line, body in enumerate(record.vehicles):
        colour, latency = vehicle_colour(body), float(record.initial.latency_s[0, body - 1])
        axes.plot(record.time_s, record.command_mps2[:, body - 1], drawstyle="steps-post", color=colour, linewidth=1.4)
        axes.axvline(latency, color=colour, linewidth=0.8, linestyle=":")
        axes.annotate(
            f"acts from {latency:g} s", (latency, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -1 - 10 * line),
            textcoords="offset points", fontsize=8, color=colour, va="top",
        )  # fmt: skip


ABREAST = 4  # distributions in a row of the figure
MOST_NAMED = 4  # outlines in a distribution with a legend
LINE_RANKS = {"shortest line": 0.0, "median line": 0.5, "longest line": 1.0}  # relative rank of the sum of gaps
PICTURE = 224  # height (pixels) of road and speeds, the upper part of a picture


def write_worlds(path: Path, scenario: Scenario, episodes: int, *, seed: int, force: bool = False) -> None:
    write_picture(path, worlds_figure(scenario, scenario.draw(episodes, seed), seed=seed), force=force)


@in_our_style
def worlds_figure(scenario: Scenario, drawn_worlds: DrawnWorlds, *, seed: int) -> Figure:
    """Draw the distributions of what differs between worlds, and three worlds: least, median, largest sum of gaps."""
    varying = _varying_quantities(drawn_worlds)
    columns = min(max(len(varying), 1), ABREAST)
    rows = -(-len(varying) // columns)
    pictures = _pictures(scenario, drawn_worlds)
    height_in = 0.01 * len(pictures)
    figure = new_figure(8.0, 1.6 * rows + height_in + 0.4)
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=[*[1.6] * rows, height_in])
    for place, (rule, entries) in enumerate(varying.items()):
        _distribution(figure.add_subplot(grid[divmod(place, columns)]), rule, entries)
    axes = figure.add_subplot(grid[rows, :])
    axes.imshow(pictures)
    axes.set_axis_off()
    name = label_text(scenario.name, 80)
    return finish(
        figure, f"{name}, {count_of(drawn_worlds.worlds.n, 'world')} of the list of seed {seed}; shares of worlds."
    )


def _varying_quantities(drawn_worlds: DrawnWorlds) -> dict[Rule, dict[int, Floats]]:
    columns, varying = quantities_of(drawn_worlds.worlds, drawn_worlds.road), dict[Rule, dict[int, Floats]]()
    for rule in (rule for rule in QUANTITIES.values() if rule.column):
        for i in range(rule.count(drawn_worlds.worlds.vehicles)):
            values = columns.get(rule.column_of(i))
            if values is not None and np.nanmin(values) < np.nanmax(values):
                varying.setdefault(rule, {})[i] = values
    return varying


def _distribution(axes: Axes, rule: Rule, entries: dict[int, Floats]) -> None:
    values = [column[~np.isnan(column)] for column in entries.values()]
    axes.hist(
        values,
        np.histogram_bin_edges(np.concatenate(values), 24).tolist(),
        weights=[np.full(column.size, 1.0 / column.size) for column in values],
        histtype="step",
        color=[vehicle_colour(i + 1) for i in entries],
        linestyle=[DASHES[i % len(DASHES)] for i in entries],
        label=[rule.owner(i).replace("_", " ") for i in entries],
    )
    if 1 < len(values) <= MOST_NAMED:
        axes.legend(fontsize=6.5, loc="lower left", bbox_to_anchor=(0.0, 0.98), borderpad=0.0)
    axes.locator_params(nbins=3)
    axes.tick_params(labelsize=7)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    name = rule.key.removesuffix(f"_{rule.unit}") if rule.unit else rule.key
    unit = {"mps": "m/s", "mps2": "m/s²", "mps3": "m/s³"}.get(rule.unit, rule.unit)
    axes.set_xlabel(name.replace("_", " ") + (f" ({unit})" if unit else ""))


def _pictures(scenario: Scenario, drawn_worlds: DrawnWorlds) -> Frame:
    worlds = drawn_worlds.worlds
    ranked = np.argsort(worlds.gaps_m.sum(axis=1), kind="stable")
    rows = {name: int(ranked[round(rank * (worlds.n - 1))]) for name, rank in LINE_RANKS.items()}
    scenes = [
        Scene(
            f"World {worlds.clock[row, NUMBER]:.0f}, {name}", scenario.learners, False, 0.0, worlds.line[row],
            worlds.car[row], worlds.wanted[row], 0.0, (), (0.0, AHEAD_M),
        )
        for name, row in rows.items()
    ]  # fmt: skip
    left = min(scene.shown_m[0] for scene in scenes)
    right = AHEAD_M + max(scene.obstacle_m if scene.has_obstacle else 0.0 for scene in scenes)
    return np.concatenate([picture(scene._replace(road_m=(left, right)))[:PICTURE] for scene in scenes])
