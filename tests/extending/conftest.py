"""Parts that a test registers are forgotten after it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ethbrake_marl import objectives
from ethbrake_marl.agents import registry as agents
from ethbrake_marl.evaluation import harm_metrics
from ethbrake_marl.files import plugins
from ethbrake_marl.learning import registry as algorithms
from ethbrake_marl.rewards import registry as terms
from ethbrake_marl.scenario import features, v2x

TABLES = (
    (features, "FEATURES"),
    (v2x, "CHANNELS"),
    (objectives, "KINDS"),
    (agents, "_ENTRIES"),
    (algorithms, "_ENTRIES"),
    (terms, "TERMS"),
    (harm_metrics, "METRICS"),
    (plugins, "_RUN"),
    (plugins, "_LOADED"),
)


@pytest.fixture(autouse=True)
def forget_what_is_registered() -> Iterator[None]:
    """Every table as it was before the test."""
    before = [(getattr(module, name), dict(getattr(module, name))) for module, name in TABLES]
    yield
    for table, entries in before:
        table.clear()
        table.update(entries)
    objectives.parse_objective.cache_clear()
