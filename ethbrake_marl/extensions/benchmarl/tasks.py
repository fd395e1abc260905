"""Register every shipped scenario that has a learner as a BenchMARL task (needs the extra ``marl``).

``python -m ethbrake_marl.extensions.benchmarl.tasks algorithm=mappo task=ethbrake/paper_random`` registers these tasks
and then runs BenchMARL's own command line.
"""

from __future__ import annotations

import sys
from typing import Any

from ethbrake_marl.errors import MissingExtra, naming_extras

try:
    with naming_extras():
        from benchmarl.environments import task_config_registry
        from benchmarl.environments.common import Task
        from hydra.core.config_store import ConfigStore
except MissingExtra as error:
    if __name__ != "__main__":
        raise
    sys.stderr.write(f"tasks.py: error: {error}\n")
    raise SystemExit(2) from None

from ethbrake_marl.extensions.benchmarl.task import LineTask
from ethbrake_marl.worlds.catalogue import list_scenarios, load_scenario


class _Scenarios(Task):  # type: ignore[misc]  # Task has no types if the extra is not installed
    @staticmethod
    def associated_class() -> type[LineTask]:
        return LineTask

    def get_from_yaml(self, path: str | None = None) -> LineTask:
        return LineTask(self.name, _settings(TASK_SCENARIOS[self.name] if path is None else path))


def _settings(scenario: str) -> dict[str, Any]:
    return {"scenario": scenario, "reward": "shaped", "horizon_is_end": True, "shield": None, "actions": None}


def _task_name(scenario: str) -> str:
    return scenario.replace("-", "_").upper()


_SHIPPED = [entry.name for entry in list_scenarios()]

TASK_SCENARIOS = {_task_name(name): name for name in _SHIPPED if load_scenario(name).learners}

EthBrakeTask = _Scenarios("EthBrakeTask", list(TASK_SCENARIOS))


def register_tasks() -> None:
    """Register the tasks in BenchMARL, with names such as ``ethbrake/paper_random``; repeated calls are harmless."""
    store = ConfigStore.instance()
    for task in EthBrakeTask:
        name = task.name.lower()
        task_config_registry[f"ethbrake/{name}"] = task
        store.store(group="task/ethbrake", name=name, node=_settings(TASK_SCENARIOS[task.name]), package="task")


register_tasks()

if __name__ == "__main__":
    from benchmarl.run import hydra_experiment

    hydra_experiment()
