"""Several learners at equal processor time: table ``equal-learners`` of docs/results/cooperation.json, and its figure.

    python docs/studies/cooperative.py runs/learners --seeds 0 1 2 3 4        # trains what is missing there
    python docs/studies/cooperative.py runs/learners --draw docs/figures/cooperative-learners.png

Needs the extra `marl`. ``STEPS`` are about 20 s of one core; what each training took stands in the table, without
imports and compiling. Every method observes the same, and its last policy is driven: nothing is chosen on the way.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

import ethbrake_marl as eb
from ethbrake_marl.evaluation.seeds import interquartile_mean
from ethbrake_marl.extensions.report.style import GREY, finish, name_axes, new_panels, series_style, write_picture
from ethbrake_marl.physics.state import Floats
from tests.docs.site import load

METHODS = {
    "options": "recipe `options`, in small rounds",
    "cooperation": "recipe `cooperation` (counterfactuals)",
    "ppo": "SB3's PPO, shared (recipe `cooperation-ppo`)",
    "ippo": "BenchMARL's IPPO",
    "mappo": "BenchMARL's MAPPO",
}
STEPS = {  # decisions of all learners, in the order of METHODS
    "cooperation-3-pair": (400_000, 1_000_000, 550_000, 260_000, 260_000),
    "cooperation-4-all": (480_000, 1_000_000, 450_000, 270_000, 270_000),
}
KIN = ("ppo", "ippo", "mappo")  # these learn by the settings of PPO's recipe
WORLDS, SEED = 2000, 7
SEEN = ["own", "front_1", "rear_1", "role", "obstacle"]
SMALL = {
    "reward": {"harm": 1.0, "harm_count": "first"}, "n_steps": 4, "tried": 400, "gradient_steps": 60, "memory": 40_000,
    "learning_rate": {"start": 2e-3, "end": 3e-5},
}  # fmt: skip
HEAD = ["scenario", "method", "seeds", "decisions", "CPU", "first-impact", "IQM", "total", "IQM", "P(less than PPO)"]
Harms = dict[str, tuple[float, Floats]]  # method -> processor seconds, harms [seeds, 2]


def learn(method: str, scenario: eb.Scenario, steps: int, seed: int, folder: Path) -> float:
    """Train into the new folder; processor seconds."""
    begun = time.process_time()
    recipe = eb.load_recipe("cooperation-ppo" if method in KIN else method)
    recipe = recipe.replace(observation=SEEN, total_steps=steps, seed=seed, **(SMALL if method == "options" else {}))
    if method in ("ippo", "mappo"):
        load("../../train/benchmarl_mappo").train_mappo(recipe, scenario, folder, method)
    else:
        eb.train(recipe, scenario, folder, measure=None, on_progress=None)
    return time.process_time() - begun


def learn_missing(runs: Path, seeds: Sequence[int]) -> None:
    """Train what the folder has not: ``LEVEL/METHOD-SEED``, and its processor seconds beside it."""
    with TemporaryDirectory() as scratch:
        for method in METHODS:  # compiles, imports
            learn(method, eb.load_scenario("cooperation-3-pair"), 1, 0, Path(scratch) / method)
    for seed, method, level in product(seeds, METHODS, STEPS):
        folder = runs / level / f"{method}-{seed}"
        if not folder.with_suffix(".txt").exists():
            steps = STEPS[level][list(METHODS).index(method)]
            cpu_s = learn(method, eb.load_scenario(level), steps, seed, folder)
            folder.with_suffix(".txt").write_text(f"{cpu_s:.1f}\n", "utf-8")
            print(f"{folder}: {cpu_s:.1f} s", flush=True)


def drive(runs: Path, level: str) -> tuple[Harms, Floats]:
    """First-impact and total harm of what was trained for a level, and of full braking, on its list."""
    scenario, files = eb.load_scenario(level), sorted((runs / level).glob("*.txt"))
    agents = {each.stem: eb.make_agent(f"team@{each.with_suffix('')}", scenario=scenario) for each in files}
    agents["full_brake"] = eb.make_agent("full_brake")
    found = eb.evaluate(scenario.sample(WORLDS, SEED), agents, scenario=scenario, aftermath=False)
    mean = {n: np.array([found.outcome(n).ledger.world_harm(c).mean() for c in ("first", "total")]) for n in agents}
    harms: Harms = {}
    for method in METHODS:
        own = [each for each in files if each.stem.rpartition("-")[0] == method]
        if own:
            cpu_s = np.mean([float(each.read_text("utf-8")) for each in own])
            harms[method] = float(cpu_s), np.array([mean[each.stem] for each in own])
    return harms, mean["full_brake"]


def lines(level: str, harms: Harms, braking: Floats) -> list[list[str]]:
    """The rows of a level."""
    found = [[f"`{level}`", "full braking", "–", "–", "–", f"{braking[0]:.2f}", "–", f"{braking[1]:.2f}", "–", "–"]]
    ppo = harms["ppo"][1][:, 0]
    for method, (cpu_s, harm) in harms.items():
        steps = STEPS[level][list(METHODS).index(method)]
        middle = [interquartile_mean([each]).in_words() if len(each) > 1 else "–" for each in harm.T]
        cells = [f"{harm[:, 0].mean():.2f}", middle[0], f"{harm[:, 1].mean():.2f}", middle[1]]
        pairs = np.sign(ppo - harm[:, :1])  # 1: less harm than that run of PPO's
        less = f"{0.5 + 0.5 * pairs.mean():.2f}" if len(harm) > 1 else "–"
        found.append([f"`{level}`", METHODS[method], f"{len(harm)}", f"{steps:,}", f"{cpu_s:.0f} s", *cells, less])
    return found


def draw(found: Mapping[str, tuple[Harms, Floats]]) -> Figure:
    """The interquartile mean of each method with its interval, and every seed, a panel for each level."""
    figure, panels = new_panels((9.4, 3.2), columns=len(found), sharey=True)
    for axes, (level, (harms, braking)) in zip(panels, found.items(), strict=True):
        for row, method in enumerate(METHODS):
            for number, what in enumerate(("first-impact harm", "total harm")):
                style, at = series_style(number + 1), row + 0.24 * number - 0.12
                values = harms[method][1][:, number]
                middle = interquartile_mean([values])
                axes.plot(values, [at] * len(values), ".", color=style["color"], alpha=0.5, markersize=5)
                axes.hlines(at, *middle.ends, color=style["color"], linewidth=1.6)
                axes.plot(middle.value, at, style["marker"], color=style["color"], label="_" * bool(row) + what)
        axes.axvline(braking[0], color=GREY, linewidth=0.9, linestyle="--", label="full braking, first-impact")
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_yticks(range(len(METHODS)), [name.replace("`", "") for name in METHODS.values()], fontsize=8)
        name_axes(axes, level, "Harm (m²/s²)")
    panels[0].invert_yaxis()
    caption = (
        f"Interquartile means over seeds (dots) with 95 % intervals; {WORLDS:,} worlds of the list of seed {SEED}."
    )
    return finish(figure, caption, panels[0])


def main() -> None:
    """Train, or else drive all that was trained, print the rows and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[])
    parser.add_argument("--draw", type=Path)
    given = parser.parse_args()
    if given.seeds:
        learn_missing(given.runs, given.seeds)
    if given.draw:
        found = {level: drive(given.runs, level) for level in STEPS}
        write_picture(given.draw, draw(found), force=True)
        every = [HEAD, ["---"] * len(HEAD), *(line for level, each in found.items() for line in lines(level, *each))]
        print("\n".join(f"| {' | '.join(line)} |" for line in every))


if __name__ == "__main__":
    main()
