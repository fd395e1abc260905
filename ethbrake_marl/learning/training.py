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

from ethbrake_marl.agents import AgentSettings, Driver, LearnedAgent, Team
from ethbrake_marl.errors import AlreadyExists, CorruptBundle, InvalidInput
from ethbrake_marl.files.plugins import check_plugins, noted_plugins
from ethbrake_marl.files.store import new_folder, parse_strict_json, read_plain, write_file
from ethbrake_marl.files.yaml import Document, FileModel, Wording, read_model, refuse
from ethbrake_marl.learning.recipe import WORDS, SacRecipe, Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.observations import ObservationSpec, choose_observation
from ethbrake_marl.policies import SHIPPED, Policy, installed_versions, load_named_policy, load_policy
from ethbrake_marl.scenario import Scenario, load_scenario, observation_for

if TYPE_CHECKING:  # torch takes seconds, and what is asked of a run needs none
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from torch import Tensor
    from torch.optim import Optimizer

    from ethbrake_marl.envs import EthBrakeVecEnv

# The folder of a run: its files, its configuration, how far it came, and who may train in it.

_LIMIT_BYTES = 16 << 20  # of a JSON file

RunStatus = Literal["running", "finished", "interrupted", "failed"]


class RunDirectory:
    """A run's folder: the names inside, and what its files say."""

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

    def create(
        self, config: Mapping[str, Any], *, team: Mapping[str, Any] | None = None, force: bool = False
    ) -> RunDirectory:
        """Make the folder with its configuration and its record, in one step: it can be resumed from then on.

        ``team`` is the content of ``team.json``. Raises ``AlreadyExists`` when there is something; with ``force`` an
        earlier run (a folder with a ``run.json``) or an empty folder is replaced, and anything else is still refused.
        """
        path, is_run = self.path, self.status.is_file()
        replace = force and path.is_dir() and not path.is_symlink() and (is_run or not any(path.iterdir()))
        if not replace and (path.exists() or path.is_symlink()):
            if not is_run:
                raise AlreadyExists(f"{path}: is there already, and is no run; give another name")
            raise AlreadyExists(
                f"{path}: is there already; give another name (--name), go on with it (ethbrake train resume), or"
                " replace it with force (--force; make run ARGS=--force)"
            )
        with new_folder(path, replace=replace) as partial:
            new = RunDirectory(partial)
            new.write_json(new.config, config)
            if team is not None:
                new.write_json(new.team, team)
            new.write_status("running")
        return self

    def write_json(self, file: Path, content: Mapping[str, Any]) -> None:
        """Replace ``file`` in one step."""
        write_file(file, json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")

    def write_status(self, status: RunStatus, **more: Any) -> None:
        """Replace ``run.json``: when it was started stays, and when it ended is now."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        before = read_object(self.status) if self.status.exists() else {}
        times = {"started_utc": before.get("started_utc") or now}
        if status != "running":
            times["ended_utc"] = now
        self.write_json(self.status, {"format": "ethbrake-run", "format_version": 1, "status": status, **times, **more})

    def read_config(self) -> dict[str, Any]:
        """The configuration; raises ``InvalidInput`` where there is no run, or naming the file that is damaged."""
        if not (os.path.lexists(self.status) or os.path.lexists(self.config)):
            raise InvalidInput(f"{self.path}: holds no training; give the folder of a run, for instance runs/my-run")
        for folder in (self.checkpoints, self.tensorboard):
            if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
                raise InvalidInput(f"{folder}: is not a plain folder; a training deletes in it what it no longer needs")
        status, config = read_object(self.status), read_object(self.config)
        for key, right in (("format", ("ethbrake-run",)), ("status", get_args(RunStatus))):
            if status.get(key) not in right:
                raise InvalidInput(f"{self.status}: {key} = {status.get(key)!r:.60}: must be {' or '.join(right)}")
        return config

    def check_plugins(self, config: Mapping[str, Any], advice: str) -> None:
        """Raise ``InvalidInput``, ending in ``advice``, unless the plug-ins of this process are those of this run."""
        check_plugins(config.get("plugins", []), str(self.config), advice)

    def training(self, config: Mapping[str, Any]) -> Training:
        """The training of its configuration.

        Raises ``InvalidInput`` naming what is wrong with it, and for a training of another library.
        """
        if "library" in config:
            raise InvalidInput(
                f"{self.path}: was trained by {config['library']}, which leaves nothing to go on from; train again"
            )
        try:
            recipe = TrainingRecipe.of(config["recipe"])
            scenario = Scenario.from_document(Document("scenario", config["scenario"], {}))
        except KeyError as error:
            raise InvalidInput(f"{self.config}: is not the configuration of a training: {error} is missing") from None
        except InvalidInput as error:
            raise InvalidInput(f"{self.config}: {error}") from None
        return resolve(recipe, scenario)

    def check_same(self, training: Training) -> None:
        """Raise ``InvalidInput`` unless it holds this training, naming the keys in which they differ.

        Its plug-ins must be those of this process.
        """
        config = read_object(self.config)
        self.check_plugins(config, "or give another folder (--output)")
        found = self.training(config)
        if found.identity == training.identity:
            return
        kept, wanted = found.content(), training.content()
        other = [
            f"{part} {key}"
            for part in wanted
            for key in dict.fromkeys([*wanted[part], *kept[part]])
            if key not in kept[part] or key not in wanted[part] or kept[part][key] != wanted[part][key]
        ]
        raise InvalidInput(
            f"{self.path}: holds another training (here other: {', '.join(other)}); give another folder (--output)"
        )

    @property
    def is_finished(self) -> bool:
        """Whether it holds a training that came to its end."""
        return self.status.is_file() and read_object(self.status).get("status") == "finished"

    @property
    def is_team(self) -> bool:
        """Whether its learners have a policy each, so that no policy alone drives all of them."""
        return os.path.lexists(self.team) and len(set(_read_team(self.team).drivers.values())) > 1

    def wait_for_others(self, longest_s: float) -> None:
        """Wait until no other process trains here, so long at most: one that was left alone ends by itself."""
        with suppress(Timeout, OSError), FileLock(self.lock, timeout=longest_s, mode=0o666):
            pass

    def rows(self) -> list[dict[str, str]]:
        """Its table, one row per update."""
        return list(csv.DictReader(self.progress.read_text("utf-8").splitlines()))

    def column(self, name: str) -> dict[int, float]:
        """A column of its table: step -> value, where there is one."""
        return {int(row["steps"]): float(row[name]) for row in self.rows() if row.get(name)}


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


@dataclass(frozen=True, slots=True)
class Training:
    """All that a training is before it begins; made by ``resolve``."""

    recipe: TrainingRecipe
    scenario: Scenario
    scheme: Scheme
    drivers: Mapping[str, str]  # learner, front to rear -> where in the run's folder its bundle will stand
    observation: ObservationSpec  # of every learner

    def content(self) -> dict[str, dict[str, Any]]:
        """What makes it what it is: plain data with every default in it, without words."""
        recipe = self.recipe.model_dump(mode="json", exclude=set(WORDS))
        return {"recipe": recipe, "scenario": self.scenario.content(without=WORDS)}

    @property
    def identity(self) -> str:
        """SHA-256 of its content, in hexadecimal digits."""
        return self.identity_of(self.content())

    @staticmethod
    def identity_of(content: Mapping[str, Any]) -> str:
        """SHA-256 of such content."""
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def config(self, settings: Sequence[str] = ()) -> dict[str, Any]:
        """What ``config.json`` says of it, and of the ``settings`` by which it differs from files."""
        recipe = self.recipe
        return {
            "recipe": recipe.model_dump(mode="json"),
            "scenario": self.scenario.model_dump(mode="json", exclude_unset=True),  # as in its file: defaults may clash
            "seeds": {"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            "versions": installed_versions(),
            "plugins": noted_plugins(),
            **({"update_ratio": recipe.update_ratio} if isinstance(recipe, SacRecipe) else {}),
            **({"settings": list(settings)} if settings else {}),
        }

    def team(self) -> dict[str, Any]:
        """What ``team.json`` says of it."""
        file = _TeamFile(scheme=self.scheme, vehicles=self.scenario.vehicles, drivers=dict(self.drivers))
        return file.model_dump(mode="json")

    def who_drives(self) -> str:
        """Its scheme and ``drivers`` to read: ``scheme shared: policy drives vehicle_2, vehicle_3``."""
        bundles: dict[str, list[str]] = {}
        for vehicle, bundle in self.drivers.items():
            bundles.setdefault(bundle, []).append(vehicle)
        told = "; ".join(f"{bundle} drives {', '.join(vehicles)}" for bundle, vehicles in bundles.items())
        return f"scheme {self.scheme}: {told}"


def resolve(recipe: TrainingRecipe | str | Path, scenario: Scenario | str | Path, **changes: Any) -> Training:
    """The training of a recipe on a scenario, both given or by name or path; ``changes`` override the recipe.

    Learners observe what the recipe says; where it says nothing, what the scenario says. Raises ``InvalidInput`` where
    they do not fit each other: nobody learns, or the scheme is for others.
    """
    recipe = recipe if isinstance(recipe, TrainingRecipe) else load_recipe(recipe)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    recipe = recipe.replace(**changes) if changes else recipe
    scheme = recipe.scheme_for(scenario)
    names = [scenario.vehicle_names[vehicle] for vehicle in scenario.learners]
    drivers = {name: _driver(scheme, name) for name in names}
    if recipe.observation is None:
        return Training(recipe, scenario, scheme, drivers, observation_for(scenario))
    observation = choose_observation(recipe.observation, scenario.time_step_s)
    return Training(recipe, scenario, scheme, drivers, observation)


def _driver(scheme: Scheme, vehicle: str) -> str:
    """Where in the run's folder the bundle stands that drives a learner."""
    return f"policy/{vehicle}" if scheme == "independent" else "policy"


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

        Its state holds the ``tensors`` of the recipe's ``network_spec``.
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
            if bundle != _driver(self.scheme, name):
                refuse(("drivers", name), bundle, f"must be {_driver(self.scheme, name)} under scheme {self.scheme}")
        alone = len(self.drivers) == 1
        if (self.scheme == "single" and not alone) or (self.scheme == "independent" and alone):
            right = "two vehicles or more" if alone else "one vehicle"
            refuse(("drivers",), self.drivers, f"must be {right} under scheme {self.scheme}")
        return self


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
    return Team(
        {i: LearnedAgent(load_policy(Path(path) / team.drivers[each]), name) for each, i in wanted.items()}, name
    )


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
    agent: LearnedAgent | Team
    if name == "universal" and path != SHIPPED:
        raise InvalidInput(f"agent {spec!r}: must be universal@{SHIPPED}; for another policy: ppo@PATH or sac@PATH")
    if not ships and (name == "team" or (name != "universal" and RunDirectory(Path(path)).is_team)):
        agent = load_team(path, settings.needed_scenario(), spec)
        first: Any = agent.drivers[min(agent.drivers)]
        policy: Policy = first.policy
    else:
        policy = load_named_policy(path, "policy" if name == "team" else name, settings.scenario, settings.harm_count)
        agent = LearnedAgent(policy, name=spec)
    trained_by = policy.manifest.algorithm
    if name in ("ppo", "sac", "counterfactual") and name != trained_by:
        raise InvalidInput(
            f"agent '{name}@{path}': that policy was trained by {trained_by.upper()}: {trained_by}@{path}"
        )
    return agent
