"""The findings of an ablation: Markdown tables, and a page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Agent, Driver, Team
from ethbrake_marl.agents.registry import make_single_agent
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput, OnProgress, Progress, count_of
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, policy_sha256, result_identity
from ethbrake_marl.evaluation.results import write_output
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.statistics import (
    interquartile_mean,
    mean_over_seeds,
    paired_over_seeds,
    rate_over_seeds,
    share_over_seeds,
)
from ethbrake_marl.figures.studies import change_figure, harm_curve, who_pays
from ethbrake_marl.figures.style import Figure, write_picture
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, csv_text, estimates_to_json
from ethbrake_marl.learning.progress import HARM_METRIC
from ethbrake_marl.learning.recipe import WORDS
from ethbrake_marl.learning.training import RunDirectory, is_team, load_team, read_object
from ethbrake_marl.limits.best_harm import best_harm
from ethbrake_marl.pages.frame import Section, facts, page, table
from ethbrake_marl.pages.player import Played, player
from ethbrake_marl.pages.report import Chosen, drive_played
from ethbrake_marl.pages.vector import drawing
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.policies.bundle import Policy, load_policy
from ethbrake_marl.scenario import Sample, Scenario
from ethbrake_marl.scenario.fields import DECLARED, LEARNER
from ethbrake_marl.shield.guard import Shielded
from ethbrake_marl.studies.ablation import Harms, Level, Measured, Plan, Training, harms_of
from ethbrake_marl.studies.jobs import Job, each, run_jobs

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
        try:
            recipe = read_object(config).get("recipe") or {}
        except InvalidInput as error:
            raise InvalidInput(f"{error}; give the policy instead: {Path(path) / 'policy'}") from None
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
    processes = processes if len(lines) > 1 else 1
    told = tell if processes == 1 else None
    jobs = [
        Job(line.name, _of_length, (question, line, sample, tuple(agents), told))
        for line, sample in zip(lines, lists, strict=True)
    ]
    found: dict[str, LineResult] = {}

    def take(job: Job, result: LineResult) -> None:
        found[job.name] = result
        if tell is not None and processes > 1:
            tell(Progress("lengths", len(found), len(jobs)))

    if not run_jobs(jobs, processes, each(take)):
        raise KeyboardInterrupt
    return [found[job.name] for job in jobs]


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


# The comparison of levels: harm of each, what each step is worth, who pays, the distance to the joint optimum.
#
# Intervals hold for other training seeds and other worlds: both are drawn anew (``evaluation.statistics``).

TOLERANCE = 1e-6  # m2/s2; a vehicle whose harm rose by more is worse off

Json = dict[str, Any]


def compare(measured: Sequence[Measured], searched: int) -> Json:
    """Plain data for JSON: ``levels``, ``steps`` of the ladder, ``channels`` (lost messages); see docs/cli.md.

    The joint optimum is known in the first ``searched`` worlds; what stands beside it is of these worlds too. Each
    algorithm has a ladder of its own; levels in which nobody learns are in all of them.
    """
    algorithms = [m.algorithm for m in measured if m.algorithm is not None]
    steps, channels = [], []
    for algorithm in dict.fromkeys(algorithms):
        own = [m for m in measured if m.algorithm in (None, algorithm)]
        ladder = [m for m in own if m.level.clear is None]
        steps += [_change(before, after, algorithm) for before, after in pairwise(ladder)]
        by_name = {m.level.name: m for m in own}
        channels += [_change(by_name[m.level.clear], m, algorithm) for m in own if m.level.clear is not None]
    return {
        "kind": "ablate",
        "levels": [_level(one, searched) for one in measured],
        "steps": steps,
        "channels": channels,
    }


def _level(one: Measured, searched: int) -> Json:
    """What one level reached under one algorithm."""
    scenario = one.level.scenario
    return {
        **one.identity,
        "policy_sha256": [dict(seed) for seed in one.reached.policies],
        "level": one.level.name,
        "title": scenario.title,
        "algorithm": one.algorithm,
        "clear": one.level.clear,
        "learners": [scenario.vehicle_names[i] for i in scenario.learners],
        "seeds": len(one.reached.collided),
        "worlds": one.reached.collided.shape[1],
        "collision_rate": rate_over_seeds(one.reached.collided).to_json(),
        **{harm_count: _under_count(one, harm_count, searched) for harm_count in HARM_COUNTS},
    }


def _under_count(one: Measured, harm_count: HarmCount, searched: int) -> Json:
    """Harm (m2/s2) under one count and what it is if all brake fully, in all worlds and in the ``searched`` ones.

    There also the joint optimum, and the share of its reduction that is realised.
    """
    reached, braking = one.reached.world[harm_count], one.full_brake.world[harm_count]
    each = reached.mean(axis=1)
    return {
        "full_brake": mean_over_seeds(braking).to_json(),
        "harm": mean_over_seeds(reached).to_json(),
        "each_seed": each.tolist(),
        "interquartile_mean": interquartile_mean([each], resamples=2000).to_json(),
        "vehicles": [mean_over_seeds(column).to_json() for column in _columns(one.reached, harm_count)],
        "searched": _compare_searched(
            reached[:, :searched], braking[:, :searched], None if one.best is None else one.best[harm_count]
        ),
        "shielded": None if one.shielded is None else _behind(one, one.shielded[harm_count], harm_count, searched),
    }


def _behind(one: Measured, shielded: Shielded, harm_count: HarmCount, searched: int) -> Json:
    """The same teams in the same worlds behind the shield that guards this count, beside what they do without it."""
    before, after = one.reached.vehicle[harm_count], shielded.vehicle_harm
    actions = shielded.decisions * shielded.replaced.shape[2]
    return {
        "harm": mean_over_seeds(shielded.harm).to_json(),
        "each_seed": shielded.harm.mean(axis=1).tolist(),
        "difference": mean_over_seeds(shielded.harm - one.reached.world[harm_count]).to_json(),
        "bound": mean_over_seeds(shielded.bound).to_json(),
        "above_bound": int((shielded.harm > shielded.bound).sum()),
        "replaced": float(shielded.replaced.sum() / actions.sum()),
        "replaced_vehicles": (shielded.replaced.sum(axis=(0, 1)) / shielded.decisions.sum()).tolist(),
        "stepped_in": rate_over_seeds((shielded.replaced > 0).any(axis=2)).to_json(),
        "vehicles": [mean_over_seeds(column).to_json() for column in np.moveaxis(after - before, 2, 0)],
        "worse_off": rate_over_seeds((after > before + TOLERANCE).any(axis=2)).to_json(),
        "above_baseline": rate_over_seeds((after > shielded.baseline + TOLERANCE).any(axis=2)).to_json(),
        "moving": int(shielded.moving.sum()),
        "searched": {"harm": mean_over_seeds(shielded.harm[:, :searched]).to_json()},
    }


def _compare_searched(reached: Floats, braking: Floats, best: Floats | None) -> Json:
    """Everything in the worlds in which the joint optimum was searched."""
    share = None if best is None else share_over_seeds(reached, braking, best)
    return {
        "worlds": reached.shape[1],
        "full_brake": mean_over_seeds(braking).to_json(),
        "harm": mean_over_seeds(reached).to_json(),
        "each_seed": reached.mean(axis=1).tolist(),
        "best_known": None if best is None else mean_over_seeds(best).to_json(),
        "realised_share": None if share is None else share.to_json(),
    }


def _change(before: Measured, after: Measured, algorithm: str) -> Json:
    """From one level to another on the same worlds: positive is more harm."""
    found: Json = {"from": before.level.name, "to": after.level.name, "algorithm": algorithm}
    for harm_count in HARM_COUNTS:
        pairs = zip(_columns(after.reached, harm_count), _columns(before.reached, harm_count), strict=True)
        worse = _worse_off(before.reached, after.reached, harm_count)
        found[harm_count] = {
            "difference": paired_over_seeds(
                after.reached.world[harm_count], before.reached.world[harm_count]
            ).to_json(),
            "vehicles": [paired_over_seeds(new, old).to_json() for new, old in pairs],
            "worse_off": rate_over_seeds(worse.any(axis=2)).to_json(),
            "worse_off_vehicles": [float(share) for share in worse.mean(axis=(0, 1))],
        }
    return found


def _worse_off(before: Harms, after: Harms, harm_count: HarmCount) -> Bools:
    """Which vehicles bear more than before, [seeds, worlds, N]: seed k against seed k, or against the only one."""
    old, new = before.vehicle[harm_count], after.vehicle[harm_count]
    worse: Bools = new > old + TOLERANCE
    return worse


def _columns(harms: Harms, harm_count: HarmCount) -> list[Floats]:
    """[seeds, worlds] of each vehicle."""
    return [harms.vehicle[harm_count][:, :, i] for i in range(harms.vehicle[harm_count].shape[2])]


# The findings of an ablation as CSV: one row per level, algorithm and seed.


def levels_csv(measured: Sequence[Measured], searched: int) -> str:
    """One row per level, algorithm and seed: means over the worlds (m2/s2); without a shield its columns are empty.

    ``searched``: over the worlds in which the joint optimum was searched.
    """
    rows = []
    for one in measured:
        for seed, collided in enumerate(one.reached.collided):
            about: Json = {"level": one.level.name, "algorithm": one.algorithm, "seed": seed if one.algorithm else None}
            about |= {"worlds": len(collided), "collision_rate": float(collided.mean())}
            vehicles: Json = {}
            behind: Json = {}
            for harm_count in HARM_COUNTS:
                name = HARM_METRIC[harm_count]
                reached, braking = one.reached.world[harm_count][seed], one.full_brake.world[harm_count]
                about |= {
                    name: float(reached.mean()),
                    f"full_brake_{name}": float(braking.mean()),
                    f"searched_{name}": float(reached[:searched].mean()),
                    f"searched_full_brake_{name}": float(braking[:, :searched].mean()),
                    f"searched_best_known_{name}": None if one.best is None else float(one.best[harm_count].mean()),
                }
                each = one.reached.vehicle[harm_count][seed].mean(axis=0)
                vehicles |= {f"{name}_{i + 1}": float(harm) for i, harm in enumerate(each)}
                behind |= dict.fromkeys((f"shielded_{name}", f"bound_{name}", f"actions_replaced_{name}"))
                if one.shielded is not None:
                    found = one.shielded[harm_count]
                    actions = found.decisions[seed].sum() * found.replaced.shape[2]
                    shares = found.harm[seed].mean(), found.bound[seed].mean(), found.replaced[seed].sum() / actions
                    behind |= dict(zip([*behind][-3:], map(float, shares), strict=True))
            rows.append({**about, **vehicles, **behind})
    return csv_text(rows)


_ALGORITHM = "Algorithm"
_HARM = {"first": "first-impact harm", "total": "total harm"}


def markdown(found: Json, conditions: str) -> str:
    """All tables, with their conditions below."""
    blocks = [text for title, sheets in _blocks(found) for text in (f"## {title}", *(s.markdown() for s in sheets))]
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
    for title, sheets in _blocks(found):
        parts = []
        for sheet in sheets:
            rows = [
                [cell.in_words.replace("`", "") for cell in row] for row in sheet.shown() if not isinstance(row, str)
            ]
            parts.append(table(sheet.headings, rows))
        sections.append(Section(title, parts))
    settings = {name: value for name, value in found["settings"].items() if name != "recipes"}
    sections.append(Section("Settings", [facts(settings)]))
    return page("What cooperation is worth", sections, lead="Who learns, who knows, whose harm counts: step by step.")


def _blocks(found: Json) -> list[tuple[str, list[Sheet]]]:
    """The tables below their titles, without the algorithm's column where there is only one."""
    levels = found["levels"]
    worlds = levels[0]["first"]["searched"]["worlds"]
    blocks = [("Levels", [_levels(levels, harm_count) for harm_count in HARM_COUNTS])]
    optima = [_optima(levels, harm_count) for harm_count in HARM_COUNTS]
    blocks.append((f"How near the joint optimum, in the first {count_of(worlds, 'world')}", optima))
    if any(level["first"]["shielded"] for level in levels):
        behind = [_shielded(levels, harm_count) for harm_count in HARM_COUNTS]
        blocks.append(("Behind the step shield that guards the count of the table", behind))
    for title, key in (("What each step is worth", "steps"), ("Price of lost messages", "channels")):
        if found[key]:
            blocks.append((title, [_changes(found[key])]))
    changes = found["steps"] + found["channels"]
    if changes:
        blocks.append(("Who pays", [_who_pays(changes, harm_count) for harm_count in HARM_COUNTS]))
    return [(title, list(map(_alone, sheets))) for title, sheets in blocks]


def interval_words(seeds: int) -> str:
    """What the intervals of figures over so many seeds hold for."""
    if seeds == 1:
        return "95 % intervals for other worlds only: one seed says nothing about others"
    rough = f" (rough: {seeds} seeds)" if seeds < 3 else ""
    return f"95 % intervals for other seeds and other worlds{rough}"


def lines_markdown(found: Sequence[LineResult], question: LineQuestion, runs: int) -> str:
    """One row per length of the line."""
    columns: list[Column | str] = [
        "Vehicles",
        _harm("All brake fully"),
        _harm("Reached"),
        _share("Decrease"),
        _share("Somebody worse off"),
    ]
    searched = [_harm("Best known"), _share("Share of the joint optimum")] if question.search_episodes else []
    rows = [
        [str(one.vehicles), one.full_brake, one.reached, one.decrease, one.worse_off, one.best_known, one.share]
        for one in found
    ]
    conditions = (
        f"{_HARM[question.harm_count].capitalize()} (m²/s², means per world) of the line of {question.scenario.name}"
        f" made longer: {runs} {'policies' if runs > 1 else 'policy'}, {count_of(question.episodes, 'world')} of seed"
        f" {question.list_seed} for each length; {interval_words(runs)}."
    )
    if question.search_episodes:
        conditions += (
            f" Best known and share: the first {count_of(question.search_episodes, 'world')},"
            f" {question.budget:,} candidates each."
        )
    return f"{Sheet('', [*columns, *searched], rows).markdown()}\n\n{conditions}\n"


def _harm(heading: str, sign: Literal["-", "+"] = "-") -> Column:
    return Column(heading, sign=sign)


def _share(heading: str) -> Column:
    return Column(heading, digits=1, scale=100.0, unit=" %", sign="-")


def _estimate(told: Json | None) -> Estimate | None:
    return None if told is None else Estimate(told["value"], told["interval"])


def _levels(levels: Sequence[Json], harm_count: HarmCount) -> Sheet:
    reached = _harm(f"Reached, {_HARM[harm_count]}")
    columns: list[Column | str] = ["Level", _ALGORITHM, _share("Collisions"), _harm("All brake fully"), reached]
    rows = [
        [f"`{level['level']}`", level["algorithm"], _estimate(level["collision_rate"]),
         level[harm_count]["full_brake"]["value"], _estimate(level[harm_count]["harm"])]
        for level in levels
    ]  # fmt: skip
    return Sheet("", columns, rows)


def _optima(levels: Sequence[Json], harm_count: HarmCount) -> Sheet:
    columns: list[Column | str] = [
        "Level",
        _ALGORITHM,
        _harm("All brake fully"),
        _harm(f"Reached, {_HARM[harm_count]}"),
    ]
    columns += [_harm("Joint optimum"), _share("Share of its reduction")]
    rows = []
    for level in levels:
        own = level[harm_count]["searched"]
        if own["best_known"] is not None:
            row = [f"`{level['level']}`", level["algorithm"], own["full_brake"]["value"], _estimate(own["harm"])]
            rows.append([*row, own["best_known"]["value"], _estimate(own["realised_share"])])
    return Sheet("", columns, rows)


def _shielded(levels: Sequence[Json], harm_count: HarmCount) -> Sheet:
    columns: list[Column | str] = [
        "Level",
        _ALGORITHM,
        _harm(f"Without, {_HARM[harm_count]}"),
        _harm("With"),
        _harm("Change", "+"),
    ]
    shares = ("Replaced", "Stepped in", "Somebody worse off", "Above the baseline plan")
    columns += [_harm("Bound"), *map(_share, shares), Column("Above the bound")]
    rows = []
    for level in levels:
        own, behind = level[harm_count], level[harm_count]["shielded"]
        if behind is not None:
            row = [f"`{level['level']}`", level["algorithm"], own["harm"]["value"], behind["harm"]["value"]]
            row += [_estimate(behind["difference"]), behind["bound"]["value"], behind["replaced"]]
            row += [_estimate(behind[key]) for key in ("stepped_in", "worse_off", "above_baseline")]
            rows.append([*row, behind["above_bound"]])
    return Sheet("", columns, rows)


def _changes(changes: Sequence[Json]) -> Sheet:
    columns: list[Column | str] = ["From", "To", _ALGORITHM]
    for harm_count in HARM_COUNTS:
        columns += [_harm(f"Change of {_HARM[harm_count]}", "+"), _share(f"Somebody worse off, {_HARM[harm_count]}")]
    rows = [
        [f"`{change['from']}`", f"`{change['to']}`", change["algorithm"],
         *(_estimate(change[count][key]) for count in HARM_COUNTS for key in ("difference", "worse_off"))]
        for change in changes
    ]  # fmt: skip
    return Sheet("", columns, rows)


def _who_pays(changes: Sequence[Json], harm_count: HarmCount) -> Sheet:
    vehicles = [f"Vehicle {i + 1}" for i in range(len(changes[0][harm_count]["vehicles"]))]
    columns: list[Column | str] = [
        f"Change of {_HARM[harm_count]}",
        _ALGORITHM,
        *(_harm(name, "+") for name in vehicles),
    ]
    columns += [_share(f"{name} worse off") for name in vehicles]
    rows = []
    for change in changes:
        own = change[harm_count]
        row = [f"`{change['from']}` to `{change['to']}`", change["algorithm"], *map(_estimate, own["vehicles"])]
        rows.append(row + own["worse_off_vehicles"])
    return Sheet("", columns, rows)


def _alone(sheet: Sheet) -> Sheet:
    """The table without the algorithm's column where there is only one."""
    if _ALGORITHM not in sheet.columns:
        return sheet
    column = sheet.columns.index(_ALGORITHM)
    if len({row[column] for row in sheet.rows} - {None}) != 1:
        return sheet
    return sheet.only(k for k in range(len(sheet.columns)) if k != column)


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
