"""Measuring agents on fixed lists of worlds: inputs, rollouts, measures, statistics, tables, results, episodes."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.evaluation.chunks import (
        Lineup as Lineup,
        evaluate_held as evaluate_held,
        summarise_tally as summarise_tally,
        tally_list as tally_list,
    )
    from ethbrake_marl.evaluation.curves import (
        DecelerationCurve as DecelerationCurve,
        deceleration_curve as deceleration_curve,
    )
    from ethbrake_marl.evaluation.episodes import (
        EpisodeMotion as EpisodeMotion,
        EpisodeRecord as EpisodeRecord,
        check_dataset as check_dataset,
        check_film as check_film,
        film as film,
        follow_episodes as follow_episodes,
        record_episode as record_episode,
        write_dataset as write_dataset,
    )
    from ethbrake_marl.evaluation.inputs import (
        EPISODES as EPISODES,
        HELD as HELD,
        LIST_SEED as LIST_SEED,
        NamedWorld as NamedWorld,
        NamedWorlds as NamedWorlds,
        check_agents as check_agents,
        drawn_alike as drawn_alike,
        load_runnable as load_runnable,
        make_agents as make_agents,
        make_lineup as make_lineup,
        policy_sha256 as policy_sha256,
        result_identity as result_identity,
        result_versions as result_versions,
        states_of as states_of,
        try_scenario as try_scenario,
        worlds_sha256 as worlds_sha256,
    )
    from ethbrake_marl.evaluation.measures import (
        MEASURES as MEASURES,
        PAPER_ROWS as PAPER_ROWS,
        REGISTERED as REGISTERED,
        TESTS as TESTS,
        Conditions as Conditions,
        Evaluation as Evaluation,
        Exploits as Exploits,
        LeftOut as LeftOut,
        Outcome as Outcome,
        PaperRow as PaperRow,
        Rescores as Rescores,
        SummaryRow as SummaryRow,
        SummaryTable as SummaryTable,
        Tally as Tally,
        is_papers_test as is_papers_test,
        load_measures as load_measures,
        other_tests as other_tests,
        register_measure as register_measure,
        summarise as summarise,
        summarise_by as summarise_by,
    )
    from ethbrake_marl.evaluation.results import (
        compare_results as compare_results,
        read_result as read_result,
        results_to_json as results_to_json,
        write_per_world as write_per_world,
    )
    from ethbrake_marl.evaluation.rollout import evaluate as evaluate, outcome_of as outcome_of
    from ethbrake_marl.evaluation.shield_modes import ShieldModes as ShieldModes, compare_modes as compare_modes
    from ethbrake_marl.evaluation.statistics import (
        interquartile_mean as interquartile_mean,
        mean as mean,
        mean_over_seeds as mean_over_seeds,
        paired_difference as paired_difference,
        rate as rate,
        relative_decrease as relative_decrease,
        share_over_seeds as share_over_seeds,
        unpaired_difference as unpaired_difference,
    )
else:
    __getattr__ = front_door(__name__, __file__)
