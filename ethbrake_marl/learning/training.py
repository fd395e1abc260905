"""A training, resolved once: what a recipe and a scenario come to, and the one answer to "is this the same training?".

Two trainings are the same where recipe (its seed included) and scenario say the same; titles, descriptions and sources
are words and count for nothing, nor does it matter whether a default is spelt out. Learning curves and ablations ask
before they keep a finished training or go on with one, ``resume`` asks whether a checkpoint belongs to what
``config.json`` says.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from filelock import FileLock, Timeout
from pydantic import Field, model_validator

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.errors import AlreadyExists, CorruptBundle, InvalidInput
from ethbrake_marl.files.plugins import check_plugins, noted_plugins
from ethbrake_marl.files.store import new_folder, parse_strict_json, read_plain, write_file
from ethbrake_marl.files.yaml import Document, FileModel, Wording, read_model, refuse
from ethbrake_marl.learning.recipe import (
    WORDS,
    Scheme,
    TrainingRecipe,
    driver,
    drivers,
    load_recipe,
    recipe_of,
    scheme_of,
)
from ethbrake_marl.observations import ObservationSpec, choose_observation, observation_for
from ethbrake_marl.policies.actor import installed_versions
from ethbrake_marl.policies.bundle import Policy, load_policy
from ethbrake_marl.policies.shipped import SHIPPED, PolicyKind, load_named_policy
from ethbrake_marl.scenario import Scenario, load_scenario

if TYPE_CHECKING:  # torch takes seconds, and what is asked of a run needs none
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from torch import Tensor
    from torch.optim import Optimizer

    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv

# The folder of a run: its files, its configuration, how far it came, and who may train in it.

_LIMIT_BYTES = 16 << 20  # of a JSON file

RunStatus = Literal["running", "finished", "interrupted", "failed"]


class RunDirectory:
    """Names inside a run's folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.json"  # what was asked for: recipe, scenario, seeds, versions
        self.status = path / "run.json"  # how far it came: a ``RunStatus``, steps, updates, wall time
        self.progress = path / "progress.csv"  # one row per update
        self.tensorboard = path / "tensorboard"  # the same numbers as TensorBoard events
        self.policy = path / "policy"  # the bundle of least harm on the fixed list, or the last where none is measured
        self.last_policy = path / "policy-last"  # the bundle at the end of the run
        self.team = path / "team.json"  # which bundle drives which vehicle
        self.checkpoints = path / "checkpoints"  # where the training can go on; empty once it has finished
        self.lock = path / "run.lock"  # held while a process trains here

    def checkpoint(self, steps: int) -> Path:
        """The checkpoint after ``steps`` decisions."""
        return self.checkpoints / f"step_{steps:012d}"

    def write_json(self, file: Path, content: Mapping[str, Any]) -> None:
        """Replace ``file`` in one step."""
        write_file(file, json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")


def write_status(run: RunDirectory, status: RunStatus, more: Mapping[str, Any]) -> None:
    """Replace ``run.json``: when it was started stays, and when it ended is now."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    before = read_object(run.status) if run.status.exists() else {}
    times = {"started_utc": before.get("started_utc") or now} | ({} if status == "running" else {"ended_utc": now})
    run.write_json(run.status, {"format": "ethbrake-run", "format_version": 1, "status": status, **times, **more})


def read_object(file: Path) -> dict[str, Any]:
    """The JSON object in a file of a run; raises ``InvalidInput`` naming the file and what is wrong with it."""
    if not os.path.lexists(file):
        raise InvalidInput(f"{file}: is missing; without it this training cannot go on")
    data = read_plain(file, _LIMIT_BYTES)
    try:
        content = parse_strict_json(data)
    except ValueError as error:
        raise InvalidInput(f"{file}: is damaged: {error}") from None
    if not isinstance(content, dict):
        raise InvalidInput(f"{file}: is damaged: holds no JSON object")
    return content


RETURN = "rollout/ep_rew_mean"  # column of the table: mean over the last episodes, exploration included


def progress_rows(path: Path) -> list[dict[str, str]]:
    """The table of the run in ``path``, one row per update."""
    return list(csv.DictReader(RunDirectory(path).progress.read_text("utf-8").splitlines()))


def progress_column(table: Sequence[Mapping[str, str]], name: str) -> dict[int, float]:
    """A column of such a table: step -> value, where there is one."""
    return {int(row["steps"]): float(row[name]) for row in table if row.get(name)}


def create_run(
    path: Path, config: Mapping[str, Any], *, team: Mapping[str, Any] | None = None, force: bool = False
) -> RunDirectory:
    """Make the folder of a run with its configuration and its record, in one step: it can be resumed from then on.

    ``team`` is the content of ``team.json``. Raises ``AlreadyExists`` when there is something; with ``force`` an
    earlier run (a folder with a ``run.json``) or an empty folder is replaced, and anything else is still refused.
    """
    run = RunDirectory(path)
    replace = force and path.is_dir() and not path.is_symlink() and (run.status.is_file() or not any(path.iterdir()))
    if not replace and (path.exists() or path.is_symlink()):
        if not run.status.is_file():
            raise AlreadyExists(f"{path}: is there already, and is no run; give another name")
        raise AlreadyExists(
            f"{path}: is there already; give another name (--name), go on with it (ethbrake train resume), or replace"
            " it with force (--force; make run ARGS=--force)"
        )
    with new_folder(path, replace=replace) as partial:
        new = RunDirectory(partial)
        new.write_json(new.config, config)
        if team is not None:
            new.write_json(new.team, team)
        write_status(new, "running", {})
    return run


def open_run(path: Path) -> tuple[RunDirectory, dict[str, Any]]:
    """The run in ``path`` and its configuration.

    Raises ``InvalidInput`` when there is none, or naming the file of it that is damaged.
    """
    run = RunDirectory(path)
    if not (os.path.lexists(run.status) or os.path.lexists(run.config)):
        raise InvalidInput(f"{path}: holds no training; give the folder of a run, for instance runs/my-run")
    for folder in (run.checkpoints, run.tensorboard):
        if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
            raise InvalidInput(f"{folder}: is not a plain folder; a training deletes in it what it no longer needs")
    status, config = read_object(run.status), read_object(run.config)
    for key, right in (("format", ("ethbrake-run",)), ("status", get_args(RunStatus))):
        if status.get(key) not in right:
            raise InvalidInput(f"{run.status}: {key} = {status.get(key)!r:.60}: must be {' or '.join(right)}")
    return run, config


def has_finished(run: RunDirectory) -> bool:
    """Whether the training in an open run has come to its end, though its report may not."""
    status = read_object(run.status)
    resumable = any(run.checkpoints.glob("step_*"))
    return status.get("status") == "finished" or (status.get("stage") is not None and not resumable)


def is_finished(path: Path) -> bool:
    """Whether ``path`` holds a training that came to its end."""
    run = RunDirectory(path)
    return run.status.is_file() and read_object(run.status).get("status") == "finished"


def wait_for_others(path: Path, longest_s: float) -> None:
    """Wait until no other process trains in the folder, so long at most: one that was left alone ends by itself."""
    with suppress(Timeout, OSError), FileLock(RunDirectory(path).lock, timeout=longest_s, mode=0o666):
        pass


Content = dict[str, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Training:
    """All that a training is before it begins; made by ``resolve``."""

    recipe: TrainingRecipe
    scenario: Scenario
    scheme: Scheme
    drivers: Mapping[str, str]  # learner, front to rear -> where in the run's folder its bundle will stand
    observation: ObservationSpec  # of every learner
    identity: str  # SHA-256 of all that makes it what it is, in hexadecimal digits

    def config(self) -> dict[str, Any]:
        """What ``config.json`` says of it."""
        recipe = self.recipe
        return {
            "recipe": recipe.model_dump(mode="json"),
            "scenario": self.scenario.model_dump(mode="json", exclude_unset=True),  # as in its file: defaults may clash
            "seeds": {"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            "versions": installed_versions(),
            "plugins": noted_plugins(),
            **recipe.facts,
        }


def resolve(recipe: TrainingRecipe | str | Path, scenario: Scenario | str | Path, **changes: Any) -> Training:
    """The training of a recipe on a scenario, both given or by name or path; ``changes`` override the recipe.

    Raises ``InvalidInput`` where they do not fit each other: nobody learns, or the scheme is for others.
    """
    recipe = recipe if isinstance(recipe, TrainingRecipe) else load_recipe(recipe)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    recipe = recipe.replace(**changes) if changes else recipe
    scheme = scheme_of(recipe, scenario)
    recipe.check_learners(len(scenario.learners))
    identity = training_identity(training_content(recipe, scenario))
    return Training(recipe, scenario, scheme, drivers(scheme, scenario), observation_of(recipe, scenario), identity)


def observation_of(recipe: TrainingRecipe, scenario: Scenario) -> ObservationSpec:
    """What learners observe: what the recipe says; where it says nothing, what the scenario says."""
    if recipe.observation is None:
        return observation_for(scenario)
    return choose_observation(recipe.observation, scenario.time_step_s)


def training_in(folder: Path, config: Mapping[str, Any]) -> Training:
    """The training of the configuration of the run in ``folder``.

    Raises ``InvalidInput`` naming what is wrong with it, and for a training of another library.
    """
    file = RunDirectory(folder).config
    if "library" in config:
        raise InvalidInput(
            f"{folder}: was trained by {config['library']}, which leaves nothing to go on from; train again"
        )
    try:
        recipe = recipe_of(config["recipe"])
        scenario = Scenario.from_document(Document("scenario", config["scenario"], {}))
    except KeyError as error:
        raise InvalidInput(f"{file}: is not the configuration of a training: {error} is missing") from None
    except InvalidInput as error:
        raise InvalidInput(f"{file}: {error}") from None
    return resolve(recipe, scenario)


def check_run_plugins(folder: Path, config: Mapping[str, Any], advice: str) -> None:
    """Raise ``InvalidInput``, ending in ``advice``, unless the plug-ins of this process are those of this run."""
    check_plugins(config.get("plugins", []), str(RunDirectory(folder).config), advice)


def check_same(folder: Path, training: Training) -> None:
    """Raise ``InvalidInput`` unless the run in ``folder`` is this training, naming the keys in which they differ.

    Its plug-ins must be those of this process.
    """
    config = read_object(RunDirectory(folder).config)
    check_run_plugins(folder, config, "or give another folder (--output)")
    found = training_in(folder, config)
    if found.identity == training.identity:
        return
    kept, wanted = (training_content(each.recipe, each.scenario) for each in (found, training))
    other = [
        f"{part} {key}"
        for part in wanted
        for key in dict.fromkeys([*wanted[part], *kept[part]])
        if key not in kept[part] or key not in wanted[part] or kept[part][key] != wanted[part][key]
    ]
    raise InvalidInput(
        f"{folder}: holds another training (here other: {', '.join(other)}); give another folder (--output)"
    )


def training_content(recipe: TrainingRecipe, scenario: Scenario) -> Content:
    """What makes a training what it is: plain data with every default in it, without words."""
    return {
        "recipe": recipe.model_dump(mode="json", exclude=set(WORDS)),
        "scenario": scenario.content(without=WORDS),
    }


def training_identity(content: Content) -> str:
    """SHA-256 of such content, in hexadecimal digits."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


class Algorithm(ABC):
    """A learning algorithm on a model of Stable-Baselines3, or on one of your own made from its ``BaseAlgorithm``.

    ``build`` is needed. The other methods say what a checkpoint holds and what is checked; as they stand here they fit
    a model whose ``policy`` has one ``optimizer``, as in PPO and A2C.
    """

    @abstractmethod
    def build(self, training: Training, environment: EthBrakeVecEnv) -> BaseAlgorithm:
        """A fresh model on the CPU, seeded by the recipe; a function of its two arguments and of nothing else."""

    def actors(self, model: BaseAlgorithm) -> tuple[BasePolicy, ...]:
        """What drives: one for all learners, or under ``independent`` one for each, front to rear.

        Its state holds the tensors of ``policies.actor.tensor_table`` for the recipe's ``network_spec``.
        """
        return (model.policy,)

    def optimizers(self, model: BaseAlgorithm) -> Mapping[str, Optimizer]:
        """Every optimiser by a name of its own, always in this order."""
        return {"policy": model.policy.optimizer}

    def learned_beside(self, model: BaseAlgorithm) -> Mapping[str, Tensor]:
        """Learned numbers that stand outside the model's policy, by name; a checkpoint keeps them."""
        return {}

    def log_noise(self, model: BaseAlgorithm) -> Tensor | None:
        """The logarithm of how much it explores, which must stay a usable number; None: nothing to check."""
        found: Tensor | None = getattr(model.policy, "log_std", None)
        return None if found is None else found.detach()


# Ctrl-C and SIGTERM as a question that is asked between two steps, in the place of an exception inside one.

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Give a function that says whether to stop; the second signal acts as if nobody listened.

    Outside the main thread, where Python delivers no signals, the function always says no.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def listen(number: int, frame: FrameType | None) -> None:
        asked.set()
        restore()

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    try:
        for number in _SIGNALS:
            signal.signal(number, listen)
        yield asked.is_set
    finally:
        restore()


# ``team.json`` in a run's folder: which bundle drives which vehicle. Reading a team needs no torch.

_TEAM_LIMIT_BYTES = 1 << 20
_RIGHT_TEAM = (
    'right is, for instance, {"scheme": "shared", "vehicles": 3, "drivers": {"vehicle_2": "policy", "vehicle_3":'
    ' "policy"}}'
)


class _TeamFile(FileModel):
    format: Literal["ethbrake-team"] = "ethbrake-team"
    format_version: Literal[1] = 1
    scheme: Scheme
    vehicles: Annotated[int, Field(ge=2, le=64)]
    drivers: Annotated[dict[str, str], Field(min_length=1)]

    @model_validator(mode="after")
    def _drivers_of_the_line_and_scheme(self) -> _TeamFile:
        line = [f"vehicle_{i + 1}" for i in range(self.vehicles)]
        for name, bundle in self.drivers.items():
            if name not in line:
                refuse(("drivers",), name, f"must be one of {line[0]} to {line[-1]}")
            if bundle != driver(self.scheme, name):
                refuse(("drivers", name), bundle, f"must be {driver(self.scheme, name)} under scheme {self.scheme}")
        alone = len(self.drivers) == 1
        if (self.scheme == "single" and not alone) or (self.scheme == "independent" and alone):
            right = "two vehicles or more" if alone else "one vehicle"
            refuse(("drivers",), self.drivers, f"must be {right} under scheme {self.scheme}")
        return self


def team_content(scheme: Scheme, scenario: Scenario) -> dict[str, Any]:
    """What ``team.json`` says of a training."""
    file = _TeamFile(scheme=scheme, vehicles=scenario.vehicles, drivers=drivers(scheme, scenario))
    return file.model_dump(mode="json")


def is_team(path: str | os.PathLike[str]) -> bool:
    """Whether ``path`` is a run whose learners have a policy each, so that no policy alone drives all of them."""
    file = RunDirectory(Path(path)).team
    return os.path.lexists(file) and len(set(_read_team(file).drivers.values())) > 1


def load_team(path: str | os.PathLike[str], scenario: str | Path | Scenario, name: str = "team") -> Team:
    """The learners of ``scenario`` driven as they were trained together in the run at ``path``.

    A learner that the scenario gives a script is left out. Raises ``InvalidInput`` where there is no team, for one of
    another line length, or for a learner that it does not drive; ``CorruptBundle`` (file, what is wrong) for a damaged
    one.
    """
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    file = RunDirectory(Path(path)).team
    if not os.path.lexists(file):
        raise InvalidInput(f"{path}: holds no team ({file.name}); give the folder of a run, or a bundle as ppo@{path}")
    team = _read_team(file)
    if team.vehicles != scenario.vehicles:
        shared = len(set(team.drivers.values())) == 1
        raise InvalidInput(
            f"{path}: is a team for a line of {team.vehicles} vehicles, scenario {scenario.name!r} has"
            f" {scenario.vehicles}; "
            + (
                f"its one policy can drive other lines: policy@{path}"
                if shared
                else "only a shared policy can drive others"
            )
        )
    wanted = {scenario.vehicle_names[i]: i for i in scenario.learners}
    missing = [each for each in wanted if each not in team.drivers]
    if missing or not wanted:
        who = ", ".join(missing) or "nobody"
        raise InvalidInput(f"{path}: drives {', '.join(team.drivers)}; scenario {scenario.name!r} has {who} to drive")
    return Team({i: LearnedAgent(load_driver(path, each), name) for each, i in wanted.items()}, name)


def load_driver(path: str | os.PathLike[str], vehicle: str) -> Policy:
    """The policy that drives ``vehicle`` in the run at ``path``; raises as ``load_team``."""
    given: Mapping[str, str] = _read_team(RunDirectory(Path(path)).team).drivers
    if vehicle not in given:
        raise InvalidInput(f"{path}: drives {', '.join(given)}, not {vehicle}")
    return load_policy(Path(path) / given[vehicle])


def _read_team(file: Path) -> _TeamFile:
    data = read_plain(file, _TEAM_LIMIT_BYTES)
    try:
        document = Document(str(file), parse_strict_json(data), {})
    except ValueError as error:
        raise CorruptBundle(f"{file}: is not JSON ({error}); {_RIGHT_TEAM}") from None
    try:
        return read_model(document, _TeamFile, Wording(_TeamFile, _RIGHT_TEAM), f"of keys to values; {_RIGHT_TEAM}")
    except InvalidInput as error:
        raise CorruptBundle(str(error)) from None


# Trained policies as agents: ``ppo@PATH``, ``policy@PATH``, whatever trained it, ``universal@shipped``, ``team@RUN``.
#
# Needs no torch.

_KINDS: dict[str, PolicyKind] = {name: name for name in get_args(PolicyKind)} | {"team": "policy"}


def make_policy_agent(argument: None, settings: AgentSettings) -> Driver:
    """The policy of a run or a bundle, or the team of a run in which each learner has its own.

    ``PATH`` may be ``shipped``, the policy that comes with the package for this scenario and harm count, or
    ``shipped/NAME``; ``universal@shipped`` is for all scenarios, ``team@shipped`` is ``policy@shipped``. Raises
    ``InvalidInput`` for a policy of another algorithm, and what loading it raises.
    """
    spec, path = settings.spec, settings.policy
    name = spec.partition("@")[0]
    if path is None:
        raise InvalidInput(
            f"agent {spec!r}: a policy is needed: {name}@PATH, where PATH is a run or a policy bundle, for instance"
            f" {name}@runs/my-run, or {name}@{SHIPPED}"
        )
    ships = path.partition("/")[0] == SHIPPED  # one policy for all learners
    if not ships and (name == "team" or (name != "universal" and is_team(path))):
        scenario = settings.needed_scenario()
        team = load_team(path, scenario, spec)
        _check_algorithm(name, path, load_driver(path, scenario.vehicle_names[min(team.drivers)]))
        return team
    if name == "universal" and path != SHIPPED:
        raise InvalidInput(f"agent {spec!r}: must be universal@{SHIPPED}; for another policy: ppo@PATH or sac@PATH")
    policy = load_named_policy(path, _KINDS[name], settings.scenario, settings.harm_count)
    _check_algorithm(name, path, policy)
    return LearnedAgent(policy, name=spec)


def _check_algorithm(name: str, path: str, policy: Policy) -> None:
    """``ppo@PATH``, ``sac@PATH`` and ``counterfactual@PATH`` are for policies of that algorithm."""
    trained_by = policy.manifest.algorithm
    if name in ("ppo", "sac", "counterfactual") and name != trained_by:
        raise InvalidInput(
            f"agent '{name}@{path}': that policy was trained by {trained_by.upper()}: {trained_by}@{path}"
        )
