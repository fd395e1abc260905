"""What a level of cooperation is worth (``ethbrake study ablate``), and equilibria of several learners."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.extensions.cooperation.equilibria import (
        Equilibrium as Equilibrium,
        Spread as Spread,
        best_joint_harm as best_joint_harm,
        compare_starts as compare_starts,
        find_equilibria as find_equilibria,
        price_of_anarchy as price_of_anarchy,
    )
    from ethbrake_marl.extensions.cooperation.seeds import (
        mean_over_seeds as mean_over_seeds,
        share_over_seeds as share_over_seeds,
    )

else:
    __getattr__ = front_door(__name__, __file__)
