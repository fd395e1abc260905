"""``TrainingRecipe``: the settings of a training run, read from a YAML file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from operator import not_
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator
from pydantic.json_schema import models_json_schema

from ethbrake_marl.errors import InvalidInput, new_name, unknown_name
from ethbrake_marl.files.json_schema import FileSchema, schema_lines
from ethbrake_marl.files.model import NAME_PATTERN, FileModel, Wording, read_model, refuse
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text, read_yaml
from ethbrake_marl.first_edition.game.features import ListedFeatures, listed_features
from ethbrake_marl.first_edition.game.measures import MEASURES
from ethbrake_marl.first_edition.game.rewards import RewardParams, setting_names
from ethbrake_marl.first_edition.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.first_edition.scenario.catalogue import check_file_name, shipped_folder
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.registry import Registry

WORDS = ("title", "description", "source")  # descriptive fields that do not affect a training

Scheme = Literal["single", "shared", "independent", "centralised"]

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]

NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

Rate = Annotated[float, Field(gt=0.0, le=1.0)]

ACTOR_LAYERS = "hidden layers of the actor"

Layers = Annotated[tuple[Annotated[int, Field(ge=1, le=4096)], ...], Field(strict=False, min_length=1, max_length=8)]


class LearningRate(FileModel):
    """Learning rate of the optimiser, which falls from ``start`` to ``end`` over the training."""

    start: Rate  # learning rate at the beginning
    end: Rate  # learning rate at the end
    schedule: Literal["cosine"] = Field(
        "cosine", description="learning rate after a fraction p of all steps: end + (start - end) (1 + cos(pi p)) / 2"
    )

    def at(self, remaining: float) -> float:
        """Return the learning rate ``end + (start - end) (1 + cos(pi p)) / 2`` with ``p = 1 - remaining``.

        ``remaining`` is the fraction (1 to 0) of the training's steps that is not yet done.
        """
        done = min(max(1.0 - remaining, 0.0), 1.0)
        return self.end + (self.start - self.end) * 0.5 * (1.0 + math.cos(math.pi * done))


class Shape(FileModel):
    """Base class for the value of a recipe's key ``network``, which describes the networks to train.

    A subclass declares the keys inside ``network`` as fields. A subclass needs the fields ``policy`` (sizes of the
    actor's hidden layers, such as ``[64, 64]``) and ``activation``, unless it overrides ``spec``.
    """

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """Return the description of the network in a policy bundle: an actor with one action in [-1, 1].

        ``observation_size`` is the number of features of an observation. ``more`` has fields of the returned
        ``NetworkSpec`` that differ from their default values, such as ``output="tanh"``.
        """
        shape: Any = self  # subclasses declare the fields
        fields = {"policy_hidden": shape.policy, "value_hidden": (), "activation": shape.activation, "output": "clip"}
        return NetworkSpec(observation_size=observation_size, action_size=1, **(fields | more))


class NetworkShape(Shape):
    """Hidden layers of actor and critic, and the initial exploration noise."""

    policy: Layers = Field(description=ACTOR_LAYERS)
    value: Layers = Field(description="hidden layers of the critic")
    activation: Activation = "relu"
    initial_log_std: Annotated[float, Field(ge=-10.0, le=2.0)] = Field(
        0.0, description="logarithm of the standard deviation of the exploration noise at the start"
    )

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """Return the description of an actor and a critic; see ``Shape.spec``."""
        return super().spec(observation_size, value_hidden=self.value, **more)


class EvaluationPlan(FileModel):
    """Measurements of the policy during training, on a fixed list of worlds."""

    every_updates: Annotated[int, Field(ge=1)]  # number of updates between two measurements
    worlds: Annotated[int, Field(ge=1, le=1_000_000)]  # number of worlds in the fixed list
    seed: Annotated[int, Field(ge=0)]  # seed from which the worlds are drawn


class TrainingRecipe(FileModel):
    """Settings of a training run that all algorithms have: algorithm, reward, seed, checkpoints and measurements.

    An *update* is one round of collecting decisions and learning from them. Each algorithm has a subclass of this
    class, with further keys. The text in ``Field(description=...)`` explains a key in new recipe files, in the JSON
    Schema and in the documentation.

    >>> import ethbrake_marl.first_edition as eb
    >>> recipe = eb.load_recipe("ppo").replace(seed=3, total_steps=100_000)
    >>> recipe.algorithm, recipe.seed, recipe.total_steps
    ('ppo', 3, 100000)

    """

    schemes: ClassVar[tuple[Scheme, ...]] = ("single", "shared")  # schemes that the algorithm supports
    most_decisions: ClassVar[float] = math.inf  # largest number of decisions per update that fits into memory

    name: str = Field(pattern=NAME_PATTERN, description="equal to the file's name without .yaml")
    title: str = Field("", description="title in one line")
    description: str = Field("", description="what the recipe is for")
    source: str = Field("", description="where the values come from")
    algorithm: str = Field(
        description="name of the learning algorithm: ppo, sac, or another registered one (ethbrake scenario parts)"
    )
    scheme: Scheme | None = Field(  # None: single for one learner, shared for several
        None, description="how several learners train together: single, shared, independent, centralised"
    )
    total_steps: int = Field(ge=1, description="number of decisions of all learners together")
    n_envs: int = Field(ge=1, description="number of worlds that are simulated together")
    learning_rate: LearningRate = Field(description="learning rate of the optimiser, which falls from start to end")
    gamma: Fraction = Field(description="discount factor per time step; must be equal to reward.shaping_discount")
    reward: RewardParams = Field(description="weights and constants of the reward's terms (game/rewards.py)")
    observation: Annotated[ListedFeatures | None, Field(exclude_if=not_)] = Field(
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
    def _some_reward(cls, value: RewardParams) -> RewardParams:
        if not any(weight for name, weight in value.weights.items() if name != "shaping"):
            raise ValueError(
                "all weights of the reward except shaping are 0, so there is nothing to learn; give at least one of"
                " these terms another weight"
            )
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
            right = f"n_envs x n_steps = {rollout} decisions per update are too many (at most {self.most_decisions})"
            refuse(("n_envs",), self.n_envs, right)
        return self

    def network_spec(self, observation_size: int) -> NetworkSpec:
        """Return the description of the network in the policy bundle, for observations with ``observation_size``
        features.
        """
        shape: Shape = vars(self)["network"]
        return shape.spec(observation_size)

    @property
    def rounds(self) -> int:
        """Number of decisions of each learner in each world between two updates: the recipe's ``n_steps``."""
        return int(vars(self)["n_steps"])

    @property
    def updates_per_row(self) -> int:
        """Number of updates between two rows of ``progress.csv``."""
        return 1

    def check_learners(self, learners: int) -> None:
        """Raise ``InvalidInput`` if the recipe does not fit the number of learners; the base class accepts every
        number.
        """

    def begins(self, scenario: Scenario) -> str | None:
        """Return a description of the initial weights in training on a scenario; None if they are random."""
        return None

    def derived(self) -> dict[str, float]:
        """Return numbers for ``config.json`` that are computed from the recipe's keys, by name; by default none."""
        return {}

    def scheme_for(self, scenario: Scenario) -> Scheme:
        """Return the scheme (how the scenario's learners train together), such as ``single`` or ``shared``.

        If the recipe does not set a scheme, the scheme is ``single`` for one learner and ``shared`` for several. Raises
        ``InvalidInput`` if no vehicle learns, or if the scheme or the recipe does not fit the number of learners.
        """
        learners, where = len(scenario.learners), f"scenario {scenario.name!r}"
        if not learners:
            raise InvalidInput(f"{where} has no learner; give at least one vehicle the role learner")
        scheme = self.scheme or ("single" if learners == 1 else "shared")
        if scheme == "single" and learners > 1:
            raise InvalidInput(
                f"scheme single: {where} has {learners} learners; use the scheme shared, independent or centralised,"
                " or a scenario with one learner"
            )
        if scheme == "independent" and learners == 1:
            raise InvalidInput(
                f"scheme independent: needs several learners, but {where} has one; use the scheme single"
            )
        if scheme not in self.schemes:
            raise InvalidInput(
                f"scheme {scheme}: the algorithm {self.algorithm} of recipe {self.name!r} does not support this scheme;"
                " use a recipe for PPO, for instance cooperation-ppo"
            )
        self.check_learners(learners)
        return scheme

    def make_algorithm(self) -> Any:
        """Return a new object of the recipe's learning algorithm (a ``training.algorithm.Algorithm``)."""
        algorithm = ALGORITHMS[self.algorithm][1]
        return (resolve_name(algorithm) if isinstance(algorithm, str) else algorithm)()

    @staticmethod
    def shipped() -> dict[str, Path]:
        """Return the files of all recipes that come with the package, by the recipe's name.

        Recipes for an extension's algorithm are in a folder that has the extension's name.
        """
        files = sorted(shipped_folder("train").rglob("*.yaml"), key=lambda file: file.name)
        return {file.stem: file for file in files}

    @staticmethod
    def usable() -> dict[str, Path]:
        """Return the files of all shipped recipes whose algorithm is installed, by the recipe's name."""
        return {
            name: file
            for name, file in TrainingRecipe.shipped().items()
            if _algorithm_in(read_yaml(file)) in ALGORITHMS
        }

    @staticmethod
    def file(name_or_path: str | Path) -> Path:
        """Return the path of a recipe's file.

        If the argument contains a path separator or ends in ``.yaml``, the argument is a path, and the file need not
        exist. Any other argument must be the name of a shipped recipe; an unknown name raises ``UnknownName``.
        """
        text = str(name_or_path)
        if Path(text).suffix in (".yaml", ".yml") or "/" in text or "\\" in text:
            return Path(text)
        shipped = TrainingRecipe.shipped()
        if text not in shipped:
            raise unknown_name("recipe", text, TrainingRecipe.usable())
        return shipped[text]

    @staticmethod
    def of(content: Any) -> TrainingRecipe:
        """Return the recipe whose keys and values are ``content``, a mapping such as a YAML file contains.

        Raises ``InvalidInput``, whose message names the key, if the content is invalid.
        """
        return _checked(Document("recipe", content, {}))

    def new_text(self, name: str) -> str:
        """Return the text of a commented YAML file for a new recipe that has the values of this recipe.

        The text must be saved as ``<name>.yaml``. Raises ``InvalidInput`` for an invalid name.
        """
        check_file_name("recipe", name)
        words = {
            "title": "Title in one line",
            "description": "What this recipe is for.",
            "source": f"Values of {self.name}, to be changed.",
        }
        head = f"# Recipe {name}, a copy of {self.name}. Train with it: ethbrake train --recipe {name}.yaml\n"
        return self.replace(name=name, **words).text(head)

    def text(self, head: str) -> str:
        """Return the text of a commented YAML file with all keys of this recipe, below the comment ``head``.

        Keys whose value is None are commented out.
        """
        lines = [head, schema_lines("recipe", "train --schema")]
        values, meanings = self.model_dump(mode="json"), key_meanings(type(self))
        for key in type(self).model_fields:
            value = values.get(key)
            lines.append(f"\n# {meanings[key]}\n" if key in meanings else "\n")
            if value is None:
                lines.append(f"# {key}:\n")
            elif isinstance(value, Mapping):
                inside = (f"  {name}: {flow_text(entry)}\n" for name, entry in value.items() if entry is not None)
                lines += [f"{key}:\n", *inside]
            else:
                lines.append(f"{key}: {flow_text(value)}\n")
        return "".join(lines)

    def replace(self, **changes: Any) -> Self:
        """Return a copy of the recipe with other values for some keys (``seed=3``).

        Raises ``InvalidInput`` for an unknown key or an invalid value.
        """
        content = {**self.model_dump(mode="json"), **changes}
        changed = _checked(Document(f"recipe {self.name!r}", content, {}))
        assert isinstance(changed, type(self)) or "algorithm" in changes
        return changed  # type: ignore[return-value]  # another class only with another algorithm

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """Return the JSON Schema of recipe files, with which editors complete and check YAML.

        The schema includes registered algorithms and measures. The allowed keys depend on the key ``algorithm``.
        """
        classes = {name: recipe for name, (recipe, _) in ALGORITHMS.usable().items()}
        places, whole = models_json_schema(
            [(each, "validation") for each in classes.values()], schema_generator=FileSchema
        )
        parts = whole["$defs"]
        for name, recipe in classes.items():
            keys = parts[str(places[recipe, "validation"]["$ref"]).rpartition("/")[2]]["properties"]
            keys["algorithm"] |= {"description": key_meanings(recipe)["algorithm"], "const": name}
        weight = {"type": "number", "description": "weight of a registered measure"}
        properties = parts["RewardParams"]["properties"]
        properties |= {name: weight for name in MEASURES.usable() if name not in properties}
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
                "description": "Settings of a training.",
                "type": "object",
                "required": ["algorithm"],
                "properties": {
                    "algorithm": {"enum": [*classes], "description": "learning algorithm; decides which keys exist"}
                },
                "allOf": ways,
                "$defs": parts,
            }
        )


def key_meanings(recipe: type[TrainingRecipe]) -> dict[str, str]:
    """Return the description of each key of the recipes of class ``recipe``.

    If a class declares a key without a description, the description in its base class is used.
    """
    meanings: dict[str, str] = {}
    for each in reversed(recipe.__mro__):
        for key, field in each.model_fields.items() if issubclass(each, TrainingRecipe) else ():
            meanings |= {key: field.description} if field.description else {}
    return meanings


_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


def register_algorithm(name: str, recipe: type[TrainingRecipe], algorithm: type[Any] | str) -> None:
    """Register a learning algorithm, which recipes select with ``algorithm: NAME``.

    Instead of calling this function, a package can declare an entry point of the group ``ethbrake_marl.first_edition.algorithms``: a
    ``Part`` with the recipe class and the algorithm.

    Args:
        name: 1 to 64 letters ``a-z``, digits, ``-`` and ``_``.
        recipe: class of the algorithm's recipes, a subclass of ``TrainingRecipe``, which also checks their YAML files.
        algorithm: class of the algorithm, a subclass of ``training.algorithm.Algorithm``, or the text
            ``"module:class"``. The module in such a text (and torch, whose import takes seconds) is imported only when
            a training run begins.

    Raises ``InvalidInput`` for an invalid name or a class that lacks a required method, and ``AlreadyExists`` if
    another algorithm has the name.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"algorithm {name!r:.80}: the name must have 1 to 64 characters (a-z, 0-9, - and _), and must not begin"
            " with - or _"
        )
    if not (isinstance(recipe, type) and hasattr(recipe, "network_spec")):
        raise InvalidInput(
            f"algorithm {name!r}: recipe = {recipe!r:.80}: must be a class with the method network_spec, a subclass of"
            " TrainingRecipe"
        )
    is_place = isinstance(algorithm, str) and ":" in algorithm
    if not (is_place or (isinstance(algorithm, type) and hasattr(algorithm, "build"))):
        raise InvalidInput(
            f"algorithm {name!r}: algorithm = {algorithm!r:.80}: must be a class with the method build, or the text"
            " 'module:class' that says where this class is"
        )
    ALGORITHMS.add(name, (recipe, algorithm), lambda entry: entry == (recipe, algorithm))


ALGORITHMS: Registry[tuple[type[TrainingRecipe], type[Any] | str]] = Registry(
    "algorithm", "first_edition.algorithms", register_algorithm
)


def algorithm_names() -> tuple[str, ...]:
    """Return the names of all registered algorithms, beginning with the algorithms of this package."""
    return tuple(ALGORITHMS)


def load_recipe(name_or_path: str | Path) -> TrainingRecipe:
    """Read and check a recipe.

    ``name_or_path`` is the name of a shipped recipe (``ppo``) or, if it contains a path separator or ends in ``.yaml``,
    the path of a file. Raises ``UnknownName`` for an unknown name, and ``InvalidInput`` for invalid content; the
    message contains file, line, key, value and what would be right.
    """
    return _checked(TrainingRecipe.file(name_or_path))


def _algorithm_in(document: Document) -> object:
    """Return the value of ``algorithm`` in a recipe file; ``ppo`` if the key is missing."""
    return document.content.get("algorithm", "ppo") if isinstance(document.content, dict) else "ppo"


def _checked(source: Path | Document) -> TrainingRecipe:
    document = source if isinstance(source, Document) else read_yaml(source)
    name = _algorithm_in(document)
    if not isinstance(name, str) or name not in ALGORITHMS:
        new, absent = new_name(name, ALGORITHMS), ""
        right = f"is now called {new}" if new else f"must be one of {', '.join(ALGORITHMS)}"
        if isinstance(source, Path) and source in TrainingRecipe.shipped().values():
            absent = f"; this algorithm belongs to the extension {source.parent.name}, which is not installed"
        where = document.where(("algorithm",))
        raise InvalidInput(f"{where}: algorithm = {flow_text(name, 60)}: {right}{absent}")
    shipped = f"; the shipped recipe {name} has all keys" if name in TrainingRecipe.shipped() else ""
    model = ALGORITHMS[name][0]
    wording = _RecipeWording(model, f"this key is required{shipped}")
    return read_model(document, model, wording, "of keys to values, for instance algorithm: ppo")


class _RecipeWording(Wording):
    def known(self, path: YamlPath) -> list[str]:
        """Return the keys that are allowed where an unknown key stands; an error message suggests one of them.

        ``path`` contains the keys that lead to the unknown key, such as ``("reward", "harm")``.
        """
        return setting_names() if path[:-1] == ("reward",) else super().known(path)
