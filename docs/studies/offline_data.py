"""The offline data set of a task: E-V2X-BM, `plan` and random commands in the worlds of seed 1.

    python docs/studies/offline_data.py benchmark-single benchmark-single.parquet

Prints the SHA-256 of the columns, which does not depend on versions. Use one agent's rows, or all rows as mixed data.
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path

import numpy as np
import pyarrow.parquet

import ethbrake_marl as eb
from ethbrake_marl.episode.commands import commands_of
from ethbrake_marl.episode.state import NUMBER
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.extensions.datasets import to_parquet

EPISODES, SEED = 1000, 1
MOST = 1000  # random actions of an episode


class Random:
    """Agent that draws a uniform action at each decision. The draws of a world depend on its number alone."""

    name, knows = "random", "own sensors"

    def begin(self, alert: eb.State, body: int) -> np.ndarray:
        numbers = alert.clock[:, NUMBER].astype(int).tolist()
        return np.array([np.random.default_rng([SEED, body, number]).uniform(-1.0, 1.0, MOST) for number in numbers])

    def act(self, state: eb.State, memory: np.ndarray, body: int) -> tuple[np.ndarray, np.ndarray]:
        actions = memory[np.arange(state.n), np.minimum(state.steps.astype(int), MOST - 1)]
        return commands_of(state, body, actions), memory


def digest(path: Path) -> str:
    """SHA-256 of the columns of a Parquet file, in their order."""
    total = hashlib.sha256()
    table = pyarrow.parquet.read_table(path)
    for name in table.column_names:
        column = table[name].to_numpy()
        total.update(name.encode() + ("\n".join(column).encode() if name == "agent" else column.tobytes()))
    return total.hexdigest()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="name of a scenario, or path of its file")
    parser.add_argument("output", type=Path, help="new Parquet file")
    parser.add_argument("--episodes", type=int, default=EPISODES, help=f"of each agent (default: {EPISODES})")
    args = parser.parse_args()
    agents = {name: eb.make_agent(name, scenario=args.task, harm_count="honest") for name in ("e_v2x_bm", "plan")}
    try:
        to_parquet(
            args.output, {**agents, "random": Random()}, scenario=args.task, episodes=args.episodes, seed=SEED,
            reward={"harm": 1.0, "harm_count": "honest"},
        )  # fmt: skip
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    print(f"{args.output}: SHA-256 of the columns {digest(args.output)}")
