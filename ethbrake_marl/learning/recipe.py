"""A training set-up as one YAML file: everything that shapes a policy, checked before anything starts."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.messages import Wording, explain
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text, read_yaml
from ethbrake_marl.learning.registry import algorithm_names, recipe_class
from ethbrake_marl.policies.manifest import Activation, NetworkSpec, Width
from ethbrake_marl.rewards import RewardParams, setting_names
from ethbrake_marl.scenario.catalogue import shipped_folder
from ethbrake_marl.scenario.features import ListedFeatures, listed_features

WORDS = ("title", "description", "source")  # fields that tell about a recipe and change nothing

Scheme = Literal["single", "shared", "independent", "centralised"]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Rate = Annotated[float, Field(gt=0.0, le=1.0)]
Layers = Annotated[tuple[Width, ...], Field(strict=False, min_length=1, max_length=8)]


def _none(value: Any) -> bool:
    return value is None


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class LearningRate(_Part):
    """A learning rate that falls from ``start`` to ``end`` over the training."""

    start: Rate
    end: Rate
    schedule: Literal["cosine"] = "cosine"

    def at(self, remaining: float) -> float:
        """``end + (start - end) (1 + cos(pi p)) / 2`` with ``p = 1 - remaining``, the share of steps done."""
        done = min(max(1.0 - remaining, 0.0), 1.0)
        return self.end + (self.start - self.end) * 0.5 * (1.0 + math.cos(math.pi * done))


class NetworkShape(_Part):
    """Hidden layers of actor and critic, and the exploration noise they start with."""

    policy: Layers
    value: Layers
    activation: Activation = "relu"
    initial_log_std: Annotated[float, Field(ge=-10.0, le=2.0)] = 0.0

    def spec(self, observation_size: int) -> NetworkSpec:
        """The whole network for one action in [-1, 1]."""
        return NetworkSpec(
            observation_size=observation_size,
            action_size=1,
            policy_hidden=self.policy,
            value_hidden=self.value,
            activation=self.activation,
            output="clip",
        )


class SquashedShape(_Part):
    """Hidden layers of the actor and of each of the two critics; the actor's noise depends on what it sees."""

    policy: Layers
    value: Layers
    activation: Activation = "relu"

    def spec(self, observation_size: int) -> NetworkSpec:
        """What a bundle holds: the actor, whose squashed mean is the action. Critics stay in the checkpoints."""
        return NetworkSpec(
            observation_size=observation_size,
            action_size=1,
            policy_hidden=self.policy,
            value_hidden=(),
            activation=self.activation,
            output="tanh",
        )


class ActorShape(_Part):
    """Hidden layers of the actor, where there is no critic."""

    policy: Layers
    activation: Activation = "relu"
    initial_action: Annotated[float | None, Field(ge=-1.0, le=1.0, exclude_if=_none)] = None  # at first; None: 0

    def spec(self, observation_size: int) -> NetworkSpec:
        """What a bundle holds."""
        return NetworkSpec(
            observation_size=observation_size,
            action_size=1,
            policy_hidden=self.policy,
            value_hidden=(),
            activation=self.activation,
            output="clip",
        )


class OffsetRange(_Part):
    """How far an action is moved to see what comes of it; the logarithm of what is drawn is uniform."""

    smallest: Rate
    largest: Rate

    @field_validator("largest")
    @classmethod
    def _in_order(cls, value: float, info: ValidationInfo) -> float:
        if "smallest" in info.data and not value >= info.data["smallest"]:
            raise ValueError(f"must be at least smallest = {info.data['smallest']:g}")
        return value


class EvaluationPlan(_Part):
    """The fixed list on which the policy is measured while it learns."""

    every_updates: Annotated[int, Field(ge=1)]
    worlds: Annotated[int, Field(ge=1, le=1_000_000)]
    seed: Annotated[int, Field(ge=0)]


class TrainingRecipe(_Part):
    """How to train, whatever the algorithm: its name, reward, seed, and what is saved and measured on the way.

    An update is one round of collecting and learning. The recipes of an algorithm are a class made from this one.

    >>> import ethbrake_marl as eb
    >>> recipe = eb.load_recipe("ppo").replace(seed=3, total_steps=100_000)
    >>> recipe.algorithm, recipe.seed, recipe.total_steps
    ('ppo', 3, 100000)

    """

    schemes: ClassVar[tuple[Scheme, ...]] = ("single", "shared")  # under which the algorithm can learn

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")  # equal to the file's without .yaml
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
    observation: Annotated[ListedFeatures | None, Field(exclude_if=_none)] = None  # of learners; None: the scenario's
    horizon_is_end: bool = False  # nothing is expected beyond the horizon
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

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """The network of the policy's bundle."""
        raise NotImplementedError

    @property
    def rounds(self) -> int:
        """Decisions of each learner between two updates."""
        raise NotImplementedError

    @property
    def logged_updates(self) -> int:
        """Updates between two rows of the progress table."""
        return 1

    @property
    def facts(self) -> dict[str, Any]:
        """What follows from the recipe and is worth a key of ``config.json``."""
        return {}

    def check_learners(self, learners: int) -> None:
        """Raise ``InvalidInput`` where the recipe does not fit a line with that many learners."""

    def replace(self, **changes: Any) -> Self:
        """The same recipe with other values in some fields, checked again; raises ``InvalidInput``."""
        content = {**self.model_dump(mode="json"), **changes}
        changed = _checked(Document(f"recipe {self.name!r}", content, {}))
        assert isinstance(changed, type(self)) or "algorithm" in changes
        return changed  # type: ignore[return-value]  # of another class only if another algorithm was asked for


def load_recipe(name_or_path: str | Path) -> TrainingRecipe:
    """Read a shipped recipe by name (``ppo``) or a file by path (anything with a separator or ``.yaml``).

    Raises ``UnknownName`` with a suggestion, or ``InvalidInput`` with file, line, key, value and what would be right.
    """
    return _checked(read_yaml(recipe_path(name_or_path)))


def recipe_path(name_or_path: str | Path) -> Path:
    """The file of a recipe, a shipped name or any path; it need not exist. Raises ``UnknownName`` with a suggestion."""
    text = str(name_or_path)
    if Path(text).suffix in (".yaml", ".yml") or "/" in text or "\\" in text:
        return Path(text)
    shipped = shipped_recipes()
    if text not in shipped:
        raise unknown_name("recipe", text, shipped)
    return shipped[text]


def shipped_recipes() -> dict[str, Path]:
    """Name -> file of every recipe that comes with the package: the checkout's ``train/``, or the installed copy."""
    return {file.stem: file for file in sorted(shipped_folder("train", "recipes").glob("*.yaml"))}


def recipe_of(content: str) -> TrainingRecipe:
    """The recipe that ``model_dump(mode="json")`` wrote, from its JSON text; raises ``InvalidInput``."""
    return _checked(Document("recipe", json.loads(content), {}))


def _checked(document: Document) -> TrainingRecipe:
    content = document.content
    if not isinstance(content, dict):
        raise InvalidInput(f"{document.file}: must be a mapping of keys to values, for instance algorithm: ppo")
    name = content.get("algorithm", "ppo")
    if not isinstance(name, str) or name not in algorithm_names():
        where, right = document.where(("algorithm",)), " or ".join(algorithm_names())
        raise InvalidInput(f"{where}: algorithm = {flow_text(name, 60)}: must be {right}")
    model: type[TrainingRecipe] = recipe_class(name)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise explain(error, document, RecipeWording(name, model)) from None


class RecipeWording(Wording):
    """The ``Wording`` of messages about a recipe of one algorithm."""

    def __init__(self, algorithm: str, model: type[TrainingRecipe]) -> None:
        self._algorithm, self._model = algorithm, model

    def known(self, path: YamlPath) -> list[str]:
        """The keys of the part in which ``path`` ends."""
        model: type[BaseModel] = self._model
        for part in path[:-1]:
            annotation = model.model_fields[str(part)].annotation
            for inner in (annotation, *get_args(annotation)):  # a part that may be left out is "that part, or None"
                if isinstance(inner, type) and issubclass(inner, BaseModel):
                    model = inner
        return setting_names() if model is RewardParams else list(model.model_fields)

    def needed(self, path: YamlPath) -> str:
        """Where an example stands."""
        shipped = self._algorithm in shipped_recipes()
        return f"it is needed; every key is in the shipped recipe {self._algorithm}" if shipped else "it is needed"
