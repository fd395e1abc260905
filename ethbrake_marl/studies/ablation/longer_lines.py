"""The same weights on longer lines: policies of one line length drive every learner of lines of other lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.registry import make_single_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.identity import policy_sha256, result_identity
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.seed_statistics import mean_over_seeds, rate_over_seeds, share_over_seeds
from ethbrake_marl.evaluation.statistics import Estimate, estimates_to_json
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.learning.recipe import WORDS
from ethbrake_marl.learning.run_folder import RunDirectory
from ethbrake_marl.learning.team_file import is_team
from ethbrake_marl.limits.best_harm import best_harm
from ethbrake_marl.physics import Floats
from ethbrake_marl.policies.policy import Policy, load_policy
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario import Sample, Scenario
from ethbrake_marl.scenario.quantities import DECLARED
from ethbrake_marl.scenario.roles import LEARNER
from ethbrake_marl.studies.ablation.comparison import TOLERANCE
from ethbrake_marl.studies.ablation.plan import read_kept
from ethbrake_marl.studies.ablation.run import Harms, harms_of
from ethbrake_marl.studies.jobs.local import run_all
from ethbrake_marl.studies.jobs.work import pack


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
