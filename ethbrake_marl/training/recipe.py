"""``TrainingRecipe``: the settings of a training as one YAML file, for any algorithm."""

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
from ethbrake_marl.game.features import ListedFeatures, listed_features
from ethbrake_marl.game.measures import MEASURES
from ethbrake_marl.game.rewards import RewardParams, setting_names
from ethbrake_marl.policies.network_spec import Activation, NetworkSpec
from ethbrake_marl.registry import Registry
from ethbrake_marl.scenario.catalogue import check_file_name, shipped_folder
from ethbrake_marl.scenario.schema import Scenario

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
        "cosine", description="end + (start - end) (1 + cos(pi p)) / 2, where p is the share of steps done"
    )

    def at(self, remaining: float) -> float:
        """Return the learning rate when the share ``remaining`` (1 to 0) of the training's steps is still to be done.

        It is ``end + (start - end) (1 + cos(pi p)) / 2`` with ``p = 1 - remaining``.
        """
        done = min(max(1.0 - remaining, 0.0), 1.0)
        return self.end + (self.start - self.end) * 0.5 * (1.0 + math.cos(math.pi * done))


class Shape(FileModel):
    """Base class of the value of the key ``network`` in a recipe: the sizes of the networks.

    A subclass declares the keys as fields. It needs ``policy`` (sizes of the actor's hidden layers, ``[64, 64]``) and
    ``activation``, or its own ``spec``.
    """

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """Return the description of the network in a policy bundle: an actor with one action in [-1, 1].

        Args:
            observation_size: number of features of an observation.
            more: fields of ``NetworkSpec`` that differ from those of a plain actor.

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
        0.0, description="logarithm of the exploration noise at the start"
    )

    def spec(self, observation_size: int, **more: Any) -> NetworkSpec:
        """Return the description of the network in a policy bundle: an actor and a critic.

        ``observation_size`` is the number of features of an observation; ``more`` are other fields of ``NetworkSpec``.
        """
        return super().spec(observation_size, value_hidden=self.value, **more)


class EvaluationPlan(FileModel):
    """The fixed list of worlds on which the policy is measured during training, and how often."""

    every_updates: Annotated[int, Field(ge=1)]  # number of updates between two measurements
    worlds: Annotated[int, Field(ge=1, le=1_000_000)]  # number of worlds of the list
    seed: Annotated[int, Field(ge=0)]  # seed from which the worlds are drawn


class TrainingRecipe(FileModel):
    """How to train, with any algorithm: algorithm, reward, seed, checkpoints and measurements.

    An update is one round of collecting and learning. The recipes of an algorithm are a subclass. Each key is explained
    in ``Field(description=...)``: new files, the JSON Schema and the documentation show this text.

    >>> import ethbrake_marl as eb
    >>> recipe = eb.load_recipe("ppo").replace(seed=3, total_steps=100_000)
    >>> recipe.algorithm, recipe.seed, recipe.total_steps
    ('ppo', 3, 100000)

    """

    schemes: ClassVar[tuple[Scheme, ...]] = ("single", "shared")  # schemes that the algorithm supports
    most_decisions: ClassVar[float] = math.inf  # largest number of decisions held in memory between two updates

    name: str = Field(pattern=NAME_PATTERN, description="equal to the file's name without .yaml")
    title: str = Field("", description="one line for lists")
    description: str = Field("", description="what the recipe is for")
    source: str = Field("", description="where the values come from")
    algorithm: str = Field(description="a registered name: ppo, sac, or another one (ethbrake scenario parts)")
    scheme: Scheme | None = Field(  # None: single for one learner, shared for several
        None, description="how several learners train together: single, shared, independent, centralised"
    )
    total_steps: int = Field(ge=1, description="decisions of all learners")
    n_envs: int = Field(ge=1, description="worlds that are advanced together")
    learning_rate: LearningRate = Field(description="learning rate of the optimiser, from its start to its end")
    gamma: Fraction = Field(description="discount factor per time step; equal to reward.shaping_discount")
    reward: RewardParams = Field(description="weights and constants of the reward's terms (docs/reference/rewards.md)")
    observation: Annotated[ListedFeatures | None, Field(exclude_if=not_)] = Field(
        None, description="groups and features that learners observe, [own, front_1, rear_1]; left out: the scenario's"
    )
    horizon_is_end: bool = Field(True, description="true: nothing is expected beyond the horizon")
    seed: int = Field(0, ge=0, lt=2**32, description="seed of worlds, networks and exploration")
    evaluation: EvaluationPlan = Field(
        description="the fixed list on which the policy is measured while it learns, and how often"
    )
    checkpoint_every_updates: int = Field(ge=1, description="updates between two checkpoints")

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
        """Return the description of the network in the policy's bundle, from the recipe's key ``network``.

        ``observation_size`` is the number of features of an observation.
        """
        shape: Shape = vars(self)["network"]
        return shape.spec(observation_size)

    @property
    def rounds(self) -> int:
        """Decisions of each learner in each world between two updates: the recipe's ``n_steps``."""
        return int(vars(self)["n_steps"])

    @property
    def updates_per_row(self) -> int:
        """Number of updates between two rows of ``progress.csv``."""
        return 1

    def check_learners(self, learners: int) -> None:
        """Raise ``InvalidInput`` if the recipe does not fit this number of learners; a subclass may override it."""

    def begins(self, scenario: Scenario) -> str | None:
        """Return a description of the initial weights for a scenario; None if the algorithm has random ones."""
        return None

    def derived(self) -> dict[str, float]:
        """Return numbers that follow from the keys, by name, to be recorded in ``config.json``."""
        return {}

    def scheme_for(self, scenario: Scenario) -> Scheme:
        """Return the scheme in which the scenario's learners train: ``single``, ``shared``, ``independent``, ...

        This is the recipe's scheme; if it names none, ``single`` for one learner and ``shared`` for several. Raises
        ``InvalidInput`` if no vehicle learns, or if the scheme or the recipe does not fit the learners.
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
                f"scheme {scheme}: recipe {self.name!r} is for {self.algorithm}, which cannot train so; use a recipe"
                " for PPO, for instance cooperation-ppo"
            )
        self.check_learners(learners)
        return scheme

    def make_algorithm(self) -> Any:
        """Return a new instance of the class of the recipe's algorithm, a ``training.algorithm.Algorithm``."""
        algorithm = ALGORITHMS[self.algorithm][1]
        return (resolve_name(algorithm) if isinstance(algorithm, str) else algorithm)()

    @staticmethod
    def shipped() -> dict[str, Path]:
        """Return the file of every recipe that comes with the package, by name.

        A recipe for an algorithm of an extension is in a folder with the name of the extension.
        """
        files = sorted(shipped_folder("train").rglob("*.yaml"), key=lambda file: file.name)
        return {file.stem: file for file in files}

    @staticmethod
    def usable() -> dict[str, Path]:
        """Return the file of every shipped recipe whose algorithm is installed, by name; others need an extension."""
        return {
            name: file
            for name, file in TrainingRecipe.shipped().items()
            if _algorithm_in(read_yaml(file)) in ALGORITHMS
        }

    @staticmethod
    def file(name_or_path: str | Path) -> Path:
        """Return the path of a recipe's file, from a shipped recipe's name or a path.

        A text with a separator or the ending ``.yaml`` is a path; the file need not exist. Raises ``UnknownName`` for
        another text that is no shipped recipe.
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
        """Return the recipe with this content, a mapping from keys to values as in a YAML file.

        Raises ``InvalidInput``, naming the key, if the content is invalid.
        """
        return _checked(Document("recipe", content, {}))

    def new_text(self, name: str) -> str:
        """Return the text of a commented YAML file for a new recipe ``name`` that starts from this recipe.

        All keys are written; a key without a value stands in a comment. Save the text as ``<name>.yaml``. Raises
        ``InvalidInput`` for an invalid name.
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
        """Return the text of a commented YAML file with all keys of this recipe, below the comment ``head``.

        A key without a value stands in a comment.
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
        """Return the recipe with other values for some keys, ``seed=3``; raise ``InvalidInput`` if one is invalid."""
        content = {**self.model_dump(mode="json"), **changes}
        changed = _checked(Document(f"recipe {self.name!r}", content, {}))
        assert isinstance(changed, type(self)) or "algorithm" in changes
        return changed  # type: ignore[return-value]  # another class only with another algorithm

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """Return the JSON Schema of a recipe file, for editors that complete and check YAML.

        The allowed keys depend on ``algorithm``. Registered algorithms and measures are included.
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


def key_meanings(recipe: type[TrainingRecipe]) -> dict[str, str]:
    """Return key -> meaning of the key in recipes of this class.

    A key that the class declares without a description has the description of its base class.
    """
    meanings: dict[str, str] = {}
    for each in reversed(recipe.__mro__):
        for key, field in each.model_fields.items() if issubclass(each, TrainingRecipe) else ():
            meanings |= {key: field.description} if field.description else {}
    return meanings


_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


def register_algorithm(name: str, recipe: type[TrainingRecipe], algorithm: type[Any] | str) -> None:
    """Register an algorithm, so that recipes with ``algorithm: name`` can be read, trained, stopped and resumed.

    An installed package does the same with an entry point of the group ``ethbrake_marl.algorithms``: a ``Part`` of
    recipe and algorithm.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        recipe: the class of its recipes, a subclass of ``TrainingRecipe``; it checks the YAML file.
        algorithm: the class of the algorithm, a subclass of ``training.algorithm.Algorithm``; or ``"module:class"``, so
            that recipes can be read without importing it, since torch takes seconds.

    Raises ``InvalidInput`` for an invalid or taken name, or a class that lacks a required method.

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


def algorithm_names() -> tuple[str, ...]:
    """Return the names of all algorithms, the package's own first."""
    return tuple(ALGORITHMS)


def load_recipe(name_or_path: str | Path) -> TrainingRecipe:
    """Read and check a recipe: a shipped one by name (``ppo``), or a file by path.

    A text with a separator or the ending ``.yaml`` is a path. Raises ``UnknownName`` with a suggestion, or
    ``InvalidInput`` with file, line, key, value and what would be right.
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
            absent = f"; the extension {source.parent.name}, which gives it, is not installed"
        where = document.where(("algorithm",))
        raise InvalidInput(f"{where}: algorithm = {flow_text(name, 60)}: {right}{absent}")
    shipped = f"; every key is in the shipped recipe {name}" if name in TrainingRecipe.shipped() else ""
    model = ALGORITHMS[name][0]
    wording = _RecipeWording(model, f"it is needed{shipped}")
    return read_model(document, model, wording, "of keys to values, for instance algorithm: ppo")


class _RecipeWording(Wording):
    def known(self, path: YamlPath) -> list[str]:
        """Return the keys that are allowed beside a key, from which an error message suggests one.

        ``path`` holds the keys that lead to it in the file, such as ``("reward", "harm")``. Below ``reward``, the
        weights of registered measures are included.
        """
        return setting_names() if path[:-1] == ("reward",) else super().known(path)
