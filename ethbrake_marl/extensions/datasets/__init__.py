"""Write the episodes of agents to a Parquet file: observation, action and reward of every decision.

An agent's command is a float64 number in m/s2, and a learner's action a float32 number in [-1, 1]. So each world is
simulated twice: first the agent drives, and its commands are rounded to actions; then learners take these actions. The
file contains the second episode. An environment that gets the recorded actions repeats this episode bit for bit.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.files.sheet import parquet_file
from ethbrake_marl.files.store import check_target
from ethbrake_marl.first_edition.agents.driving import episode_engine, script_agents
from ethbrake_marl.first_edition.agents.protocol import Driver, Team
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.evaluation.identity import LIST_SEED, result_versions
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.game.actions import command_to_action
from ethbrake_marl.first_edition.game.observations import Observations
from ethbrake_marl.first_edition.game.observed import observation_for
from ethbrake_marl.first_edition.game.rewards import Reward, reward_params
from ethbrake_marl.first_edition.physics.state import Ints, Worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario

_BATCH = 500  # number of worlds simulated together; it limits memory and has no effect on the episodes


def to_parquet(
    path: str | Path,
    agents: str | Mapping[str, Driver],
    *,
    scenario: str | Path | Scenario,
    episodes: int,
    seed: int = LIST_SEED,
    reward: Reward = "harm",
    force: bool = False,
) -> None:
    """Let agents drive, and write a Parquet file with one row for each agent, world and decision.

    docs/extensions/datasets.md describes the columns and the metadata.

    Args:
        path: file to write.
        agents: names of agents as on the command line, or a mapping from names to agents or teams. Each drives all
            learners of the scenario in its own episodes.
        scenario: a ``Scenario``, or its name or path.
        episodes: number of worlds in which each agent drives: the worlds 0 to ``episodes`` - 1 of ``seed``.
        seed: seed from which the worlds are drawn.
        reward: reward to record: a name such as ``harm``, or the weights of the reward's terms.
        force: whether to replace an existing file.

    Raises ``InvalidInput`` if an argument is invalid, ``AlreadyExists`` if the file exists and ``force`` is false, and
    ``MissingExtra`` if pyarrow is not installed.

    """
    scenario, reward = load_scenario(scenario), reward_params(reward)
    drivers = make_lineup(agents, scenario) if isinstance(agents, str) else agents
    if not (drivers and scenario.learners and episodes >= 1):
        raise InvalidInput(
            f"to_parquet: {len(drivers)} agents, {episodes} episodes and {len(scenario.learners)} learners in scenario"
            f" {scenario.name!r}: must be at least one of each"
        )
    told = {
        "scenario": scenario.declared(),
        "seed": int(seed),
        "learners": [scenario.vehicle_names[i] for i in scenario.learners],
        "agents": list(drivers),
        "observation": [feature.name for feature in observation_for(scenario).features],
        "reward": reward.model_dump(mode="json"),
        "versions": result_versions(),
    }
    with parquet_file(check_target(path, force=force), told=lambda: {"ethbrake_marl": json.dumps(told)}) as write:
        for name, driver in drivers.items():
            for first in range(0, int(episodes), _BATCH):
                sample = scenario.sample(min(_BATCH, int(episodes) - first), seed, first=first)
                engine = Engine(
                    scenario, sample.worlds.n, learners=scenario.learners, scripts=script_agents(scenario),
                    reward=reward, worlds=sample.worlds,
                )  # fmt: skip
                rows = list(_decisions(engine, sample.index, _actions(sample.worlds, driver, scenario)))
                columns = {column: np.concatenate([each[column] for each in rows]) for column in rows[0]}
                order = np.argsort(columns["world"], kind="stable")  # one episode after the other
                write({"agent": np.full(len(order), name)} | {key: values[order] for key, values in columns.items()})


def _actions(worlds: Worlds, driver: Driver, scenario: Scenario) -> list[Observations]:
    """Return the agent's commands in n worlds as actions of L learners: one array [n, L] for each decision."""
    engine, actions = episode_engine(worlds, Team.of(driver, scenario.learners), scenario), []
    while not engine.ended.all():
        engine.step({})
        actions.append(
            np.stack(
                [command_to_action(engine.wanted_mps2[:, i], worlds.vehicles, i) for i in scenario.learners], axis=1
            ).astype(np.float32)
        )
    return actions


def _decisions(engine: Engine, index: Ints, actions: list[Observations]) -> Iterator[dict[str, Any]]:
    """Yield the columns of each decision, with one value for each world whose episode has not ended.

    The learners of the engine take ``actions``; if an episode needs more actions, they repeat the last one. ``index``
    has the number of each world.
    """
    learners, t = list(engine.learners), 0
    while not engine.ended.all():
        rows, before, seen = np.flatnonzero(~engine.ended), engine.worlds, engine.observe_all(np.array(learners))
        action = actions[min(t, len(actions) - 1)]
        step = engine.step(action)
        columns = {"world": index[rows], "decision": np.full(len(rows), t), "time_s": before.time_s[rows]}
        columns |= {f"gap_{p + 1}_m": gap[rows] for p, gap in enumerate(before.gaps_m.T)}
        columns |= {f"speed_{i + 1}_mps": speed[rows] for i, speed in enumerate(before.speeds_mps.T)}
        for c, i in enumerate(learners):
            each = enumerate(engine.observation.features)
            columns |= {f"observation_{i + 1}.{feature.name}": seen[rows, c, f] for f, feature in each}
            columns |= {f"action_{i + 1}": action[rows, c], f"reward_{i + 1}": step.reward[rows, i]}
        yield columns | {"terminated": step.terminated[rows], "truncated": step.truncated[rows]}
        t += 1
    if engine.roster.failed:
        raise PhysicsError(engine.roster.failed)
