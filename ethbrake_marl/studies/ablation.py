"""Ablations: levels of cooperation, trained and compared on the same worlds."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents import Driver, Team, make_agent, split_names
from ethbrake_marl.errors import InvalidInput, OnProgress, Progress, check_whole_number, count_of
from ethbrake_marl.evaluation import (
    LIST_SEED,
    evaluate,
    interquartile_mean,
    load_runnable,
    mean_over_seeds,
    result_identity,
    share_over_seeds,
)
from ethbrake_marl.figures import Figure, ablation_figures, write_picture
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, csv_text
from ethbrake_marl.files.store import write_output
from ethbrake_marl.files.yaml import Override
from ethbrake_marl.harm import HARM_COUNTS, HarmCount, Ledger, objective_harm
from ethbrake_marl.learning import WORDS, RunDirectory, Training, TrainingRecipe, load_recipe, read_settings
from ethbrake_marl.limits import BestHarmTable, best_harm, chunks_left, search_list, task_problem
from ethbrake_marl.pages.page import Page, Part, Played, Section
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario import Sample, Scenario, Task
from ethbrake_marl.shield import Shielded
from ethbrake_marl.studies.folder import StudyFolder
from ethbrake_marl.studies.trainings import Timed, TrainingJob, train_all

# Levels of cooperation that belong together: the same lines; what differs is who learns, knows and cares.

LADDER = (
    "cooperation-0-sensors",
    "cooperation-1-front",
    "cooperation-2-paper",
    "cooperation-3-pair",
    "cooperation-4-all",
)
STANDARD = (*LADDER, "cooperation-2-blocked")

Json = dict[str, Any]

_LINE = ("vehicles", "time_step_s", "horizon_s")
_WORLD = ("gaps_m", "speeds_mps")
_VEHICLE = (
    "braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "speed_limit_mps", "restitution", "brake_rate_mps3",
    "release_rate_mps3",
)  # fmt: skip
_MAY_DIFFER = "roles, objective, obstacle_gap_m, v2x and, where v2x differs, latency_s"
_BUT_CHANNEL = {"name", "title", "description", "source", "v2x"}


@dataclass(frozen=True, slots=True)
class Level:
    """One scenario of an ablation."""

    scenario: Scenario
    clear: str | None = None  # name of the level that is the same but for ``v2x``; None: a step of the ladder

    @property
    def name(self) -> str:
        """The scenario's name."""
        return self.scenario.name


def read_levels(names: Sequence[str], settings: Sequence[Override] = ()) -> list[Level]:
    """Load the levels, by name or path, in this order; ``settings`` hold in each.

    One that differs from an earlier one in ``v2x`` only is that level over another channel; the others are the ladder,
    each compared with the one before. Raises ``InvalidInput`` for fewer than two levels or one given twice, and what
    ``load_runnable`` raises.
    """
    levels: list[Level] = []
    for name in names:
        scenario = load_runnable(name, settings)
        if any(level.name == scenario.name for level in levels):
            raise InvalidInput(f"levels: {scenario.name!r} is given twice")
        told = scenario.model_dump(mode="json", exclude=_BUT_CHANNEL)
        same = [
            level.name
            for level in levels
            if level.clear is None
            and level.scenario.v2x != scenario.v2x
            and level.scenario.model_dump(mode="json", exclude=_BUT_CHANNEL) == told
        ]
        levels.append(Level(scenario, same[0] if same else None))
    if len(levels) < 2:
        raise InvalidInput(f"levels: {len(levels)} given; at least two are needed to compare")
    return levels


def common_worlds(levels: Sequence[Level], episodes: int, seed: int) -> list[Sample]:
    """The list of each level: world k is the same line in all of them, and the same physics hold in it.

    Latencies may differ where ``v2x`` does, and an obstacle ahead may be there or not. Raises ``InvalidInput`` naming
    the level and what is another there.
    """
    samples = [level.scenario.sample(episodes, seed) for level in levels]
    for k, level in enumerate(levels):
        if level.scenario.observation != levels[0].scenario.observation:
            raise InvalidInput(
                f"level {level.name!r}: its observation differs from that of {levels[0].name!r}, so that what it gains"
                f" would not be cooperation's; levels may differ in {_MAY_DIFFER}"
            )
        _check_same(levels[0], samples[0], level, samples[k], (*_LINE, *_WORLD, *_VEHICLE))
        clear = next(j for j in range(k + 1) if levels[j].scenario.v2x == level.scenario.v2x)
        _check_same(levels[clear], samples[clear], level, samples[k], ("latency_s",))
    return samples


def _check_same(one: Level, first: Sample, other: Level, sample: Sample, names: Sequence[str]) -> None:
    for name in names:
        values, others = (_values(name, *pair) for pair in ((one, first), (other, sample)))
        rows = np.flatnonzero((values != others).reshape(len(values), -1).any(axis=1))
        if rows.size:
            here, there = (", ".join(f"{each:g}" for each in np.ravel(v[rows[0]])) for v in (others, values))
            raise InvalidInput(
                f"level {other.name!r}: its {name} differs from that of {one.name!r} ({here}; there {there}); levels"
                f" are compared on the same lines and may differ in {_MAY_DIFFER}, so change or leave out one of them"
            )


def _values(name: str, level: Level, sample: Sample) -> Floats:
    """One row per world of a quantity of the worlds; one row of a number of the scenario."""
    if name in _LINE:
        return np.array([getattr(level.scenario, name)], np.float64)
    values: Floats = getattr(sample.worlds if name in _WORLD else sample.worlds.vehicles, name)
    return values


SETTINGS = "settings.json"  # inside the ablation's folder
_QUICK = {"seeds": 2, "steps_per_learner": 200_000, "episodes": 500, "search_episodes": 40, "budget": 2_000}
_FULL = {"seeds": 5, "steps_per_learner": 400_000, "episodes": 4_000, "search_episodes": 600, "budget": 20_000}


@dataclass(frozen=True, slots=True)
class Plan:
    """An ablation."""

    levels: tuple[Level, ...]
    recipes: tuple[TrainingRecipe, ...]  # with the scheme of levels with several learners, see ``with_scheme``
    seeds: int
    steps_per_learner: int  # decisions of each learner
    episodes: int  # worlds on which everything is measured
    list_seed: int
    search_episodes: int  # of these, worlds in which the joint optimum is searched
    budget: int  # candidates per world and count of that search
    folder: Path
    noted: tuple[str, ...] = ()  # by which scenarios and recipes differ from their files, for ``config.json``
    shield: str | None = None  # "step": everything drives a second time, behind it

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of what is compared: recipes with the scheme."""
        return tuple(_algorithm(recipe) for recipe in self.recipes)

    def trainings(self) -> Iterator[tuple[Level, str, TrainingJob]]:
        """Level, algorithm and training; seed by seed, so that a first result over all levels is there early."""
        for seed in range(self.seeds):
            for recipe in self.recipes:
                for level in self.levels:
                    if level.scenario.learners:
                        yield level, _algorithm(recipe), self.training(level, recipe, seed)

    def training(self, level: Level, recipe: TrainingRecipe, seed: int) -> TrainingJob:
        """The training of one seed; raises ``InvalidInput`` where recipe and level do not go together."""
        learners = len(level.scenario.learners)
        changes: dict[str, Any] = {"seed": seed, "total_steps": self.steps_per_learner * learners}
        if learners == 1:  # the same training whatever the scheme of several learners
            changes |= dict.fromkeys({"scheme", "turns"} & type(recipe).model_fields.keys())
        name = recipe.name if learners == 1 else _algorithm(recipe)
        folder = self.folder / "trainings" / f"{level.name}-{name}-seed{seed}"
        return TrainingJob(Training.of(recipe.replace(**changes), level.scenario), folder, self.noted)

    def settings(self) -> dict[str, Any]:
        """Everything that shapes the results, as plain data."""
        numbers = ("seeds", "steps_per_learner", "episodes", "list_seed", "search_episodes", "budget")
        return {
            "levels": [level.scenario.model_dump(mode="json", exclude=set(WORDS)) for level in self.levels],
            "recipes": [recipe.model_dump(mode="json", exclude=set(WORDS)) for recipe in self.recipes],
            **{name: getattr(self, name) for name in numbers},
            "shield": self.shield,
        }

    def study_folder(self) -> StudyFolder:
        """The folder, which no ablation with other settings may have: its results would be lost."""
        advice = f"give another folder (--output), or, to use its trainings, a copy of it without {SETTINGS}"
        written = (*FIGURES, *(f"ablation.{ending}" for ending in ("html", "md", "csv", "json")))
        return StudyFolder(self.folder, "an ablation", self.settings(), record=SETTINGS, advice=advice, writes=written)

    def optimum_folder(self, level: Level) -> Path:
        """Where the parts of its search stand."""
        return self.folder / "optimum" / level.name


def with_scheme(recipe: TrainingRecipe, scheme: str | None = None) -> TrainingRecipe:
    """The recipe with this scheme for several learners; None: its own, else shared."""
    return recipe.replace(scheme=scheme or recipe.scheme or "shared")


def _algorithm(recipe: TrainingRecipe) -> str:
    return f"{recipe.name}-{recipe.scheme}"


def plan_ablation(
    levels: str | None,
    recipes: str,
    settings: Sequence[str] | None,
    *,
    quick: bool = False,
    tell: Callable[[str], None] | None = None,
    **given: Any,
) -> Plan:
    """The ablation that is asked for; ``given`` are fields of ``Plan``, None: as ``quick`` has them, or as usual.

    Raises ``InvalidInput`` for recipes of one name, numbers below 1, an unknown shield, nothing to train, and whatever
    cannot be trained or compared.
    """
    names = [*(LADDER if quick else STANDARD)] if levels is None else split_names(levels, os.path.isfile)
    loaded = [load_recipe(each.strip()) for each in split_names(recipes, os.path.isfile)]
    changed = read_settings(settings, loaded)
    usual = {"list_seed": LIST_SEED, **(_QUICK if quick else _FULL)}
    plan = Plan(
        levels=tuple(read_levels([each.strip() for each in names], changed.scenario)),
        recipes=tuple(with_scheme(changed.change(recipe, tell)) for recipe in loaded),
        noted=changed.texts,
        **{**usual, **{name: value for name, value in given.items() if value is not None}},
    )
    for name in ("seeds", "steps_per_learner", "episodes", "search_episodes", "budget"):
        check_whole_number(name, getattr(plan, name), 1)
    called = [recipe.name for recipe in loaded]
    if len(set(called)) < len(called):
        raise InvalidInput(f"recipes {', '.join(called)}: give at least one, each with a name of its own")
    if plan.shield not in (None, "step"):
        raise InvalidInput(f"shield {plan.shield!r}: must be step; episode and robust shield one vehicle")
    if plan.search_episodes > plan.episodes:
        raise InvalidInput(
            f"search-episodes {plan.search_episodes}: must be at most the {plan.episodes} worlds of --episodes"
        )
    if not any(level.scenario.learners for level in plan.levels):
        raise InvalidInput("levels: nobody learns in any of them; give at least one with a learner")
    StudyFolder(plan.folder, "an ablation").check()
    common_worlds(plan.levels, 5, plan.list_seed)
    list(plan.trainings())  # one that cannot be is refused
    return plan


# The joint optimum of every level: the least harm known that its learners can do together, world by world.
#
# It depends on the worlds, on who learns, and on the scripts of the others; not on who knows what, nor on objectives.
# So levels that differ in these only ask one question, which is searched once, and what is known of one level is known
# of every other whose learners can do the same.


@dataclass(frozen=True, slots=True)
class LevelOptimum:
    """What is known of one level: its search, and what its teams (of all recipes and seeds) do in the same worlds."""

    level: Level
    worlds: Worlds
    searched: BestHarmTable
    teams: tuple[Team, ...]


def questions(plan: Plan, samples: Sequence[Sample]) -> list[tuple[Level, Sample, list[Level]]]:
    """Each question once: the first level that asks it, its worlds to be searched, and all levels that ask it."""
    found: dict[bytes, tuple[Level, Sample, list[Level]]] = {}
    rows = np.arange(plan.search_episodes)
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.scenario.learners:
            part = sample.take(rows)
            identity = task_problem(part.worlds, Task(level.scenario, level.scenario.learners)).identity.tobytes()
            found.setdefault(identity, (level, part, []))[2].append(level)
    return list(found.values())


def search_all(plan: Plan, samples: Sequence[Sample], jobs: int, tell: OnProgress) -> dict[str, BestHarmTable]:
    """The search of every level with learners, by its name; parts that were found earlier are kept."""
    found: dict[str, BestHarmTable] = {}
    for level, part, alike in questions(plan, samples):
        table = search_list(
            level.scenario,
            part,
            budget=plan.budget,
            threads=jobs,
            chunks=plan.optimum_folder(level),
            on_progress=partial(_tell, tell, f"joint optimum of {level.name}"),
        )
        found |= {each.name: table for each in alike}
    return found


def _tell(tell: OnProgress, name: str, done: int, total: int) -> None:
    tell(Progress(name, done, total))


def best_known(own: LevelOptimum, answers: Sequence[LevelOptimum]) -> dict[HarmCount, Floats]:
    """The least harm [n] of each count in all ``answers`` (its own is among them) that these learners can give too."""
    best = {harm_count: np.full(own.worlds.n, np.inf) for harm_count in HARM_COUNTS}
    for other in answers:
        rows = np.flatnonzero(_can_imitate(own, other))
        if rows.size:
            for harms in _harms(own, other, rows):
                for harm_count in HARM_COUNTS:
                    best[harm_count][rows] = np.minimum(best[harm_count][rows], harms[harm_count])
    return best


def _can_imitate(own: LevelOptimum, other: LevelOptimum) -> Bools:
    """In which worlds the learners of ``own`` can do what those of ``other`` do, [n].

    They are the same vehicles or more, all others follow the same scripts, latencies are equal, and the decisions of
    ``other`` fall on theirs. What an obstacle ahead does to it is found by driving, so ``other`` may lack one.
    """
    mine, theirs = own.level.scenario, other.level.scenario
    same_scripts = all(theirs.scripts.get(i) == script for i, script in mine.scripts.items())
    if not (set(theirs.learners) <= set(mine.learners) and same_scripts):
        return np.zeros(own.worlds.n, np.bool_)
    latency_s, obstacle_m = own.worlds.vehicles.latency_s, other.worlds.obstacle_gap_m
    later_s = own.worlds.first_decision_s(theirs.learners) - own.worlds.first_decision_s(mine.learners)
    steps = later_s / mine.time_step_s
    same = (latency_s == other.worlds.vehicles.latency_s).all(axis=1)
    on_grid = np.abs(steps - np.rint(steps)) < 1e-9
    return np.asarray(same & on_grid & ((obstacle_m == own.worlds.obstacle_gap_m) | np.isinf(obstacle_m)), np.bool_)


def _harms(own: LevelOptimum, other: LevelOptimum, rows: Ints) -> Iterator[dict[HarmCount, Floats]]:
    """Harm of both counts that the search and every team of ``other`` do in some worlds of ``own``."""
    scenario, task = other.level.scenario, Task(other.level.scenario, other.level.scenario.learners)
    worlds = replace(other.worlds, obstacle_gap_m=own.worlds.obstacle_gap_m).take(rows)
    for best in other.searched.best.values():
        kept = best._replace(harm=best.harm[rows], profiles=best.profiles.take(rows))
        yield dict(zip(HARM_COUNTS, task_problem(worlds, task).follow(kept.profiles), strict=True))
    for team in other.teams:
        driven = evaluate(worlds, {team.name: team}, scenario=scenario, aftermath=False).complete()
        ledger = driven.outcome(team.name).ledger
        yield {harm_count: ledger.world_harm(harm_count) for harm_count in HARM_COUNTS}


@dataclass(frozen=True, slots=True)
class Harms:
    """What several trainings (or one script) did, on the same worlds."""

    world: dict[HarmCount, Floats]  # [seeds, worlds] harm of all vehicles (m2/s2)
    vehicle: dict[HarmCount, Floats]  # [seeds, worlds, N] harm of each
    collided: Bools  # [seeds, worlds]
    policies: tuple[Mapping[str, str], ...] = ()  # of each seed: vehicle -> SHA-256 of its policy's manifest
    ledgers: tuple[Ledger, ...] = ()  # of each seed


class Goal(NamedTuple):
    """What the trainings of a level make small: mean over seeds, worlds and learners; of full braking, too."""

    name: str
    reached: float
    full_brake: float

    @classmethod
    def of(cls, training: Training, reached: Harms, full_brake: Harms) -> Goal:
        """The goal that the training's reward counts: the harm of the line, or the objective of each learner."""
        reward, scenario = training.recipe.reward, training.scenario
        objectives = reward.settled(scenario.objective, scenario.vehicles)[1]

        def mean(harms: Harms) -> float:
            if not objectives:
                return float(harms.world[reward.harm_count].mean())
            each = [objective_harm(ledger, reward.harm_count, objectives) for ledger in harms.ledgers]
            return float(np.stack(each)[:, :, list(scenario.learners)].mean())

        return cls("objective" if objectives else _HARM[reward.harm_count], mean(reached), mean(full_brake))

    @property
    def missed(self) -> bool:
        """Whether full braking of everybody does better than what was trained."""
        return self.reached > self.full_brake + TOLERANCE


@dataclass(frozen=True, slots=True)
class Measured:
    """One level under one algorithm."""

    level: Level
    algorithm: str | None  # None: nobody learns
    reached: Harms
    full_brake: Harms  # of all vehicles, whatever their roles
    best: dict[HarmCount, Floats] | None  # [1, search_episodes] joint optimum, best known; None: nobody to control
    identity: Mapping[str, Any] = field(default_factory=dict)  # of worlds and scenario, and what computed it
    shielded: dict[HarmCount, Shielded] | None = None  # [seeds, worlds] behind the shield that guards that count
    goal: Goal | None = None  # None: nobody learns


def measure(plan: Plan, jobs: int = 1, tell: OnProgress | None = None) -> list[Measured]:
    """Let everything that was trained drive the common worlds, and search the joint optima (parts found are kept).

    Level by level in the plan's order, algorithm by algorithm. What some policy does better than the search becomes
    the best known of that world. Raises what loading teams and ``common_worlds`` raise, before any long work.
    """
    say = tell or (lambda progress: None)
    teams: dict[tuple[str, str], list[Team]] = {}
    trainings: dict[tuple[str, str], Training] = {}
    for level, algorithm, training in plan.trainings():
        trainings[level.name, algorithm] = training.training
        team = RunDirectory(training.folder).load_team(level.scenario, training.folder.name)
        teams.setdefault((level.name, algorithm), []).append(team)
    samples = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    tables = search_all(plan, samples, jobs, say)
    answers = {}
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.scenario.learners:
            own = [team for algorithm in plan.algorithms for team in teams[level.name, algorithm]]
            part = sample.worlds.take(np.arange(plan.search_episodes))
            answers[level.name] = LevelOptimum(level, part, tables[level.name], tuple(own))
    found: list[Measured] = []
    for level, sample in zip(plan.levels, samples, strict=True):
        alike = level.scenario.replace(roles=dict.fromkeys(level.scenario.vehicle_names, "full_brake"))
        braking = _drive(alike, sample, [Team({}, f"full braking in {level.name}")], say)
        about = result_identity("ablate", level.scenario, sample)
        if not level.scenario.learners:
            scripts = _drive(level.scenario, sample, [Team({}, f"scripts of {level.name}")], say)
            found.append(Measured(level, None, scripts, braking, None, about))
            continue
        known = best_known(answers[level.name], list(answers.values()))
        best = {harm_count: harm[np.newaxis] for harm_count, harm in known.items()}
        for algorithm in plan.algorithms:
            own = teams[level.name, algorithm]
            reached = _drive(level.scenario, sample, own, say)
            behind: dict[HarmCount, Shielded] = {}
            for harm_count in HARM_COUNTS if plan.shield else ():
                task, parts = Task(level.scenario, level.scenario.learners, harm_count), []
                for team in own:
                    parts.append(Shielded.driven(team, sample.worlds, task))
                    name = f"driving {team.name} behind the shield, {harm_count}"
                    say(Progress(name, sample.worlds.n, sample.worlds.n))
                behind[harm_count] = Shielded.stack(parts)
            goal = Goal.of(trainings[level.name, algorithm], reached, braking)
            found.append(Measured(level, algorithm, reached, braking, best, about, behind or None, goal))
    return found


def _drive(scenario: Scenario, sample: Sample, drivers: Sequence[Driver], tell: OnProgress) -> Harms:
    """Harms of several drivers of one level on the same worlds."""
    outcomes = []
    for driver in drivers:
        result = evaluate(sample, {driver.name: driver}, scenario=scenario).complete()
        outcomes.append(result.outcome(driver.name))
        tell(Progress(f"driving {driver.name}", sample.worlds.n, sample.worlds.n))
    ledgers = [outcome.ledger for outcome in outcomes]
    return Harms(
        {harm_count: np.stack([each.world_harm(harm_count) for each in ledgers]) for harm_count in HARM_COUNTS},
        {harm_count: np.stack([each.vehicle_harm(harm_count) for each in ledgers]) for harm_count in HARM_COUNTS},
        np.stack([outcome.collided for outcome in outcomes]),
        tuple(dict(outcome.policies) for outcome in outcomes),
        tuple(ledgers),
    )


# The findings of an ablation: Markdown tables, and a page.

# Episodes on the page of an ablation: the same few lines of vehicles, driven level by level.

_MOST, _USUAL, _LEAST = 3, 2, 2  # worlds in which most, as usual and least is saved


def choose_worlds(measured: Sequence[Measured]) -> list[Played]:
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
    found: dict[int, Played] = {}
    for kind, rows in kinds:
        for row in map(int, rows):
            found.setdefault(row, Played(row, kind, f"total harm {before[row]:.2f} to {after[row]:.2f}"))
    return list(found.values())


def episodes_section(plan: Plan, measured: Sequence[Measured]) -> Section:
    """A few worlds of the ablation to watch, level beside level; each trained level by its first seed."""
    played = choose_worlds(measured)
    rows = np.array([each.number for each in played], np.int64)
    driven: dict[str, tuple[int, ...]] = {}
    for level in plan.levels:
        worlds = level.scenario.sample(plan.episodes, plan.list_seed).worlds.take(rows)
        drivers = {level.name: Team({}, level.name)}  # who drives nobody changes nothing
        if level.scenario.learners:
            drivers = {}
            for recipe in plan.recipes:
                folder = plan.training(level, recipe, 0).folder
                name = level.name if len(plan.recipes) == 1 else f"{level.name}, {_algorithm(recipe)}"
                drivers[name] = RunDirectory(folder).load_team(level.scenario, name)
        for name, team in drivers.items():
            Played.drive(played, worlds, name, team, level.scenario)
            driven[name] = level.scenario.learners
    told = (
        f"{count_of(len(played), 'world')}, the same line at every level; of several seeds the first drives."
        f" The conditions are those of {plan.levels[0].name}: delays of messages and an obstacle ahead are each"
        " level's own."
    )
    return Section("Episodes", [told, Part.player(played, driven)])


# The comparison of levels: harm of each, what each step is worth, who pays, the distance to the joint optimum.
#
# Intervals hold for other training seeds and other worlds: both are drawn anew (``evaluation.statistics``).

TOLERANCE = 1e-6  # m2/s2; a vehicle whose harm rose by more is worse off


def compare(measured: Sequence[Measured], searched: int) -> Json:
    """Plain data for JSON: ``levels``, ``steps`` of the ladder, ``channels``; see docs/ablate-cooperation.md.

    ``undertrained`` has a sentence for each level in which everybody braking fully does better than what was trained.

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
        "undertrained": [_undertrained(one, one.goal) for one in measured if one.goal is not None and one.goal.missed],
    }


def _undertrained(one: Measured, goal: Goal) -> str:
    return (
        f"{one.level.name} ({one.algorithm}) is not trained enough to say anything: its {goal.name} is"
        f" {goal.reached:.2f}, and {goal.full_brake:.2f} if everybody brakes fully."
    )


def _level(one: Measured, searched: int) -> Json:
    """What one level reached under one algorithm; harm (m2/s2) in all worlds, and in the ``searched`` ones.

    There also the joint optimum, and the share of its reduction that is realised.
    """
    scenario = one.level.scenario
    found: Json = {
        **one.identity,
        "policy_sha256": [dict(seed) for seed in one.reached.policies],
        "level": one.level.name,
        "title": scenario.title,
        "algorithm": one.algorithm,
        "clear": one.level.clear,
        "learners": [scenario.vehicle_names[i] for i in scenario.learners],
        "seeds": len(one.reached.collided),
        "worlds": one.reached.collided.shape[1],
        "collision_rate": mean_over_seeds(one.reached.collided).to_json(),
        "goal": None if one.goal is None else {**one.goal._asdict(), "missed": one.goal.missed},
    }
    for harm_count in HARM_COUNTS:
        reached, braking = one.reached.world[harm_count], one.full_brake.world[harm_count]
        best = None if one.best is None else one.best[harm_count]
        share = None if best is None else share_over_seeds(reached[:, :searched], braking[:, :searched], best)
        found[harm_count] = {
            "full_brake": mean_over_seeds(braking).to_json(),
            "harm": mean_over_seeds(reached).to_json(),
            "each_seed": reached.mean(axis=1).tolist(),
            "interquartile_mean": interquartile_mean([reached.mean(axis=1)], resamples=2000).to_json(),
            "vehicles": [mean_over_seeds(column).to_json() for column in _columns(one.reached, harm_count)],
            "searched": {
                "worlds": min(searched, reached.shape[1]),
                "full_brake": mean_over_seeds(braking[:, :searched]).to_json(),
                "harm": mean_over_seeds(reached[:, :searched]).to_json(),
                "each_seed": reached[:, :searched].mean(axis=1).tolist(),
                "best_known": None if best is None else mean_over_seeds(best).to_json(),
                "share_of_possible_reduction": None if share is None else share.to_json(),
            },
            "shielded": None if one.shielded is None else _behind(one, one.shielded[harm_count], harm_count, searched),
        }
    return found


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
        "stepped_in": mean_over_seeds((shielded.replaced > 0).any(axis=2)).to_json(),
        "vehicles": [mean_over_seeds(column).to_json() for column in np.moveaxis(after - before, 2, 0)],
        "worse_off": mean_over_seeds((after > before + TOLERANCE).any(axis=2)).to_json(),
        "above_baseline": mean_over_seeds((after > shielded.baseline + TOLERANCE).any(axis=2)).to_json(),
        "moving": int(shielded.moving.sum()),
        "searched": {"harm": mean_over_seeds(shielded.harm[:, :searched]).to_json()},
    }


def _change(before: Measured, after: Measured, algorithm: str) -> Json:
    """From one level to another on the same worlds: positive is more harm."""
    found: Json = {"from": before.level.name, "to": after.level.name, "algorithm": algorithm}
    for harm_count in HARM_COUNTS:
        pairs = zip(_columns(after.reached, harm_count), _columns(before.reached, harm_count), strict=True)
        # seed k against seed k, or against the only one
        old, new = before.reached.vehicle[harm_count], after.reached.vehicle[harm_count]
        worse = new > old + TOLERANCE
        found[harm_count] = {
            "difference": mean_over_seeds(after.reached.world[harm_count], before.reached.world[harm_count]).to_json(),
            "vehicles": [mean_over_seeds(new, old).to_json() for new, old in pairs],
            "worse_off": mean_over_seeds(worse.any(axis=2)).to_json(),
            "worse_off_vehicles": [float(share) for share in worse.mean(axis=(0, 1))],
        }
    return found


def _columns(harms: Harms, harm_count: HarmCount) -> list[Floats]:
    """[seeds, worlds] of each vehicle."""
    return [harms.vehicle[harm_count][:, :, i] for i in range(harms.vehicle[harm_count].shape[2])]


# The findings of an ablation as CSV: one row per level, algorithm and seed.


def levels_csv(measured: Sequence[Measured], searched: int) -> str:
    """One row per level, algorithm and seed: means over the worlds (m2/s2); without a shield its columns are empty.

    ``searched``: over the worlds in which the joint optimum was searched.
    """
    return csv_text(_seed_row(one, seed, searched) for one in measured for seed in range(len(one.reached.collided)))


def _seed_row(one: Measured, seed: int, searched: int) -> Json:
    collided = one.reached.collided[seed]
    about: Json = {
        "level": one.level.name,
        "algorithm": one.algorithm,
        "seed": seed if one.algorithm else None,
        "worlds": len(collided),
        "collision_rate": float(collided.mean()),
    }
    vehicles: Json = {}
    shield: Json = {}
    for harm_count in HARM_COUNTS:
        name = RunDirectory.HARM[harm_count]
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
        behind = None if one.shielded is None else one.shielded[harm_count]
        actions = 1 if behind is None else behind.decisions[seed].sum() * behind.replaced.shape[2]
        shield |= {
            f"shielded_{name}": None if behind is None else float(behind.harm[seed].mean()),
            f"bound_{name}": None if behind is None else float(behind.bound[seed].mean()),
            f"actions_replaced_{name}": None if behind is None else float(behind.replaced[seed].sum() / actions),
        }
    return {**about, **vehicles, **shield}


_ALGORITHM = "Algorithm"
_HARM = {"first": "first-impact harm", "total": "total harm"}


def markdown(found: Json, conditions: str) -> str:
    """All tables, with their conditions below."""
    blocks = [f"**{line}**" for line in found["undertrained"]]
    blocks += [text for title, sheets in _blocks(found) for text in (f"## {title}", *(s.markdown() for s in sheets))]
    return "\n\n".join([*blocks, conditions]) + "\n"


def ablation_page(found: Json, conditions: str, figures: Mapping[str, Figure], episodes: Sequence[Section] = ()) -> str:
    """The figures by name, sections of episodes to watch and all tables as one HTML page, with their conditions."""
    drawn = [
        Part.drawing(figure, *FIGURES[name], alone=name == "ablation-who-pays.png", known=conditions)
        for name, figure in figures.items()
    ]
    sections = [Section("Conditions", [conditions]), *([Section("Figures", drawn)] if drawn else []), *episodes]
    for title, sheets in _blocks(found):
        parts = []
        for sheet in sheets:
            rows = [
                [cell.in_words.replace("`", "") for cell in row] for row in sheet.shown() if not isinstance(row, str)
            ]
            parts.append(Part.table(Sheet("", [Column(heading) for heading in sheet.headings], rows)))
        sections.append(Section(title, parts))
    settings = {name: value for name, value in found["settings"].items() if name != "recipes"}
    sections.append(Section("Settings", [Part.facts(settings)]))
    lead = "Who learns, who knows, whose harm counts: step by step."
    alarms = [Part.paragraph(line, "alarm") for line in found["undertrained"]]
    return Page("What cooperation is worth", sections, lead, opening=alarms).html


def _blocks(found: Json) -> list[tuple[str, list[Sheet]]]:
    """The tables below their titles; a cell stands where its path says: keys with blanks between."""
    levels = [{**level, "level": f"`{level['level']}`"} for level in found["levels"]]
    steps, channels = (
        [{**change, "from": f"`{change['from']}`", "to": f"`{change['to']}`"} for change in found[key]]
        for key in ("steps", "channels")
    )
    both = [{**change, "change": f"{change['from']} to {change['to']}"} for change in steps + channels]
    vehicles = range(len(both[0]["first"]["vehicles"]) if both else 0)
    worlds = levels[0]["first"]["searched"]["worlds"]
    braking = Column("All brake fully")
    about: _Columns = [("Level", "level"), (_ALGORITHM, "algorithm")]
    changed: _Columns = [("From", "from"), ("To", "to"), (_ALGORITHM, "algorithm")]
    for count in HARM_COUNTS:
        changed += [
            (Column(f"Change of {_HARM[count]}", sign="+"), f"{count} difference"),
            (_share(f"Somebody worse off, {_HARM[count]}"), f"{count} worse_off"),
        ]
    blocks = {
        "Levels": [
            _sheet(levels, [
                *about,
                (_share("Collisions"), "collision_rate"),
                (braking, f"{count} full_brake value"),
                (Column(f"Reached, {_HARM[count]}"), f"{count} harm"),
            ])
            for count in HARM_COUNTS
        ],
        f"How near the joint optimum, in the first {count_of(worlds, 'world')}": [
            _sheet([level for level in levels if level[count]["searched"]["best_known"] is not None], [
                *about,
                (braking, f"{count} searched full_brake value"),
                (Column(f"Reached, {_HARM[count]}"), f"{count} searched harm"),
                (Column("Joint optimum"), f"{count} searched best_known value"),
                (_share("Share of its reduction"), f"{count} searched share_of_possible_reduction"),
            ])
            for count in HARM_COUNTS
        ],
        "Behind the step shield that guards the count of the table": [
            _sheet([level for level in levels if level[count]["shielded"]], [
                *about,
                (Column(f"Without, {_HARM[count]}"), f"{count} harm value"),
                (Column("With"), f"{count} shielded harm value"),
                (Column("Change", sign="+"), f"{count} shielded difference"),
                (Column("Bound"), f"{count} shielded bound value"),
                (_share("Replaced"), f"{count} shielded replaced"),
                (_share("Stepped in"), f"{count} shielded stepped_in"),
                (_share("Somebody worse off"), f"{count} shielded worse_off"),
                (_share("Above the baseline plan"), f"{count} shielded above_baseline"),
                (Column("Above the bound"), f"{count} shielded above_bound"),
            ])
            for count in HARM_COUNTS
        ],
        "What each step is worth": [_sheet(steps, changed)],
        "Price of lost messages": [_sheet(channels, changed)],
        "Who pays": [
            _sheet(both, [
                (f"Change of {_HARM[count]}", "change"),
                (_ALGORITHM, "algorithm"),
                *((Column(f"Vehicle {i + 1}", sign="+"), f"{count} vehicles {i}") for i in vehicles),
                *((_share(f"Vehicle {i + 1} worse off"), f"{count} worse_off_vehicles {i}") for i in vehicles),
            ])
            for count in HARM_COUNTS
        ],
    }  # fmt: skip
    always = [*blocks][:2]
    return [(title, sheets) for title, sheets in blocks.items() if title in always or any(s.rows for s in sheets)]


_Columns = list[tuple[Column | str, str]]


def _sheet(rows: Sequence[Json], columns: _Columns) -> Sheet:
    """The table without the algorithm's column where there is only one."""
    if len({row["algorithm"] for row in rows} - {None}) == 1:
        columns = [(column, path) for column, path in columns if column != _ALGORITHM]
    cells: list[list[Any]] = []
    for row in rows:
        cells.append([])
        for _, path in columns:
            found: Any = row
            for key in path.split():
                found = found[int(key) if isinstance(found, list) else key]
            cells[-1].append(Estimate(**found) if isinstance(found, dict) else found)
    return Sheet("", [column for column, _ in columns], cells)


def interval_words(seeds: int) -> str:
    """What the intervals of figures over so many seeds hold for."""
    if seeds == 1:
        return "95 % intervals for other worlds only: one seed says nothing about others"
    rough = f" (rough: {seeds} seeds)" if seeds < 3 else ""
    return f"95 % intervals for other seeds and other worlds{rough}"


def _share(heading: str) -> Column:
    return Column(heading, digits=1, scale=100.0, unit=" %")


FIGURES = {  # those of ``ablation_figures``, each with its title and what it shows
    "ablation.png": (
        "Harm against cooperation",
        "Both harms at each level, between full braking and the joint optimum.",
    ),
    "ablation-changes.png": ("What each step is worth", "Change of both harms from one level to the next."),
    "ablation-who-pays.png": ("Who pays", "Change of the harm of each vehicle, under both counts."),
}


def write_ablation(plan: Plan, measured: Sequence[Measured], machine: str) -> tuple[Json, list[Path]]:
    """Write all files, replacing earlier ones: what ``ablation.json`` holds; page, Markdown and figures."""
    settings = {
        **plan.settings(),
        "levels": [level.name for level in plan.levels],
        "recipes": {name: r.model_dump(mode="json") for name, r in zip(plan.algorithms, plan.recipes, strict=True)},
        "machine": machine,
        "date": datetime.now(UTC).date().isoformat(),
    }
    found = {"settings": settings, **compare(measured, plan.search_episodes)}
    recipes = ", ".join(
        f"{name} (rewarded for {'first-impact' if recipe.reward.harm_count == 'first' else 'total'} harm)"
        for name, recipe in zip(plan.algorithms, plan.recipes, strict=True)
    )
    conditions = (
        f"{recipes}; {plan.seeds} {'seeds' if plan.seeds > 1 else 'seed'}, {plan.steps_per_learner:,} decisions of each"
        f" learner. Harms are means per world in m²/s² on the same {count_of(plan.episodes, 'world')} of seed"
        f" {plan.list_seed} at every level; {interval_words(plan.seeds)}. Joint optimum: the least harm known that"
        f" the level's learners can do, and everything beside it, in the first {plan.search_episodes:,} of these"
        f" worlds, {plan.budget:,} candidates per world and count. {machine}."
    )
    drawn = found["steps"] or found["channels"]
    figures = dict(zip(FIGURES, ablation_figures(found, conditions), strict=True)) if drawn else {}
    for name, figure in figures.items():
        write_picture(plan.folder / name, figure, force=True)
    texts = {
        "ablation.html": ablation_page(found, conditions, figures, [episodes_section(plan, measured)]),
        "ablation.md": markdown(found, conditions),
        "ablation.csv": levels_csv(measured, plan.search_episodes),
        "ablation.json": json.dumps(found, indent=2, allow_nan=False) + "\n",
    }
    for name, text in texts.items():
        write_output(plan.folder / name, text.encode(), force=True)
    return found, [plan.folder / name for name in ("ablation.html", "ablation.md", *figures)]


# An ablation as a whole: what is left to do, and doing it.


def run_ablation(
    plan: Plan, jobs: int = 1, machine: str = "", tell: OnProgress | None = None
) -> tuple[Json, list[Path]] | None:
    """Bring every training to its end, ``jobs`` at a time, measure, and write all files, replacing earlier ones.

    What ``ablation.json`` holds; page, Markdown and figures. None when Ctrl-C stopped the trainings. Raises what
    ``StudyFolder.work``, ``train_all`` and ``measure`` raise.
    """
    with plan.study_folder().work():
        if not train_all([training for _, _, training in plan.trainings()], jobs, tell):
            return None
        return write_ablation(plan, measure(plan, jobs, tell), machine)


def ablation_cost(plan: Plan) -> str:
    """What is left to do, in seconds of one core, and a line for each damaged part of a search.

    A short training of each level and recipe, an evaluation and a search are timed; other work on the machine
    counts as well, for seconds are of the clock. Raises as ``TrainingJob.steps_left``, and what ``load_team``
    raises for a finished training that cannot drive.
    """
    left = [(level, algorithm, training, training.steps_left()) for level, algorithm, training in plan.trainings()]
    decisions: Counter[tuple[str, str]] = Counter()
    for level, algorithm, training, steps in left:
        decisions[level.name, algorithm] += steps
        if not steps:
            RunDirectory(training.folder).load_team(level.scenario)
    lists = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    samples = {level.name: sample for level, sample in zip(plan.levels, lists, strict=True)}
    kinds = {(level.name, algorithm): training for level, algorithm, training, _ in left}
    short = {kind: kinds[kind].time(samples[kind[0]]) for kind, steps in decisions.items() if steps}
    training_s = sum(each.seconds(decisions[kind]) for kind, each in short.items())
    level, _, first, _ = left[0]
    worlds_s = [each.world_s for each in short.values()] or [first.world_seconds(samples[level.name])]
    driving_s = sum(worlds_s) / len(worlds_s) * plan.episodes * (len(left) + len(plan.levels))
    for level in plan.levels if plan.shield else ():  # learners that brake fully are replaced most often
        if level.scenario.learners:
            task, often = Task(level.scenario, level.scenario.learners), plan.seeds * len(plan.recipes)
            shielded = partial(Shielded.driven, make_agent("full_brake"), task=task)
            world_s = Timed.each_s(samples[level.name].worlds, shielded)
            driving_s += plan.episodes * often * len(HARM_COUNTS) * world_s
    search_s, damaged = 0.0, []
    for level, part, _ in questions(plan, lists):
        number, broken = chunks_left(level.scenario, part, budget=plan.budget, chunks=plan.optimum_folder(level))
        damaged += broken
        if number:
            searching = partial(best_harm, level.scenario, budget=plan.budget, threads=1)
            search_s += number * Timed.each_s(part.worlds, searching, most=4)
    speed = f" at {decisions.total() / training_s:,.0f}/s" if training_s > 0.0 else ""
    told = Timed.in_words
    line = (
        f"to do: {sum(steps > 0 for *_, steps in left)} trainings, {decisions.total():,} decisions{speed}:"
        f" {told(training_s)}; joint optima {told(search_s)}; driving the common worlds {told(driving_s)};"
        f" together about {told(training_s + driving_s + search_s)} of one core"
    )
    return "\n".join([line, *(f"{file}: is damaged; its worlds are searched again" for file in damaged)])
