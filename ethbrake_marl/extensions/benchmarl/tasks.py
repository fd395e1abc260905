"""Register every shipped scenario that has a learner as a BenchMARL task (needs the extra ``marl``).

``python -m ethbrake_marl.extensions.benchmarl.tasks algorithm=mappo task=ethbrake/paper_random`` is BenchMARL's own
command line, which then knows these tasks and takes Hydra overrides. BenchMARL searches tasks only in its own folder.
This module therefore adds the tasks to BenchMARL's tables of tasks before BenchMARL reads the command line.
"""

from __future__ import annotations

from typing import Any

from benchmarl.environments import task_config_registry
from benchmarl.environments.common import Task
from hydra.core.config_store import ConfigStore

from ethbrake_marl.extensions.benchmarl.task import LineTask
from ethbrake_marl.scenario.catalogue import list_scenarios, load_scenario


class _Scenarios(Task):  # type: ignore[misc]  # Task has no types if the extra is not installed
    """Enumeration of tasks in BenchMARL's form: one task for each shipped scenario that has a learner."""

    @staticmethod
    def associated_class() -> type[LineTask]:
        """Return ``LineTask``, the class of all tasks."""
        return LineTask

    def get_from_yaml(self, path: str | None = None) -> LineTask:
        """Return the task for the scenario file ``path``, or, if it is None, for the shipped scenario of this entry.

        The reward is minus the harm, and the task has no shield.
        """
        return LineTask(self.name, _settings(SCENARIOS[self.name] if path is None else path))


def _settings(scenario: str) -> dict[str, Any]:
    return {"scenario": scenario, "reward": "harm", "horizon_is_end": True, "shield": None, "actions": None}


def _task_name(scenario: str) -> str:
    return scenario.replace("-", "_").upper()


_SHIPPED = [entry.name for entry in list_scenarios()]

SCENARIOS = {_task_name(name): name for name in _SHIPPED if load_scenario(name).learners}

EthBrakeTask = _Scenarios("EthBrakeTask", list(SCENARIOS))


def register_tasks() -> None:
    """Add the tasks to BenchMARL's tables, with names such as ``ethbrake/paper_random``; may be called repeatedly."""
    store = ConfigStore.instance()
    for task in EthBrakeTask:
        name = task.name.lower()
        task_config_registry[f"ethbrake/{name}"] = task
        store.store(group="task/ethbrake", name=name, node=_settings(SCENARIOS[task.name]), package="task")


register_tasks()

if __name__ == "__main__":
    from benchmarl.run import hydra_experiment

    hydra_experiment()
