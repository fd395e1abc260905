"""What cooperation is worth (``study ablate``)."""

from typing import TYPE_CHECKING

from ethbrake_marl.lazy_imports import front_door

if TYPE_CHECKING:
    from ethbrake_marl.extensions.cooperation.seeds import (
        mean_over_seeds as mean_over_seeds,
        share_over_seeds as share_over_seeds,
    )

else:
    __getattr__ = front_door(__name__)
