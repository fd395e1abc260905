"""Results of a front: mean harms with intervals, hypervolumes, and a comparison with agents."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ethbrake_marl.extensions.fronts.front import Borne, Front, amounts_of
from ethbrake_marl.extensions.fronts.hypervolume import MOST_DIMENSIONS, hypervolume
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.evaluation.conditions import Conditions
from ethbrake_marl.first_edition.evaluation.identity import result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.statistics import Texts, mean, paired_difference
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario

RESAMPLES = 200  # bootstrap samples of the worlds, for intervals of hypervolumes

FRONT = "Pareto front"  # name of the front beside the agents in the entry "hypervolume"; no agent can have this name

Json = dict[str, Any]


def front_results(
    front: Front, scenario: Scenario, sample: Sample, beside: Mapping[str, Borne], seed: int | None
) -> Json:
    """Return the content of ``front.json``: the front, full braking, maximin, and the agents.

    All means have 95 % intervals over worlds or, if the worlds come from recordings, over recordings. For each choice
    of weights, ``ratio`` is the mean weighted harm divided by the front's (null if the front's is 0), and ``above`` is
    the mean weighted harm minus the front's.

    Args:
        front: the front.
        scenario: scenario of the worlds.
        sample: worlds for which the front was searched.
        beside: results to compare with the front: name -> harm count -> harm of each vehicle, [n, N] m2/s2. The name
            ``full_brake`` is required; names such as ``maximin`` are optional.
        seed: seed with which the worlds were drawn, if known.

    """
    by = sample.clusters
    return {
        "kind": "front",
        "scenario": scenario.name,
        "seed": seed,
        "episodes": len(sample.index),
        **({} if by is None else {"recordings": len(np.unique(by))}),
        "harm_count": front.harm_count,
        "vehicles": list(scenario.vehicle_names),
        "beside": {name: _vehicles(borne, by) for name, borne in beside.items()},
        "points": _points(front, front.borne, by),
        "agents": {name: _points(front, borne, by) for name, borne in front.agents.items()},
        "hypervolume": hypervolumes(front, beside["full_brake"][front.harm_count], by),
        "scenario_sha256": scenario_sha256(scenario),
        "worlds_sha256": worlds_sha256(sample.worlds, sample.index),
        "versions": result_versions(),
    }


def _points(front: Front, borne: Borne, by: Texts | None) -> list[Json]:
    points = []
    for k, (weights, least) in enumerate(zip(front.weights, front.amounts, strict=True)):
        harm = borne[front.harm_count][k]
        amounts = amounts_of(harm, weights)
        points.append({
            "weights": weights.tolist(),
            "vehicles": _vehicles({count: borne[count][k] for count in HARM_COUNTS}, by),
            "amount": mean(amounts, by).to_json(),
            "sum": mean(harm.sum(axis=1), by).to_json(),
            "above": paired_difference(amounts, least, by).to_json(),
            "ratio": float(amounts.mean()) / float(least.mean()) if least.any() else None,
        })  # fmt: skip
    return points


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
    count of ``front``. The result is empty for more than ``MOST_DIMENSIONS`` vehicles.
    """
    if len(full_brake.T) > MOST_DIMENSIONS:
        return []
    worlds = np.arange(len(full_brake))
    names = worlds if clusters is None else np.unique(clusters, return_inverse=True)[1]
    members = [np.flatnonzero(names == k) for k in range(names.max() + 1)]  # worlds of each cluster
    drawn = np.random.default_rng(0).integers(len(members), size=(RESAMPLES, len(members)))
    draws = [worlds, *(np.concatenate([members[k] for k in row]) for row in drawn)]  # first: each world once
    harms = {FRONT: front.borne, **front.agents}
    points = {
        name: np.stack([borne[front.harm_count][:, rows].mean(axis=1) for rows in draws])
        for name, borne in harms.items()
    }
    braking = np.stack([full_brake[rows].mean(axis=0) for rows in draws])
    largest = np.maximum(braking, points[FRONT].max(axis=1))
    entries = []
    for words, reference in (("full braking", braking), ("largest harm of each vehicle", largest)):
        volumes = {name: np.array(list(map(hypervolume, rows, reference))) for name, rows in points.items()}
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = {name: volume / volumes[FRONT] for name, volume in volumes.items()}
        each = {name: {"volume": _interval(volumes[name]), "share": _interval(shares[name])} for name in volumes}
        entries.append({"reference": words, "at": reference[0].tolist(), "of": each})
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
    learners = [scenario.vehicle_names[i] for i in scenario.learners]
    brakes = scenario.replace(roles={**scenario.roles, **dict.fromkeys(learners, "full_brake")})
    outcome = evaluate(sample, {"full_brake": Team({}, "full_brake")}, scenario=brakes, aftermath=False).complete()
    return {count: outcome.outcome("full_brake").vehicle_harm(count) for count in HARM_COUNTS}


def front_sheet(results: Json) -> Sheet:
    """Return a table with one row for each choice of weights, and one for each further result, such as full braking.

    A row contains the mean harm of each vehicle. The row of a choice of weights also contains the ``ratio`` of each
    agent (see ``front_results``). ``results`` is the content of ``front.json``.
    """
    count, agents = results["harm_count"], results["agents"]

    def row(name: str, vehicles: Mapping[str, list[Json]], *ratios: float | None) -> tuple[str | float | None, ...]:
        means = {each: [harm["value"] for harm in vehicles[each]] for each in HARM_COUNTS}
        return (name, *means[count], *map(sum, means.values()), *ratios)

    rows = [
        row(",".join(f"{weight:g}" for weight in point["weights"]), point["vehicles"], *ratios)
        for point, *ratios in zip(
            results["points"], *([each["ratio"] for each in points] for points in agents.values()), strict=True
        )
    ]
    rows += [row(name, vehicles) for name, vehicles in results["beside"].items()]
    columns = [
        Column("Weights"), *(Column(f"Vehicle {k + 1}", short=f"V{k + 1}") for k in range(len(results["vehicles"]))),
        Column("Sum, first impacts", short="First"), Column("Sum, all impacts", short="All"),
        *(Column(name, digits=3, short=re.sub("(?<=[/+])", "\n", name)) for name in agents),
    ]  # fmt: skip
    by_recording = Conditions(recordings=results.get("recordings", 0)).by_recording
    note = (
        f"Mean {'first-impact' if count == 'first' else 'total'} harm of each vehicle, and mean first-impact and total"
        " harm of the line, m2/s2. Agents: weighted harm of the agent divided by the weighted harm of the front"
        f"{by_recording}."
    )
    return Sheet(f"Front of {results['scenario']}, {results['episodes']:,} worlds", columns, rows, note, gap=2)


def hypervolume_sheet(results: Json) -> Sheet:
    """Return a table of the hypervolumes in ``results``, the content of ``front.json``."""
    share = Column("Share of the front", digits=1, scale=100.0, unit=" %")
    rows = [
        (each["reference"], name, *(None if value is None else Estimate(**value) for value in volume.values()))
        for each in results["hypervolume"]
        for name, volume in each["of"].items()
    ]
    return Sheet(
        "Hypervolume of the mean harm (m2/s2)^N", ["Reference", "Of", Column("Hypervolume"), share], rows, gap=2
    )
