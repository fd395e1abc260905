"""Read the YAML file of a sweep or tuning, and load the scenarios and recipes that the file names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, PrivateAttr

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.trial import load_runnable
from ethbrake_marl.files.model import FileModel, Wording, read_model
from ethbrake_marl.files.yaml import Document, flow_text, read_yaml
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.training.settings import read_settings

Seed = Annotated[int, Field(ge=0, lt=2**32)]


class StudyFile(FileModel):
    """Base class for the content of the YAML file of a sweep or tuning."""

    title: str = Field(default="", description="title of one line, for the reader; it has no effect")
    _document: Document = PrivateAttr(Document("the file", {}, {}))  # source document, for messages

    @classmethod
    def read_as(cls, path: str | Path, needed: str) -> Self:
        """Read and check a YAML file with the content of this class.

        Raises ``InvalidInput``, which names the file, the line, the key and the wrong value, and says what would be
        right. ``needed`` are words for the right content, such as ``with a grid or a list of jobs``.
        """
        document = read_yaml(path)
        wording = Wording(cls, "this key is required; docs/extensions/studies.md shows an example")
        study = read_model(document, cls, wording, needed)
        study._document = document
        return study


def load_parts(scenario: str, recipe: str, settings: Sequence[str]) -> tuple[Scenario, TrainingRecipe]:
    """Load a scenario and a recipe by name or path, and apply the settings ``KEY=VALUE`` to them.

    A setting changes the scenario or the recipe, whichever has the key. Raises ``InvalidInput`` if a name or key is
    unknown, or if a value is not allowed.
    """
    loaded = load_recipe(recipe)
    changes = read_settings(settings, [loaded])
    return load_runnable(scenario, changes.scenario), changes.change(loaded)


def refused_part(scenario: str, recipe: str, settings: Sequence[str]) -> str:
    """Return the argument that makes ``load_parts`` fail: ``recipe``, ``scenario`` or the key of a setting.

    The text is empty if every argument is valid by itself, but the arguments do not fit together.
    """
    tried: dict[str, Callable[[], object]] = {
        "recipe": partial(load_recipe, recipe),
        "scenario": partial(load_scenario, scenario),
        **{text.partition("=")[0]: partial(load_parts, scenario, recipe, (text,)) for text in settings},
    }
    for part, load in tried.items():
        try:
            load()
        except InvalidInput:
            return part
    return ""


def texts_of(values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return each entry of ``values`` as a text ``KEY=VALUE``, as for the option ``--set``."""
    return tuple(f"{key}={flow_text(value)}" for key, value in values.items())
