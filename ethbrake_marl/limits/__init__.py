"""Limits of a world, whoever drives: what is avoidable, the least harm known, the harm that is proven."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.limits.limits import (
        BestHarmTable as BestHarmTable,
        Limits as Limits,
        Unproven as Unproven,
        best_harm as best_harm,
        chunks_left as chunks_left,
        fold_episodes as fold_episodes,
        known_limits as known_limits,
        prove as prove,
        scripted_commands as scripted_commands,
        search_list as search_list,
        shipped_tables as shipped_tables,
        task_problem as task_problem,
        unproven_because as unproven_because,
    )
else:
    __getattr__ = front_door(__name__, __file__)
