"""Scenarios: YAML files that describe how worlds are drawn, and reproducible lists of worlds drawn from these files."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.files.yaml import parse_yaml as parse_yaml
    from ethbrake_marl.first_edition.scenario.catalogue import (
        check_file_name as check_file_name,
        group_of_scenarios as group_of_scenarios,
        list_scenarios as list_scenarios,
        load_scenario as load_scenario,
        new_scenario_text as new_scenario_text,
        register_scenarios as register_scenarios,
        scenario_path as scenario_path,
        shipped_folder as shipped_folder,
    )
    from ethbrake_marl.first_edition.scenario.channel import CHANNELS as CHANNELS, register_preset as register_preset
    from ethbrake_marl.first_edition.scenario.distributions import Uniform as Uniform
    from ethbrake_marl.first_edition.scenario.fields import QUANTITY as QUANTITY
    from ethbrake_marl.first_edition.scenario.roles import ScriptSpec as ScriptSpec
    from ethbrake_marl.first_edition.scenario.sample import Sample as Sample, recording_of as recording_of
    from ethbrake_marl.first_edition.scenario.schema import (
        Scenario as Scenario,
        scenario_json_schema as scenario_json_schema,
    )
    from ethbrake_marl.first_edition.scenario.tables import rows_text as rows_text
    from ethbrake_marl.first_edition.scenario.task import Task as Task
else:
    __getattr__ = front_door(__name__, __file__)
