"""Training, and the policies that come out of it. torch is imported only by the modules that train."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.learning.recipe import (
        WORDS as WORDS,
        TrainingRecipe as TrainingRecipe,
        algorithm_names as algorithm_names,
        load_recipe as load_recipe,
        new_recipe_text as new_recipe_text,
        read_settings as read_settings,
        recipe_json_schema as recipe_json_schema,
        recipe_path as recipe_path,
        register_algorithm as register_algorithm,
        shipped_recipes as shipped_recipes,
    )
    from ethbrake_marl.learning.runs import (
        HARM_METRIC as HARM_METRIC,
        OBJECTIVE as OBJECTIVE,
        StopAt as StopAt,
        TrainResult as TrainResult,
        chosen_by as chosen_by,
        resume as resume,
        train as train,
    )
    from ethbrake_marl.learning.training import (
        RETURN as RETURN,
        RunDirectory as RunDirectory,
        Training as Training,
        load_team as load_team,
        read_object as read_object,
        resolve as resolve,
        stop_on_signal as stop_on_signal,
    )
else:
    __getattr__ = front_door(__name__, __file__)
