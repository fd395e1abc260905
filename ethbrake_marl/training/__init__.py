"""Train policies, and go on with a training. torch and Stable-Baselines3 are imported where a training begins."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.training.recipe import (
        PpoRecipe as PpoRecipe,
        SacRecipe as SacRecipe,
        TrainingRecipe as TrainingRecipe,
        load_recipe as load_recipe,
        register_algorithm as register_algorithm,
    )
    from ethbrake_marl.training.train import TrainResult as TrainResult, resume as resume, train as train
    from ethbrake_marl.training.training import Training as Training
else:
    __getattr__ = front_door(__name__, __file__)
