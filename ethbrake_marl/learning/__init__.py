"""Training, and the policies that come out of it. torch is imported only by the modules that train."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.learning.runs import (
        StopAt as StopAt,
        TrainResult as TrainResult,
        resume as resume,
        train as train,
    )
    from ethbrake_marl.learning.training import (
        WORDS as WORDS,
        RunDirectory as RunDirectory,
        Settings as Settings,
        Training as Training,
        TrainingRecipe as TrainingRecipe,
        algorithm_names as algorithm_names,
        load_recipe as load_recipe,
        read_settings as read_settings,
        register_algorithm as register_algorithm,
    )
else:
    __getattr__ = front_door(__name__, __file__)
