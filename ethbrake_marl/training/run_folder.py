"""The folder of a run: its files, its configuration, how far it came, and who may train in it."""

from __future__ import annotations

import csv
import hashlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args

from filelock import FileLock, Timeout
from pydantic import Field, model_validator

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.errors import AlreadyExists, CorruptBundle, InvalidInput
from ethbrake_marl.files.model import FileModel, Wording, read_model, refuse
from ethbrake_marl.files.plain import parse_strict_json, read_object, read_plain
from ethbrake_marl.files.store import new_folder, write_file
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.game.observations import ObservationSpec, choose_observation
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.network import load_policy
from ethbrake_marl.policies.shipped import SHIPPED, shipped_name
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.observed import common_observation, observations_of
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.recipe import WORDS, Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.training.recipes import SacRecipe

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from torch import Tensor
    from torch.optim import Optimizer

    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv

RunStatus = Literal["running", "finished", "interrupted", "failed"]


class RunDirectory:
    """A run's folder: the names inside, and what its files say."""

    # Columns of its table, and keys of its evaluations (``eval/`` stands before them in the table)
    RETURN = "rollout/ep_rew_mean"  # mean over the last episodes, exploration included
    OBJECTIVE = "objective"  # mean over the learners of their objectives' harm, where one is another than total
    HARM: ClassVar[dict[HarmCount, str]] = {"first": "first_impact_harm", "total": "total_harm"}

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
                f"{path}: is there already; give another folder (--output), go on with it (ethbrake train --resume),"
                " or replace it with force (--force; make run ARGS=--force)"
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
        for folder in (self.checkpoints, self.tensorboard, self.policy, self.last_policy):
            if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
                raise InvalidInput(f"{folder}: is not a plain folder; a training deletes in it, or replaces it")
        status, config = read_object(self.status), read_object(self.config)
        for key, right in (("format", ("ethbrake-run",)), ("status", get_args(RunStatus))):
            if status.get(key) not in right:
                raise InvalidInput(f"{self.status}: {key} = {status.get(key)!r:.60}: must be {' or '.join(right)}")
        return config

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
        return Training.of(recipe, scenario)

    def check_same(self, training: Training) -> None:
        """Raise ``InvalidInput`` unless it holds this training, naming the keys in which they differ."""
        found = self.training(read_object(self.config))
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

    def load_team(
        self, scenario: str | Path | Scenario, name: str = "team", vehicles: Collection[int] | None = None
    ) -> Team:
        """The ``vehicles`` (None: the learners of ``scenario``) driven as they were trained together in this run.

        A learner of the run that is none of them is left out. Raises ``InvalidInput`` where there is no team, for one
        of another line length, or for a learner that it does not drive; ``CorruptBundle`` (file, what is wrong) for a
        damaged one.
        """
        scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        path, file = self.path, self.team
        if not os.path.lexists(file):
            raise InvalidInput(
                f"{path}: holds no team ({file.name}); give the folder of a run, or a bundle as ppo@{path}"
            )
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
        wanted = {scenario.vehicle_names[i]: i for i in (scenario.learners if vehicles is None else vehicles)}
        missing = [each for each in wanted if each not in team.drivers]
        if missing or not wanted:
            who = ", ".join(missing) or "nobody"
            raise InvalidInput(
                f"{path}: drives {', '.join(team.drivers)}; scenario {scenario.name!r} has {who} to drive"
            )
        return Team({i: LearnedAgent(load_policy(path / team.drivers[each]), name) for each, i in wanted.items()}, name)

    def wait_for_others(self, longest_s: float) -> None:
        """Wait until no other process trains here, so long at most: one that was left alone ends by itself."""
        with suppress(Timeout, OSError), FileLock(self.lock, timeout=longest_s, mode=0o666):
            pass

    @classmethod
    def chosen_by(cls, evaluations: Sequence[Mapping[str, Any]], harm_count: HarmCount, prefix: str = "") -> str:
        """What the best policy has least of: the objective, or the line's harm where an evaluation tells none."""
        found = evaluations and all(entry.get(prefix + cls.OBJECTIVE) not in (None, "") for entry in evaluations)
        return prefix + (cls.OBJECTIVE if found else cls.HARM[harm_count])

    def rows(self) -> list[dict[str, str]]:
        """Its table, one row per update."""
        return list(csv.DictReader(self.progress.read_text("utf-8").splitlines()))

    def cpu_s(self) -> dict[int, float]:
        """Processor seconds of learning until each evaluation, by step; raises ``InvalidInput`` where none are kept."""
        kept = read_object(self.status).get("cpu_s") or {}
        if not kept:
            raise InvalidInput(f"{self.path}: tells no processor time; train again with this version")
        return {int(steps): float(spent) for steps, spent in kept.items()}

    def column(self, name: str) -> dict[int, float]:
        """A column of its table: step -> value, where there is one."""
        return {int(row["steps"]): float(row[name]) for row in self.rows() if row.get(name)}


@dataclass(frozen=True, slots=True)
class Training:
    """All that a training is before it begins; made by ``Training.of``."""

    recipe: TrainingRecipe
    scenario: Scenario
    scheme: Scheme
    drivers: Mapping[str, str]  # learner, front to rear -> where in the run's folder its bundle will stand
    observation: ObservationSpec  # of a learner's row: where each observes its own features, those of all
    observations: Mapping[str, ObservationSpec]  # of each learner

    @classmethod
    def of(cls, recipe: TrainingRecipe | str | Path, scenario: Scenario | str | Path, **changes: Any) -> Training:
        """The training of a recipe on a scenario, both given or by name or path; ``changes`` override the recipe.

        Learners observe what the recipe says; where it says nothing, what the scenario says. Raises ``InvalidInput``
        where they do not fit each other: nobody learns, the scheme is for others, or one policy for all is to drive
        learners that observe different features.
        """
        recipe = recipe if isinstance(recipe, TrainingRecipe) else load_recipe(recipe)
        scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        recipe = recipe.replace(**changes) if changes else recipe
        scheme = recipe.scheme_for(scenario)
        names = [scenario.vehicle_names[vehicle] for vehicle in scenario.learners]
        drivers = {name: _driver(scheme, name) for name in names}
        every = observations_of(scenario, recipe.observation)
        observations = {name: every[vehicle] for name, vehicle in zip(names, scenario.learners, strict=True)}
        if scheme == "independent" and len(set(observations.values())) > 1:
            listed = dict.fromkeys(feature.name for spec in observations.values() for feature in spec.features)
            observation = choose_observation([*listed], scenario.time_step_s)
        else:
            observation = common_observation(every, scenario)
        return cls(recipe, scenario, scheme, drivers, observation, observations)

    @property
    def columns(self) -> list[list[int]]:
        """Which numbers of its row each learner observes, front to rear."""
        place = {feature.name: column for column, feature in enumerate(self.observation.features)}
        return [[place[feature.name] for feature in spec.features] for spec in self.observations.values()]

    @property
    def start(self) -> str | None:
        """The policy whose weights it begins with, ``ppo@shipped/ppo``; None: random weights.

        A recipe's ``ppo@shipped`` stands for what ships for the scenario, if anything does.
        """
        asked: str | None = getattr(self.recipe, "start", None)
        kind, _, path = (asked or "").partition("@")
        if path != SHIPPED:
            return asked
        with suppress(InvalidInput):
            return f"{asked}/{shipped_name(kind, self.scenario, self.recipe.reward.harm_count)}"
        return None

    @property
    def begins(self) -> str | None:
        """What its weights begin as, in words; None where no recipe of its algorithm names a policy."""
        if "start" not in type(self.recipe).model_fields:
            return None
        asked, name = getattr(self.recipe, "start", None), self.scenario.name
        return self.start or f"random weights{'' if asked is None else f', as {asked} has none for scenario {name!r}'}"

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


# ``team.json`` in a run's folder: which bundle drives which vehicle. Reading a team needs no torch.

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


def _read_team(file: Path) -> _TeamFile:
    data = read_plain(file, 1 << 20)
    try:
        document = Document(str(file), parse_strict_json(data), {})
    except ValueError as error:
        raise CorruptBundle(f"{file}: is not JSON ({error}); {_RIGHT_TEAM}") from None
    try:
        return read_model(document, _TeamFile, Wording(_TeamFile, _RIGHT_TEAM), f"of keys to values; {_RIGHT_TEAM}")
    except InvalidInput as error:
        raise CorruptBundle(str(error)) from None
