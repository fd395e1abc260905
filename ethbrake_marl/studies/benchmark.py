"""Entries: what one agent does on every list of a suite, as one file that binds suite, policies, versions and results.

A list that an agent cannot drive (a team of other vehicles, a shield for one learner alone) has no score, and the entry
says why. Its own hash tells accidents and careless edits; that its numbers are true is shown by driving again.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field, JsonValue

from ethbrake_marl.agents import Driver, Team
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput, OnProgress, PhysicsError, Progress, one_line, unknown_name
from ethbrake_marl.evaluation import (
    check_agents,
    content_sha256,
    driving_policy,
    evaluate,
    make_lineup,
    mean,
    rate,
    relative_decrease,
    result_versions,
    worlds_sha256,
)
from ethbrake_marl.files.sheet import DASH, Column, Estimate, Sheet
from ethbrake_marl.files.store import read_plain, write_output
from ethbrake_marl.files.yaml import FileModel, read_json_model
from ethbrake_marl.limits import BestHarmTable, task_problem
from ethbrake_marl.physics import Floats
from ethbrake_marl.policies import Policy, Sha256
from ethbrake_marl.scenario import Sample, Scenario, Task

# Frozen suites: lists of worlds that never change, each with the least harm known in it.
#
# A suite is a folder of the package: ``suite.json``, and beside it one table of the best known for each list. A list is
# its scenario's whole content, a seed, and the hash of its worlds' bytes. What differs in any of them is another suite.

SUITES = Path(__file__).resolve().parents[1] / "_suites"
CONTENT = "suite.json"
_LIMIT_BYTES, _TABLE_BYTES = 4 << 20, 16 << 20

Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,63}$")]
Mean = Annotated[float, Field(ge=0.0)]


Content = TypeVar("Content", bound=FileModel)


class ListContent(FileModel):
    """One list, as the suite's file says it; harms are means over its worlds under ``harm_count`` (m2/s2)."""

    name: Name
    about: str
    scenario: dict[str, JsonValue]
    seed: Annotated[int, Field(ge=0)]
    worlds: Annotated[int, Field(ge=2, le=100_000)]
    harm_count: HarmCount
    worlds_sha256: Sha256
    table_sha256: Sha256
    full_brake_harm: Mean  # when every learner brakes fully: the score 0
    best_known_harm: Mean  # of the table: the score 1


class SuiteContent(FileModel):
    """The whole of a suite's file."""

    format: Literal["ethbrake-suite"]
    format_version: Annotated[int, Field(ge=1, le=1)]
    name: Name
    lists: Annotated[tuple[ListContent, ...], Field(min_length=1, max_length=100)]


@dataclass(frozen=True, slots=True)
class SuiteList:
    """One list of a suite: what its file says, and its scenario."""

    content: ListContent
    scenario: Scenario
    folder: Path

    @property
    def name(self) -> str:
        """Of the list, in the suite."""
        return self.content.name

    def sample(self) -> Sample:
        """Its worlds; raises ``InvalidInput`` if this version draws others than the suite was frozen with."""
        sample = self.scenario.sample(self.content.worlds, self.content.seed)
        found = worlds_sha256(sample.worlds, sample.index)
        if found != self.content.worlds_sha256:
            raise InvalidInput(
                f"list {self.name}: the worlds drawn here have SHA-256 {found:.12}, the suite's have"
                f" {self.content.worlds_sha256:.12}; at least one world is another one"
            )
        return sample

    def best_known(self, sample: Sample) -> Floats:
        """The least harm known in each of its worlds, [n] m2/s2, from the table that belongs to the suite.

        Raises ``InvalidInput`` for another table, or one without some of the worlds; ``CorruptBundle`` for none.
        """
        file = self.folder / f"{self.name}.npz"
        if hashlib.sha256(read_plain(file, _TABLE_BYTES)).hexdigest() != self.content.table_sha256:
            raise InvalidInput(f"{file}: is not the table that belongs to the suite")
        task = Task(self.scenario, self.scenario.learners, self.content.harm_count)
        harm = BestHarmTable.load(file).harm(task_problem(sample.worlds, task).identity, self.content.harm_count)
        if not np.isfinite(harm).all():
            raise InvalidInput(f"{file}: holds {int(np.isfinite(harm).sum())} of the {len(harm)} worlds of its list")
        return harm


@dataclass(frozen=True, slots=True)
class Suite:
    """A frozen suite; ``sha256`` binds its lists and their tables."""

    name: str
    sha256: str
    lists: tuple[SuiteList, ...]

    @property
    def seeds(self) -> frozenset[int]:
        """The seeds of its lists, which no training and no choice of a policy may use."""
        return frozenset(each.content.seed for each in self.lists)

    def make_entry(self, spec: str, *, on_progress: OnProgress | None = None) -> Entry:
        """Let an agent drive every list.

        Args:
            spec: the agent, as ``make_agent`` takes it; it minimises each list's own count of harm.
            on_progress: is told how many worlds of which list have been driven.

        Raises ``InvalidInput`` for an agent that can drive no list (the first one's reason), a policy that was trained
        or chosen with a seed of the suite, and worlds or physics that are not those of the suite.

        """
        lists: dict[str, ListResult | NotDriven] = {}
        for each in self.lists:
            sample = each.sample()  # an error here is the suite's, not the agent's
            count = each.content.harm_count
            try:
                lineup = make_lineup([spec], each.scenario, harm_count=count)
                if len(lineup) != 1:
                    raise InvalidInput(f"agent {spec!r}: stands for {len(lineup)} agents; an entry is of one")
                check_agents(lineup, sample.worlds, each.scenario)
            except (InvalidInput, PhysicsError) as error:
                lists[each.name] = NotDriven(not_driven=one_line(str(error))[:1000])
                continue
            (driver,) = lineup.values()
            seeds = policy_seeds(driver, each)
            for vehicle, purposes in seeds.items():
                for purpose, seed in purposes.items():
                    if seed in self.seeds:
                        raise InvalidInput(
                            f"agent {spec!r}: its policy of {vehicle} was made with {purpose} seed {seed}, which is"
                            f" suite {self.name}'s own: the suite would not measure it, but what it was made with"
                        )
            lists[each.name] = _drive_list(each, sample, lineup, seeds, on_progress)
        driven = [each for each in lists.values() if isinstance(each, ListResult)]
        refused = [each for each in lists.values() if isinstance(each, NotDriven)]
        if not driven:
            raise InvalidInput(f"suite {self.name}: {spec!r} can drive no list of it: {refused[0].not_driven}")
        shares = mean_of_lists([each.realised_share for each in driven])
        entry = Entry(
            format="ethbrake-benchmark-entry",
            format_version=1,
            suite=self.name,
            suite_sha256=self.sha256,
            agent=spec,
            command=shlex.join(["ethbrake", "benchmark", self.name, "--agent", spec, "--output", "ENTRY.json"]),
            versions=result_versions(),
            lists=dict(lists),
            lists_driven=len(driven),
            mean_of_driven=shares,
            overall=None if refused else shares,
            entry_sha256="0" * 64,
        )
        return entry.model_copy(update={"entry_sha256": entry.content_sha256()})


def suite_names(folder: Path | None = None) -> list[str]:
    """The suites of a folder; of the package, if none is given."""
    return sorted(path.parent.name for path in (folder or SUITES).glob(f"*/{CONTENT}"))


def load_suite(name: str, folder: Path | None = None) -> Suite:
    """The suite called ``name``, of those that ship or of another folder.

    Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for a damaged one.
    """
    folder = folder or SUITES
    if name not in suite_names(folder):
        raise unknown_name("suite", name, suite_names(folder))
    file = folder / name / CONTENT
    content = read_content(file, SuiteContent)
    if content.name != name:
        raise InvalidInput(f"{file}: is suite {content.name}")
    lists = []
    for each in content.lists:
        try:
            lists.append(SuiteList(each, Scenario(**each.scenario), file.parent))
        except InvalidInput as error:
            raise InvalidInput(f"{file}, list {each.name}: {error}") from None
    named = [each.name for each in lists]
    if twice := {name for name in named if named.count(name) > 1}:
        raise InvalidInput(f"{file}: list {min(twice)} stands in it twice")
    return Suite(name, plain_sha256(content.model_dump(mode="json")), tuple(lists))


def read_content(file: Path, kind: type[Content]) -> Content:
    """A JSON file as ``kind``; raises ``InvalidInput`` naming the file and the first mistake."""
    data = read_plain(file, _LIMIT_BYTES)
    try:
        return read_json_model(data, kind)[1]
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InvalidInput(f"{file}: is no JSON, or was not written to its end: {error}") from None
    except ValueError as error:
        raise InvalidInput(f"{file}: {error}") from None


def plain_sha256(content: Any) -> str:
    """SHA-256 of plain data: its JSON with sorted keys and no blanks."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


# The score of an agent on a list: how much of what is possible it realises, and how it does where it does worst.

TOLERANCE = 1e-6  # m2/s2; an agent that is less than this below the best known is not below it


def realised_share(harm: Floats, full_brake: Floats, best_known: Floats) -> Estimate:
    """``(full braking - agent) / (full braking - best known)`` of the mean harms, [n] m2/s2 each, paired by world.

    0: no better than full braking; below 0: worse. 1: as good as the best known; above 1: better. The interval is that
    of ``relative_decrease`` of the regret. Raises ``InvalidInput`` where nothing is possible: the best known is full
    braking.
    """
    share = relative_decrease(harm - best_known, full_brake - best_known)
    if share is None:
        raise InvalidInput("realised share: full braking is the best known everywhere, so there is nothing to realise")
    return share


def worst_mean(regret: Floats) -> Estimate:
    """Mean regret of the tenth of the worlds where it is greatest (m2/s2), with its interval.

    With q the quantile at ``1 - 0.1``, that mean is the mean over all worlds of ``q + max(regret - q, 0) / 0.1``
    (the conditional value at risk); the interval is the t interval of this mean, which holds for many worlds.
    """
    q = float(np.quantile(regret, 1.0 - 0.1, method="inverted_cdf"))
    return mean(q + np.maximum(regret - q, 0.0) / 0.1)


def mean_of_lists(shares: Sequence[Estimate]) -> Estimate:
    """Mean over lists, each with the same weight. The lists share no world, so half-widths add as squares.

    No interval where one of them has none.
    """
    value = math.fsum(share.value for share in shares) / len(shares)
    if any(share.interval is None for share in shares):
        return Estimate(value, None)
    halves = [0.5 * (share.ends[1] - share.ends[0]) for share in shares]
    half = math.sqrt(math.fsum(half * half for half in halves)) / len(shares)
    return Estimate(value, (value - half, value + half))


REFERENCE = "full_brake"
Count = Annotated[int, Field(ge=0)]


class ListResult(FileModel):
    """What an agent did on one list; harms are means per world (m2/s2)."""

    worlds: Count
    worlds_sha256: Sha256
    policies: dict[str, Sha256]  # vehicle -> the policy that drives it
    policy_seeds: dict[str, dict[str, int]]  # vehicle -> what its policy says of the seeds of its training
    knows: str
    realised_share: Estimate
    worst_decile_regret: Estimate
    first_impact_harm: Estimate
    total_harm: Estimate
    collision_rate: Estimate
    below_best_known: Count  # worlds in which it does less harm than the best known of the suite
    horizon_ends: Count  # worlds that the horizon cut off
    outcome_sha256: Sha256  # of the harm of every pair in every world


class NotDriven(FileModel):
    """A list that the agent cannot drive, and why."""

    not_driven: Annotated[str, Field(min_length=1, max_length=1000)]


class Entry(FileModel):
    """One agent on a suite. ``overall`` is the mean share over all lists, null unless all of them were driven."""

    format: Literal["ethbrake-benchmark-entry"]
    format_version: Annotated[int, Field(ge=1, le=1)]
    suite: Name
    suite_sha256: Sha256
    agent: Annotated[str, Field(min_length=1, max_length=500)]
    command: str
    versions: dict[str, str]
    lists: dict[str, ListResult | NotDriven]
    lists_driven: Count
    mean_of_driven: Estimate  # mean share over the lists that were driven
    overall: Estimate | None
    entry_sha256: Sha256  # of everything above

    @property
    def driven(self) -> dict[str, ListResult]:
        """The results by list, of those that were driven."""
        return {name: each for name, each in self.lists.items() if isinstance(each, ListResult)}

    def content_sha256(self) -> str:
        """What ``entry_sha256`` must be."""
        return plain_sha256(self.model_dump(mode="json", exclude={"entry_sha256"}))

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write it; raises as ``check_target``."""
        content = json.dumps(self.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"
        write_output(path, content.encode(), force=force)

    def sheet(self) -> Sheet:
        """One line per list, for a terminal; means per world."""
        columns: list[Column | str] = [
            "List",
            Column("Share %", digits=1, scale=100.0),
            Column("Worst decile", digits=1),
            Column("First", interval="hidden"),
            Column("Total", interval="hidden"),
            Column("Collided %", digits=1, scale=100.0, interval="hidden"),
            Column("Moving %", digits=1, scale=100.0),
        ]
        rows: list[list[Any]] = []
        for name, each in self.lists.items():
            if isinstance(each, NotDriven):
                rows.append([name, "not driven", *[None] * 5])
            else:
                harms = (each.worst_decile_regret, each.first_impact_harm, each.total_harm)
                rows.append([name, each.realised_share, *harms, each.collision_rate, each.horizon_ends / each.worlds])
        reasons = [f"{name}: {each.not_driven}" for name, each in self.lists.items() if isinstance(each, NotDriven)]
        return Sheet("", columns, rows, "\n".join(reasons), gap=2)


def read_entry(path: Path) -> Entry:
    """Read an entry; raises ``InvalidInput`` for what is none, or was changed after it was made."""
    entry = read_content(path, Entry)
    if entry.content_sha256() != entry.entry_sha256:
        raise InvalidInput(f"{path}: was changed after it was made: its content is not that of its entry_sha256")
    return entry


def policy_seeds(driver: Driver, each: SuiteList) -> dict[str, dict[str, int]]:
    """Vehicle -> what the manifest of its policy says of seeds; only vehicles whose policy has a manifest."""
    found = {}
    for vehicle, agent in Team.of(driver, each.scenario.learners).drivers.items():
        policy = driving_policy(agent)
        if isinstance(policy, Policy):
            found[each.scenario.vehicle_names[vehicle]] = dict(policy.manifest.seeds)
    return found


def _drive_list(
    each: SuiteList,
    sample: Sample,
    lineup: Mapping[str, Driver],
    seeds: dict[str, dict[str, int]],
    on_progress: OnProgress | None,
) -> ListResult | NotDriven:
    """What the agent does on a list; ``NotDriven`` where it, or the physics under it, fails.

    Raises ``InvalidInput`` where full braking or the best known is not the suite's.
    """
    content, (spec,) = each.content, lineup

    def tell(agent: str, done: int) -> None:
        if on_progress is not None and agent == spec:
            on_progress(Progress(each.name, done, sample.worlds.n))

    try:
        evaluation = evaluate(
            sample,
            {**make_lineup([REFERENCE], each.scenario), **lineup},
            scenario=each.scenario,
            seed=content.seed,
            on_progress=tell,
            aftermath=False,
        ).complete()
    except (InvalidInput, PhysicsError) as error:
        return NotDriven(not_driven=one_line(str(error))[:1000])
    outcome, best = evaluation.outcome(spec), each.best_known(sample)
    full, harm = (evaluation.outcome(name).world_harm(content.harm_count) for name in (REFERENCE, spec))
    for what, found, frozen in (
        ("full braking", float(full.mean()), content.full_brake_harm),
        ("the best known", float(best.mean()), content.best_known_harm),
    ):
        if not abs(found - frozen) <= 1e-6 * max(1.0, frozen):  # what another machine may round otherwise
            raise InvalidInput(
                f"list {each.name}: the harm of {what} is {found:.9g} m2/s2 here, {frozen:.9g} in the suite: this"
                " version has another physics"
            )
    return ListResult(
        worlds=content.worlds,
        worlds_sha256=content.worlds_sha256,
        policies=dict(outcome.policies),
        policy_seeds=seeds,
        knows=outcome.knows.text,
        realised_share=realised_share(harm, full, best),
        worst_decile_regret=worst_mean(harm - best),
        first_impact_harm=mean(outcome.first_impact_harm),
        total_harm=mean(outcome.total_harm),
        collision_rate=rate(int(outcome.collided.sum()), content.worlds),
        below_best_known=int((harm < best - TOLERANCE).sum()),
        horizon_ends=int((~outcome.at_rest).sum()),
        outcome_sha256=content_sha256(outcome.ledger),
    )


# Entries of one suite, sorted by their score: as a table, as Markdown and as a page.


@dataclass(frozen=True, slots=True)
class Leaderboard:
    """Entries of one suite: those of all lists by their score, then the others by how many lists they drove."""

    suite: Suite
    entries: tuple[tuple[Path, Entry], ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """What the figures are, who is ranked, and the suite."""
        return (
            "Realised share of what is possible, in %: (full braking - agent) / (full braking - best known) of the mean"
            " harm of a list; 0 is full braking, 100 the best known. 95 % intervals in brackets.",
            "Only who drives every list is ranked, by the mean over all lists. A mean over some of them is shown, and"
            " is no score: those lists may be the easy ones.",
            f"Suite {self.suite.name}, SHA-256 {self.suite.sha256}",
        )

    def sheet(self) -> Sheet:
        """One line per entry, for a terminal; lists that were not driven show a dash."""
        rows = []
        for rank, entry in self._ranks():
            each = "  ".join(f"{name} {_SHARE.show(_share(entry, name)).value}" for name in entry.lists)
            rows.append([rank, entry.agent, entry.mean_of_driven, self._driven(entry), each])
        told = Column("Realised share of each list, in the suite's order", text=True)
        overall = replace(_SHARE, heading="Overall")
        return Sheet("", [Column(""), "Agent", overall, Column("Lists"), told], rows, gap=2)

    def table(self) -> Sheet:
        """One column per list, for a document."""
        names = [each.name for each in self.suite.lists]
        rows = []
        for rank, entry in self._ranks():
            overall = _SHARE.show(entry.mean_of_driven).in_words
            overall = overall if entry.overall is not None else f"({overall}, {self._driven(entry)} lists)"
            agent = one_line(entry.agent).replace("`", "'").replace("|", "/")
            rows.append([rank, f"`{agent}`", overall, *(_share(entry, name) for name in names)])
        shares = [replace(_SHARE, heading=name) for name in names]
        return Sheet("", [Column(""), "Agent", Column("Overall"), *shares], rows)

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        entries = [
            {
                "file": path.name,
                "agent": entry.agent,
                "overall": None if entry.overall is None else entry.overall.to_json(),
                "mean_of_driven": entry.mean_of_driven.to_json(),
                "lists_driven": entry.lists_driven,
                "policies": sorted({sha256 for each in entry.driven.values() for sha256 in each.policies.values()}),
                "lists": {name: each.model_dump(mode="json") for name, each in entry.lists.items()},
            }
            for path, entry in self.entries
        ]
        return {"suite": self.suite.name, "suite_sha256": self.suite.sha256, "entries": entries}

    def _ranks(self) -> list[tuple[str, Entry]]:
        """Every entry with its rank; a dash for who did not drive every list: its mean cannot be compared."""
        return [(DASH if entry.overall is None else str(k), entry) for k, (_, entry) in enumerate(self.entries, 1)]

    def _driven(self, entry: Entry) -> str:
        return f"{entry.lists_driven} of {len(self.suite.lists)}"


_SHARE = Column("", digits=1, scale=100.0)


def _share(entry: Entry, name: str) -> float | None:
    result = entry.lists[name]
    return result.realised_share.value if isinstance(result, ListResult) else None


def read_leaderboard(paths: Sequence[Path], suite: Suite | None = None) -> Leaderboard:
    """Read and sort entries of one suite (default: the one that the first entry names).

    Raises ``InvalidInput`` naming the first file that is refused: no entry, changed since it was made, or of another
    suite.
    """
    if not paths:
        raise InvalidInput("leaderboard: no entries given; ethbrake benchmark writes them")
    entries = [(path, read_entry(path)) for path in paths]
    suite = load_suite(entries[0][1].suite) if suite is None else suite
    for path, entry in entries:
        if entry.suite_sha256 != suite.sha256 or entry.lists.keys() != {each.name for each in suite.lists}:
            raise InvalidInput(
                f"{path}: is about another suite: {entry.suite} with SHA-256 {entry.suite_sha256:.12}, and"
                f" this is {suite.name} with {suite.sha256:.12}"
            )
    entries.sort(key=lambda each: (-each[1].lists_driven, -each[1].mean_of_driven.value, each[1].agent))
    return Leaderboard(suite, tuple(entries))
