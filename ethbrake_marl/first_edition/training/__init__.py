"""Train policies, and load trained policies. Loading a policy does not import torch; training one does."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.first_edition.training.callback import StopAt as StopAt
    from ethbrake_marl.first_edition.training.recipe import (
        WORDS as WORDS,
        TrainingRecipe as TrainingRecipe,
        algorithm_names as algorithm_names,
        load_recipe as load_recipe,
        register_algorithm as register_algorithm,
    )
    from ethbrake_marl.first_edition.training.run_folder import RunDirectory as RunDirectory
    from ethbrake_marl.first_edition.training.session import (
        TrainResult as TrainResult,
        resume as resume,
        train as train,
    )
    from ethbrake_marl.first_edition.training.settings import Settings as Settings, read_settings as read_settings
    from ethbrake_marl.first_edition.training.team import load_team as load_team
    from ethbrake_marl.first_edition.training.training import Training as Training
else:
    __getattr__ = front_door(__name__, __file__)
