"""The main job, end to end: train a policy, shield it, measure both against the baselines, and show the result."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any, Literal

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.defaults import EPISODES, LIST_SEED
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.evaluation import Evaluation, SummaryRow, evaluate, parameter_line, summarise
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, make_agents
from ethbrake_marl.evaluation.paper import TESTS, other_tests
from ethbrake_marl.evaluation.rollout import controlled_vehicle
from ethbrake_marl.learning.recipe import TrainingRecipe
from ethbrake_marl.learning.run_folder import RunDirectory, RunStatus, read_object
from ethbrake_marl.learning.train import TrainResult, train
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.rewards import RewardParams
from ethbrake_marl.scenario import Sample, Scenario
from ethbrake_marl.shield import HybridAgent
from ethbrake_marl.studies.results import write_beside, write_figures, write_page, write_results

RUNS = Path("runs")
BASELINES = ("full_brake", "e_v2x_bm", "e_v2x_bm:pairwise")
BESIDE = ("full_brake", "e_v2x_bm")  # baselines on the other two of the three tests
BESIDE_EPISODES = 2_000  # at most so many worlds of each

Ended = Literal["finished", "interrupted"]


@dataclass(frozen=True, slots=True)
class ExperimentResult:
    """What an experiment left behind."""

    directory: Path
    status: Ended  # interrupted: the policy was not trained to the end, everything else is there
    steps: int
    rows: list[SummaryRow]
    report: Path
    beside: Mapping[str, list[SummaryRow]] = field(default_factory=dict)  # by test: the other two of the three tests


def run_folder(
    scenario: Scenario,
    recipe: TrainingRecipe,
    *,
    seed: int | None = None,
    name: str | None = None,
    output: Path | None = None,
) -> Path:
    """Folder of a run: ``output``, or ``runs/<name>``, by default ``runs/<scenario>-<recipe>-seed<seed>``.

    The default has the scheme behind the recipe where the recipe names one. Raises ``InvalidInput`` when both are
    given, or for a name that is not a plain folder name.
    """
    if output is not None:
        if name is not None:
            raise InvalidInput(f"name {name!r} and output {str(output)!r}: give one of the two")
        return output
    if name is not None and not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,127}", name):
        raise InvalidInput(
            f"run name {name!r:.60}: must be up to 128 letters, digits, . _ -, not beginning with . or -"
        )
    plan = recipe.name if recipe.scheme is None else f"{recipe.name}-{recipe.scheme}"
    return RUNS / (name or f"{scenario.name}-{plan}-seed{recipe.seed if seed is None else seed}")


def run_experiment(
    scenario: Scenario,
    directory: Path,
    *,
    recipe: TrainingRecipe,
    steps: int | None = None,
    seed: int | None = None,
    episodes: int = EPISODES,
    list_seed: int = LIST_SEED,
    stop_when_lost: bool = False,
    force: bool = False,
    settings: Sequence[str] = (),
    on_progress: OnProgress | None = None,
) -> ExperimentResult:
    """Train a policy on ``scenario``, evaluate it, its hybrid and the baselines on a fixed list, write everything.

    On one of the three tests the policy also drives the other two, which it was not trained for.

    ``seed`` is the training's; the list is ``episodes`` worlds of ``list_seed``; ``settings`` are noted;
    ``stop_when_lost`` is as in ``train``.
    Ctrl-C during the training ends it
    after the update in progress, and the policy so far is evaluated; a second one, or one during the evaluation,
    raises ``KeyboardInterrupt``, and the folder keeps the policy. ``run.json`` always says which. Raises what
    ``train`` and ``evaluate`` raise, ``AlreadyExists`` for an existing run before any work.
    """
    started = time.monotonic()
    tell = on_progress or (lambda progress: None)
    vehicle = controlled_vehicle(scenario, None)
    sample = scenario.sample(episodes, list_seed)
    trained = train(
        recipe,
        scenario,
        directory,
        steps=steps,
        seed=seed,
        force=force,
        stop_when_lost=stop_when_lost,
        settings=settings,
        on_progress=on_progress,
    )
    run = RunDirectory(trained.directory)
    with _status(run, trained.status):
        agents = _agents(trained.policy, scenario)
        evaluation = _evaluate(sample, agents, scenario, vehicle, list_seed, trained, tell)
        begin = _stages(tell, 3 + len(other_tests(scenario)))
        begin("what nobody can avoid in these worlds, proven world by world")
        rows = summarise(evaluation)
        beside = _beside(trained.policy, scenario, min(episodes, BESIDE_EPISODES), list_seed, begin)
        begin("results and figures")
        write_results(run.path, evaluation, rows)
        write_beside(run.path, beside)
        wall_s = time.monotonic() - started
        report = _show(run, evaluation, rows, beside, trained, agents, begin, wall_s=wall_s)
        begin("")
    return ExperimentResult(run.path, trained.status, trained.steps, rows, report, beside)


def _stages(tell: OnProgress, total: int) -> Callable[[str], None]:
    """What is to be called when each of so many parts of the report begins, with a line about it, and at the end."""
    done = count()
    return lambda note: tell(Progress("report", next(done), total, note=note))


def _beside(
    policy: Policy, scenario: Scenario, episodes: int, list_seed: int, begin: Callable[[str], None]
) -> dict[str, list[SummaryRow]]:
    """The same policy, trained on ``scenario`` alone, on the other two of the three tests, beside two baselines."""
    found: dict[str, list[SummaryRow]] = {}
    for other in other_tests(scenario):
        begin(f"the same policy on {other.name}: {count_of(episodes, 'world')}")
        agents = _agents(policy, other, BESIDE)
        evaluation = evaluate(other.sample(episodes, list_seed), agents, scenario=other, seed=list_seed)
        found[other.name] = summarise(evaluation)
    return found


def _agents(policy: Policy, scenario: Scenario, baselines: Sequence[str] = BASELINES) -> dict[str, Agent]:
    """The baselines, the policy alone (``ppo`` or ``sac``), and the policy behind its shield (``hybrid``)."""
    name = policy.manifest.algorithm
    learned: dict[str, Agent] = {
        name: LearnedAgent(policy, name),
        "hybrid": HybridAgent(LearnedAgent(policy, name), scenario),
    }
    return {**make_agents(baselines, scenario), **learned}


def _evaluate(
    sample: Sample,
    agents: Mapping[str, Agent],
    scenario: Scenario,
    vehicle: int,
    list_seed: int,
    trained: TrainResult,
    tell: OnProgress,
) -> Evaluation:
    """Every agent on the list, with its progress told."""
    total = sample.worlds.n
    if trained.status == "interrupted":
        note = f"interrupted after {trained.steps:,} steps: evaluating the policy so far; Ctrl-C again stops at once"
        tell(Progress(next(iter(agents)), 0, total, note=note))
    return evaluate(
        sample,
        agents,
        scenario=scenario,
        vehicle=vehicle,
        seed=list_seed,
        chunk=PROGRESS_EVERY,
        on_progress=lambda name, done: tell(Progress(name, done, total)),
    )


def _show(
    run: RunDirectory,
    evaluation: Evaluation,
    rows: list[SummaryRow],
    beside: Mapping[str, list[SummaryRow]],
    trained: TrainResult,
    agents: Mapping[str, Agent],
    begin: Callable[[str], None],
    *,
    wall_s: float,
) -> Path:
    """Figures and page."""
    config = read_object(run.config)
    plan = config["recipe"]["evaluation"]
    caption = (
        f"{evaluation.scenario.name}: worlds 0 to {plan['worlds'] - 1} of the list of seed {plan['seed']} at every"
        f" point; training seed {config['seeds']['training']}. Level lines: {parameter_line(rows[0].parameters)}."
    )
    figures = write_figures(
        run.path, evaluation, rows, course=trained.evaluations, course_caption=caption, agents=agents
    )
    told = {
        "Training": f"{config['recipe']['title'] or config['recipe']['name']}: {trained.steps:,} steps"
        f" of {config['recipe']['total_steps']:,} ({trained.status}), {trained.wall_s:.0f} s",
        "Seeds": f"training {config['seeds']['training']}, evaluation list {evaluation.seed}",
        "Reward": _reward(config["recipe"]["reward"]),
        "Whole run": f"{wall_s:.0f} s",
        **_own_parts(config),
    }
    manifest = trained.policy.manifest
    which = f"Policy by {manifest.algorithm}, after {manifest.steps:,} steps (least harm on its own list)"
    summary = f"{which}, alone and behind its shield, against the baselines."
    if evaluation.scenario.name in TESTS and beside:
        summary += f" {TESTS[evaluation.scenario.name]} The other two tests stand below."
    if trained.status == "interrupted":
        summary += " The training was interrupted; this is the policy it had by then."
    begin("the page, and the episodes to watch there")
    return write_page(
        run.path,
        evaluation,
        rows,
        figures,
        agents,
        beside=beside,
        summary=summary,
        settings=told,
        versions=installed_versions(),
    )


def _own_parts(config: Mapping[str, Any]) -> dict[str, str]:
    """What the command line changed or added: settings and plug-ins; nothing where there are none."""
    told = {
        "Settings": config.get("settings", ()),
        "Plug-ins": [f"{each['name']} (SHA-256 {each['sha256']})" for each in config["plugins"]],
    }
    return {what: ", ".join(each) for what, each in told.items() if each}


def _reward(given: dict[str, Any]) -> str:
    """The settings of a reward that are not its defaults."""
    own = RewardParams(**given).model_dump(exclude_defaults=True)
    return ", ".join(f"{name} {value}" for name, value in own.items()) or "minus the first-impact harm"


@contextmanager
def _status(run: RunDirectory, status: Ended) -> Iterator[None]:
    """Keep ``run.json`` true while the evaluation runs: ``running``, then the training's status or what went wrong."""
    _note(run, "running", "evaluation", None)
    try:
        yield
    except BaseException as error:
        _note(run, "interrupted" if isinstance(error, KeyboardInterrupt) else "failed", "evaluation", repr(error))
        raise
    _note(run, status, "report", None)


def _note(run: RunDirectory, status: RunStatus, stage: str, reason: str | None) -> None:
    """Bring ``run.json`` up to date; its steps and ``wall_s`` stay those of the training."""
    content = read_object(run.status)
    ended = None if status == "running" else datetime.now(UTC).isoformat(timespec="seconds")
    run.write_json(run.status, {**content, "status": status, "stage": stage, "ended_utc": ended, "reason": reason})
