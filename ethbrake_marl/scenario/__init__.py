"""Scenarios: strict YAML files that describe families of worlds, and the reproducible lists drawn from them."""

from ethbrake_marl.files.yaml import Document, parse_yaml, read_yaml
from ethbrake_marl.scenario.fields import (
    Choice,
    LogUniform,
    Normal,
    Sample,
    Uniform,
    constant_command,
    is_state_free,
    parse_agent_spec,
)
from ethbrake_marl.scenario.sampling import (
    Channel,
    initial_state_worlds,
    read_initial_states,
    table_columns,
    worlds_from_table,
)
from ethbrake_marl.scenario.schema import (
    CatalogueEntry,
    Scenario,
    Task,
    list_scenarios,
    load_scenario,
    new_scenario_text,
    read_scenario,
    scenario_folder,
    scenario_json_schema,
    scenario_path,
)

__all__ = [
    "CatalogueEntry",
    "Channel",
    "Choice",
    "Document",
    "LogUniform",
    "Normal",
    "Sample",
    "Scenario",
    "Task",
    "Uniform",
    "constant_command",
    "initial_state_worlds",
    "is_state_free",
    "list_scenarios",
    "load_scenario",
    "new_scenario_text",
    "parse_agent_spec",
    "parse_yaml",
    "read_initial_states",
    "read_scenario",
    "read_yaml",
    "scenario_folder",
    "scenario_json_schema",
    "scenario_path",
    "table_columns",
    "worlds_from_table",
]
