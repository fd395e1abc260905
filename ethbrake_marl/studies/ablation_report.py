"""The findings of an ablation: Markdown tables, and a page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Agent, Driver, Team
from ethbrake_marl.agents.registry import make_single_agent
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput, OnProgress, Progress, count_of
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, policy_sha256, result_identity
from ethbrake_marl.evaluation.results import write_output
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.seed_statistics import mean_over_seeds, rate_over_seeds, share_over_seeds
from ethbrake_marl.evaluation.statistics import Estimate, estimates_to_json
from ethbrake_marl.figures.studies import change_figure, harm_curve, who_pays
from ethbrake_marl.figures.style import Figure, write_picture
from ethbrake_marl.learning.recipe import WORDS
from ethbrake_marl.learning.training import RunDirectory, is_team, load_team
from ethbrake_marl.limits.best_harm import best_harm
from ethbrake_marl.pages.frame import Section, facts, page, table
from ethbrake_marl.pages.player import Played, player
from ethbrake_marl.pages.report import Chosen, drive_played
from ethbrake_marl.pages.vector import drawing
from ethbrake_marl.physics import Floats
from ethbrake_marl.policies.bundle import Policy, load_policy
from ethbrake_marl.scenario import Sample, Scenario
from ethbrake_marl.scenario.fields import DECLARED, LEARNER
from ethbrake_marl.studies.ablation import (
    TOLERANCE,
    Harms,
    Level,
    Measured,
    Plan,
    Training,
    compare,
    harms_of,
    levels_csv,
    read_kept,
)
from ethbrake_marl.studies.jobs import pack, run_all

# Episodes on the page of an ablation: the same few lines of vehicles, driven level by level.

_MOST, _USUAL, _LEAST = 3, 2, 2  # worlds in which most, as usual and least is saved


def choose_worlds(measured: Sequence[Measured]) -> list[Chosen]:
    """A few worlds by what the last level of the ladder saves against the first, in total harm, of the first seed."""
    ladder = [one for one in measured if one.level.clear is None]
    first, last = ladder[0], ladder[-1]
    before, after = (one.reached.world["total"][0] for one in (first, last))
    order = np.argsort(after - before, kind="stable")
    middle = max((len(order) - _USUAL) // 2, 0)
    kinds = (
        (f"Where {last.level.name} saves most against {first.level.name}", order[:_MOST]),
        ("As usual", order[middle : middle + _USUAL]),
        ("Where it saves least, or harms", order[::-1][:_LEAST]),
    )
    found: dict[int, Chosen] = {}
    for kind, rows in kinds:
        for row in map(int, rows):
            why = f"total harm {before[row]:.2f} to {after[row]:.2f}"
            found.setdefault(row, Chosen(row, kind, why))
    return list(found.values())


def episodes_section(plan: Plan, measured: Sequence[Measured]) -> Section:
    """A few worlds of the ablation to watch, level beside level; each trained level by its first seed."""
    chosen = choose_worlds(measured)
    rows = np.array([each.row for each in chosen], np.int64)
    played = [Played(each.row, each.kind, each.why, {}, {}) for each in chosen]
    driven: dict[str, tuple[int, ...]] = {}
    for name, level, driver, spelling in _drivers(plan):
        worlds = level.scenario.sample(plan.episodes, plan.list_seed).worlds.take(rows)
        drive_played(played, worlds, name, driver, level.scenario, spelling, seed=plan.list_seed)
        driven[name] = level.scenario.learners
    told = (
        f"{count_of(len(chosen), 'world')}, the same line at every level; of several seeds the first drives."
        f" The conditions are those of {plan.levels[0].name}: delays of messages and an obstacle ahead are each"
        " level's own."
    )
    return Section("Episodes", [told, player(played, driven)])


def _drivers(plan: Plan) -> Iterator[tuple[str, Level, Driver, str]]:
    """Name, level, who drives and how that is written on a command line, level by level."""
    trained: dict[tuple[str, str], Training] = {}
    for training in plan.trainings():
        trained.setdefault((training.level.name, training.algorithm), training)
    for level in plan.levels:
        if not level.trained:  # who drives nobody changes nothing
            yield level.name, level, Team({}, level.name), "full_brake"
            continue
        for algorithm in plan.algorithms:
            training = trained[level.name, algorithm]
            name = level.name if len(plan.algorithms) == 1 else f"{level.name}, {algorithm}"
            team = load_team(training.folder, level.scenario, name)
            yield name, level, team, f"{training.recipe.algorithm}@{training.folder}"


# The same weights on longer lines: policies of one line length drive every learner of lines of other lengths.


@dataclass(frozen=True, slots=True)
class LineQuestion:
    """On which lines the policies are measured."""

    scenario: Scenario  # of any length; see ``lengthen``
    vehicles: tuple[int, ...]  # lengths of the lines
    episodes: int
    list_seed: int
    harm_count: HarmCount
    search_episodes: int  # worlds in which the joint optimum is searched; 0: none
    budget: int


@dataclass(frozen=True, slots=True)
class LineResult:
    """Lines of one length: means over the worlds, and over the policies where there are several (m2/s2)."""

    vehicles: int
    full_brake: Estimate
    reached: Estimate
    decrease: Estimate | None  # 1 - reached / full braking
    best_known: Estimate | None  # in the worlds that were searched
    share: Estimate | None  # of the joint optimum's reduction, there
    worse_off: Estimate  # share of worlds in which somebody bears more than under full braking
    identity: Mapping[str, Any] = field(default_factory=dict)  # of worlds and scenario, and what computed it
    policy_sha256: tuple[str | None, ...] = ()  # of each policy

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        names = ("full_brake", "reached", "decrease", "best_known", "share", "worse_off")
        told = {"vehicles": self.vehicles, **estimates_to_json({name: getattr(self, name) for name in names})}
        return {**self.identity, **told, "policy_sha256": list(self.policy_sha256)}


def lengthen(scenario: Scenario, vehicles: int) -> Scenario:
    """The scenario with a line of ``vehicles``: shorter ones lose the rear, vehicle i > N is like vehicle i - 2.

    All followers learn; Vehicle 1 keeps its role. Raises ``InvalidInput`` for fewer than 2 vehicles.
    """
    if not vehicles >= 2:
        raise InvalidInput(f"line of {vehicles} vehicles: at least 2 are needed")
    given = scenario.model_dump(mode="json", exclude_unset=True)
    changes: dict[str, Any] = {"vehicles": vehicles, "name": f"{scenario.name}-n{vehicles}"}
    for key in (*DECLARED, "objective", "types"):
        values = given.get(key)
        if isinstance(values, list):
            wanted = vehicles - (scenario.vehicles - len(values))
            while len(values) < wanted:
                values = [*values, values[-2] if len(values) > 1 else values[-1]]
            changes[key] = values[:wanted]
    first = scenario.roles.get("vehicle_1", "full_brake")
    roles = {"vehicle_1": first} | {f"vehicle_{i + 1}": LEARNER for i in range(1, vehicles)}
    return scenario.replace(**changes, roles=roles)


def load_runs(paths: Sequence[str], scenario: Scenario) -> list[Agent]:
    """One agent for each run or bundle, the seeds of one training, to drive lines of ``scenario``.

    Raises ``InvalidInput`` for no path, a run whose learners have a policy each, one policy twice, policies of
    different trainings, or policies that never drove Vehicle 1 where it learns.
    """
    if not paths or not all(paths):
        raise InvalidInput(f"runs {','.join(paths)!r}: must be runs or bundles, for instance runs/my-run")
    for path in paths:
        if is_team(path):
            raise InvalidInput(f"{path}: its learners have a policy each; only one that all share drives other lines")
    policies = [load_policy(Path(path)) for path in paths]
    trained = [_training(path, policy) for path, policy in zip(paths, policies, strict=True)]
    for k, policy in enumerate(policies):
        _check_front(paths[k], policy, scenario)
        same = [path for path, one in zip(paths, policies[:k], strict=False) if _weights(one) == _weights(policy)]
        if same:
            raise InvalidInput(f"runs {same[0]} and {paths[k]}: are one policy; give each once")
        other = [name for name, value in trained[k].items() if trained[0].get(name, value) != value]
        if other:
            raise InvalidInput(
                f"runs {paths[0]} and {paths[k]}: differ in {', '.join(other)}; give seeds of one training"
            )
    return [LearnedAgent(policy, path) for path, policy in zip(paths, policies, strict=True)]


def _weights(policy: Policy) -> str:
    return policy.manifest.weights_sha256


def _training(path: str, policy: Policy) -> dict[str, Any]:
    """What seeds of one training have in common; the recipe too where ``path`` is a run."""
    manifest = policy.manifest.model_dump(mode="json")
    found = {name: manifest[name] for name in ("algorithm", "network", "observation", "learners", "reward", "scenario")}
    config = RunDirectory(Path(path)).config
    if config.is_file():
        recipe = dict(read_kept(config, f"give the policy instead: {Path(path) / 'policy'}").get("recipe") or {})
        found["recipe"] = {name: value for name, value in recipe.items() if name not in (*WORDS, "seed")}
    return found


def _check_front(path: str, policy: Policy, scenario: Scenario) -> None:
    """Raise ``InvalidInput`` where Vehicle 1 learns, which the policy never drove."""
    manifest = policy.manifest
    if 0 in scenario.learners and "vehicle_1" not in manifest.learners:
        raise InvalidInput(
            f"scenario {scenario.name!r}: vehicle_1 learns there, and {path} was trained for"
            f" {', '.join(manifest.learners)}; give one whose Vehicle 1 follows a script, for instance"
            f" --scenario {manifest.scenario['name']}"
        )


def drive_longer(
    question: LineQuestion, agents: Sequence[Agent], tell: OnProgress | None = None, processes: int = 1
) -> list[LineResult]:
    """Let every agent drive all learners of lines of each length, on the same worlds as full braking.

    All lines are made before the first is driven; ``processes`` lengths at a time. Raises ``InvalidInput`` for a
    length that is given twice or that the scenario cannot have.
    """
    if len(set(question.vehicles)) < len(question.vehicles):
        raise InvalidInput(f"vehicles {', '.join(map(str, question.vehicles))}: each length once")
    lines = [lengthen(question.scenario, vehicles) for vehicles in question.vehicles]
    lists = [line.sample(question.episodes, question.list_seed) for line in lines]
    if processes == 1 or len(lines) < 2:
        return [_of_length(question, *line, agents, tell) for line in zip(lines, lists, strict=True)]
    say = tell or (lambda progress: None)

    def call_of(number: int) -> bytes:
        return pack(_of_length, question, lines[number], lists[number], tuple(agents), None)

    found = run_all(call_of, len(lines), processes, "lengths", say)
    if found is None:
        raise KeyboardInterrupt
    return found


def _of_length(
    question: LineQuestion, scenario: Scenario, sample: Sample, agents: Sequence[Agent], tell: OnProgress | None
) -> LineResult:
    count = question.harm_count
    braking = _drive([make_single_agent("full_brake")], scenario, sample, tell)
    reached = _drive(agents, scenario, sample, tell)
    worst, own = braking.world[count], reached.world[count]
    none = np.zeros_like(worst)
    worse = (reached.vehicle[count] > braking.vehicle[count] + TOLERANCE).any(axis=2)
    best = _search(question, scenario, sample, own, tell)
    known = slice(0, question.search_episodes)
    return LineResult(
        scenario.vehicles,
        mean_over_seeds(worst),
        mean_over_seeds(own),
        share_over_seeds(own, worst, none),
        None if best is None else mean_over_seeds(best),
        None if best is None else share_over_seeds(own[:, known], worst[:, known], best),
        rate_over_seeds(worse),
        result_identity("generalise", scenario, sample),
        tuple(policy_sha256(agent) for agent in agents),
    )


def _drive(agents: Sequence[Agent], scenario: Scenario, sample: Sample, tell: OnProgress | None) -> Harms:
    named = {str(k): agent for k, agent in enumerate(agents)}
    result = evaluate(sample, named, scenario=scenario, chunk=PROGRESS_EVERY).complete()
    if tell is not None:
        tell(Progress(f"{scenario.vehicles} vehicles, {agents[0].name}", sample.worlds.n, sample.worlds.n))
    return harms_of([result.outcome(name) for name in named])


def _search(
    question: LineQuestion, scenario: Scenario, sample: Sample, reached: Floats, tell: OnProgress | None
) -> Floats | None:
    """Least harm known of all followers together in the first worlds, [1, search_episodes]."""
    if question.search_episodes == 0:
        return None
    part = sample.worlds.take(np.arange(question.search_episodes))
    table = best_harm(scenario, part, counts=[question.harm_count], budget=question.budget)
    if tell is not None:
        tell(Progress(f"{scenario.vehicles} vehicles, joint optimum", part.n, part.n))
    best: Floats = np.minimum(table.best[question.harm_count].harm, reached[:, : part.n].min(axis=0))
    return best[np.newaxis]


NONE = "–"
_ALGORITHM = "Algorithm"
_HARM = {"first": "first-impact harm", "total": "total harm"}

Json = dict[str, Any]


class _Table(NamedTuple):
    """A table whose first ``left`` columns are texts."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: int


def markdown(found: Json, conditions: str) -> str:
    """All tables, with their conditions below."""
    blocks = [each for title, tables in _blocks(found) for each in (f"## {title}", *map(_write_table, tables))]
    return "\n\n".join([*blocks, conditions]) + "\n"


def ablation_page(found: Json, conditions: str, figures: Mapping[str, Figure], episodes: Sequence[Section] = ()) -> str:
    """The figures by name, sections of episodes to watch and all tables as one HTML page, with their conditions."""
    drawn = [
        drawing(figure, *FIGURE_TEXTS[name], alone=name == "ablation-who-pays.png", known=conditions)
        for name, figure in figures.items()
    ]
    sections = [Section("Conditions", [conditions])]
    sections += [Section("Figures", drawn)] if drawn else []
    sections += episodes
    for title, tables in _blocks(found):
        parts = [
            table(t.head, [[cell.replace("`", "") for cell in row] for row in t.rows]) for t in map(_alone, tables)
        ]
        sections.append(Section(title, parts))
    settings = {name: value for name, value in found["settings"].items() if name != "recipes"}
    sections.append(Section("Settings", [facts(settings)]))
    return page("What cooperation is worth", sections, lead="Who learns, who knows, whose harm counts: step by step.")


def _blocks(found: Json) -> list[tuple[str, list[_Table]]]:
    """The tables below their titles."""
    worlds = found["levels"][0]["first"]["searched"]["worlds"]
    blocks = [("Levels", [_levels(found["levels"], harm_count) for harm_count in HARM_COUNTS])]
    optima = [_optima(found["levels"], harm_count) for harm_count in HARM_COUNTS]
    blocks.append((f"How near the joint optimum, in the first {count_of(worlds, 'world')}", optima))
    if any(level["first"]["shielded"] for level in found["levels"]):
        behind = [_shielded(found["levels"], harm_count) for harm_count in HARM_COUNTS]
        blocks.append(("Behind the step shield that guards the count of the table", behind))
    for title, key in (("What each step is worth", "steps"), ("Price of lost messages", "channels")):
        if found[key]:
            blocks.append((title, [_changes(found[key])]))
    if found["steps"] or found["channels"]:
        changes = found["steps"] + found["channels"]
        blocks.append(("Who pays", [_who_pays(changes, harm_count) for harm_count in HARM_COUNTS]))
    return blocks


def interval_words(seeds: int) -> str:
    """What the intervals of figures over so many seeds hold for."""
    if seeds == 1:
        return "95 % intervals for other worlds only: one seed says nothing about others"
    rough = f" (rough: {seeds} seeds)" if seeds < 3 else ""
    return f"95 % intervals for other seeds and other worlds{rough}"


def lines_markdown(found: Sequence[LineResult], question: LineQuestion, runs: int) -> str:
    """One row per length of the line."""
    head = ["Vehicles", "All brake fully", "Reached", "Decrease", "Somebody worse off"]
    head += ["Best known", "Share of the joint optimum"] if question.search_episodes else []
    rows = []
    for one in found:
        row = [str(one.vehicles), _of(one.full_brake), _of(one.reached), _of(one.decrease, 100.0, 1, " %")]
        row.append(_of(one.worse_off, 100.0, 1, " %"))
        rows.append(row + ([_of(one.best_known), _of(one.share, 100.0, 1, " %")] if question.search_episodes else []))
    name = question.scenario.name
    conditions = (
        f"{_HARM[question.harm_count].capitalize()} (m²/s², means per world) of the line of {name} made longer:"
        f" {runs} {'policies' if runs > 1 else 'policy'}, {count_of(question.episodes, 'world')} of seed"
        f" {question.list_seed} for each length; {interval_words(runs)}."
    )
    if question.search_episodes:
        conditions += (
            f" Best known and share: the first {count_of(question.search_episodes, 'world')},"
            f" {question.budget:,} candidates each."
        )
    return f"{_write_table(_Table(head, rows, left=1))}\n\n{conditions}\n"


def _of(estimate: Estimate | None, scale: float = 1.0, digits: int = 2, unit: str = "") -> str:
    return _cell(None if estimate is None else estimate.to_json(), scale, digits, unit)


def _levels(levels: Sequence[Json], harm_count: HarmCount) -> _Table:
    head = ["Level", _ALGORITHM, "Collisions", "All brake fully", f"Reached, {_HARM[harm_count]}"]
    rows = []
    for level in levels:
        own = level[harm_count]
        row = [f"`{level['level']}`", level["algorithm"] or NONE, _cell(level["collision_rate"], 100.0, 1, " %")]
        rows.append([*row, _value(own["full_brake"]), _cell(own["harm"])])
    return _Table(head, rows, left=2)


def _optima(levels: Sequence[Json], harm_count: HarmCount) -> _Table:
    head = ["Level", _ALGORITHM, "All brake fully", f"Reached, {_HARM[harm_count]}"]
    head += ["Joint optimum", "Share of its reduction"]
    rows = []
    for level in levels:
        own = level[harm_count]["searched"]
        if own["best_known"] is not None:
            row = [f"`{level['level']}`", level["algorithm"], _value(own["full_brake"]), _cell(own["harm"])]
            rows.append([*row, _value(own["best_known"]), _cell(own["realised_share"], 100.0, 1, " %")])
    return _Table(head, rows, left=2)


def _shielded(levels: Sequence[Json], harm_count: HarmCount) -> _Table:
    head = ["Level", _ALGORITHM, f"Without, {_HARM[harm_count]}", "With", "Change", "Bound", "Replaced", "Stepped in"]
    rows = []
    for level in levels:
        own, behind = level[harm_count], level[harm_count]["shielded"]
        if behind is not None:
            row = [f"`{level['level']}`", level["algorithm"], _value(own["harm"]), _value(behind["harm"])]
            row += [
                _cell(behind["difference"], sign=True),
                _value(behind["bound"]),
                f"{100.0 * behind['replaced']:.1f} %",
            ]
            row += [_cell(behind[key], 100.0, 1, " %") for key in ("stepped_in", "worse_off", "above_baseline")]
            rows.append([*row, str(behind["above_bound"])])
    return _Table([*head, "Somebody worse off", "Above the baseline plan", "Above the bound"], rows, left=2)


def _changes(changes: Sequence[Json]) -> _Table:
    head = ["From", "To", _ALGORITHM]
    for harm_count in HARM_COUNTS:
        head += [f"Change of {_HARM[harm_count]}", f"Somebody worse off, {_HARM[harm_count]}"]
    rows = []
    for change in changes:
        row = [f"`{change['from']}`", f"`{change['to']}`", change["algorithm"]]
        for harm_count in HARM_COUNTS:
            row += [
                _cell(change[harm_count]["difference"], sign=True),
                _cell(change[harm_count]["worse_off"], 100.0, 1, " %"),
            ]
        rows.append(row)
    return _Table(head, rows, left=3)


def _who_pays(changes: Sequence[Json], harm_count: HarmCount) -> _Table:
    vehicles = len(changes[0][harm_count]["vehicles"])
    head = [f"Change of {_HARM[harm_count]}", _ALGORITHM, *(f"Vehicle {i + 1}" for i in range(vehicles))]
    head += [f"Vehicle {i + 1} worse off" for i in range(vehicles)]
    rows = []
    for change in changes:
        own = change[harm_count]
        row = [f"`{change['from']}` to `{change['to']}`", change["algorithm"]]
        row += [_cell(estimate, sign=True) for estimate in own["vehicles"]]
        rows.append(row + [f"{100.0 * share:.1f} %" for share in own["worse_off_vehicles"]])
    return _Table(head, rows, left=2)


def _alone(given: _Table) -> _Table:
    """The table without the algorithm's column where there is only one."""
    head, rows, left = given
    if _ALGORITHM not in head:
        return given
    column = head.index(_ALGORITHM)
    if len({row[column] for row in rows} - {NONE}) != 1:
        return given
    head, *rows = ([*row[:column], *row[column + 1 :]] for row in (head, *rows))
    return _Table(head, rows, left - 1)


def _write_table(given: _Table) -> str:
    """A table in Markdown."""
    head, rows, left = _alone(given)
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * left + " ---: |" * (len(head) - left)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _cell(estimate: Json | None, scale: float = 1.0, digits: int = 2, unit: str = "", *, sign: bool = False) -> str:
    """``12.34 [12.00, 12.70]``."""
    if estimate is None:
        return NONE
    plus = "+" if sign else ""
    value = f"{scale * estimate['value']:{plus}.{digits}f}{unit}"
    if estimate["interval"] is None:
        return value
    low, high = (f"{scale * end:{plus}.{digits}f}" for end in estimate["interval"])
    return f"{value} [{low}, {high}]"


def _value(estimate: Json | None) -> str:
    return NONE if estimate is None else f"{estimate['value']:.2f}"


SUMMARY, TABLE, TEXT, PAGE = "ablation.json", "ablation.csv", "ablation.md", "ablation.html"
FIGURES = {"ablation.png": harm_curve, "ablation-changes.png": change_figure, "ablation-who-pays.png": who_pays}

FIGURE_TEXTS = {
    "ablation.png": (
        "Harm against cooperation",
        "Both harms at each level, between full braking and the joint optimum.",
    ),
    "ablation-changes.png": ("What each step is worth", "Change of both harms from one level to the next."),
    "ablation-who-pays.png": ("Who pays", "Change of the harm of each vehicle, under both counts."),
}


def write_ablation(plan: Plan, measured: Sequence[Measured], machine: str) -> dict[str, Any]:
    """Write all files, replacing earlier ones, and give what ``ablation.json`` holds."""
    found = {"settings": _settings(plan, machine), **compare(measured, plan.search_episodes)}
    conditions = _conditions(plan, machine)
    write_output(plan.folder / SUMMARY, (json.dumps(found, indent=2, allow_nan=False) + "\n").encode(), force=True)
    write_output(plan.folder / TABLE, levels_csv(measured, plan.search_episodes).encode(), force=True)
    write_output(plan.folder / TEXT, markdown(found, conditions).encode(), force=True)
    drawn = found["steps"] or found["channels"]
    figures = {name: draw(found, conditions) for name, draw in FIGURES.items() if drawn}
    for name, figure in figures.items():
        write_picture(plan.folder / name, figure, force=True)
    page_text = ablation_page(found, conditions, figures, [episodes_section(plan, measured)])
    write_output(plan.folder / PAGE, page_text.encode(), force=True)
    return found


def _settings(plan: Plan, machine: str) -> dict[str, Any]:
    return {
        **plan.settings(),
        "levels": [level.name for level in plan.levels],
        "recipes": {name: r.model_dump(mode="json") for name, r in zip(plan.algorithms, plan.recipes, strict=True)},
        "machine": machine,
        "date": datetime.now(UTC).date().isoformat(),
    }


def _conditions(plan: Plan, machine: str) -> str:
    recipes = ", ".join(
        f"{name} (rewarded for {'first-impact' if recipe.reward.harm_count == 'first' else 'total'} harm)"
        for name, recipe in zip(plan.algorithms, plan.recipes, strict=True)
    )
    return (
        f"{recipes}; {plan.seeds} {'seeds' if plan.seeds > 1 else 'seed'}, {plan.steps_per_learner:,} decisions of each"
        f" learner. Harms are means per world in m²/s² on the same {count_of(plan.episodes, 'world')} of seed"
        f" {plan.list_seed} at every level; {interval_words(plan.seeds)}. Joint optimum: the least harm known that"
        f" the level's learners can do, and everything beside it, in the first {plan.search_episodes:,} of these"
        f" worlds, {plan.budget:,} candidates per world and count. {machine}."
    )
