"""Common parts of the YAML files of a sweep and of a tuning: reading them, and loading scenario and recipe."""

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
    """Base class of the content of a study's YAML file, of a sweep or of a tuning."""

    title: str = Field(default="", description="one line, for you")
    _document: Document = PrivateAttr(Document("the file", {}, {}))  # source document, for messages

    @classmethod
    def read_as(cls, path: str | Path, needed: str) -> Self:
        """Read and check a YAML file of this class.

        Args:
            path: the file.
            needed: what the file must contain, for messages: ``with a grid or a list of jobs``.

        Raises ``InvalidInput`` with file, line, key, value and what would be right.

        """
        document = read_yaml(path)
        wording = Wording(cls, "it is needed; docs/extensions/studies.md shows an example")
        study = read_model(document, cls, wording, needed)
        study._document = document
        return study


def load_parts(scenario: str, recipe: str, settings: Sequence[str]) -> tuple[Scenario, TrainingRecipe]:
    """Load scenario and recipe, by name or path, and apply the settings ``KEY=VALUE`` to the one that has the key.

    Raises ``InvalidInput`` for an unknown name or key, and for a value that is not allowed.
    """
    loaded = load_recipe(recipe)
    changes = read_settings(settings, [loaded])
    return load_runnable(scenario, changes.scenario), changes.change(loaded)


def refused_part(scenario: str, recipe: str, settings: Sequence[str]) -> str:
    """Return which argument causes ``load_parts`` to fail: ``recipe``, ``scenario`` or the key of a setting.

    The result is empty if each of them alone is valid.
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
    """Return values by key as ``KEY=VALUE`` texts, as ``--set`` takes them."""
    return tuple(f"{key}={flow_text(value)}" for key, value in values.items())
