"""Figure of the worlds of a scenario: how the quantities are distributed, and three worlds to scale."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ethbrake_marl.episode.state import NUMBER
from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.rendering.picture import Frame, picture, vehicle_colour
from ethbrake_marl.extensions.rendering.scene import AHEAD_M, Scene
from ethbrake_marl.extensions.report.style import DASHES, finish, in_our_style, label_text, new_figure, write_picture
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.describe import quantities_of
from ethbrake_marl.worlds.rules import RULES, Rule
from ethbrake_marl.worlds.sampling import Drawn
from ethbrake_marl.worlds.scenario import Scenario

ABREAST = 4  # distributions in a row of the figure
MOST_NAMED = 4  # outlines in a distribution with a legend
SHOWN = {"shortest line": 0.0, "median line": 0.5, "longest line": 1.0}  # relative rank of the sum of gaps
PICTURE = 224  # height (pixels) of road and speeds, the upper part of a picture


def write_worlds(path: Path, scenario: Scenario, episodes: int, *, seed: int, force: bool = False) -> None:
    write_picture(path, worlds_figure(scenario, scenario.draw(episodes, seed), seed=seed), force=force)


@in_our_style
def worlds_figure(scenario: Scenario, drawn: Drawn, *, seed: int) -> Figure:
    """Draw the distribution of each quantity that differs between worlds, and three worlds at the alert."""
    varying = _varying(drawn)
    columns = min(max(len(varying), 1), ABREAST)
    rows = -(-len(varying) // columns)
    pictures = _pictures(scenario, drawn)
    height_in = 0.01 * len(pictures)
    figure = new_figure(8.0, 1.6 * rows + height_in + 0.4)
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=[*[1.6] * rows, height_in])
    for place, (rule, entries) in enumerate(varying.items()):
        _distribution(figure.add_subplot(grid[divmod(place, columns)]), rule, entries)
    axes = figure.add_subplot(grid[rows, :])
    axes.imshow(pictures)
    axes.set_axis_off()
    name = label_text(scenario.name, 80)
    return finish(figure, f"{name}, {count_of(drawn.worlds.n, 'world')} of the list of seed {seed}; shares of worlds.")


def _varying(drawn: Drawn) -> dict[Rule, dict[int, Floats]]:
    columns, varying = quantities_of(drawn.worlds, drawn.friction), dict[Rule, dict[int, Floats]]()
    for rule in (rule for rule in RULES.values() if rule.column):
        for i in range(rule.count(drawn.worlds.vehicles)):
            values = columns.get(rule.column_of(i))
            if values is not None and np.nanmin(values) < np.nanmax(values):
                varying.setdefault(rule, {})[i] = values
    return varying


def _distribution(axes: Axes, rule: Rule, entries: dict[int, Floats]) -> None:
    values = [each[~np.isnan(each)] for each in entries.values()]
    axes.hist(
        values,
        np.histogram_bin_edges(np.concatenate(values), 24).tolist(),
        weights=[np.full(each.size, 1.0 / each.size) for each in values],
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


def _pictures(scenario: Scenario, drawn: Drawn) -> Frame:
    worlds = drawn.worlds
    ranked = np.argsort(worlds.gaps_m.sum(axis=1), kind="stable")
    rows = {name: int(ranked[round(rank * (worlds.n - 1))]) for name, rank in SHOWN.items()}
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
