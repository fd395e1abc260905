"""The common part of the files of a sweep and of a tuning: how they are read, and what a training of them is."""

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
    """What the files of both have in common."""

    title: str = Field(default="", description="one line, for you")
    _document: Document = PrivateAttr(Document("the file", {}, {}))  # where it stands, for messages

    @classmethod
    def read_as(cls, path: str | Path, page: str, needed: str) -> Self:
        """Read a file; raises ``InvalidInput`` with file, line, key, value and what would be right."""
        document = read_yaml(path)
        found = read_model(document, cls, Wording(cls, f"it is needed; docs/{page}.md shows an example"), needed)
        found._document = document
        return found


def load_parts(scenario: str, recipe: str, settings: Sequence[str]) -> tuple[Scenario, TrainingRecipe]:
    """Scenario and recipe, each a name or a path, with the settings ``KEY=VALUE`` in them.

    Raises ``InvalidInput`` for what is not known, and for a value that is not allowed.
    """
    loaded = load_recipe(recipe)
    given = read_settings(settings, [loaded])
    return load_runnable(scenario, given.scenario), given.change(loaded)


def refused_part(scenario: str, recipe: str, settings: Sequence[str]) -> str:
    """The part that is refused by itself where ``load_parts`` refuses: ``recipe``, ``scenario`` or a setting's key.

    Empty where each by itself is in order.
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
    """The values as ``KEY=VALUE``."""
    return tuple(f"{key}={flow_text(value)}" for key, value in values.items())
