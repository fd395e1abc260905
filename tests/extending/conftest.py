"""Parts that a test registers are forgotten after it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from ethbrake_marl import harm, observations, rewards as terms
from ethbrake_marl.agents import registry as agents
from ethbrake_marl.evaluation import measures
from ethbrake_marl.files import plugins
from ethbrake_marl.learning import training as algorithms
from ethbrake_marl.scenario import schema, v2x

TABLES = (
    (schema, "FOLDERS"),
    (observations, "FEATURES"),
    (v2x, "CHANNELS"),
    (harm, "KINDS"),
    (agents, "_ENTRIES"),
    (algorithms, "_ALGORITHMS"),
    (terms, "TERMS"),
    (measures, "REGISTERED"),
    (plugins, "_RUN"),
    (plugins, "_LOADED"),
)


Tables = list[tuple[dict[Any, Any], dict[Any, Any]]]


def tables() -> Tables:
    """Every table with a copy of what it holds now."""
    return [(getattr(module, name), dict(getattr(module, name))) for module, name in TABLES]


def restore(before: Tables) -> None:
    """Every table as it was when ``tables`` was called."""
    for table, entries in before:
        table.clear()
        table.update(entries)
    harm.parse_objective.cache_clear()


@pytest.fixture(autouse=True)
def forget_what_is_registered() -> Iterator[None]:
    """Every table as it was before the test."""
    before = tables()
    yield
    restore(before)
