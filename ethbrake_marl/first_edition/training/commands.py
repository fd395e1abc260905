"""What commands of extensions still need: a task from words, and the agents of a list."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ethbrake_marl.first_edition import evaluation, training

if TYPE_CHECKING:
    from ethbrake_marl.first_edition.scenario.task import Task


def read_task(scenario: str, settings: Sequence[str] | None) -> Task:
    """Return the task of controlling the learners of a scenario, with settings ``KEY=VALUE``.

    The settings may include ``harm_count=total``. Raises ``InvalidInput`` if the scenario has no learner.
    """
    from ethbrake_marl.first_edition.scenario.task import Task

    chosen = training.read_settings(settings, of_agents=("harm_count",))
    loaded = evaluation.load_runnable(scenario, chosen.scenario, drives="some")
    return Task(loaded, loaded.learners, chosen.harm_count)


def make_drivers(agents: str | Sequence[str], task: Task, *, bare: bool = False) -> dict[str, Any]:
    """Return the agents named on a command line, by name (``make_lineup``, where ``agents`` are ``specs``)."""
    return evaluation.make_lineup(agents, task.scenario, harm_count=task.harm_count, bare=bare)
