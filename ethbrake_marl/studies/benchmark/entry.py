"""Entries: what one agent does on every list of a suite, as one file that binds suite, policies, versions and results.

A list that an agent cannot drive (a team of other vehicles, a shield for one learner alone) has no score, and the entry
says why. Its own hash tells accidents and careless edits; that its numbers are true is shown by driving again.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from ethbrake_marl.agents.knowledge import knowledge_text
from ethbrake_marl.agents.team import Driver, team_of
from ethbrake_marl.errors import InvalidInput, PhysicsError, one_line
from ethbrake_marl.evaluation.identity import content_sha256, driving_policy, policies_by_name, result_versions
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, check_agents, make_lineup
from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.evaluation.per_world import write_output
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.statistics import Estimate, mean, rate
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario import Sample
from ethbrake_marl.studies.benchmark.score import TOLERANCE, mean_of_lists, realised_share, worst_mean
from ethbrake_marl.studies.benchmark.suite import (
    Name,
    Sha256,
    Strict,
    Suite,
    SuiteList,
    plain_sha256,
    read_content,
)

REFERENCE = "full_brake"
_SAME_HARM = 1e-6  # of means (m2/s2), relative or absolute: what another machine may round otherwise
Count = Annotated[int, Field(ge=0)]


class ListResult(Strict):
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


class NotDriven(Strict):
    """A list that the agent cannot drive, and why."""

    not_driven: Annotated[str, Field(min_length=1, max_length=1000)]


class Entry(Strict):
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


def make_entry(suite: Suite, spec: str, *, on_progress: OnProgress | None = None) -> Entry:
    """Let an agent drive every list of the suite.

    Args:
        suite: what is driven.
        spec: the agent, as ``make_agent`` takes it; it minimises each list's own count of harm.
        on_progress: is told how many worlds of which list have been driven.

    Raises ``InvalidInput`` for an agent that can drive no list (the first one's reason), a policy that was trained or
    chosen with a seed of the suite, and worlds or physics that are not those of the suite.

    """
    lists: dict[str, ListResult | NotDriven] = {}
    for each in suite.lists:
        sample = each.sample()  # an error here is the suite's, not the agent's
        try:
            driver = _make_driver(each, sample, spec)
        except (InvalidInput, PhysicsError) as error:
            lists[each.name] = NotDriven(not_driven=one_line(str(error))[:1000])
            continue
        _check_seeds(spec, policy_seeds(driver, each), suite)
        lists[each.name] = _drive_list(each, sample, spec, driver, on_progress)
    driven = [each for each in lists.values() if isinstance(each, ListResult)]
    if not driven:
        reasons = [each.not_driven for each in lists.values() if isinstance(each, NotDriven)]
        raise InvalidInput(f"suite {suite.name}: {spec!r} can drive no list of it: {reasons[0]}")
    shares = mean_of_lists([each.realised_share for each in driven])
    entry = Entry(
        format="ethbrake-benchmark-entry",
        format_version=1,
        suite=suite.name,
        suite_sha256=suite.sha256,
        agent=spec,
        command=shlex.join(["ethbrake", "benchmark", suite.name, "--agent", spec, "--output", "ENTRY.json"]),
        versions=result_versions(),
        lists=dict(lists),
        lists_driven=len(driven),
        mean_of_driven=shares,
        overall=shares if len(driven) == len(suite.lists) else None,
        entry_sha256="0" * 64,
    )
    return entry.model_copy(update={"entry_sha256": entry.content_sha256()})


def write_entry(path: Path, entry: Entry, *, force: bool = False) -> None:
    """Write an entry; raises as ``check_target``."""
    content = json.dumps(entry.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"
    write_output(path, content.encode(), force=force)


def read_entry(path: Path) -> Entry:
    """Read an entry; raises ``InvalidInput`` for what is none, or was changed after it was made."""
    entry = read_content(path, Entry)
    if entry.content_sha256() != entry.entry_sha256:
        raise InvalidInput(f"{path}: was changed after it was made: its content is not that of its entry_sha256")
    return entry


def policy_seeds(driver: Driver, each: SuiteList) -> dict[str, dict[str, int]]:
    """Vehicle -> what the manifest of its policy says of seeds; only vehicles whose policy has a manifest."""
    found = {}
    for vehicle, agent in team_of(driver, each.scenario.learners).drivers.items():
        policy = driving_policy(agent)
        if isinstance(policy, Policy):
            found[each.scenario.vehicle_names[vehicle]] = dict(policy.manifest.seeds)
    return found


def _check_seeds(spec: str, seeds: Mapping[str, Mapping[str, int]], suite: Suite) -> None:
    """Refuse a policy that was trained or chosen with a seed of the suite."""
    for vehicle, each in seeds.items():
        for purpose, seed in each.items():
            if seed in suite.seeds:
                raise InvalidInput(
                    f"agent {spec!r}: its policy of {vehicle} was made with {purpose} seed {seed}, which is suite"
                    f" {suite.name}'s own: the suite would not measure it, but what it was made with"
                )


def _make_driver(each: SuiteList, sample: Sample, spec: str) -> Driver:
    """The agent for a list, tried out there."""
    lineup = make_lineup([spec], each.scenario, harm_count=each.content.harm_count)
    if len(lineup) != 1:
        raise InvalidInput(f"agent {spec!r}: stands for {len(lineup)} agents; an entry is of one")
    check_agents(lineup, sample.worlds, each.scenario)
    (driver,) = lineup.values()
    return driver


def _drive_list(
    each: SuiteList, sample: Sample, spec: str, driver: Driver, on_progress: OnProgress | None
) -> ListResult | NotDriven:
    """What the agent does on a list; ``NotDriven`` where it, or the physics under it, fails."""
    reference = make_lineup([REFERENCE], each.scenario)[REFERENCE]

    def tell(agent: str, done: int) -> None:
        if on_progress is not None and agent == spec:
            on_progress(Progress(each.name, done, sample.worlds.n))

    try:
        evaluation = evaluate(
            sample,
            {REFERENCE: reference} | {spec: driver},
            scenario=each.scenario,
            seed=each.content.seed,
            chunk=PROGRESS_EVERY,
            on_progress=tell,
            aftermath=False,
        ).complete()
    except (InvalidInput, PhysicsError) as error:
        return NotDriven(not_driven=one_line(str(error))[:1000])
    return _result(each, sample, evaluation, spec, policy_seeds(driver, each))


def _result(
    each: SuiteList, sample: Sample, evaluation: Evaluation, spec: str, seeds: dict[str, dict[str, int]]
) -> ListResult:
    """The figures of a list; raises ``InvalidInput`` where full braking or the best known is not the suite's."""
    content, outcome = each.content, evaluation.outcome(spec)
    best = each.best_known(sample)
    full, harm = (evaluation.outcome(name).world_harm(content.harm_count) for name in (REFERENCE, spec))
    for what, found, frozen in (
        ("full braking", float(full.mean()), content.full_brake_harm),
        ("the best known", float(best.mean()), content.best_known_harm),
    ):
        if not abs(found - frozen) <= _SAME_HARM * max(1.0, frozen):
            raise InvalidInput(
                f"list {each.name}: the harm of {what} is {found:.9g} m2/s2 here, {frozen:.9g} in the suite: this"
                " version has another physics"
            )
    return ListResult(
        worlds=content.worlds,
        worlds_sha256=content.worlds_sha256,
        policies=policies_by_name(outcome.policies, each.scenario),
        policy_seeds=seeds,
        knows=knowledge_text(outcome.knows),
        realised_share=realised_share(harm, full, best),
        worst_decile_regret=worst_mean(harm - best),
        first_impact_harm=mean(outcome.first_impact_harm),
        total_harm=mean(outcome.total_harm),
        collision_rate=rate(int(outcome.collided.sum()), content.worlds),
        below_best_known=int((harm < best - TOLERANCE).sum()),
        horizon_ends=int((~outcome.at_rest).sum()),
        outcome_sha256=content_sha256(outcome.ledger),
    )
