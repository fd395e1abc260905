"""``TrainingRecipe``: the settings of a training, from a YAML file; and the recipes of PPO and SAC."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from operator import not_
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import Field, field_validator, model_validator

from ethbrake_marl.episode.features import listed_features
from ethbrake_marl.episode.reward import RewardParams, registered_terms
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.model import (
    NAME_PATTERN,
    FileModel,
    NonNegative,
    Positive,
    Wording,
    read_model,
    refuse,
    require,
)
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text, read_yaml
from ethbrake_marl.policies.network import Activation, NetworkSpec
from ethbrake_marl.registry import Registry
from ethbrake_marl.worlds.catalogue import shipped_folder
from ethbrake_marl.worlds.scenario import plain

Scheme = Literal["single", "shared", "independent", "centralised"]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Rate = Annotated[float, Field(gt=0.0, le=1.0)]
LayerSizes = Annotated[
    tuple[Annotated[int, Field(ge=1, le=4096)], ...], Field(strict=False, min_length=1, max_length=8)
]

MOST_DECISIONS = 2**24  # of one update that fit into memory
ACTOR_LAYERS = "hidden layers of the actor"
NETWORK = "hidden layers of actor and critic, and their activation"
BATCH_SIZE = "number of decisions in one step of the optimiser"


class LearningRate(FileModel):
    """Learning rate of the optimiser, which falls from ``start`` to ``end`` over the training."""

    start: Rate  # learning rate at the beginning
    end: Rate  # learning rate at the end
    schedule: Literal["cosine"] = Field(
        "cosine", description="learning rate after a fraction p of all steps: end + (start - end) (1 + cos(pi p)) / 2"
    )

    def at(self, remaining: float) -> float:
        """Learning rate ``end + (start - end) (1 + cos(pi p)) / 2`` with ``p = 1 - remaining``.

        ``remaining`` is the fraction (1 to 0) of the training's steps that remains.
        """
        progress = min(max(1.0 - remaining, 0.0), 1.0)
        return self.end + (self.start - self.end) * 0.5 * (1.0 + math.cos(math.pi * progress))


class NetworkShape(FileModel):
    """Hidden layers of actor and critics."""

    policy: LayerSizes = Field(description=ACTOR_LAYERS)
    value: LayerSizes = Field(description="hidden layers of each critic")
    activation: Activation = "relu"


class NoisyShape(NetworkShape):
    """Hidden layers of PPO's actor and critic, and the initial exploration noise."""

    initial_log_std: Annotated[float, Field(ge=-10.0, le=2.0)] = Field(
        0.0, description="logarithm of the standard deviation of the exploration noise at the start"
    )


class EvaluationPlan(FileModel):
    """Measurements of the policy during training, on a fixed list of worlds."""

    every_updates: Annotated[int, Field(ge=1)]  # number of updates between two measurements
    worlds: Annotated[int, Field(ge=1, le=1_000_000)]  # number of worlds in the fixed list
    seed: Annotated[int, Field(ge=0)]  # seed from which the worlds are drawn


class TrainingRecipe(FileModel):
    """The settings that all learning algorithms have; each algorithm has a subclass with further settings.

    An *update* collects decisions and learns from them. The text in ``Field(description=...)`` explains a key in new
    recipe files, in the JSON Schema and in the documentation.

    >>> import ethbrake_marl as eb
    >>> recipe = eb.load_recipe("ppo").replace(seed=3, total_steps=100_000)
    >>> recipe.algorithm, recipe.seed, recipe.total_steps
    ('ppo', 3, 100000)
    """

    schemes: ClassVar[tuple[Scheme, ...]] = ("single", "shared")  # schemes that the algorithm supports

    name: str = Field(pattern=NAME_PATTERN, description="equal to the file's name without .yaml")
    title: str = Field("", description="title in one line")
    description: str = Field("", description="what the recipe is for")
    source: str = Field("", description="where the values come from")
    scenario: str | None = Field(
        None,
        pattern=NAME_PATTERN,
        exclude_if=not_,
        description="name of the scenario on which `ethbrake train` and `ethbrake run` train, unless --scenario names"
        " another one; if missing, paper-random",
    )
    algorithm: str = Field(
        description="name of the learning algorithm: ppo, sac, or another registered one (ethbrake scenario list)"
    )
    scheme: Scheme | None = Field(  # None: single for one learner, shared for several
        None, description="how several learners train together: single, shared, independent, centralised"
    )
    total_steps: int = Field(ge=1, description="number of decisions of all learners together")
    n_envs: int = Field(ge=1, description="number of worlds that are simulated together")
    learning_rate: LearningRate = Field(description="learning rate of the optimiser, which falls from start to end")
    gamma: Fraction = Field(description="discount factor per time step; at most reward.shaping_discount")
    reward: RewardParams = Field(description="weights and constants of the reward's terms (episode/terms.py)")
    observation: Annotated[tuple[str, ...] | None, Field(strict=False, exclude_if=not_)] = Field(
        None,
        description="groups and features that learners observe, such as [own, front_1, rear_1]; if missing, the"
        " observation of the scenario is used",
    )
    horizon_is_end: bool = Field(
        True, description="whether the return ends at the horizon, instead of continuing with the critic's estimate"
    )
    seed: int = Field(0, ge=0, lt=2**32, description="seed of worlds, networks and exploration")
    evaluation: EvaluationPlan = Field(
        description="measurements of the policy during training: how often, and on which fixed list of worlds"
    )
    checkpoint_every_updates: int = Field(ge=1, description="number of updates between two checkpoints")

    @field_validator("reward")
    @classmethod
    def _something_to_learn(cls, value: RewardParams) -> RewardParams:
        if not any(weight for name, weight in value.weights.items() if name != "shaping"):
            raise ValueError(
                "all weights of the reward except shaping are 0, so there is nothing to learn; give at least one of"
                " these terms another weight"
            )
        return value

    @model_validator(mode="after")
    def _shaping_pays_rightly(self) -> Self:
        right = self.reward.right_gamma(self.gamma)
        require(not right, ("gamma",), self.gamma, right)
        return self

    @field_validator("observation", mode="before")
    @classmethod
    def _known_features(cls, value: Any) -> Any:
        if value is not None:
            try:
                listed_features(value)
            except InvalidInput as error:
                raise ValueError(str(error).removeprefix("observation: ")) from None
        return value

    @property
    def rounds(self) -> int:
        """Key ``n_steps``."""
        return int(vars(self)["n_steps"])

    @property
    def updates_per_row(self) -> int:
        return 1

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """An algorithm overrides this unless its actor has one action, clipped to [-1, 1]."""
        shape = vars(self)["network"]
        return NetworkSpec(
            observation_size=observation_size,
            policy_hidden=shape.policy,
            value_hidden=getattr(shape, "value", ()),
            activation=shape.activation,
            output="clip",
        )

    def replace(self, **changes: Any) -> Self:
        """Such as ``replace(seed=3)``. Raises the errors of ``load_recipe``."""
        content = {**self.model_dump(mode="json"), **{key: plain(value) for key, value in changes.items()}}
        changed = _check_recipe(Document(f"recipe {self.name!r}", content, {}))
        return changed  # type: ignore[return-value]  # another class only with another algorithm


class PpoRecipe(TrainingRecipe):
    """Recipe of PPO: an update collects ``n_steps`` decisions of every learner, and learns from them."""

    schemes = get_args(Scheme)

    algorithm: Annotated[str, Field(pattern="^ppo$")]
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    n_steps: int = Field(ge=2, description="number of decisions of each learner in each world between two updates")
    n_epochs: int = Field(ge=1, le=1000, description="number of passes over the collected decisions in one update")
    gae_lambda: Fraction = Field(
        description="lambda of generalised advantage estimation, from 0 (one step) to 1 (whole return)"
    )
    clip_range: Rate = Field(
        description="PPO's clip range: largest relative change of an action's probability in one update"
    )
    ent_coef: NonNegative = Field(description="weight of the policy's entropy in the loss")
    vf_coef: NonNegative = Field(description="weight of the critic's loss")
    max_grad_norm: Positive = Field(description="largest norm of the gradient; longer gradients are scaled down to it")
    target_kl: Positive | None = Field(None, description="KL divergence beyond which an update stops early")
    network: NoisyShape = Field(description=NETWORK)

    @model_validator(mode="after")
    def _keys_fit(self) -> Self:
        rollout = self.n_envs * self.n_steps
        if not rollout <= MOST_DECISIONS:
            right = f"n_envs x n_steps = {rollout} decisions per update are too many (at most {MOST_DECISIONS})"
            refuse(("n_envs",), self.n_envs, right)
        if rollout % self.batch_size:
            refuse(("batch_size",), self.batch_size, f"must divide n_envs x n_steps = {rollout}")
        return self


class SacRecipe(TrainingRecipe):
    """Recipe of SAC: an update stores ``steps_per_update`` decisions of every learner, and learns from stored ones."""

    algorithm: Annotated[str, Field(pattern="^sac$")]
    batch_size: int = Field(ge=2, description=BATCH_SIZE)
    steps_per_update: int = Field(
        1, ge=1, le=10_000, description="number of decisions of each learner in each world between two updates"
    )
    gradient_steps: int = Field(1, ge=1, le=100_000, description="number of steps of the optimiser in one update")
    buffer_size: int = Field(ge=1, le=10_000_000, description="largest number of decisions in the replay buffer")
    learning_starts: int = Field(ge=0, description="number of decisions before the first update")
    tau: Rate = Field(description="fraction by which the target critic moves towards the critic in one update")
    ent_coef: float | str = Field("auto", description="weight of the policy's entropy: a number, or auto (learned)")
    initial_ent_coef: Positive = Field(1.0, description="initial value of ent_coef if it is learned")
    target_entropy: Annotated[float, Field(allow_inf_nan=False)] | None = Field(
        None, description="entropy at which a learned ent_coef aims; if missing, -1 per action"
    )
    target_update_interval: int = Field(1, ge=1, description="number of updates between two moves of the target critic")
    network: NetworkShape = Field(description=NETWORK)
    log_every_updates: int = Field(ge=1, description="number of updates between two rows of progress.csv")

    @field_validator("ent_coef", mode="plain")
    @classmethod
    def _automatic_or_fixed(cls, value: Any) -> float | str:
        if value == "auto":
            return "auto"
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise ValueError("must be 'auto' or a finite number of at least 0")
        return float(value)

    @model_validator(mode="after")
    def _room_for_everybody(self) -> Self:
        if not self.buffer_size >= self.n_envs:
            refuse(("buffer_size",), self.buffer_size, f"must be at least n_envs = {self.n_envs}")
        return self

    @property
    def rounds(self) -> int:
        return self.steps_per_update

    @property
    def updates_per_row(self) -> int:
        return self.log_every_updates

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """A SAC policy is saved without critics."""
        return super().network_spec(observation_size).model_copy(update={"value_hidden": (), "output": "tanh"})


def shipped_recipes() -> dict[str, Path]:
    """Name -> file, also those of extensions."""
    files = sorted(shipped_folder("train").rglob("*.yaml"), key=lambda file: file.name)
    return {file.stem: file for file in files}


def usable_recipes() -> dict[str, Path]:
    """Name -> file of recipes whose algorithm is installed."""
    return {name: file for name, file in shipped_recipes().items() if _algorithm_in(read_yaml(file)) in ALGORITHMS}


def load_recipe(recipe: str | Path | Mapping[str, Any] | TrainingRecipe) -> TrainingRecipe:
    """Load a recipe by its name, by the path of its file, or from a file's content.

    A text that ends in ``.yaml`` or contains a path separator is a path; ``~`` is the home folder. Raises
    ``UnknownName`` for an unknown name, and ``InvalidInput`` for bad content.
    """
    if isinstance(recipe, TrainingRecipe):
        return recipe
    if isinstance(recipe, Mapping):
        return _check_recipe(Document("recipe", plain(recipe), {}))
    text, shipped = str(recipe), shipped_recipes()
    if Path(text).suffix in (".yaml", ".yml") or "/" in text or "\\" in text:
        return _check_recipe(read_yaml(Path(text).expanduser()))
    if text not in shipped:
        raise unknown_name("recipe", text, usable_recipes())
    return _check_recipe(read_yaml(shipped[text]), shipped[text])


def _algorithm_in(document: Document) -> object:
    return document.content.get("algorithm", "ppo") if isinstance(document.content, dict) else "ppo"


def _check_recipe(document: Document, shipped: Path | None = None) -> TrainingRecipe:
    """``shipped``: path of a shipped recipe, for the error message."""
    name = _algorithm_in(document)
    if not isinstance(name, str) or name not in ALGORITHMS:
        right = f"must be one of {', '.join(ALGORITHMS)}"
        if shipped is not None:
            right += f"; this algorithm belongs to the extension {shipped.parent.name}, which is not installed"
        raise InvalidInput(f"{document.where(('algorithm',))}: algorithm = {flow_text(name, 60)}: {right}")
    model = ALGORITHMS[name][0]
    example = f"; the shipped recipe {name} has all keys" if name in shipped_recipes() else ""
    wording = _RecipeWording(model, f"this key is required{example}")
    return read_model(document, model, wording, "of keys to values, for instance algorithm: ppo")


class _RecipeWording(Wording):
    def known(self, path: YamlPath) -> list[str]:
        inside = super().known(path)
        return [*inside, *registered_terms()] if path[:-1] == ("reward",) else inside


def register_algorithm(name: str, recipe: type[TrainingRecipe], algorithm: type[Any] | str) -> None:
    """Register a learning algorithm, which recipes select with ``algorithm: NAME``.

    A package may instead declare an entry point in the group ``ethbrake_marl.algorithms``: a ``Part`` with recipe class
    and algorithm.

    Args:
        name: 1 to 64 letters ``a-z``, digits, ``-`` and ``_``.
        recipe: class of the algorithm's recipes, which validates their YAML files.
        algorithm: a subclass of ``training.algorithm.Algorithm``, or the text ``"module:class"``; then the module (and
            torch, which takes seconds) is imported only when a training starts.

    Raises ``InvalidInput`` for an invalid name or class, and ``AlreadyExists`` if another algorithm has the name.

    """
    if not isinstance(name, str) or re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,63}", name) is None:
        raise InvalidInput(
            f"algorithm {name!r:.80}: the name must have 1 to 64 characters (a-z, 0-9, - and _), and must not begin"
            " with - or _"
        )
    if not (isinstance(recipe, type) and issubclass(recipe, TrainingRecipe)):
        raise InvalidInput(f"algorithm {name!r}: recipe = {recipe!r:.80}: must be a subclass of TrainingRecipe")
    is_place = isinstance(algorithm, str) and ":" in algorithm
    if not (is_place or (isinstance(algorithm, type) and hasattr(algorithm, "build"))):
        raise InvalidInput(
            f"algorithm {name!r}: algorithm = {algorithm!r:.80}: must be a class with the method build, or the text"
            " 'module:class' that says where this class is"
        )
    ALGORITHMS.add(name, (recipe, algorithm), lambda entry: entry == (recipe, algorithm))


ALGORITHMS: Registry[tuple[type[TrainingRecipe], type[Any] | str]] = Registry(
    "algorithm",
    "algorithms",
    register_algorithm,
    {"ppo": (PpoRecipe, "ethbrake_marl.training.ppo:Ppo"), "sac": (SacRecipe, "ethbrake_marl.training.sac:Sac")},
)


def algorithm_of(recipe: TrainingRecipe) -> Any:
    algorithm = ALGORITHMS[recipe.algorithm][1]
    return (resolve_name(algorithm) if isinstance(algorithm, str) else algorithm)()
