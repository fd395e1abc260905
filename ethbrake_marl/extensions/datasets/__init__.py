"""Write the episodes of agents to a Parquet file: observation, action and reward of every decision.

An agent's command is a float64 number in m/s2, but a learner's action is a float32 number in [-1, 1]. So each world is
simulated twice: first the agent drives, and its commands are rounded to actions; then learners take these actions. The
file contains the second episode. An environment that gets the recorded actions repeats this episode bit for bit.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agent_names import open_game, teams_of
from ethbrake_marl.agents.team import Team, play
from ethbrake_marl.episode.commands import actions_of
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import NUMBER, State
from ethbrake_marl.errors import InvalidInput, check_whole_number, naming_extras
from ethbrake_marl.evaluation.evaluate import SEED
from ethbrake_marl.evaluation.provenance import versions
from ethbrake_marl.files.store import check_target, new_file
from ethbrake_marl.worlds.open_game import AnyScenario

EPISODES_AT_ONCE = 500  # number of worlds simulated together; it limits memory and has no effect on the episodes


def to_parquet(
    path: str | Path,
    agents: Any,
    *,
    scenario: AnyScenario,
    episodes: int,
    seed: int = SEED,
    reward: Any = "honest",
    force: bool = False,
) -> None:
    """Let each of ``agents`` drive all learners in the worlds 0 to ``episodes`` - 1; write a row per agent, world,
    decision.

    docs/data.md describes the file. Raises ``InvalidInput`` for an invalid argument, ``AlreadyExists`` if the file
    exists and ``force`` is false, and ``MissingExtra`` without pyarrow.
    """
    loaded, game = open_game(scenario, reward=reward)
    if not loaded.learners:
        raise InvalidInput(f"to_parquet: scenario {loaded.name!r} has no learner; choose one that has")
    check_whole_number("to_parquet: episodes", episodes, 1)
    teams = teams_of(agents, loaded)
    names = {body: loaded.vehicle_names[body - 1] for body in loaded.learners}
    about = {
        "scenario": loaded.declared(),
        "seed": int(seed),
        "learners": list(names.values()),
        "agents": list(teams),
        "observation": {name: list(game.views[body].names) for body, name in names.items()},
        "reward": game.rewarding.params.model_dump(mode="json"),
        "versions": versions(),
    }
    with naming_extras():
        import pyarrow
        from pyarrow.parquet import ParquetWriter

    def tables() -> Iterator[Any]:
        for name, team in teams.items():
            for first in range(0, episodes, EPISODES_AT_ONCE):
                alert = loaded.sample(min(EPISODES_AT_ONCE, episodes - first), seed, first=first)
                rows = list(decisions(game, alert, rounded_actions(team, game, alert)))
                columns = {column: np.concatenate([row[column] for row in rows]) for column in rows[0]}
                order = np.argsort(columns["world"], kind="stable")  # one episode after the other
                table = {"agent": np.full(len(order), name)} | {key: values[order] for key, values in columns.items()}
                yield pyarrow.table(table, metadata={"ethbrake_marl": json.dumps(about)})

    with new_file(check_target(path, force=force)) as partial:
        batches = tables()
        table = next(batches)
        with ParquetWriter(partial, table.schema) as writer:
            for following in chain([table], batches):
                writer.write_table(following)


def rounded_actions(team: Team, game: Game, alert: State) -> list[Observations]:
    """Commands of a team as float32 actions of the L learners, [n, L] for each decision."""
    learners = game.settings.learners
    return [
        actions_of(state, learners, state.wanted[:, learners]).astype(np.float32)
        for step, state in play(game, alert, team)
        if step is not None
    ]


def decisions(game: Game, alert: State, actions: list[Observations]) -> Iterator[dict[str, Any]]:
    """Columns of the file for each decision, name -> a value for each world that has not ended, under ``actions`` [n,
    L].
    """
    state, learners = game.reset(alert), game.settings.learners.tolist()
    while not state.ended.all():
        rows, observations = ~state.ended, game.observe(state, game.settings.learners)
        t = int(state.steps.max())
        action = actions[min(t, len(actions) - 1)]
        after, step = game.step(state, action.astype(np.float64))
        columns = {
            "world": state.clock[rows, NUMBER].astype(np.int64),
            "decision": np.full(rows.sum(), t),
            "time_s": state.time_s[rows],
        }
        columns |= {f"gap_{p}_m": gap[rows] for p, gap in enumerate(state.gaps_m.T, 1)}
        columns |= {f"speed_{i}_mps": speed[rows] for i, speed in enumerate(state.speeds_mps.T, 1)}
        for c, i in enumerate(learners):
            features = zip(game.views[i].names, observations[c][rows].T, strict=True)
            columns |= {f"observation_{i}.{name}": column for name, column in features}
            columns |= {f"action_{i}": action[rows, c], f"reward_{i}": step.reward[rows, i - 1]}
        yield columns | {"terminated": step.terminated[rows], "truncated": step.truncated[rows]}
        state = after
