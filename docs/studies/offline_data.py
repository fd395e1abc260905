"""The offline data of a task: what agents observe, do and receive in the worlds of seed 1, for pandas, as Parquet.

    python docs/studies/offline_data.py benchmark-single benchmark-single.parquet

An agent's command is a float64 number in m/s2, but a learner's action is a float32 number in [-1, 1]. So each world is
simulated twice: first the agent drives, and its commands are rounded to actions; then learners take these actions. The
file contains the second episode. An environment that gets the recorded actions repeats this episode bit for bit.

Prints the SHA-256 of the columns, which does not depend on versions. Use one agent's rows, or all rows as mixed data.
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path

import numpy as np
import pandas as pd

import ethbrake_marl as eb
from ethbrake_marl.agent_names import require_learner, teams_of
from ethbrake_marl.agents.team import Team, play
from ethbrake_marl.episode.commands import actions_of, commands_of
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import NUMBER
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.files.store import check_target

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


def rounded_actions(game: Game, alert: eb.State, team: Team) -> list[np.ndarray]:
    """Commands of a team as float32 actions of the L learners, [n, L] for each decision."""
    learners = game.settings.learners
    states = [state for step, state in play(game, alert, team) if step is not None]
    return [actions_of(state, learners, state.wanted[:, learners]).astype(np.float32) for state in states]


def recorded(game: Game, alert: eb.State, team: Team) -> pd.DataFrame:
    """One row for each world and decision, one episode after the other."""
    actions, state, frames = rounded_actions(game, alert, team), game.reset(alert), []
    while not state.ended.all():
        rows, decision = ~state.ended, int(state.steps.max())
        observations, action = game.observe(state, game.settings.learners), actions[min(decision, len(actions) - 1)]
        after, step = game.step(state, action.astype(np.float64))
        columns = {"agent": team.name, "world": state.clock[:, NUMBER].astype(np.int64), "decision": decision}
        columns |= {"time_s": state.time_s} | {f"gap_{p}_m": gap for p, gap in enumerate(state.gaps_m.T, 1)}
        columns |= {f"speed_{i}_mps": speed for i, speed in enumerate(state.speeds_mps.T, 1)}
        for c, i in enumerate(game.settings.learners.tolist()):
            features = zip(game.views[i].names, observations[c].T, strict=True)
            columns |= {f"observation_{i}.{name}": feature for name, feature in features}
            columns |= {f"action_{i}": action[:, c], f"reward_{i}": step.reward[:, i - 1]}
        columns |= {"terminated": step.terminated, "truncated": step.truncated}
        frames.append(pd.DataFrame(columns)[rows])
        state = after
    return pd.concat(frames).sort_values("world", kind="stable")


def digest(frame: pd.DataFrame) -> str:
    """SHA-256 of the columns, in their order."""
    total = hashlib.sha256()
    for name, column in frame.items():
        total.update(str(name).encode())
        total.update("\n".join(column).encode() if name == "agent" else column.to_numpy().tobytes())
    return total.hexdigest()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="name of a scenario, or path of its file")
    parser.add_argument("output", type=Path, help="new Parquet file")
    parser.add_argument(
        "--agents", default="e_v2x_bm,plan,random", help="agents by name; random draws actions (default: %(default)s)"
    )
    parser.add_argument("--episodes", type=int, default=EPISODES, help="of each agent (default: %(default)s)")
    args = parser.parse_args()
    try:
        check_target(args.output)
        scenario, game = eb.open_game(args.task, reward={"harm": 1.0, "harm_count": "honest"})
        require_learner(scenario)
        agents = {name: Random() if name == "random" else name for name in args.agents.split(",")}
        teams = teams_of(agents, scenario)
        alert = scenario.sample(args.episodes, SEED)
        frame = pd.concat([recorded(game, alert, team) for team in teams.values()], ignore_index=True)
        frame.to_parquet(args.output)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    print(f"{args.output}: SHA-256 of the columns {digest(frame)}")
