"""How much does each piece of a message reduce harm? Prints a Markdown table of the harm without each piece.

    python docs/studies/message_contents.py runs/pieces --seeds 5     # trains missing policies, prints the table
    python docs/studies/message_contents.py runs/pieces --jobs 16     # the same, in 16 processes
    python docs/studies/message_contents.py runs/pieces --quick       # a one-minute check; the results mean nothing

There are three lines of vehicles: ``paper-random``, a line of five of which four learn, and ``paper-random`` over a
channel that loses half of its messages and a fifth of its links. Messages contain the usual pieces, the usual pieces
without one, the usual pieces with the intent, or only the alert. For each combination policies are trained and
evaluated on the same worlds. Five seeds take two to three hours on one core. All policies observe the same features; a
feature that needs a missing piece reads 0. The last policy of a training is used, not the best.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.extensions.cooperation import mean_over_seeds
from ethbrake_marl.extensions.messages.declared import DEFAULT_CONTENT
from ethbrake_marl.files.sheet import Column
from ethbrake_marl.motion.layout import Floats

LINES = {  # line of vehicles -> scenario, channel
    "`paper-random`": ("paper-random", {"preset": "paper"}),
    "line of five": ("cooperation-3-five", {"preset": "paper"}),
    "lossy channel": ("paper-random", {"preset": "blocked", "persistence": "periodic"}),
}
ALL = "the usual pieces"
CONTENTS: dict[str, tuple[str, ...]] = {
    ALL: DEFAULT_CONTENT,
    **{
        f"without {one.replace('_', ' ')}": tuple(each for each in DEFAULT_CONTENT if each != one)
        for one in DEFAULT_CONTENT
    },
    "with intent": (*DEFAULT_CONTENT, "intent"),
    "the alert alone": (),
}
SEEN = ["own", "front_1", "rear_1", "role", "front_1.intent", "rear_1.intent"]
SEED = 7
HEAD = ["messages contain", *(f"{line}, {what}" for line in LINES for what in ("total harm", "change"))]


class Effort(NamedTuple):
    seeds: int  # trainings per combination
    steps: int  # decisions of each learner in a training
    worlds: int  # worlds of the evaluation


def scenario_of(line: str, contents: str) -> eb.Scenario:
    """Scenario of a line of vehicles whose messages have these ``contents``."""
    name, channel = LINES[line]
    return eb.load_scenario(name).replace(v2x={**channel, "tells": list(CONTENTS[contents])})


def learn(runs: Path, line: str, contents: str, steps: int, seed: int) -> Path:
    """Folder of a training. Train first if the folder has no policy."""
    scenario = scenario_of(line, contents)
    folder = runs / f"{line.strip('`')}-{contents}-{steps}-{seed}".replace(" ", "-")
    several = len(scenario.learners)
    recipe = eb.load_recipe("cooperation").replace(
        observation=SEEN, total_steps=steps * several, seed=seed, reward={"harm": 1.0, "harm_count": "total"},
        **({"scheme": "shared"} if several > 1 else {}),
    )  # fmt: skip
    if not (folder / "policy-last").exists():
        eb.train(recipe, scenario, folder, measure=None, on_progress=None, force=True)
    return folder


def harms(runs: Path, line: str, contents: str, effort: Effort) -> Floats:
    """Total harm of the policy of every seed, [seeds, worlds] in m2/s2."""
    scenario = scenario_of(line, contents)
    folders = [learn(runs, line, contents, effort.steps, seed) for seed in range(effort.seeds)]
    agents = {folder.name: eb.LearnedAgent(eb.load_policy(folder / "policy-last")) for folder in folders}
    result = eb.evaluate(scenario, agents, episodes=effort.worlds, seed=SEED)
    return np.stack([result[name]["total_harm"] for name in agents])


def table(runs: Path, effort: Effort) -> list[list[str]]:
    """Rows: harm, and its change from the usual pieces, with 95 % intervals over seeds and worlds."""
    found = {(line, each): harms(runs, line, each, effort) for line in LINES for each in CONTENTS}
    rows = []
    for each in CONTENTS:
        row = [each]
        for line in LINES:
            change = Column("", sign="+").show(mean_over_seeds(found[line, each], found[line, ALL])).in_words
            row += [mean_over_seeds(found[line, each]).in_words(), "–" if each == ALL else change]
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=300_000, help="decisions of each learner in a training")
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel trainings")
    parser.add_argument("--quick", action="store_true", help="one seed of 4,096 decisions, 50 worlds")
    given = parser.parse_args()
    effort = Effort(1, 4_096, 50) if given.quick else Effort(given.seeds, given.steps, 4_000)
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        trainings = product([given.runs], LINES, CONTENTS, [effort.steps], range(effort.seeds))
        list(pool.map(learn, *zip(*trainings, strict=True)))
    rows = table(given.runs, effort)
    print("\n".join(f"| {' | '.join(row)} |" for row in [HEAD, ["---"] * len(HEAD), *rows]))


if __name__ == "__main__":
    main()
