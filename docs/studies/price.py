"""The price of not knowing: table and figure of docs/cooperation.md.

    .venv/bin/python docs/studies/price.py docs/figures/price-of-not-knowing.png

Compares agents that decide only on received messages with the same agents that know the line exactly. The price is the
difference of their harms, paired by world.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

import ethbrake_marl as eb
from ethbrake_marl.evaluation.statistics import difference, mean, rate
from ethbrake_marl.extensions.report.style import GREY, finish, in_our_style, new_panels, series_style, write_picture
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.channel import V2X

SCENARIO, WORLDS, SEED = "cooperation-2-paper", 1000, 7
PRESETS = ("paper", "clear", "nominal", "congested", "blocked", "sensors-only")
POLICY = "ppo"
ALONE = ("full_brake", POLICY)  # agents that have no variant ``estimated``
LIMITS = {f"{POLICY}+step:estimated": f"{POLICY}+step"}  # shield that decides on messages -> one that knows the line
COUNTS = {"first": "first_impact_harm", "total": "total_harm"}
CAPTION = (
    f"{SCENARIO} over each channel: {WORLDS:,} worlds of the list of seed {SEED}. Harm of the agent that decides on"
    " received messages, minus harm of the same agent that knows the line exactly; 95 % intervals, paired by world."
)


def channels() -> dict[str, dict[str, str]]:
    """Channels by name: each preset, and each preset with messages also with periodic messages."""
    named = {}
    for preset in PRESETS:
        named[preset] = {"preset": preset}
        channel = V2X.model_validate(preset)
        if channel.timing == "messages" and channel.hears != "none":
            named[f"{preset}, periodic"] = {"preset": preset, "persistence": "periodic"}
    return named


def first_bound(game: eb.Game, alert: eb.State, last: eb.State) -> Floats | None:
    """Bound of the agent's shield at the alert, m2/s2."""
    return getattr(last.memories.get("shield"), "first", None)


def drive(scenario: eb.Scenario, n: int, lines: Mapping[str, dict[str, str]]) -> dict[str, eb.Result]:
    """Evaluate all agents and their exact counterparts in the first ``n`` worlds of the list, over every channel.

    ``lines``: name of a channel -> settings of ``v2x``.
    """
    eb.register_measure("first_bound", first_bound, unit="m2/s2")
    agents = list(dict.fromkeys((*ALONE, *LIMITS, *LIMITS.values())))
    return {
        name: eb.evaluate(
            scenario.replace(v2x=v2x), agents, episodes=n, seed=SEED, measures="first_bound", harm_count="first"
        )
        for name, v2x in lines.items()
    }


def price(over: eb.Result, agent: str, count: str) -> Estimate:
    """Harm of the agent minus the harm of its exact counterpart, over one channel."""
    own, limit = (over[spec][COUNTS[count]] for spec in (agent, LIMITS[agent]))
    return difference(own, limit)


def above(over: eb.Result, agent: str) -> Estimate | None:
    """Share of worlds with more harm than the first bound of the agent's shield; None without a shield."""
    own = over[agent]
    return rate(own["first_impact_harm"] > own["first_bound"] + 1e-6) if "first_bound" in own else None


def tables(found: Mapping[str, eb.Result]) -> str:
    """Markdown tables: one of the agents without counterpart, and one per compared agent; a row per channel."""
    head = ["channel", *(f"`{agent}`, {count}" for agent in ALONE for count in COUNTS)]
    lines = [
        [name, *(mean(over[agent][COUNTS[count]]).in_words() for agent in ALONE for count in COUNTS)]
        for name, over in found.items()
    ]
    return "\n\n".join([markdown(head, lines), *(compared(found, agent) for agent in LIMITS)])


def compared(found: Mapping[str, eb.Result], agent: str) -> str:
    words = (f"`{LIMITS[agent]}`", f"`{agent}`", "price")
    head = ["channel", *(f"{word}, {count}" for count in COUNTS for word in words)]
    lines = []
    for name, over in found.items():
        cells = [name]
        for count in COUNTS:
            harms = (over[spec][COUNTS[count]].mean() for spec in (LIMITS[agent], agent))
            cells += [*(f"{harm:.2f}" for harm in harms), price(over, agent, count).in_words()]
        share = above(over, agent)
        lines.append(cells if share is None else [*cells, share.in_words(scale=100, unit=" %")])
    return markdown(head if len(lines[0]) == len(head) else [*head, "above its bound"], lines)


def markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = "| --- |" + " ---: |" * (len(head) - 1)
    return "\n".join(["| " + " | ".join(head) + " |", rule, *("| " + " | ".join(cells) + " |" for cells in lines)])


@in_our_style
def draw(found: Mapping[str, eb.Result]) -> Figure:
    """Draw the prices: a group of bars per channel, a bar per agent, a panel per count of harm."""
    units = ("price, first-impact harm (m²/s²)", "price, total harm (m²/s²)")
    at, width = np.arange(len(found)), 0.8 / len(LIMITS)
    figure, panels = new_panels((8.4, 7.2), 2, sharex=True)
    for axes, count, unit in zip(panels, COUNTS, units, strict=True):
        for number, agent in enumerate(LIMITS):
            prices = [price(over, agent, count) for over in found.values()]
            value = np.array([each.value for each in prices])
            ends = np.array([each.interval or (each.value, each.value) for each in prices]).T
            axes.bar(
                at + (number - (len(LIMITS) - 1) / 2) * width, value, width, label=agent,
                color=series_style(number)["color"], yerr=np.abs(ends - value),
                error_kw={"ecolor": GREY, "elinewidth": 0.8},
            )  # fmt: skip
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set_ylabel(unit)
    axes.set_xticks(at, list(found), rotation=30, ha="right", fontsize=8.5)
    panels[0].legend(fontsize=8.5)
    return finish(figure, CAPTION)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", help="file for the figure")
    given = parser.parse_args()
    results = drive(eb.load_scenario(SCENARIO), WORLDS, channels())
    write_picture(given.picture, draw(results), force=True)
    print(tables(results))
