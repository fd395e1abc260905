"""How much latency may V2X have before nothing can help? The figure of docs/paper.md.

    .venv/bin/python docs/studies/paper/latency.py docs/figures/latency.png

The least contact rate and the least harm of every strategy in the paper's random test, over the latencies of Vehicles
2 and 3: whether contact is unavoidable is proven in closed form (measure ``contact_avoidable``); the harm is the proven
lower bound (``proven_harm``). Vehicle 2 acts first. Worlds in which it collides before it may act are drawn again, as
in the paper. Prints both tables.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import ethbrake_marl as eb
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.extensions.report.style import finish, in_our_style, new_panels, write_picture

SEED, WORLDS, BOUNDED_WORLDS = 7, 10_000, 1_000
ACTS_S = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
REAR_S = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


def least(acts_s: float, rear_s: float) -> tuple[float, float]:
    """Least contact rate (%) and least mean harm (m2/s2); NaN if Vehicle 2 would act after Vehicle 3."""
    if acts_s > rear_s:
        return np.nan, np.nan
    scenario = eb.load_scenario("paper-random").replace(latency_s=[0.0, acts_s, rear_s])
    certain = ~avoidability(scenario.sample(WORLDS, SEED), 2).avoidable
    few = scenario.sample(BOUNDED_WORLDS, SEED)
    bound = lower_bound(few, harm_count="first", horizon_s=scenario.horizon_s, time_step_s=scenario.time_step_s)
    return 100.0 * float(certain.mean()), float(bound.harm.mean())


@in_our_style
def draw(rates: np.ndarray, harms: np.ndarray) -> Figure:
    """``rates`` (%) and ``harms`` (m2/s2): [ACTS_S, REAR_S]."""
    figure, panels = new_panels((10.0, 4.4), columns=2)
    titles = "least contact rate (%)", "least harm (m²/s²)"
    for axes, table, title, digits in zip(panels, (rates, harms), titles, (0, 1), strict=True):
        axes.grid(visible=False)
        axes.imshow(table, cmap="YlOrRd", origin="lower", aspect="auto")
        for (k, j), value in np.ndenumerate(table):
            if not np.isnan(value):
                dark = value > 0.6 * np.nanmax(table)
                axes.text(j, k, f"{value:.{digits}f}", ha="center", va="center", color="white" if dark else "black")
        axes.set(title=title, xlabel="latency of Vehicle 3 (s)", ylabel="latency of Vehicle 2 (s)")
        axes.set_xticks(range(len(REAR_S)), [f"{each:g}" for each in REAR_S])
        axes.set_yticks(range(len(ACTS_S)), [f"{each:g}" for each in ACTS_S])
    return finish(figure, "Whoever drives Vehicle 2, in the paper's random test. The paper: 0.5 and 0.8 s.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("picture", type=Path)
    picture = parser.parse_args().picture
    table = np.array([[least(acts_s, rear_s) for rear_s in REAR_S] for acts_s in ACTS_S])
    for k, what in enumerate(("least contact rate (%)", "least harm (m2/s2)")):
        print(f"{what}; rows: Vehicle 2 at {ACTS_S}, columns: Vehicle 3 at {REAR_S}")
        print("\n".join(" ".join(f"{value:6.2f}" for value in row) for row in table[:, :, k]))
    write_picture(picture, draw(table[:, :, 0], table[:, :, 1]), force=True)


if __name__ == "__main__":
    main()
