"""A training set-up as one YAML file: everything that shapes a policy, checked before anything starts."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator
from pydantic.json_schema import models_json_schema

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.yaml import (
    Document,
    FileSchema,
    Override,
    Wording,
    YamlPath,
    changed_parts,
    explain,
    flow_text,
    parse_overrides,
    publish,
    read_yaml,
    schema_lines,
)
from ethbrake_marl.policies.actor import Activation, NetworkSpec, Width
from ethbrake_marl.rewards import RewardParams, registered_terms, setting_names
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.scenario.catalogue import check_file_name, shipped_folder
from ethbrake_marl.scenario.features import ListedFeatures, listed_features

# The names of the learning algorithms, each with the class of its recipes and the algorithm itself.
#
# An entry of the package is a string ``module:attribute``, imported when it is first used.

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
_PLACE = "ethbrake_marl.learning.algorithms"


@dataclass(frozen=True, slots=True)
class _Entry:
    recipe: str | type[Any]
    algorithm: str | Any


_ENTRIES: dict[str, _Entry] = {
    "ppo": _Entry(f"{_PLACE}.ppo:PpoRecipe", f"{_PLACE}.ppo:Ppo"),
    "sac": _Entry(f"{_PLACE}.sac:SacRecipe", f"{_PLACE}.sac:Sac"),
    "counterfactual": _Entry(
        f"{_PLACE}.counterfactual:CounterfactualRecipe", f"{_PLACE}.counterfactual:Counterfactual"
    ),
}


def register_algorithm(name: str, recipe: type[BaseModel], algorithm: type[Any]) -> None:
    """Make ``algorithm: name`` a recipe that can be read, trained, stopped and resumed.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        recipe: the class of its recipes, made from ``learning.recipe.TrainingRecipe``; it checks the YAML file.
        algorithm: the class of the algorithm, made from ``learning.algorithms.protocol.Algorithm``.

    Raises ``InvalidInput`` for a name that is taken or is no such name, or a class that lacks what is needed.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"algorithm {name!r:.80}: must be 1 to 64 of a-z, 0-9, - and _, not beginning with - or _")
    if name in _ENTRIES:
        raise InvalidInput(f"algorithm {name!r}: is registered already; give another name")
    for what, given, needed in (("recipe", recipe, "network_spec"), ("algorithm", algorithm, "build")):
        if not (isinstance(given, type) and hasattr(given, needed)):
            raise InvalidInput(f"algorithm {name!r}: {what} = {given!r:.80}: must be a class with {needed}")
    _ENTRIES[name] = _Entry(recipe, algorithm)


def algorithm_names() -> tuple[str, ...]:
    """Every registered name, the package's own first."""
    return tuple(_ENTRIES)


def recipe_class(name: str) -> Any:
    """The class of the recipes of an algorithm; raises ``UnknownName``."""
    return _import(_entry(name).recipe)


def algorithm_named(name: str) -> Any:
    """The algorithm of this name, new; raises ``UnknownName``."""
    return _import(_entry(name).algorithm)()


def _entry(name: str) -> _Entry:
    if name not in _ENTRIES:
        raise unknown_name("algorithm", name, _ENTRIES)
    return _ENTRIES[name]


def _import(entry: str | Any) -> Any:
    if not isinstance(entry, str):
        return entry
    module, _, attribute = entry.partition(":")
    return getattr(import_module(module), attribute)


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


# Meanings of the keys of a recipe, and the text of a new one: every key with its value and a comment.

MEANINGS = {
    "name": "equal to the file's name without .yaml",
    "title": "one line for lists",
    "description": "what it is for",
    "source": "where the values come from",
    "algorithm": "a registered name: ppo, sac, counterfactual",
    "scheme": "how several learners train together: single, shared, independent, centralised",
    "total_steps": "decisions of all learners",
    "n_envs": "worlds that are advanced together",
    "learning_rate": "of the optimiser, from its start to its end",
    "gamma": "discount of one time step; equal to reward.shaping_discount",
    "reward": "weights and constants of the reward's terms (docs/learning.md)",
    "observation": "groups and features that learners observe, [own, front_1, rear_1]; left out: the scenario's",
    "horizon_is_end": "true: nothing is expected beyond the horizon",
    "seed": "of worlds, networks and exploration",
    "evaluation": "the fixed list on which the policy is measured while it learns, and how often",
    "checkpoint_every_updates": "updates between two checkpoints",
    "batch_size": "decisions in one step of the optimiser",
    "network": "hidden layers of actor and critic, and their activation",
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
    "start": "a policy to go on from, ppo@shipped; left out: random weights",
    "counterfactuals": "how many of the decisions of a round are tried in two ways",
    "offset": "how far an action is moved to see what comes of it; the logarithm of what is drawn is uniform",
    "holds": "for how many steps it is moved, one of these",
    "gradient_limit": "a larger gradient, at a jump, counts as this one; return per unit of action",
    "trust_radius": "farthest that one update asks an action to move",
    "anchor": "how much an action that makes no difference holds to where it is",
    "averaging": "share of itself that the average of the weights, which drives, keeps in each gradient step",
    "focus": "share of what is tried that a scout chooses; left out: 0, all decisions alike",
    "modes": "several networks and a gate between them; left out: one network",
    "log_every_updates": "updates between two rows of the progress table",
}


def new_recipe_text(name: str, based_on: str = "ppo") -> str:
    """Text of a commented YAML file for a new recipe ``name`` with the values of ``based_on``, all keys written out.

    A key that ``based_on`` leaves out stands in a comment. Save it as ``<name>.yaml``. Raises ``InvalidInput`` for a
    name that cannot be one, and what ``load_recipe`` raises for ``based_on``.
    """
    check_file_name("recipe", name)
    base = load_recipe(based_on)
    words = {
        "title": "One line for lists",
        "description": "What this recipe is for.",
        "source": f"Values of {base.name}, to be changed.",
    }
    head = f"# Recipe {name}, started from {base.name}. Train with it: ethbrake train --recipe {name}.yaml\n"
    return recipe_text(base.replace(name=name, **words), head)


def recipe_text(recipe: TrainingRecipe, head: str) -> str:
    """Text of a commented YAML file of ``recipe`` below ``head``, all keys written out.

    A key that it leaves out stands in a comment.
    """
    values = recipe.model_dump(mode="json")
    lines = (_line_of(key, values.get(key)) for key in type(recipe).model_fields)
    return head + schema_lines("recipe") + "".join(lines)


def _line_of(key: str, value: Any) -> str:
    """A key with its comment above; a mapping has each of its keys on a line of its own."""
    comment = f"\n# {MEANINGS[key]}\n" if key in MEANINGS else "\n"
    if value is None:
        return f"{comment}# {key}:\n"
    if isinstance(value, Mapping):
        inside = "".join(f"  {name}: {flow_text(entry)}\n" for name, entry in value.items() if entry is not None)
        return f"{comment}{key}:\n{inside}"
    return f"{comment}{key}: {flow_text(value)}\n"


# The JSON Schema of recipe files: for each algorithm its own keys, with their meanings.

_WEIGHT = {"type": "number", "minimum": 0, "description": "weight of a registered term"}


def recipe_json_schema() -> dict[str, Any]:
    """JSON Schema of a recipe file, for editors that complete and check YAML.

    Which keys there are depends on ``algorithm``. Algorithms and reward terms that are registered now are known too.
    """
    classes = {name: recipe_class(name) for name in algorithm_names()}
    places, whole = models_json_schema([(each, "validation") for each in classes.values()], schema_generator=FileSchema)
    parts = whole["$defs"]
    for name, recipe in classes.items():
        part = parts[_part_of(places[recipe, "validation"])]
        part["properties"] = {key: _described(key, value) for key, value in part["properties"].items()}
        part["properties"]["algorithm"]["const"] = name
    parts["RewardParams"]["properties"] |= {name: _WEIGHT for name in registered_terms()}
    ways = [
        {
            "if": {"properties": {"algorithm": {"const": name}}, "required": ["algorithm"]},
            "then": places[recipe, "validation"],
        }
        for name, recipe in classes.items()
    ]
    return publish(
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


def _part_of(place: dict[str, Any]) -> str:
    return str(place["$ref"]).rpartition("/")[2]


def _described(key: str, value: dict[str, Any]) -> dict[str, Any]:
    return {"description": MEANINGS[key], **value} if key in MEANINGS else value


# Schemes of training several learners together, and the network that therefore drives each vehicle.

SCHEMES: tuple[Scheme, ...] = get_args(Scheme)
POLICY = "policy"  # folder of a run in which the policies stand


def scheme_of(recipe: TrainingRecipe, scenario: Scenario) -> Scheme:
    """The recipe's scheme; where it names none, ``single`` for one learner and ``shared`` for several.

    Raises ``InvalidInput`` where nobody learns, or for a scheme that does not fit the learners or the algorithm.
    """
    learners, where = len(scenario.learners), f"scenario {scenario.name!r}"
    if not learners:
        raise InvalidInput(f"{where}: no vehicle learns; give at least one the role learner")
    scheme = recipe.scheme or ("single" if learners == 1 else "shared")
    if scheme == "single" and learners > 1:
        raise InvalidInput(
            f"scheme single: {where} has {learners} learners; use shared, independent or centralised, or let one learn"
        )
    if scheme == "independent" and learners == 1:
        raise InvalidInput(f"scheme independent: {where} has one learner; use single")
    if scheme not in recipe.schemes:
        raise InvalidInput(
            f"scheme {scheme}: recipe {recipe.name!r} is for {recipe.algorithm.upper()}; it needs one for PPO"
        )
    return scheme


def check_scheme(name: str) -> Scheme:
    """``name`` if it is a scheme; raises ``UnknownName`` with a suggestion."""
    for scheme in SCHEMES:
        if scheme == name:
            return scheme
    raise unknown_name("scheme", name, SCHEMES)


def drivers(scheme: Scheme, scenario: Scenario) -> dict[str, str]:
    """Learner -> where in the run's folder the bundle stands that drives it, front to rear."""
    names = [scenario.vehicle_names[vehicle] for vehicle in scenario.learners]
    return {name: driver(scheme, name) for name in names}


def driver(scheme: Scheme, vehicle: str) -> str:
    """Where in the run's folder the bundle stands that drives a learner."""
    return f"{POLICY}/{vehicle}" if scheme == "independent" else POLICY


def who_drives_what(given: Mapping[str, str]) -> str:
    """``drivers`` as a line to read: ``policy drives vehicle_2, vehicle_3``."""
    bundles: dict[str, list[str]] = {}
    for vehicle, bundle in given.items():
        bundles.setdefault(bundle, []).append(vehicle)
    return "; ".join(f"{bundle} drives {', '.join(vehicles)}" for bundle, vehicles in bundles.items())


# Settings ``key=value``: which are the scenario's and which the recipe's, and what belongs together.

_NO_SETTING = {"name", *WORDS}  # they tell about a file, and change nothing
_TOGETHER = (("gamma", "reward.shaping_discount"),)  # keys of a recipe whose values must be equal


class Settings(NamedTuple):
    """What is asked for."""

    texts: tuple[str, ...]  # as they were given
    scenario: tuple[Override, ...]
    recipe: tuple[Override, ...]

    def change(self, recipe: TrainingRecipe, tell: Callable[[str], None] | None = None) -> TrainingRecipe:
        """The recipe with those of its settings that it has; ``tell`` hears what else may have to be changed."""
        own = [override for override in self.recipe if override.top in type(recipe).model_fields]
        if not own:
            return recipe
        changed = recipe.replace(**changed_parts(recipe.model_dump(mode="json"), own))
        if tell is not None:
            for note in unpaired_settings(changed, own):
                tell(f"note: {note}")
        return changed


def read_settings(texts: Sequence[str] | None, recipes: Sequence[TrainingRecipe] = ()) -> Settings:
    """Tell the settings apart: ``mass_t=40`` and ``scenario.mass_t=40`` are the scenario's, ``gamma=0.9`` a recipe's.

    Raises ``UnknownName`` with a suggestion for a key that neither has.
    """
    known = {
        "scenario": {*Scenario.model_fields} - _NO_SETTING,
        "recipe": {key for recipe in recipes for key in type(recipe).model_fields} - _NO_SETTING,
    }
    found: dict[str, list[Override]] = {"scenario": [], "recipe": []}
    for override in parse_overrides(texts or ()):
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
    return Settings(tuple(texts or ()), tuple(found["scenario"]), tuple(found["recipe"]))


def unpaired_settings(recipe: TrainingRecipe, overrides: Sequence[Override]) -> list[str]:
    """What must be said of settings that belong together where only one was changed, and they differ now."""
    keys = {override.key for override in overrides}
    values = {"gamma": recipe.gamma, "reward.shaping_discount": recipe.reward.shaping_discount}
    notes = []
    for pair in _TOGETHER:
        given = [key for key in pair if key in keys]
        if len(given) == 1 and values[pair[0]] != values[pair[1]]:
            (other,) = set(pair) - set(given)
            notes.append(
                f"{given[0]} = {values[given[0]]:g}, but {other} stays {values[other]:g}: shaping leaves the best"
                f" policy as it is only where both are equal (--set {other}={values[given[0]]:g})"
            )
    return notes
