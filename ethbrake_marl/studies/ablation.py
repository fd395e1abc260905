"""Training everything that an ablation needs, and letting it drive the common worlds."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.agents.registry import make_single_agent
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput, OnProgress, Progress
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, load_runnable, policies_by_name, result_identity
from ethbrake_marl.evaluation.outcome import Outcome
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.files.yaml import Override
from ethbrake_marl.learning.recipe import WORDS, Scheme, TrainingRecipe
from ethbrake_marl.learning.training import load_team, resolve
from ethbrake_marl.limits.best_harm import (
    BestHarmTable,
    best_harm,
    chunks_left,
    realised_harm,
    search_list,
    world_identity,
)
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.kernel import first_decision_s
from ethbrake_marl.scenario import Sample, Scenario, Task
from ethbrake_marl.shield.guard import Shielded, drive_chunks, stack
from ethbrake_marl.studies.jobs import JobFolder
from ethbrake_marl.studies.trainings import (
    TIMED_DRIVES,
    TrainingJob,
    finish_trainings,
    time_training,
    told_seconds,
    world_seconds,
)

# Levels of cooperation that belong together: the same lines; what differs is who learns, knows and cares.

LADDER = (
    "cooperation-0-sensors",
    "cooperation-1-front",
    "cooperation-2-paper",
    "cooperation-3-pair",
    "cooperation-4-all",
)
STANDARD = (*LADDER, "cooperation-2-blocked")

_LINE = ("vehicles", "time_step_s", "horizon_s")
_WORLD = ("gaps_m", "speeds_mps")
_VEHICLE = ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "speed_limit_mps", "restitution")
_MAY_DIFFER = "roles, objective, obstacle_gap_m, v2x and, where v2x differs, latency_s"
_ABOUT = {"name", "title", "description", "source"}


@dataclass(frozen=True, slots=True)
class Level:
    """One scenario of an ablation."""

    scenario: Scenario
    clear: str | None = None  # name of the level that is the same but for ``v2x``; None: a step of the ladder

    @property
    def name(self) -> str:
        """The scenario's name."""
        return self.scenario.name

    @property
    def trained(self) -> bool:
        """Whether anybody learns; else all follow their scripts."""
        return bool(self.scenario.learners)


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
        same = [level.name for level in levels if level.clear is None and _but_channel(level.scenario, scenario)]
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


def _but_channel(one: Scenario, other: Scenario) -> bool:
    """Whether two scenarios differ in their channel, and in nothing else that matters."""
    first, second = (scenario.model_dump(mode="json", exclude=_ABOUT | {"v2x"}) for scenario in (one, other))
    return first == second and one.v2x != other.v2x


TRAININGS, OPTIMUM, SETTINGS = "trainings", "optimum", "settings.json"  # inside the ablation's folder
SHIELDS = ("step",)  # that may be put around every level's learners
_NUMBERS = ("seeds", "steps_per_learner", "episodes", "list_seed", "search_episodes", "budget")
_TOLD = (*_NUMBERS, "shield")  # settings whose values are told where they differ


@dataclass(frozen=True, slots=True)
class Training:
    """One training: a level, a recipe with its seed, and where it stands."""

    level: Level
    algorithm: str
    recipe: TrainingRecipe
    folder: Path
    noted: tuple[str, ...] = ()  # by which scenario and recipe differ from their files, for ``config.json``

    def job(self) -> TrainingJob:
        """What brings it to its end."""
        return TrainingJob(resolve(self.recipe, self.level.scenario), self.folder, self.noted)


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
    noted: tuple[str, ...] = ()  # see ``Training``
    shield: str | None = None  # one of ``SHIELDS``: everything drives a second time, behind it

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of what is compared: recipes with the scheme."""
        return tuple(_algorithm(recipe) for recipe in self.recipes)

    def trainings(self) -> Iterator[Training]:
        """Seed by seed, so that a first result over all levels is there early."""
        for seed in range(self.seeds):
            for recipe in self.recipes:
                for level in self.levels:
                    if level.trained:
                        yield self.training(level, recipe, seed)

    def training(self, level: Level, recipe: TrainingRecipe, seed: int) -> Training:
        """The training of one seed."""
        learners = len(level.scenario.learners)
        changes: dict[str, Any] = {"seed": seed, "total_steps": self.steps_per_learner * learners}
        if learners == 1:  # the same training whatever the scheme of several learners
            changes |= dict.fromkeys({"scheme", "turns"} & type(recipe).model_fields.keys())
        name = recipe.name if learners == 1 else _algorithm(recipe)
        folder = self.folder / TRAININGS / f"{level.name}-{name}-seed{seed}"
        return Training(level, _algorithm(recipe), recipe.replace(**changes), folder, self.noted)

    def settings(self) -> dict[str, Any]:
        """Everything that shapes the results, as plain data."""
        scenarios = [level.scenario.model_dump(mode="json", exclude=set(WORDS)) for level in self.levels]
        recipes = [recipe.model_dump(mode="json", exclude=set(WORDS)) for recipe in self.recipes]
        numbers = {name: getattr(self, name) for name in _NUMBERS}
        return {"levels": scenarios, "recipes": recipes, **numbers, "shield": self.shield}

    def job_folder(self) -> JobFolder:
        """The folder, which no ablation with other settings may have: its results would be lost."""
        advice = f"give another folder (--output), or, to use its trainings, a copy of it without {SETTINGS}"
        return JobFolder(self.folder, "an ablation", self.settings(), record=SETTINGS, advice=advice)

    def optimum_folder(self, level: Level) -> Path:
        """Where the parts of its search stand."""
        return self.folder / OPTIMUM / level.name


def with_scheme(recipe: TrainingRecipe, scheme: Scheme | None) -> TrainingRecipe:
    """The recipe with this scheme for several learners; None: its own, else shared."""
    return recipe.replace(scheme=scheme or recipe.scheme or "shared")


def _algorithm(recipe: TrainingRecipe) -> str:
    return f"{recipe.name}-{recipe.scheme}"


def check_plan(plan: Plan) -> None:
    """Raise ``InvalidInput`` for recipes of one name, numbers below 1, an unknown shield, or nothing to train."""
    names = [recipe.name for recipe in plan.recipes]
    if not names or len(set(names)) < len(names):
        raise InvalidInput(f"recipes {', '.join(names) or 'none'}: give at least one, each with a name of its own")
    for name in _NUMBERS:
        if name != "list_seed" and not getattr(plan, name) >= 1:
            raise InvalidInput(f"{name.replace('_', '-')} {getattr(plan, name)}: must be at least 1")
    if plan.shield not in (None, *SHIELDS):
        raise InvalidInput(
            f"shield {plan.shield!r}: must be {', '.join(SHIELDS)}; episode and robust shield one vehicle"
        )
    if plan.search_episodes > plan.episodes:
        raise InvalidInput(
            f"search-episodes {plan.search_episodes}: must be at most the {plan.episodes} worlds of --episodes"
        )
    if not any(level.trained for level in plan.levels):
        raise InvalidInput("levels: nobody learns in any of them; give at least one with a learner")


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
        if level.trained:
            part = sample.take(rows)
            identity = world_identity(part.worlds, Task(level.scenario, level.scenario.learners)).tobytes()
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
    later_s = first_decision_s(own.worlds, theirs.learners) - first_decision_s(own.worlds, mine.learners)
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
        yield dict(zip(HARM_COUNTS, realised_harm(worlds, task, kept), strict=True))
    for team in other.teams:
        driven = evaluate(worlds, {team.name: team}, scenario=scenario, aftermath=False).complete()
        ledger = driven.outcome(team.name).ledger
        yield {harm_count: ledger.world_harm(harm_count) for harm_count in HARM_COUNTS}


def check_finished(trainings: Iterable[Training]) -> None:
    """Raise what ``load_team`` raises for a finished training that cannot drive, before anything long is begun."""
    for training in trainings:
        if not training.job().steps_left():
            load_team(training.folder, training.level.scenario)


@dataclass(frozen=True, slots=True)
class Harms:
    """What several trainings (or one script) did, on the same worlds."""

    world: dict[HarmCount, Floats]  # [seeds, worlds] harm of all vehicles (m2/s2)
    vehicle: dict[HarmCount, Floats]  # [seeds, worlds, N] harm of each
    collided: Bools  # [seeds, worlds]
    policies: tuple[Mapping[str, str], ...] = ()  # of each seed: vehicle -> SHA-256 of its policy's manifest


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


def run_ablation(plan: Plan, jobs: int = 1, tell: OnProgress | None = None) -> list[Measured] | None:
    """Bring every training to its end, ``jobs`` at a time, and measure; None when Ctrl-C stopped the trainings.

    Raises what ``JobFolder.work``, ``finish_trainings`` and ``measure`` raise.
    """
    kept = plan.job_folder()
    with kept.work():
        if not finish_trainings([training.job() for training in plan.trainings()], jobs, tell, run=kept.run):
            return None
        return measure(plan, jobs, tell)


def measure(plan: Plan, jobs: int = 1, tell: OnProgress | None = None) -> list[Measured]:
    """Let everything that was trained drive the common worlds, and search the joint optima (parts found are kept).

    Level by level in the plan's order, algorithm by algorithm. What some policy does better than the search becomes
    the best known of that world. Raises what loading teams and ``common_worlds`` raise, before any long work.
    """
    say = tell or (lambda progress: None)
    teams: dict[tuple[str, str], list[Team]] = {}
    for training in plan.trainings():
        team = load_team(training.folder, training.level.scenario, training.folder.name)
        teams.setdefault((training.level.name, training.algorithm), []).append(team)
    samples = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    tables = search_all(plan, samples, jobs, say)
    answers = {}
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.trained:
            own = [team for algorithm in plan.algorithms for team in teams[level.name, algorithm]]
            part = sample.worlds.take(np.arange(plan.search_episodes))
            answers[level.name] = LevelOptimum(level, part, tables[level.name], tuple(own))
    found: list[Measured] = []
    for level, sample in zip(plan.levels, samples, strict=True):
        braking = _drive(_all_brake(level.scenario), sample, [Team({}, f"full braking in {level.name}")], say)
        about = result_identity("ablate", level.scenario, sample)
        if not level.trained:
            scripts = _drive(level.scenario, sample, [Team({}, f"scripts of {level.name}")], say)
            found.append(Measured(level, None, scripts, braking, None, about))
            continue
        known = best_known(answers[level.name], list(answers.values()))
        best = {harm_count: harm[np.newaxis] for harm_count, harm in known.items()}
        for algorithm in plan.algorithms:
            own = teams[level.name, algorithm]
            reached = _drive(level.scenario, sample, own, say)
            behind = None if plan.shield is None else _drive_behind(level.scenario, sample, own, say)
            found.append(Measured(level, algorithm, reached, braking, best, about, behind))
    return found


def _all_brake(scenario: Scenario) -> Scenario:
    """The scenario with every vehicle braking fully."""
    return scenario.replace(roles=dict.fromkeys(scenario.vehicle_names, "full_brake"))


def _drive(scenario: Scenario, sample: Sample, teams: Sequence[Team], tell: OnProgress) -> Harms:
    """Harms of several teams of one level."""
    outcomes = []
    for team in teams:
        result = evaluate(sample, {team.name: team}, scenario=scenario, chunk=PROGRESS_EVERY).complete()
        outcomes.append(result.outcome(team.name))
        tell(Progress(f"driving {team.name}", sample.worlds.n, sample.worlds.n))
    policies = tuple(policies_by_name(outcome.policies, scenario) for outcome in outcomes)
    return replace(harms_of(outcomes), policies=policies)


def _drive_behind(
    scenario: Scenario, sample: Sample, teams: Sequence[Team], tell: OnProgress
) -> dict[HarmCount, Shielded]:
    """Several teams of one level behind one step shield, once for each count, which that shield guards."""
    found: dict[HarmCount, Shielded] = {}
    for harm_count in HARM_COUNTS:
        task = Task(scenario, scenario.learners, harm_count)
        parts = []
        for team in teams:
            parts.append(drive_chunks(team, sample.worlds, task))
            tell(Progress(f"driving {team.name} behind the shield, {harm_count}", sample.worlds.n, sample.worlds.n))
        found[harm_count] = stack(parts)
    return found


def harms_of(outcomes: Sequence[Outcome]) -> Harms:
    """The outcomes of several seeds on the same worlds, stacked."""
    return Harms(
        {harm_count: np.stack([o.ledger.world_harm(harm_count) for o in outcomes]) for harm_count in HARM_COUNTS},
        {harm_count: np.stack([o.ledger.vehicle_harm(harm_count) for o in outcomes]) for harm_count in HARM_COUNTS},
        np.stack([o.collided for o in outcomes]),
    )


# The cost of an ablation, measured on this machine before it starts.

_TIMED_WORLDS = 4  # of the search, that are timed


@dataclass(frozen=True, slots=True)
class Cost:
    """Seconds of one core for what is left to do."""

    trainings: int
    decisions: int
    training_s: float
    driving_s: float
    search_s: float
    damaged: tuple[Path, ...]  # kept parts of a search that will be searched again

    @property
    def whole_s(self) -> float:
        """Everything."""
        return self.training_s + self.driving_s + self.search_s

    def __str__(self) -> str:
        """The cost in one line, and a line for each damaged part."""
        speed = f" at {self.decisions / self.training_s:,.0f}/s" if self.training_s > 0.0 else ""
        line = (
            f"to do: {self.trainings} trainings, {self.decisions:,} decisions{speed}: {told_seconds(self.training_s)};"
            f" joint optima {told_seconds(self.search_s)}; driving the common worlds {told_seconds(self.driving_s)};"
            f" together about {told_seconds(self.whole_s)} of one core"
        )
        return "\n".join([line, *(f"{file}: is damaged; its worlds are searched again" for file in self.damaged)])


def cost_of(plan: Plan) -> Cost:
    """Time a short training of each level and recipe, an evaluation and a search, and reckon up what is left.

    Other work on the machine counts as well: seconds are of the clock. Raises as ``Training.steps_left``.
    """
    left = [(training, training.job().steps_left()) for training in plan.trainings()]
    lists = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    samples = {level.name: _first(sample) for level, sample in zip(plan.levels, lists, strict=True)}
    training_s, worlds_s = 0.0, []
    for kind in {training.folder.name.rpartition("-seed")[0]: training for training, _ in left}.values():
        same = (kind.level.name, kind.algorithm)
        steps = sum(number for training, number in left if (training.level.name, training.algorithm) == same)
        if not steps:
            continue
        timed = time_training(kind.job().training, samples[kind.level.name])
        worlds_s.append(timed.world_s)
        training_s += timed.seconds(kind.job().training, steps)
    if not worlds_s:
        worlds_s.append(world_seconds(left[0][0].folder, left[0][0].level.scenario, samples[left[0][0].level.name]))
    driving_s = sum(worlds_s) / len(worlds_s) * plan.episodes * (len(left) + len(plan.levels))
    driving_s += 0.0 if plan.shield is None else _shielding_s(plan, samples)
    trainings, decisions = sum(1 for _, steps in left if steps), sum(steps for _, steps in left)
    return Cost(trainings, decisions, training_s, driving_s, *_search(plan, lists))


def _shielding_s(plan: Plan, samples: Mapping[str, Sample]) -> float:
    """Seconds behind the shield, of both counts; timed with learners that brake fully, which it replaces most often."""
    seconds = 0.0
    for level in plan.levels:
        if level.trained:
            worlds, task = samples[level.name].worlds, Task(level.scenario, level.scenario.learners)
            braking = make_single_agent("full_brake")
            drive_chunks(braking, worlds.take(np.arange(1)), task)  # compiles
            started = time.monotonic()
            drive_chunks(braking, worlds, task)
            each = (time.monotonic() - started) / worlds.n
            seconds += each * plan.episodes * plan.seeds * len(plan.recipes) * len(HARM_COUNTS)
    return seconds


def _first(sample: Sample) -> Sample:
    """The worlds that are timed."""
    rows = np.arange(min(TIMED_DRIVES, sample.worlds.n))
    return sample.take(rows)


def _search(plan: Plan, samples: Sequence[Sample]) -> tuple[float, tuple[Path, ...]]:
    """Seconds for the worlds that are still to be searched, and the kept parts that are damaged."""
    seconds, damaged = 0.0, []
    for level, part, _ in questions(plan, samples):
        left, broken = chunks_left(level.scenario, part, budget=plan.budget, chunks=plan.optimum_folder(level))
        damaged += broken
        if left:
            worlds = part.worlds.take(np.arange(min(_TIMED_WORLDS, part.worlds.n)))
            best_harm(level.scenario, worlds.take(np.arange(1)), budget=100, threads=1)
            started = time.monotonic()
            best_harm(level.scenario, worlds, budget=plan.budget, threads=1)
            seconds += (time.monotonic() - started) / worlds.n * left
    return seconds, tuple(damaged)
