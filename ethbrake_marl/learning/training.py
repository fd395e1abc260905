"""A recipe (a training set-up as one YAML file), the training that it and a scenario come to, and its run's folder.

Two trainings are the same where recipe (its seed included) and scenario say the same; titles, descriptions and sources
are words and count for nothing, nor does it matter whether a default is spelt out. Learning curves and ablations ask
before they keep a finished training or go on with one, ``resume`` asks whether a checkpoint belongs to what
``config.json`` says. Nothing here needs torch.
"""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from operator import not_
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args

from filelock import FileLock, Timeout
from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic.json_schema import models_json_schema
from pydantic_core import ErrorDetails

from ethbrake_marl.agents import AgentSettings, Driver, LearnedAgent, Source, Team, split_names
from ethbrake_marl.errors import AlreadyExists, CorruptBundle, InvalidInput, unknown_name
from ethbrake_marl.files.store import new_folder, parse_strict_json, read_object, read_plain, write_file
from ethbrake_marl.files.yaml import (
    NAME_PATTERN,
    Document,
    FileModel,
    FileSchema,
    Override,
    Wording,
    YamlPath,
    flow_text,
    read_model,
    read_yaml,
    refuse,
    schema_lines,
)
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.observations import ListedFeatures, ObservationSpec, choose_observation, listed_features
from ethbrake_marl.policies import (
    SHIPPED,
    Activation,
    NetworkSpec,
    Policy,
    installed_versions,
    load_named_policy,
    load_policy,
    shipped_name,
)
from ethbrake_marl.registry import Part, Registry
from ethbrake_marl.rewards import RewardParams, setting_names
from ethbrake_marl.scenario import (
    Scenario,
    check_file_name,
    common_observation,
    load_scenario,
    observations_of,
    shipped_folder,
)

if TYPE_CHECKING:  # torch takes seconds, and what is asked of a run needs none
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from torch import Tensor
    from torch.optim import Optimizer

    from ethbrake_marl.envs import EthBrakeVecEnv

WORDS = ("title", "description", "source")  # fields that tell about a recipe and change nothing

Scheme = Literal["single", "shared", "independent", "centralised"]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Averaging = Annotated[float, Field(ge=0.0, lt=1.0)]  # 1 would keep the first weights for ever
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Rate = Annotated[float, Field(gt=0.0, le=1.0)]
Layers = Annotated[tuple[Annotated[int, Field(ge=1, le=4096)], ...], Field(strict=False, min_length=1, max_length=8)]


class LearningRate(FileModel):
    """A learning rate that falls from ``start`` to ``end`` over the training."""

    start: Rate
    end: Rate
    schedule: Literal["cosine"] = "cosine"

    def at(self, remaining: float) -> float:
        """``end + (start - end) (1 + cos(pi p)) / 2`` with ``p = 1 - remaining``, the share of steps done."""
        done = min(max(1.0 - remaining, 0.0), 1.0)
        return self.end + (self.start - self.end) * 0.5 * (1.0 + math.cos(math.pi * done))


class _Shape(FileModel):
    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """What a bundle holds for one action in [-1, 1]: the actor, and what ``more`` says."""
        shape: Any = self  # its fields stand in an order of their own
        fields = {"policy_hidden": shape.policy, "value_hidden": (), "activation": shape.activation, "output": "clip"}
        return NetworkSpec(observation_size=observation_size, action_size=1, **(fields | more))


class NetworkShape(_Shape):
    """Hidden layers of actor and critic, and the exploration noise they start with."""

    policy: Layers
    value: Layers
    activation: Activation = "relu"
    initial_log_std: Annotated[float, Field(ge=-10.0, le=2.0)] = 0.0

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """Actor and critic."""
        return super().spec(observation_size, value_hidden=self.value, **more)


class SquashedShape(_Shape):
    """Hidden layers of the actor and of each of the two critics; the actor's noise depends on what it sees."""

    policy: Layers
    value: Layers
    activation: Activation = "relu"

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """The actor, whose squashed mean is the action. Critics stay in the checkpoints."""
        return super().spec(observation_size, output="tanh", **more)


class ActorShape(_Shape):
    """Hidden layers of the actor, where there is no critic."""

    policy: Layers
    activation: Activation = "relu"
    initial_action: Annotated[float | None, Field(ge=-1.0, le=1.0, exclude_if=lambda v: v is None)] = (
        None  # at first; None: 0
    )


class ChoosingShape(_Shape):
    """Hidden layers of an actor that scores a number of actions, evenly from -1 to 1."""

    policy: Layers
    activation: Activation = "relu"
    choices: Annotated[int, Field(ge=2, le=4096)]

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """The actor, which takes the action of the highest score."""
        return super().spec(observation_size, output="choice", choices=self.choices, **more)


class OffsetRange(FileModel):
    """How far an action is moved to see what comes of it; the logarithm of what is drawn is uniform."""

    smallest: Rate
    largest: Rate

    @field_validator("largest")
    @classmethod
    def _in_order(cls, value: float, info: ValidationInfo) -> float:
        if "smallest" in info.data and not value >= info.data["smallest"]:
            raise ValueError(f"must be at least smallest = {info.data['smallest']:g}")
        return value


class EvaluationPlan(FileModel):
    """The fixed list on which the policy is measured while it learns."""

    every_updates: Annotated[int, Field(ge=1)]
    worlds: Annotated[int, Field(ge=1, le=1_000_000)]
    seed: Annotated[int, Field(ge=0)]


class TrainingRecipe(FileModel):
    """How to train, whatever the algorithm: its name, reward, seed, and what is saved and measured on the way.

    An update is one round of collecting and learning. The recipes of an algorithm are a class made from this one.

    >>> import ethbrake_marl as eb
    >>> recipe = eb.load_recipe("ppo").replace(seed=3, total_steps=100_000)
    >>> recipe.algorithm, recipe.seed, recipe.total_steps
    ('ppo', 3, 100000)

    """

    schemes: ClassVar[tuple[Scheme, ...]] = ("single", "shared")  # under which the algorithm can learn
    most_decisions: ClassVar[float] = math.inf  # held in memory between two updates

    name: str = Field(pattern=NAME_PATTERN)  # equal to the file's without .yaml
    title: str = ""  # one line for lists
    description: str = ""  # what it is for
    source: str = ""  # where the values come from
    algorithm: str  # a registered name
    scheme: Scheme | None = None  # None: single for one learner, shared for several
    total_steps: Annotated[int, Field(ge=1)]  # decisions of all learners
    n_envs: Annotated[int, Field(ge=1)]  # worlds that are advanced together
    learning_rate: LearningRate  # from its start to its end
    gamma: Fraction  # discount of one time step
    reward: RewardParams  # what is learned for
    observation: Annotated[ListedFeatures | None, Field(exclude_if=not_)] = None  # of learners; None: the scenario's
    horizon_is_end: bool = True  # nothing is expected beyond the horizon
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # of worlds, networks and exploration
    evaluation: EvaluationPlan  # the fixed list, and how often
    checkpoint_every_updates: Annotated[int, Field(ge=1)]  # updates

    @field_validator("reward")
    @classmethod
    def _some_reward(cls, value: RewardParams) -> RewardParams:
        if not any(weight for name, weight in value.weights.items() if name != "shaping"):
            raise ValueError("every weight is 0; nothing could be learned")
        return value

    @field_validator("observation", mode="before")
    @classmethod
    def _known_features(cls, value: Any) -> Any:
        if value is not None:
            try:
                listed_features(value)
            except InvalidInput as error:
                raise ValueError(str(error).removeprefix("observation: ")) from None
        return value

    @model_validator(mode="after")
    def _room_for_an_update(self) -> Self:
        if self.most_decisions < math.inf and not (rollout := self.n_envs * self.rounds) <= self.most_decisions:
            right = f"n_envs x n_steps = {rollout} decisions per update; at most {self.most_decisions}"
            refuse(("n_envs",), self.n_envs, right)
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """The network of the policy's bundle: that of the recipe's ``network``."""
        shape: _Shape = vars(self)["network"]
        return shape.spec(observation_size)

    @property
    def rounds(self) -> int:
        """Decisions of each learner between two updates: the recipe's ``n_steps``."""
        return int(vars(self)["n_steps"])

    def check_learners(self, learners: int) -> None:
        """Raise ``InvalidInput`` where the recipe does not fit a line with that many learners."""

    def scheme_for(self, scenario: Scenario) -> Scheme:
        """The recipe's scheme; where it names none, ``single`` for one learner and ``shared`` for several.

        Raises ``InvalidInput`` where nobody learns, or where the scheme or else the recipe does not fit the learners.
        """
        learners, where = len(scenario.learners), f"scenario {scenario.name!r}"
        if not learners:
            raise InvalidInput(f"{where}: no vehicle learns; give at least one the role learner")
        scheme = self.scheme or ("single" if learners == 1 else "shared")
        if scheme == "single" and learners > 1:
            raise InvalidInput(
                f"scheme single: {where} has {learners} learners; use shared, independent or centralised, or let one"
                " learn"
            )
        if scheme == "independent" and learners == 1:
            raise InvalidInput(f"scheme independent: {where} has one learner; use single")
        if scheme not in self.schemes:
            raise InvalidInput(
                f"scheme {scheme}: recipe {self.name!r} is for {self.algorithm.upper()}; it needs one for PPO"
            )
        self.check_learners(learners)
        return scheme

    def make_algorithm(self) -> Any:
        """Its algorithm, new."""
        algorithm = ALGORITHMS[self.algorithm][1]
        return (resolve_name(algorithm) if isinstance(algorithm, str) else algorithm)()

    @staticmethod
    def shipped() -> dict[str, Path]:
        """Name -> file of every recipe that comes with the package: of the checkout's ``train/``, or installed."""
        return {file.stem: file for file in sorted(shipped_folder("train").glob("*.yaml"))}

    @staticmethod
    def file(name_or_path: str | Path) -> Path:
        """Where a recipe stands, a shipped name or any path; it need not exist. Raises ``UnknownName``."""
        text = str(name_or_path)
        if Path(text).suffix in (".yaml", ".yml") or "/" in text or "\\" in text:
            return Path(text)
        shipped = TrainingRecipe.shipped()
        if text not in shipped:
            raise unknown_name("recipe", text, shipped)
        return shipped[text]

    @staticmethod
    def of(content: Any) -> TrainingRecipe:
        """The recipe, of its algorithm's class, that ``model_dump(mode="json")`` wrote; raises ``InvalidInput``."""
        return _checked(Document("recipe", content, {}))

    def new_text(self, name: str) -> str:
        """Text of a commented YAML file for a new recipe ``name`` with the values of this one, all keys written out.

        A key that this one leaves out stands in a comment. Save it as ``<name>.yaml``. Raises ``InvalidInput`` for a
        name that cannot be one.
        """
        check_file_name("recipe", name)
        words = {
            "title": "One line for lists",
            "description": "What this recipe is for.",
            "source": f"Values of {self.name}, to be changed.",
        }
        head = f"# Recipe {name}, started from {self.name}. Train with it: ethbrake train --recipe {name}.yaml\n"
        return self.replace(name=name, **words).text(head)

    def text(self, head: str) -> str:
        """A commented YAML file below ``head``: all keys written out, one that the recipe leaves out in a comment."""
        lines = [head, schema_lines("recipe", "train --schema")]
        values = self.model_dump(mode="json")
        for key in type(self).model_fields:
            value = values.get(key)
            lines.append(f"\n# {MEANINGS[key]}\n" if key in MEANINGS else "\n")
            if value is None:
                lines.append(f"# {key}:\n")
            elif isinstance(value, Mapping):
                inside = (f"  {name}: {flow_text(entry)}\n" for name, entry in value.items() if entry is not None)
                lines += [f"{key}:\n", *inside]
            else:
                lines.append(f"{key}: {flow_text(value)}\n")
        return "".join(lines)

    def replace(self, **changes: Any) -> Self:
        """The same recipe with other values in some fields, checked again; raises ``InvalidInput``."""
        content = {**self.model_dump(mode="json"), **changes}
        changed = _checked(Document(f"recipe {self.name!r}", content, {}))
        assert isinstance(changed, type(self)) or "algorithm" in changes
        return changed  # type: ignore[return-value]  # of another class only if another algorithm was asked for

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """JSON Schema of a recipe file, for editors that complete and check YAML.

        Which keys there are depends on ``algorithm``. Registered algorithms and reward terms are known, too.
        """
        classes = {name: recipe for name, (recipe, _) in ALGORITHMS.usable().items()}
        places, whole = models_json_schema(
            [(each, "validation") for each in classes.values()], schema_generator=FileSchema
        )
        parts = whole["$defs"]
        for name, recipe in classes.items():
            keys = parts[str(places[recipe, "validation"]["$ref"]).rpartition("/")[2]]["properties"]
            for key in keys.keys() & MEANINGS.keys():
                keys[key] = {"description": MEANINGS[key], **keys[key]}
            keys["algorithm"]["const"] = name
        weight = {"type": "number", "minimum": 0, "description": "weight of a registered term"}
        properties = parts["RewardParams"]["properties"]
        properties |= {name: weight for name in setting_names() if name not in properties}
        ways = [
            {
                "if": {"properties": {"algorithm": {"const": name}}, "required": ["algorithm"]},
                "then": places[recipe, "validation"],
            }
            for name, recipe in classes.items()
        ]
        return FileSchema.publish(
            {
                "title": "Recipe",
                "description": "A training set-up: everything that shapes a policy.",
                "type": "object",
                "required": ["algorithm"],
                "properties": {
                    "algorithm": {"enum": [*classes], "description": "how it learns; decides which keys there are"}
                },
                "allOf": ways,
                "$defs": parts,
            }
        )


# Modes: what a recipe says of learning several networks and a gate.


class Shares(FileModel):
    """Of all updates, the share of each stage; together they are 1."""

    alone: Fraction  # the first network, in all worlds
    further: Fraction  # each of the others in the worlds of its own mode, one after the other
    gate: Fraction  # the gate between them
    together: Fraction  # all networks and the gate, each network where the gate chooses it

    @model_validator(mode="after")
    def _everything(self) -> Shares:
        total = self.alone + self.further + self.gate + self.together
        if not abs(total - 1.0) <= 1e-9:
            raise ValueError(f"alone, further, gate and together are {total:g} in all; must be 1")
        return self


class ModesPlan(FileModel):
    """How many networks, how the worlds of each further one are found, and how the gate between them learns."""

    networks: Annotated[int, Field(ge=2, le=16)]
    gate: Layers  # hidden layers
    worlds: Annotated[int, Field(ge=1, le=1_000_000)]  # in which a mode is looked for
    templates: Annotated[int, Field(ge=1, le=100_000)]  # drawn in each of them
    gain: NonNegative  # return by which a template must be better than all networks before to be imitated
    margin: Positive  # return by which a network may be worse than those before in a world of its own
    imitation_epochs: Annotated[int, Field(ge=1, le=1000)]
    gate_states: Annotated[int, Field(ge=1, le=1_000_000)]  # in each update, at which networks are compared
    gate_memory: Annotated[int, Field(ge=1, le=1_000_000)]  # of them that are remembered
    gate_steps: Annotated[int, Field(ge=1, le=100_000)]  # of its optimiser in each update
    tie_break: NonNegative  # of the harm by the other count, added to minus the return when networks are compared
    together_rate: Rate  # share of the learning rate in the last stage
    shares: Shares


class PpoRecipe(TrainingRecipe):
    """PPO: collect ``n_steps`` decisions of every learner, then go through them ``n_epochs`` times."""

    schemes = get_args(Scheme)
    most_decisions = 2**24

    algorithm: Literal["ppo"]
    batch_size: Annotated[int, Field(ge=2)]
    n_steps: Annotated[int, Field(ge=2)]
    n_epochs: Annotated[int, Field(ge=1, le=1000)]
    gae_lambda: Fraction
    clip_range: Rate
    ent_coef: NonNegative
    vf_coef: NonNegative
    max_grad_norm: Positive
    target_kl: Positive | None = None
    turns: Annotated[int, Field(ge=1, le=1000)] | None = None  # of independent learners; None: all learn at once
    network: NetworkShape

    @model_validator(mode="after")
    def _keys_fit(self) -> PpoRecipe:
        if self.turns is not None and self.scheme != "independent":
            refuse(("turns",), self.turns, "is for scheme: independent only; leave it out")
        rollout = self.n_envs * self.n_steps
        if rollout % self.batch_size:
            refuse(("batch_size",), self.batch_size, f"must divide n_envs x n_steps = {rollout}")
        return self

    def check_learners(self, learners: int) -> None:
        """Every turn needs an update of its own."""
        updates = -(-self.total_steps // (self.n_envs * learners * self.n_steps))
        if self.turns is not None and self.turns * learners > updates:
            raise InvalidInput(
                f"recipe {self.name!r}: turns = {self.turns}: {learners} learners need {self.turns * learners}"
                f" updates, total_steps = {self.total_steps} are {updates}"
            )


class SacRecipe(TrainingRecipe):
    """SAC: collect ``steps_per_update`` decisions of every learner, then ``gradient_steps`` steps from the memory."""

    algorithm: Literal["sac"]
    batch_size: Annotated[int, Field(ge=2)]
    steps_per_update: Annotated[int, Field(ge=1, le=10_000)] = 1
    gradient_steps: Annotated[int, Field(ge=1, le=100_000)] = 1
    buffer_size: Annotated[int, Field(ge=1, le=10_000_000)]
    learning_starts: Annotated[int, Field(ge=0)]
    tau: Rate
    ent_coef: float | str = "auto"
    initial_ent_coef: Positive = 1.0  # where an automatic one starts
    target_entropy: Annotated[float, Field(allow_inf_nan=False)] | None = None  # None: -1 per action
    target_update_interval: Annotated[int, Field(ge=1)] = 1
    network: SquashedShape
    log_every_updates: Annotated[int, Field(ge=1)]

    @field_validator("ent_coef", mode="plain")
    @classmethod
    def _automatic_or_fixed(cls, value: Any) -> float | str:
        if value == "auto":
            return "auto"
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise ValueError("must be auto or a number of at least 0")
        return float(value)

    @model_validator(mode="after")
    def _room_for_everybody(self) -> SacRecipe:
        if not self.buffer_size >= self.n_envs:
            refuse(("buffer_size",), self.buffer_size, f"must be at least n_envs = {self.n_envs}")
        return self

    @property
    def rounds(self) -> int:
        """Decisions of each learner between two updates."""
        return self.steps_per_update

    @property
    def update_ratio(self) -> float:
        """Gradient steps per decision of one learner in each world."""
        return self.gradient_steps / (self.n_envs * self.steps_per_update)


Steps = Annotated[int, Field(ge=1, le=1000)]
_NO_SHAPING = "must be 0: what is tried is played to the end, where shaping tells nothing more"


Focus = Annotated[float, Field(ge=0.0, le=0.99, exclude_if=not_)]
PolicyName = Annotated[str, Field(pattern=r"^[a-z]+@.+$", max_length=4096)]


class CounterfactualRecipe(TrainingRecipe):
    """Try ``counterfactuals`` of the ``n_envs x n_steps`` decisions of a round otherwise, then learn from all of them.

    ``start`` names a policy to go on from; without one it begins with random weights. ``ppo@shipped`` is the policy
    that ships for the scenario, and random weights where none does; ``Training.begins`` tells which.
    """

    most_decisions = 2**22

    algorithm: Literal["counterfactual"]
    start: Annotated[str, Field(pattern=r"^(ppo|counterfactual|universal)@.+$", max_length=4096)] | None = None
    n_steps: Annotated[int, Field(ge=1)]
    counterfactuals: Annotated[int, Field(ge=1)]
    offset: OffsetRange
    holds: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1, max_length=16)]
    gradient_limit: Positive | Literal["auto"]
    trust_radius: Rate
    anchor: Positive
    n_epochs: Annotated[int, Field(ge=1, le=1000)]
    batch_size: Annotated[int, Field(ge=2)]
    averaging: Averaging
    focus: Focus = 0.0  # share of what is tried that a scout chooses
    network: ActorShape
    modes: Annotated[ModesPlan | None, Field(exclude_if=not_)] = None  # several networks and a gate

    @field_validator("gradient_limit", mode="wrap")
    @classmethod
    def _automatic_or_fixed(cls, value: Any, check: Callable[[Any], Any]) -> Any:
        with suppress(ValueError):
            return check(value)
        raise ValueError("must be auto or a finite number above 0")

    @model_validator(mode="after")
    def _keys_fit(self) -> CounterfactualRecipe:
        if self.reward.shaping > 0.0:
            refuse(("reward", "shaping"), self.reward.shaping, _NO_SHAPING)
        visited = self.n_envs * self.n_steps
        if not self.counterfactuals <= visited:
            refuse(("counterfactuals",), self.counterfactuals, f"must be at most n_envs x n_steps = {visited}")
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """The actor alone, or several and a gate."""
        modes = self.modes
        several = {} if modes is None else {"networks": modes.networks, "gate_hidden": modes.gate}
        return self.network.spec(observation_size, **several)

    def check_learners(self, learners: int) -> None:
        """Several networks are for one learner: a mode of several would have to be chosen by all of them at once."""
        if self.modes is not None and learners != 1:
            raise InvalidInput(f"recipe {self.name!r}: modes: are for one learner, not for {learners}; leave modes out")


class OptionsRecipe(TrainingRecipe):
    """Try ``tried`` of the ``n_envs x n_steps`` decisions of a round with several actions each; learn to choose.

    The actions of the policy are ``network.choices``, evenly from -1 to 1, and those of the policies ``among`` which it
    chooses too. Tried are the one that it takes, one below and one above it in each of the distances ``near``, the
    actions ``fixed``, and ``drawn`` ones: of the policies, or of the actions where there are none.
    """

    most_decisions = 2**22

    algorithm: Literal["options"]
    among: Annotated[tuple[PolicyName, ...], Field(strict=False, max_length=16, exclude_if=not_)] = ()
    n_steps: Annotated[int, Field(ge=1)]
    tried: Annotated[int, Field(ge=1)]
    near: Annotated[tuple[OffsetRange, ...], Field(strict=False, max_length=8)]
    fixed: Annotated[tuple[Annotated[float, Field(ge=-1.0, le=1.0)], ...], Field(strict=False, max_length=16)]
    drawn: Annotated[int, Field(ge=0, le=16)]
    holds: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1, max_length=16)]
    largest_cost: Positive
    caution: Annotated[float, Field(ge=0.0, allow_inf_nan=False, exclude_if=not_)] = 0.0
    tie_break: Annotated[float, Field(ge=0.0, allow_inf_nan=False, exclude_if=not_)] = 0.0
    relative: Annotated[bool, Field(exclude_if=not_)] = False
    focus: Focus = 0.0  # share of what is learned from that is drawn by what there is to lose
    guide: NonNegative
    memory: Annotated[int, Field(ge=1, le=500_000)]
    gradient_steps: Annotated[int, Field(ge=1, le=100_000)]
    batch_size: Annotated[int, Field(ge=2)]
    averaging: Averaging
    network: ChoosingShape

    @model_validator(mode="after")
    def _keys_fit(self) -> OptionsRecipe:
        if self.reward.shaping > 0.0:
            refuse(("reward", "shaping"), self.reward.shaping, _NO_SHAPING)
        visited = self.n_envs * self.n_steps
        if not self.tried <= visited:
            refuse(("tried",), self.tried, f"must be at most n_envs x n_steps = {visited}")
        if not self.memory >= self.tried:
            refuse(("memory",), self.memory, f"must be at least tried = {self.tried}")
        if not self.others:
            refuse(("near",), list(self.near), "must hold a range where there are neither fixed nor drawn actions")
        return self

    @property
    def others(self) -> int:
        """How many actions are tried beside the one that the policy takes."""
        return 2 * len(self.near) + len(self.fixed) + self.drawn

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """The actor, with the policies among which it chooses."""
        several = {"observation_size": observation_size, "value_hidden": ()}
        among = tuple(each.manifest.network.model_copy(update=several) for each in self.policies)
        return self.network.spec(observation_size, among=among)

    @cached_property
    def policies(self) -> tuple[Policy, ...]:
        """Those among which it chooses, read once; raises ``InvalidInput`` naming one that cannot be taken.

        One that itself chooses among policies stands for those.
        """
        found: list[Policy] = []
        for name in self.among:
            kind, _, path = name.partition("@")
            policy = load_named_policy(path)
            where, by = f"recipe {self.name!r}: among: {name}", policy.manifest.algorithm
            if path == SHIPPED or kind not in ("policy", by):
                raise InvalidInput(f"{where}: give policy@shipped/NAME, or {by}@ and its path")
            found += policy.among or [policy]
        if found and not self.drawn <= len(found):
            raise InvalidInput(f"recipe {self.name!r}: drawn = {self.drawn}: must be at most the {len(found)} of among")
        return tuple(found)


# The names of the learning algorithms, each with the class of its recipes and the algorithm itself.

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


def register_algorithm(name: str, recipe: type[TrainingRecipe], algorithm: type[Any] | str) -> None:
    """Make ``algorithm: name`` a recipe that can be read, trained, stopped and resumed.

    An installed package does the same with an entry point of the group ``ethbrake_marl.algorithms``: a ``Part`` of
    both.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        recipe: the class of its recipes, made from ``learning.training.TrainingRecipe``; it checks the YAML file.
        algorithm: the class of the algorithm, made from ``learning.training.Algorithm``; or ``"module:class"``, so
            that recipes are read without importing it, since torch takes seconds.

    Raises ``InvalidInput`` for a name that is taken or is no such name, or a class that lacks what is needed.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"algorithm {name!r:.80}: must be 1 to 64 of a-z, 0-9, - and _, not beginning with - or _")
    if not (isinstance(recipe, type) and hasattr(recipe, "network_spec")):
        raise InvalidInput(f"algorithm {name!r}: recipe = {recipe!r:.80}: must be a class with network_spec")
    is_place = isinstance(algorithm, str) and ":" in algorithm
    if not (is_place or (isinstance(algorithm, type) and hasattr(algorithm, "build"))):
        raise InvalidInput(f"algorithm {name!r}: algorithm = {algorithm!r:.80}: must be a class with build")
    ALGORITHMS.add(name, (recipe, algorithm), lambda entry: entry == (recipe, algorithm))


ALGORITHMS: Registry[tuple[type[TrainingRecipe], type[Any] | str]] = Registry(
    "algorithm", "algorithms", register_algorithm
)
_PLACE = "ethbrake_marl.learning.algorithms:"
PPO, SAC = Part(PpoRecipe, f"{_PLACE}Ppo"), Part(SacRecipe, f"{_PLACE}Sac")
COUNTERFACTUAL = Part(CounterfactualRecipe, f"{_PLACE}Counterfactual")
OPTIONS = Part(OptionsRecipe, f"{_PLACE}Options")


def algorithm_names() -> tuple[str, ...]:
    """Every name, the package's own first."""
    return tuple(ALGORITHMS)


def load_recipe(name_or_path: str | Path) -> TrainingRecipe:
    """Read a shipped recipe by name (``ppo``) or a file by path (anything with a separator or ``.yaml``).

    Raises ``UnknownName`` with a suggestion, or ``InvalidInput`` with file, line, key, value and what would be right.
    """
    return _checked(TrainingRecipe.file(name_or_path))


def _checked(source: Path | Document) -> TrainingRecipe:
    document = source if isinstance(source, Document) else read_yaml(source)
    name = document.content.get("algorithm", "ppo") if isinstance(document.content, dict) else "ppo"
    if not isinstance(name, str) or name not in ALGORITHMS:
        where, right = document.where(("algorithm",)), f"one of {', '.join(ALGORITHMS)}"
        raise InvalidInput(f"{where}: algorithm = {flow_text(name, 60)}: must be {right}")
    shipped = f"; every key is in the shipped recipe {name}" if name in TrainingRecipe.shipped() else ""
    model = ALGORITHMS[name][0]
    wording = _RecipeWording(model, f"it is needed{shipped}")
    return read_model(document, model, wording, "of keys to values, for instance algorithm: ppo")


class _RecipeWording(Wording):
    def right(self, detail: ErrorDetails) -> str:
        """A policy to start from, in words."""
        right = "must be ppo@, counterfactual@ or universal@ and a policy, for instance ppo@shipped or ppo@runs/my-run"
        return right if (detail["type"], detail["loc"][-1:]) == ("string_pattern_mismatch", ("start",)) else ""

    def known(self, path: YamlPath) -> list[str]:
        """Registered terms have their weights beside the others."""
        return setting_names() if path[:-1] == ("reward",) else super().known(path)


# Meanings of the keys of a recipe, and the text of a new one: every key with its value and a comment.

MEANINGS = {
    "name": "equal to the file's name without .yaml",
    "title": "one line for lists",
    "description": "what it is for",
    "source": "where the values come from",
    "algorithm": "a registered name: ppo, sac, counterfactual, options",
    "scheme": "how several learners train together: single, shared, independent, centralised",
    "total_steps": "decisions of all learners",
    "n_envs": "worlds that are advanced together",
    "learning_rate": "of the optimiser, from its start to its end",
    "gamma": "discount of one time step; equal to reward.shaping_discount",
    "reward": "weights and constants of the reward's terms (docs/reference/rewards.md)",
    "observation": "groups and features that learners observe, [own, front_1, rear_1]; left out: the scenario's",
    "horizon_is_end": "true: nothing is expected beyond the horizon",
    "seed": "of worlds, networks and exploration",
    "evaluation": "the fixed list on which the policy is measured while it learns, and how often",
    "checkpoint_every_updates": "updates between two checkpoints",
    "batch_size": "decisions in one step of the optimiser",
    "network": "hidden layers of the actor, and of the critic if there is one, and their activation",
    "ent_coef": "weight of the policy's entropy; sac: auto, or a number",
    "n_steps": "decisions of each world between two updates",
    "n_epochs": "how often an update goes through what was collected",
    "gae_lambda": "memory of the advantages, from 0 (one step) to 1 (all)",
    "clip_range": "how far the probability of an action may move in one update",
    "vf_coef": "weight of the critic's loss",
    "max_grad_norm": "longest gradient",
    "target_kl": "an update stops beyond this divergence",
    "turns": "rounds in which independent learners learn one after the other",
    "steps_per_update": "decisions of each world between two updates",
    "gradient_steps": "steps of the optimiser in one update",
    "buffer_size": "decisions that the replay memory holds",
    "learning_starts": "decisions before the first update",
    "tau": "share by which the target critic follows in one update",
    "initial_ent_coef": "where an automatic ent_coef starts",
    "target_entropy": "what an automatic ent_coef keeps; without it -1 per action",
    "target_update_interval": "updates between two of the target critic",
    "start": "a policy to go on from, ppo@shipped (random weights where none ships); left out: random weights",
    "counterfactuals": "how many of the decisions of a round are tried in two ways",
    "offset": "how far an action is moved to see what comes of it; the logarithm of what is drawn is uniform",
    "holds": "for how many steps an action is tried, one of these",
    "gradient_limit": "a larger gradient, at a jump, counts as this one; return per action; auto: as measured",
    "trust_radius": "farthest that one update asks an action to move",
    "anchor": "how much an action that makes no difference holds to where it is",
    "averaging": "share of itself that the average of the weights, which drives, keeps in each gradient step",
    "focus": "share drawn where a choice matters most: of what is tried, by a scout; in options of what is learned",
    "modes": "several networks and a gate between them; left out: one network",
    "tried": "how many of the decisions of a round are tried with other actions",
    "near": "ranges of distances to the action taken, each tried below and above it; the logarithm drawn is uniform",
    "fixed": "actions tried at each of these decisions, from -1 (full braking) to 1; the nearest of the choices is",
    "drawn": "how many more are tried there: of the policies among, or where there are none of the choices",
    "among": "policies of which one can act at each decision; one that chooses among others stands for them",
    "tie_break": "weight of the whole line's harm in the other count, beside the reward",
    "relative": "true: in a mixture, costs count beside the usual ones of the same scenario",
    "caution": "how many times the excess over full braking from there on counts besides, at the end; it grows from 0",
    "largest_cost": "an action that costs more than this beyond the best one counts as this much more",
    "guide": "weight of the convex part of the loss, without which learning can stand still at the beginning",
    "memory": "how many decisions are learned from: the last ones at which the tried actions differ in cost",
    "log_every_updates": "updates between two rows of the progress table",
    # of the keys inside others: for the documentation
    "learning_rate.schedule": "end + (start - end) (1 + cos(pi p)) / 2, where p is the share of steps done",
    "network.policy": "hidden layers of the actor",
    "network.value": "hidden layers of the critic; sac: of each of its two",
    "network.initial_log_std": "logarithm of the exploration noise at the start",
    "network.choices": "how many actions, evenly from -1 to 1, the network scores",
    "network.initial_action": "about what the network does at first, [-1, 1]; left out: 0, which coasts",
    "modes.networks": "how many",
    "modes.gate": "hidden layers of the gate",
    "modes.worlds": "worlds of the training in which a mode is looked for",
    "modes.templates": "how many templates are drawn in each of them",
    "modes.gain": "return by which a template must be better than every network before, to be imitated",
    "modes.margin": "return by which a network may be worse than those before it in a world of its own",
    "modes.imitation_epochs": "how often the shown decisions are gone through",
    "modes.gate_states": "decisions of an update at which the networks are compared",
    "modes.gate_memory": "how many compared decisions are remembered",
    "modes.gate_steps": "steps of the gate's optimiser in each update",
    "modes.tie_break": "weight of the other count's harm in that comparison",
    "modes.together_rate": "share of the learning rate in the last stage, where noise undoes what was learned",
    "modes.shares": "share of all updates that each stage has, 1 in all",
}


# Settings ``key=value``: which are the scenario's and which the recipe's, and what belongs together.

_NO_SETTING = {"name", *WORDS}  # they tell about a file, and change nothing


class Settings(NamedTuple):
    """What is asked for."""

    texts: tuple[str, ...]  # as they were given
    scenario: tuple[Override, ...]
    recipe: tuple[Override, ...]
    harm_count: HarmCount = "first"  # that agents minimise
    measures: tuple[str, ...] = ()  # that an evaluation tells beside the usual ones

    def change(self, recipe: TrainingRecipe, tell: Callable[[str], None] | None = None) -> TrainingRecipe:
        """The recipe with those of its settings that it has; ``tell`` hears what else may have to be changed."""
        own = [override for override in self.recipe if override.top in type(recipe).model_fields]
        if not own:
            return recipe
        changed = recipe.replace(**Override.put(recipe.model_dump(mode="json"), own))
        together = {"gamma": changed.gamma, "reward.shaping_discount": changed.reward.shaping_discount}
        given = [key for key in together if key in {override.key for override in own}]
        if tell is not None and len(given) == 1 and len({*together.values()}) > 1:
            (key,), (other,) = given, together.keys() - set(given)
            tell(
                f"note: {key} = {together[key]:g}, but {other} stays {together[other]:g}: shaping leaves the best"
                f" policy as it is only where both are equal (--set {other}={together[key]:g})"
            )
        return changed


def read_settings(
    texts: Sequence[str] | None, recipes: Sequence[TrainingRecipe] = (), *, of_agents: Sequence[str] = ()
) -> Settings:
    """Tell the settings apart: ``mass_t=40`` and ``scenario.mass_t=40`` are the scenario's, ``gamma=0.9`` a recipe's.

    ``of_agents``: which of ``harm_count=total`` and ``measures=A,B`` may stand among them. Raises ``UnknownName`` with
    a suggestion for a key that nobody has, ``InvalidInput`` for an unknown count.
    """
    known = {
        "scenario": {*Scenario.model_fields} - _NO_SETTING,
        "recipe": {key for recipe in recipes for key in type(recipe).model_fields} - _NO_SETTING,
        "agents": {*of_agents},
    }
    found: dict[str, list[Override]] = {owner: [] for owner in known}
    for override in Override.parse(texts or ()):
        if override.top == "recipe" and len(override.path) > 1 and not recipes:
            raise InvalidInput(f"--set {override.key}: this command takes no recipe, so nothing of one can be set")
        whose = [override.top] if override.top in known and len(override.path) > 1 else [*known]
        inside = override.inside() if whose == [override.top] else override
        owners = [each for each in whose if inside.top in known[each]]
        if not owners:
            raise unknown_name("setting", inside.top, {key for each in whose for key in known[each]})
        if len(owners) > 1:
            raise InvalidInput(f"--set {override.key}: write scenario.{override.key} or recipe.{override.key}")
        found[owners[0]].append(inside)
    asked = {each.top: each.value for each in found["agents"]}
    check_harm_count(count := asked.get("harm_count", "first"))
    measures = asked.get("measures", "")
    if not isinstance(measures, str) or ("measures" in asked and not measures):
        raise InvalidInput("--set measures: must be names with commas between them, for instance measures=injury")
    return Settings(
        tuple(texts or ()),
        tuple(found["scenario"]),
        tuple(found["recipe"]),
        count,
        tuple(split_names(measures)) if measures else (),
    )


# The folder of a run: its files, its configuration, how far it came, and who may train in it.

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
    if name == "universal" and path.partition("/universal")[0] != SHIPPED:
        raise InvalidInput(f"agent {spec!r}: must be universal@{SHIPPED}; for another policy: ppo@PATH or sac@PATH")
    if not ships and (name == "team" or (name != "universal" and RunDirectory(Path(path)).is_team)):
        vehicles = None if settings.role is None else (settings.role,)
        agent = RunDirectory(Path(path)).load_team(settings.needed_scenario(), spec, vehicles)
        first: Any = agent.drivers[min(agent.drivers)]
        policy: Policy = first.policy
    else:
        kind, known = "policy" if name == "team" else name, settings.scenario
        if path == SHIPPED:
            path = f"{SHIPPED}/{shipped_name(kind, known, settings.harm_count)}"
        policy = load_named_policy(path, kind, known, settings.harm_count)
        agent = LearnedAgent(policy, name=spec if path == f"{SHIPPED}/{kind}" else f"{kind}@{path}")
    trained_by = policy.manifest.algorithm
    if name in ("ppo", "sac", "counterfactual", "options") and name != trained_by:
        raise InvalidInput(
            f"agent '{name}@{path}': that policy was trained by {trained_by.upper()}: {trained_by}@{path}"
        )
    return agent


# What this package's entry points name (pyproject.toml).

PPO_AGENT, SAC_AGENT = (
    Part(
        make_policy_agent,
        form=f"{name}@PATH",
        about=f"a policy trained by {name.upper()}: a run, a bundle, or shipped",
        knows=Source.MESSAGES,
    )
    for name in ("ppo", "sac")
)
COUNTERFACTUAL_AGENT = Part(
    make_policy_agent,
    form="counterfactual@PATH",
    about="a policy trained by counterfactuals: a run or a bundle",
    knows=Source.MESSAGES,
)
OPTIONS_AGENT = Part(
    make_policy_agent,
    form="options@PATH",
    about="a policy trained by options: a run, a bundle, or shipped",
    knows=Source.MESSAGES,
)
POLICY = Part(
    make_policy_agent,
    form="policy@PATH",
    about="a policy, whatever trained it: a run, a bundle, or shipped, the best for scenario and harm",
    knows=Source.MESSAGES,
)
UNIVERSAL = Part(
    make_policy_agent, form="universal@shipped", about="the shipped policy for every scenario", knows=Source.MESSAGES
)
TEAM = Part(
    make_policy_agent,
    form="team@RUN",
    about="the learners of a run, each as it was trained, or shipped",
    knows=Source.MESSAGES,
)
