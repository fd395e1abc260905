"""Results of a front: mean harms with intervals, hypervolumes, and a comparison with agents."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.conditions import Conditions
from ethbrake_marl.evaluation.identity import result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.statistics import Texts, mean, paired_difference
from ethbrake_marl.extensions.fronts.front import Borne, Front, amounts_of
from ethbrake_marl.extensions.fronts.hypervolume import MOST_DIMENSIONS, hypervolume
from ethbrake_marl.files.sheet import Column, Estimate, Row, Sheet
from ethbrake_marl.game.harm import HARM_COUNTS
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario

RESAMPLES = 200  # bootstrap samples of the worlds, for intervals of hypervolumes

Json = dict[str, Any]


def front_results(
    front: Front, scenario: Scenario, sample: Sample, beside: Mapping[str, Borne], seed: int | None
) -> Json:
    """Return the content of ``front.json``: the front, full braking, maximin, and the agents.

    All means have 95 % intervals over worlds or, if the worlds come from recordings, over recordings. For each choice
    of weights, ``ratio`` is an agent's mean weighted harm divided by the front's (null if the front's is 0), and
    ``above`` is the agent's mean weighted harm minus the front's.

    Args:
        front: the front.
        scenario: scenario of the worlds.
        sample: worlds for which the front was searched.
        beside: results to compare with the front: name -> harm count -> harm of each vehicle, [n, N] m2/s2. The name
            ``full_brake`` is required; names such as ``maximin`` are optional.
        seed: seed with which the worlds were drawn, if known.

    """
    least, by = front.amounts, sample.clusters
    recordings = {} if by is None else {"recordings": len(np.unique(by))}
    agents = {}
    for name, borne in front.agents.items():
        points = _points(front, borne, by)
        for k, (point, row) in enumerate(zip(points, front.weights, strict=True)):
            amounts, best = amounts_of(borne[front.harm_count][k], row), float(least[k].mean())
            point["above"] = paired_difference(amounts, least[k], by).to_json()
            point["ratio"] = float(amounts.mean()) / best if best > 0.0 else None
        agents[name] = points
    return {
        "kind": "front",
        "scenario": scenario.name,
        "seed": seed,
        "episodes": len(sample.index),
        **recordings,
        "harm_count": front.harm_count,
        "vehicles": list(scenario.vehicle_names),
        "beside": {name: _vehicles(borne, by) for name, borne in beside.items()},
        "points": _points(front, front.borne, by),
        "agents": agents,
        "hypervolume": hypervolumes(front, beside["full_brake"][front.harm_count], by),
        "scenario_sha256": scenario_sha256(scenario),
        "worlds_sha256": worlds_sha256(sample.worlds, sample.index),
        "versions": result_versions(),
    }


def _points(front: Front, borne: Borne, by: Texts | None) -> list[Json]:
    return [
        {
            "weights": row.tolist(),
            "vehicles": _vehicles({count: borne[count][k] for count in HARM_COUNTS}, by),
            "amount": mean(amounts_of(borne[front.harm_count][k], row), by).to_json(),
            "sum": mean(borne[front.harm_count][k].sum(axis=1), by).to_json(),
        }
        for k, row in enumerate(front.weights)
    ]


def _vehicles(borne: Borne, by: Texts | None) -> Mapping[str, list[Json]]:
    return {count: [mean(each, by).to_json() for each in borne[count].T] for count in HARM_COUNTS}


def hypervolumes(front: Front, full_brake: Floats, clusters: Texts | None = None) -> list[Json]:
    """Return the hypervolumes of the front and of each agent, for two reference points.

    A point consists of the mean harms of all vehicles for one choice of weights.

    The first reference point is the mean harm of each vehicle under full braking; with this reference point, a point
    contributes only if it is better than full braking for every vehicle. The second reference point contains, for each
    vehicle, the larger one of two numbers: its mean harm under full braking, and its largest mean harm on the front.
    ``share`` is an agent's hypervolume divided by the front's hypervolume. The 95 % intervals are percentiles over
    ``RESAMPLES`` bootstrap samples of the worlds, or of the clusters (recordings), whose names for each world are
    ``clusters`` [n]. ``full_brake`` is the harm of each vehicle if the learners brake fully, [n, N] m2/s2, in the harm
    count of ``front``. The result is empty for more than ``MOST_DIMENSIONS`` vehicles. Raises ``InvalidInput`` if an
    agent has the name ``front``.
    """
    if len(full_brake.T) > MOST_DIMENSIONS:
        return []
    sets = {"front": front.borne[front.harm_count], **{k: each[front.harm_count] for k, each in front.agents.items()}}
    if "front" in front.agents:
        raise InvalidInput("agent 'front': this name is reserved for the Pareto front; give the agent another name")
    n = len(full_brake)
    names = np.arange(n) if clusters is None else np.unique(clusters, return_inverse=True)[1]
    members = [np.flatnonzero(names == k) for k in range(names.max() + 1)]  # rows of each cluster
    drawn = np.random.default_rng(0).integers(len(members), size=(RESAMPLES, len(members)))
    draws = [np.arange(n), *(np.concatenate([members[k] for k in row]) for row in drawn)]  # first: each world once
    points = {name: np.stack([borne[:, rows].mean(axis=1) for rows in draws]) for name, borne in sets.items()}
    braking = np.stack([full_brake[rows].mean(axis=0) for rows in draws])
    entries = []
    for words, reference in (
        ("full braking", braking),
        ("largest harm of each vehicle", np.maximum(braking, points["front"].max(axis=1))),
    ):
        volumes = {
            name: np.array([hypervolume(each, at) for each, at in zip(rows, reference, strict=True)])
            for name, rows in points.items()
        }
        entry: Json = {"reference": words, "at": reference[0].tolist(), "of": {}}
        for name, volume in volumes.items():
            with np.errstate(divide="ignore", invalid="ignore"):
                share = volume / volumes["front"]
            entry["of"][name] = {"volume": _interval(volume), "share": _interval(share)}
        entries.append(entry)
    return entries


def _interval(values: Floats) -> Json | None:
    """Return ``values[0]`` and its 95 % interval: the 2.5 % and 97.5 % percentiles of ``values[1:]``.

    Returns None if at least one of ``values`` is not finite.
    """
    if not np.isfinite(values).all():
        return None
    low, high = np.percentile(values[1:], [2.5, 97.5])
    return Estimate(float(values[0]), (float(low), float(high))).to_json()


def full_braking(scenario: Scenario, sample: Sample) -> Borne:
    """Return the harm of each vehicle if all learners brake fully, [n, N] m2/s2 by harm count."""
    brakes = scenario.replace(
        roles={**scenario.roles, **{scenario.vehicle_names[i]: "full_brake" for i in scenario.learners}}
    )
    outcome = evaluate(sample, {"full_brake": Team({}, "full_brake")}, scenario=brakes, aftermath=False).complete()
    ledger = outcome.outcome("full_brake").ledger
    return {count: ledger.vehicle_harm(count) for count in HARM_COUNTS}


def front_sheet(results: Json) -> Sheet:
    """Return a table with one row for each choice of weights, and one for each further result, such as full braking.

    A row contains the mean harm of each vehicle. The row of a choice of weights also contains the ``ratio`` of each
    agent (see ``front_results``). ``results`` is the content of ``front.json``.
    """
    count = results["harm_count"]
    short = [re.sub("@[^+]*", "", name)[:14] for name in results["agents"]]
    columns: list[Column | str] = [
        Column("Weights"), *(Column(f"Vehicle {k + 1}", short=f"V{k + 1}") for k in range(len(results["vehicles"]))),
        Column("Sum, first impacts", short="First"), Column("Sum, all impacts", short="All"),
        # two agents with the same short name have their whole names
        *(Column(name, digits=3, short=each if short.count(each) == 1 else name.replace("/", "/\n"))
          for name, each in zip(results["agents"], short, strict=True)),
    ]  # fmt: skip
    rows: list[Row] = []
    for k, point in enumerate(results["points"]):
        weights = ",".join(f"{weight:g}" for weight in point["weights"])
        borne = [each["value"] for each in point["vehicles"][count]]
        sums = [sum(each["value"] for each in point["vehicles"][also]) for also in HARM_COUNTS]
        rows.append((weights, *borne, *sums, *(points[k]["ratio"] for points in results["agents"].values())))
    for name, braking in results["beside"].items():
        sums = [sum(each["value"] for each in braking[also]) for also in HARM_COUNTS]
        rows.append((name, *(each["value"] for each in braking[count]), *sums))
    words = {"first": "first-impact", "total": "total"}[count]
    note = (
        f"Mean {words} harm of each vehicle, and mean first-impact and total harm of the line, m2/s2. Agents:"
        " weighted harm of the agent divided by the weighted harm of the front"
    )
    note += f"{Conditions(recordings=results.get('recordings', 0)).by_recording}."
    return Sheet(f"Front of {results['scenario']}, {results['episodes']:,} worlds", columns, rows, note, gap=2)


def hypervolume_sheet(results: Json) -> Sheet:
    """Return a table of the hypervolumes in ``results``, the content of ``front.json``."""
    columns: list[Column | str] = [
        "Reference",
        "Of",
        Column("Hypervolume"),
        Column("Share of the front", digits=1, scale=100.0, unit=" %"),
    ]
    rows = [
        (each["reference"], name, *(None if value is None else Estimate(**value) for value in volume.values()))
        for each in results["hypervolume"]
        for name, volume in each["of"].items()
    ]
    return Sheet("Hypervolume of the mean harm (m2/s2)^N", columns, rows, gap=2)
