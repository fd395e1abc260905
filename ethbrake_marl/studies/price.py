"""The price of not knowing: agents that see through a channel beside the same ones on what was received."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.identity import identity_line
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.figures.bars import draw_bars
from ethbrake_marl.figures.style import Figure, write_picture
from ethbrake_marl.scenario import Scenario, load_scenario

CHANNELS = ("paper", "clear", "nominal", "congested", "blocked", "sensors-only")
POLICY = "ppo@shipped/ppo"
PAIRS = (  # who sees through the channel, and the same on what was received
    ("e_v2x_bm", "e_v2x_bm:believed"),
    ("planner:128", "planner:128:believed"),
    (f"{POLICY}+step", f"{POLICY}+step:believed"),
)
ALONE = ("full_brake", POLICY, f"{POLICY}+robust:believed")
ABOVE = 1e-6  # m2/s2 above the bound that count


@dataclass(frozen=True, slots=True)
class PriceRow:
    """One channel: mean first-impact harm of every agent, and of those with a bound how often it was exceeded."""

    channel: str  # the preset, with ``, periodic`` behind it where messages are
    harm: dict[str, float]  # m2/s2
    above: dict[str, float]  # share of worlds above what the agent expected first; only of those that expect


def channels_of(presets: Sequence[str] = CHANNELS) -> dict[str, dict[str, str]]:
    """The channels by name: each preset, and where it sends messages one by one also periodic."""
    found: dict[str, dict[str, str]] = {}
    for preset in presets:
        found[preset] = {"preset": preset}
        if preset not in ("paper", "sensors-only"):
            found[f"{preset}, periodic"] = {"preset": preset, "persistence": "periodic"}
    return found


def price_of(scenario: Scenario, name: str, v2x: dict[str, str], agents: Sequence[str], n: int, seed: int) -> PriceRow:
    """Every agent on the first ``n`` worlds of the list of ``seed`` over one channel."""
    over = scenario.replace(v2x=v2x)
    result = evaluate(over.sample(n, seed), {a: make_agent(a, scenario=over) for a in agents}, scenario=over)
    harm = {agent: result.outcome(agent).first_impact_harm for agent in agents}
    expected = {agent: result.outcome(agent).predicted_harm for agent in agents}
    above = {a: float((harm[a] > e + ABOVE).mean()) for a, e in expected.items() if e is not None}
    return PriceRow(name, {agent: float(np.mean(values)) for agent, values in harm.items()}, above)


def price_table(rows: Sequence[PriceRow]) -> str:
    """The mean harms as a Markdown table, a line per channel; of a shield on what was received also its bound."""
    agents = list(rows[0].harm)
    shown = [a for a in agents if "+" in a and a.endswith(":believed")]
    head = ["channel", *(f"`{a}`" for a in agents), *(f"above, `+{a.rpartition('+')[2]}`" for a in shown)]
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    for row in rows:
        cells = [f"{row.harm[a]:.2f}" for a in agents] + [f"{row.above[a]:.1%}" for a in shown]
        lines.append("| " + " | ".join([row.channel, *cells]) + " |")
    return "\n".join(lines)


def price_figure(rows: Sequence[PriceRow], caption: str) -> Figure:
    """The price of each pair per channel: harm on what was received minus that of the one that sees through."""
    series = [
        (omniscient, [row.harm[believing] - row.harm[omniscient] for row in rows]) for omniscient, believing in PAIRS
    ]
    return draw_bars([row.channel for row in rows], series, "Price of not knowing (m²/s²)", caption=caption)


def price_report(
    figure_path: str | Path,
    *,
    scenario: str = "cooperation-2-paper",
    presets: Sequence[str] = CHANNELS,
    n: int = 100,
    seed: int = 7,
) -> str:
    """Run the whole study, write its figure and return its table as Markdown; an older figure is overwritten."""
    chosen = load_scenario(scenario)
    agents = [ALONE[0], ALONE[1], *(agent for pair in PAIRS for agent in pair), ALONE[2]]
    rows = [price_of(chosen, name, v2x, agents, n, seed) for name, v2x in channels_of(presets).items()]
    caption = (
        f"{scenario} over each channel: {count_of(n, 'world')}, seed {seed}. First-impact harm on what was received,"
        " minus that of the same agent which reads the line as it is."
    )
    write_picture(figure_path, price_figure(rows, caption), force=True)
    return "\n\n".join([price_table(rows), identity_line(chosen, chosen.sample(n, seed))])
