"""A training set-up as one YAML file: everything that shapes a policy, checked before anything starts."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from operator import not_
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args

from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic.json_schema import models_json_schema

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.yaml import (
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
from ethbrake_marl.observations import ListedFeatures, listed_features
from ethbrake_marl.policies import Activation, NetworkSpec
from ethbrake_marl.rewards import RewardParams, registered_terms, setting_names
from ethbrake_marl.scenario import Scenario, check_file_name, shipped_folder

WORDS = ("title", "description", "source")  # fields that tell about a recipe and change nothing

Scheme = Literal["single", "shared", "independent", "centralised"]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
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
    observation: Annotated[ListedFeatures | None, Field(exclude_if=not_)] = None  # of learners; None: the scenario's
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
        """The network of the policy's bundle: that of the recipe's ``network``."""
        shape: NetworkShape | SquashedShape | ActorShape = vars(self)["network"]
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
        algorithm = _ALGORITHMS[self.algorithm][1]
        if isinstance(algorithm, str):
            module, _, attribute = algorithm.partition(":")
            algorithm = getattr(import_module(module), attribute)
        return algorithm()

    @staticmethod
    def of(content: Any) -> TrainingRecipe:
        """The recipe, of its algorithm's class, that ``model_dump(mode="json")`` wrote; raises ``InvalidInput``."""
        return _checked(Document("recipe", content, {}))

    def text(self, head: str) -> str:
        """A commented YAML file below ``head``: all keys written out, one that the recipe leaves out in a comment."""
        lines = [head, schema_lines("recipe")]
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


ROLLOUT_LIMIT = 2**24  # decisions held in memory between two updates


class PpoRecipe(TrainingRecipe):
    """PPO: collect ``n_steps`` decisions of every learner, then go through them ``n_epochs`` times."""

    schemes = get_args(Scheme)

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
        if not rollout <= ROLLOUT_LIMIT:
            right = f"n_envs x n_steps = {rollout} decisions per update; at most {ROLLOUT_LIMIT}"
            refuse(("n_envs",), self.n_envs, right)
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


MOMENTS_LIMIT = 2**22  # decisions held in memory between two updates


Steps = Annotated[int, Field(ge=1, le=1000)]


class CounterfactualRecipe(TrainingRecipe):
    """Try ``counterfactuals`` of the ``n_envs x n_steps`` decisions of a round otherwise, then learn from all of them.

    ``start`` names a policy to go on from; without one it begins with random weights.
    """

    algorithm: Literal["counterfactual"]
    start: Annotated[str, Field(pattern=r"^(ppo|counterfactual|universal)@.+$", max_length=4096)] | None = None
    n_steps: Annotated[int, Field(ge=1)]
    counterfactuals: Annotated[int, Field(ge=1)]
    offset: OffsetRange
    holds: Annotated[tuple[Steps, ...], Field(strict=False, min_length=1, max_length=16)]
    gradient_limit: Positive
    trust_radius: Rate
    anchor: Positive
    n_epochs: Annotated[int, Field(ge=1, le=1000)]
    batch_size: Annotated[int, Field(ge=2)]
    averaging: Fraction
    focus: Annotated[float, Field(ge=0.0, le=0.99, exclude_if=not_)] = (
        0.0  # share of what is tried that a scout chooses
    )
    network: ActorShape
    modes: Annotated[ModesPlan | None, Field(exclude_if=not_)] = None  # several networks and a gate

    @model_validator(mode="after")
    def _keys_fit(self) -> CounterfactualRecipe:
        if self.reward.shaping > 0.0:
            right = "must be 0: a counterfactual is played to the end, where shaping tells nothing more"
            refuse(("reward", "shaping"), self.reward.shaping, right)
        visited = self.n_envs * self.n_steps
        if not visited <= MOMENTS_LIMIT:
            right = f"n_envs x n_steps = {visited} decisions per update; at most {MOMENTS_LIMIT}"
            refuse(("n_envs",), self.n_envs, right)
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


# The names of the learning algorithms, each with the class of its recipes and the algorithm itself.
#
# An algorithm of the package is a string ``module:attribute``, imported when it is first used: torch takes seconds.

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
_ALGORITHMS: dict[str, tuple[type[TrainingRecipe], str | type[Any]]] = {
    "ppo": (PpoRecipe, "ethbrake_marl.learning.algorithms:Ppo"),
    "sac": (SacRecipe, "ethbrake_marl.learning.algorithms:Sac"),
    "counterfactual": (CounterfactualRecipe, "ethbrake_marl.learning.algorithms:Counterfactual"),
}


def register_algorithm(name: str, recipe: type[TrainingRecipe], algorithm: type[Any]) -> None:
    """Make ``algorithm: name`` a recipe that can be read, trained, stopped and resumed.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        recipe: the class of its recipes, made from ``learning.recipe.TrainingRecipe``; it checks the YAML file.
        algorithm: the class of the algorithm, made from ``learning.training.Algorithm``.

    Raises ``InvalidInput`` for a name that is taken or is no such name, or a class that lacks what is needed.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"algorithm {name!r:.80}: must be 1 to 64 of a-z, 0-9, - and _, not beginning with - or _")
    if name in _ALGORITHMS:
        raise InvalidInput(f"algorithm {name!r}: is registered already; give another name")
    for what, given, needed in (("recipe", recipe, "network_spec"), ("algorithm", algorithm, "build")):
        if not (isinstance(given, type) and hasattr(given, needed)):
            raise InvalidInput(f"algorithm {name!r}: {what} = {given!r:.80}: must be a class with {needed}")
    _ALGORITHMS[name] = recipe, algorithm


def algorithm_names() -> tuple[str, ...]:
    """Every registered name, the package's own first."""
    return tuple(_ALGORITHMS)


def load_recipe(name_or_path: str | Path) -> TrainingRecipe:
    """Read a shipped recipe by name (``ppo``) or a file by path (anything with a separator or ``.yaml``).

    Raises ``UnknownName`` with a suggestion, or ``InvalidInput`` with file, line, key, value and what would be right.
    """
    return _checked(recipe_path(name_or_path))


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
    return {file.stem: file for file in sorted(shipped_folder("train").glob("*.yaml"))}


def _checked(source: Path | Document) -> TrainingRecipe:
    document = source if isinstance(source, Document) else read_yaml(source)
    name = document.content.get("algorithm", "ppo") if isinstance(document.content, dict) else "ppo"
    if not isinstance(name, str) or name not in _ALGORITHMS:
        where, right = document.where(("algorithm",)), " or ".join(_ALGORITHMS)
        raise InvalidInput(f"{where}: algorithm = {flow_text(name, 60)}: must be {right}")
    shipped = f"; every key is in the shipped recipe {name}" if name in shipped_recipes() else ""
    model = _ALGORITHMS[name][0]
    wording = _RecipeWording(model, f"it is needed{shipped}")
    return read_model(document, model, wording, "of keys to values, for instance algorithm: ppo")


class _RecipeWording(Wording):
    def known(self, path: YamlPath) -> list[str]:
        """Registered terms have their weights beside the others."""
        return setting_names() if path[:-1] == ("reward",) else super().known(path)


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
    return base.replace(name=name, **words).text(head)


# The JSON Schema of recipe files: for each algorithm its own keys, with their meanings.


def recipe_json_schema() -> dict[str, Any]:
    """JSON Schema of a recipe file, for editors that complete and check YAML.

    Which keys there are depends on ``algorithm``. Algorithms and reward terms that are registered now are known too.
    """
    classes = {name: recipe for name, (recipe, _) in _ALGORITHMS.items()}
    places, whole = models_json_schema([(each, "validation") for each in classes.values()], schema_generator=FileSchema)
    parts = whole["$defs"]
    for name, recipe in classes.items():
        keys = parts[str(places[recipe, "validation"]["$ref"]).rpartition("/")[2]]["properties"]
        for key in keys.keys() & MEANINGS.keys():
            keys[key] = {"description": MEANINGS[key], **keys[key]}
        keys["algorithm"]["const"] = name
    weight = {"type": "number", "minimum": 0, "description": "weight of a registered term"}
    parts["RewardParams"]["properties"] |= dict.fromkeys(registered_terms(), weight)
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


# Settings ``key=value``: which are the scenario's and which the recipe's, and what belongs together.

_NO_SETTING = {"name", *WORDS}  # they tell about a file, and change nothing


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


def read_settings(texts: Sequence[str] | None, recipes: Sequence[TrainingRecipe] = ()) -> Settings:
    """Tell the settings apart: ``mass_t=40`` and ``scenario.mass_t=40`` are the scenario's, ``gamma=0.9`` a recipe's.

    Raises ``UnknownName`` with a suggestion for a key that neither has.
    """
    known = {
        "scenario": {*Scenario.model_fields} - _NO_SETTING,
        "recipe": {key for recipe in recipes for key in type(recipe).model_fields} - _NO_SETTING,
    }
    found: dict[str, list[Override]] = {"scenario": [], "recipe": []}
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
    return Settings(tuple(texts or ()), tuple(found["scenario"]), tuple(found["recipe"]))
