"""How much of full braking's honest cost can be saved, by time gap: the figure of docs/findings.md.

    .venv/bin/python docs/studies/time_gaps.py docs/figures/time-gaps.png

Lines drive at 20 m/s, and all vehicles have the same time gap. All other quantities are drawn as in the scenario.
Agents that choose minimise the honest cost. Prints the harm and cost of each agent, and the saved share of full
braking's, by scenario, time gap and count of harm.
"""

from __future__ import annotations

import argparse

import numpy as np
from matplotlib.figure import Figure

import ethbrake_marl as eb
from ethbrake_marl.extensions.report.style import finish, in_our_style, new_panels, series_style, write_picture

WORLDS, SEED = 2000, 7
GAPS_S = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4)
AGENTS = ("full_brake", "e_v2x_bm", "idm", "plan")
COUNTS = {"first": "first_impact_harm", "total": "total_harm", "honest": "honest_cost"}
SCENARIOS = ("paper-random", "realistic-motorway")
LEAST = 0.05  # no share is shown if the mean harm of full braking (m2/s2) is below this


def with_time_gap(base: eb.Scenario, gap_s: float) -> eb.Scenario:
    """``base`` with a speed of 20 m/s and the time gap ``gap_s`` for all vehicles."""
    content = {key: value for key, value in base.declared().items() if key not in ("gaps_m", "speeds_mps")}
    deviations = content.get("speed_deviations_mps", {"uniform": [-2, 2]})
    return eb.load_scenario(content | {"time_gaps_s": gap_s, "line_speed_mps": 20, "speed_deviations_mps": deviations})


def mean_harm(scenario: eb.Scenario) -> dict[str, list[float]]:
    """Mean harm of each agent on the same worlds in m2/s2, by count of harm."""
    result = eb.evaluate(scenario, AGENTS, episodes=WORLDS, seed=SEED, harm_count="honest")
    return {count: [float(result[name][column].mean()) for name in AGENTS] for count, column in COUNTS.items()}


@in_our_style
def draw(harm: dict[str, np.ndarray]) -> Figure:
    """Figure: the saved share of full braking's honest cost by agent and time gap, a panel per scenario.

    ``harm``: scenario -> mean honest cost [time gaps, agents] in m2/s2.
    """
    figure, panels = new_panels((8.4, 3.6), columns=len(SCENARIOS), sharey=True)
    for axes, (name, rows) in zip(panels, harm.items(), strict=True):
        shown = rows[:, 0] > LEAST
        for k, agent in enumerate(AGENTS[1:]):
            share = 100.0 * (1.0 - rows[shown, k + 1] / rows[shown, 0])
            axes.plot(np.array(GAPS_S)[shown], share, label=agent, **series_style(k))
        axes.set(title=name, xlabel="time gap (s)", xlim=(GAPS_S[0] - 0.05, GAPS_S[-1] + 0.05), ylim=(0.0, 103.0))
    panels[0].set_ylabel("saved of full braking's honest cost (%)")
    panels[1].legend(fontsize=8.5)
    return finish(
        figure, f"{WORLDS:,} lines of seed {SEED} for each time gap. Lines end where full braking does almost no harm."
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", help="file for the figure")
    given = parser.parse_args()
    table: dict[str, dict[str, np.ndarray]] = {count: {} for count in COUNTS}
    for name in SCENARIOS:
        harms = [mean_harm(with_time_gap(eb.load_scenario(name), gap_s)) for gap_s in GAPS_S]
        for count in COUNTS:
            table[count][name] = np.array([each[count] for each in harms])
            for gap_s, row in zip(GAPS_S, table[count][name], strict=True):
                saved = " ".join(f"{1.0 - harm / row[0]:6.1%}" if row[0] > LEAST else "     –" for harm in row[1:])
                print(f"{name:20} {gap_s:.1f} s {count:6} {' '.join(f'{harm:6.2f}' for harm in row)}  saved {saved}")
    write_picture(given.picture, draw(table["honest"]), force=True)
