"""Results of a front: mean harms with intervals, hypervolumes, a comparison with agents, tables and the figure."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.scripts import FULL_BRAKE
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.provenance import about_scenario, versions, worlds_sha256
from ethbrake_marl.evaluation.statistics import Clusters, difference, mean
from ethbrake_marl.evaluation.summary import by_recording
from ethbrake_marl.extensions.cooperation.front import BorneHarm, Front, weighted_harm
from ethbrake_marl.extensions.cooperation.results import Json
from ethbrake_marl.extensions.report.style import (
    axis_title,
    finish,
    in_our_style,
    label_text,
    new_panels,
    plain_number,
    series_style,
)
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.describe import clusters_of, columns_of
from ethbrake_marl.worlds.sampling import DrawnWorlds
from ethbrake_marl.worlds.scenario import Scenario

FRONT_NAME = (
    "Pareto front"  # name of the front beside the agents in the entry "hypervolume"; no agent can have this name
)
MOST_DIMENSIONS = 5  # the time grows with the number of points to the power of the dimensions less one
SIZE_IN = (5.6, 4.6)  # narrow enough for a phone


def front_results(
    front: Front, scenario: Scenario, drawn_worlds: DrawnWorlds, beside: Mapping[str, BorneHarm], seed: int | None
) -> Json:
    """Content of ``front.json``: the front, ``beside`` (name -> count -> [n, N] m2/s2, with ``full_brake``), and the
    agents.

    For each choice of weights, ``ratio`` is an agent's mean weighted harm divided by the front's (null if that is 0),
    and ``above`` the difference.
    """
    by = clusters_of(columns_of(drawn_worlds))
    return {
        "kind": "front",
        "scenario": scenario.name,
        "seed": seed,
        "episodes": drawn_worlds.worlds.n,
        **({} if by is None else {"recordings": len(np.unique(by))}),
        "harm_count": front.harm_count.name,
        "vehicles": list(scenario.vehicle_names),
        "beside": {name: _vehicles(borne, by) for name, borne in beside.items()},
        "points": _points(front, front.borne, by),
        "agents": {name: _points(front, borne, by) for name, borne in front.agents.items()},
        "hypervolume": hypervolumes(front, beside["full_brake"][front.harm_count.name]),
        "scenario_sha256": about_scenario(scenario)["scenario_sha256"],
        "worlds_sha256": worlds_sha256(drawn_worlds.worlds),
        "versions": versions(),
    }


def _points(front: Front, borne: BorneHarm, by: Clusters) -> list[Json]:
    points = []
    for k, (weights, least) in enumerate(zip(front.weights, front.amounts, strict=True)):
        harm = borne[front.harm_count.name][k]
        amounts = weighted_harm(harm, weights)
        points.append({
            "weights": weights.tolist(),
            "vehicles": _vehicles({count: each[k] for count, each in borne.items()}, by),
            "amount": mean(amounts, by).to_json(),
            "sum": mean(harm.sum(axis=1), by).to_json(),
            "above": difference(amounts, least, by).to_json(),
            "ratio": float(amounts.mean()) / float(least.mean()) if least.any() else None,
        })  # fmt: skip
    return points


def _vehicles(borne: BorneHarm, by: Clusters) -> dict[str, list[Json]]:
    return {count: [mean(harm, by).to_json() for harm in each.T] for count, each in borne.items()}


def hypervolumes(front: Front, full_brake: Floats) -> list[Json]:
    """Hypervolumes of the front and of each agent, for two reference points; none above ``MOST_DIMENSIONS`` vehicles.

    A point is the mean harm of all vehicles for one choice of weights. The first reference is full braking
    (``full_brake`` [n, N] m2/s2). The second has, for each vehicle, the larger of its mean harm under full braking and
    its largest on the front. ``share``: an agent's hypervolume divided by the front's, None if that is 0.
    """
    if len(full_brake.T) > MOST_DIMENSIONS:
        return []
    points = {
        name: borne[front.harm_count.name].mean(axis=1)
        for name, borne in {FRONT_NAME: front.borne, **front.agents}.items()
    }
    braking = full_brake.mean(axis=0)
    references = {
        "full braking": braking, "largest harm of each vehicle": np.maximum(braking, points[FRONT_NAME].max(axis=0)),
    }  # fmt: skip
    entries = []
    for words, reference in references.items():
        volumes = {name: hypervolume(rows, reference) for name, rows in points.items()}
        volume_of_front = volumes[FRONT_NAME]
        of = {
            name: {"volume": volume, "share": volume / volume_of_front if volume_of_front else None}
            for name, volume in volumes.items()
        }
        entries.append({"reference": words, "at": reference.tolist(), "of": of})
    return entries


def hypervolume(points: Floats, reference: Floats) -> float:
    """Exact volume of the region that ``points`` [Q, N] dominate (smaller is better), up to the point ``reference``
    [N].

    The region is cut into slices along the last coordinate (Zitzler 1999, "hypervolume by slicing objectives").

    >>> import numpy as np
    >>> from ethbrake_marl.extensions.cooperation.front_results import hypervolume
    >>> hypervolume(np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([3.0, 3.0]))
    3.0
    """
    points = points[(points < reference).all(axis=1)]
    if not len(points):
        return 0.0
    if len(reference) == 1:
        return float(reference[0] - points.min())
    points = points[np.argsort(points[:, -1], kind="stable")]
    ends = np.append(points[1:, -1], reference[-1])
    slices = ((end - points[k, -1], points[: k + 1, :-1]) for k, end in enumerate(ends))
    return sum(float(height) * hypervolume(below, reference[:-1]) for height, below in slices if height > 0.0)


def full_braking(scenario: Scenario, drawn_worlds: DrawnWorlds) -> BorneHarm:
    game = open_game(scenario)[1]
    last = play_to_end(game, drawn_worlds.worlds, Team("full_brake", dict.fromkeys(scenario.learners, FULL_BRAKE)))
    return {count.name: last.borne_harm(count) for count in last.counts}


def front_sheet(results: Json) -> Sheet:
    """Table with one row for each choice of weights, then one for each result that is compared with the front."""
    count, agents = HarmCount.of(results["harm_count"]), results["agents"]
    counts = [HarmCount.of(name) for name in results["points"][0]["vehicles"]]

    def row(name: str, vehicles: Mapping[str, list[Json]], *ratios: float | None) -> tuple[str | float | None, ...]:
        means = {each.name: [harm["value"] for harm in vehicles[each.name]] for each in counts}
        return (name, *means[count.name], *map(sum, means.values()), *ratios)

    rows = [
        row(",".join(f"{weight:g}" for weight in point["weights"]), point["vehicles"], *ratios)
        for point, *ratios in zip(
            results["points"],
            *([agent_point["ratio"] for agent_point in points] for points in agents.values()),
            strict=True,
        )
    ]
    rows += [row(name, vehicles) for name, vehicles in results["beside"].items()]
    columns = [
        Column("Weights"), *(Column(f"Vehicle {k + 1}", short=f"V{k + 1}") for k in range(len(results["vehicles"]))),
        *(Column(f"Sum, {each.words}", short=each.name.capitalize()) for each in counts),
        *(Column(name, digits=3, short=re.sub("(?<=[/+])", "\n", name)) for name in agents),
    ]  # fmt: skip
    note = (
        f"Mean {count.words} of each vehicle, and mean {', '.join(each.words for each in counts)} of the line, m2/s2."
        f" Agents: weighted {count.words} of the agent divided by that of the front"
        f"{by_recording(results.get('recordings', 0))}."
    )
    return Sheet(f"Front of {results['scenario']}, {results['episodes']:,} worlds", columns, rows, note, gap=2)


def hypervolume_sheet(results: Json) -> Sheet:
    share = Column("Share of the front", digits=1, scale=100.0, unit=" %")
    rows = [
        (entry["reference"], name, *volume.values())
        for entry in results["hypervolume"]
        for name, volume in entry["of"].items()
    ]
    columns: list[Column | str] = ["Reference", "Of", Column("Hypervolume"), share]
    return Sheet(
        f"Hypervolume of the mean {HarmCount.of(results['harm_count']).words}, (m2/s2)^N", columns, rows, gap=2
    )


@in_our_style
def front_figure(results: Json) -> Figure:
    """Draw one point for each choice of weights: mean harm of the line, and of the vehicle that bears most."""
    beside = {name: [{"vehicles": vehicles}] for name, vehicles in results["beside"].items()}
    count, all_positive = HarmCount.of(results["harm_count"]), True
    figure, (axes,) = new_panels(SIZE_IN)
    for number, (name, points) in enumerate({"Pareto front": results["points"], **beside, **results["agents"]}.items()):
        harm = np.array([[vehicle["value"] for vehicle in point["vehicles"][count.name]] for point in points])
        style = series_style(number) | {"linestyle": "none", "markersize": 5.0, "fillstyle": "none"}
        axes.plot(harm.sum(axis=1), harm.max(axis=1), label=label_text(name, 34), **style)
        all_positive &= bool((harm.max(axis=1) > 0.0).all())
    if all_positive:
        axes.set(xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(plain_number))
            axis.set_minor_formatter(FuncFormatter(plain_number))
    axes.tick_params(which="minor", labelsize=7)
    axes.set(
        xlabel=f"Line: {axis_title(count).lower()}", ylabel=f"Vehicle that bears most: {axis_title(count).lower()}"
    )
    worlds = count_of(results["episodes"], "world")
    caption = f"{results['scenario']}, {worlds}; one point for each of {len(results['points'])} choices of the weights."
    return finish(figure, caption, axes, columns=2, fontsize=8)
