"""Compare agents on fixed evaluation lists: drive the worlds, measure, compute statistics, write tables and files."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.first_edition.agents.protocol import policy_sha256 as policy_sha256
    from ethbrake_marl.first_edition.evaluation.chunks import (
        Lineup as Lineup,
        evaluate_held as evaluate_held,
        summarise_tally as summarise_tally,
        tally_list as tally_list,
    )
    from ethbrake_marl.first_edition.evaluation.comparison import compare_results as compare_results
    from ethbrake_marl.first_edition.evaluation.conditions import Conditions as Conditions
    from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation as Evaluation
    from ethbrake_marl.first_edition.evaluation.exploits import Exploits as Exploits
    from ethbrake_marl.first_edition.evaluation.groups import summarise_by as summarise_by
    from ethbrake_marl.first_edition.evaluation.identity import (
        EPISODES as EPISODES,
        HELD as HELD,
        LIST_SEED as LIST_SEED,
        result_identity as result_identity,
        result_versions as result_versions,
        worlds_sha256 as worlds_sha256,
    )
    from ethbrake_marl.first_edition.evaluation.lineup import (
        check_agents as check_agents,
        make_agents as make_agents,
        make_lineup as make_lineup,
    )
    from ethbrake_marl.first_edition.evaluation.measure_sets import (
        MEASURE_SETS as MEASURE_SETS,
        Measure as Measure,
        MeasureSet as MeasureSet,
        Silent as Silent,
        register_measure_set as register_measure_set,
    )
    from ethbrake_marl.first_edition.evaluation.motion import (
        EpisodeMotion as EpisodeMotion,
        follow_episodes as follow_episodes,
    )
    from ethbrake_marl.first_edition.evaluation.outcome import LeftOut as LeftOut, Outcome as Outcome
    from ethbrake_marl.first_edition.evaluation.own_measures import load_measures as load_measures
    from ethbrake_marl.first_edition.evaluation.per_world import (
        read_result as read_result,
        results_to_json as results_to_json,
        write_per_world as write_per_world,
    )
    from ethbrake_marl.first_edition.evaluation.record import (
        EpisodeRecord as EpisodeRecord,
        record_episode as record_episode,
    )
    from ethbrake_marl.first_edition.evaluation.rescores import Rescores as Rescores
    from ethbrake_marl.first_edition.evaluation.rollout import evaluate as evaluate, outcome_of as outcome_of
    from ethbrake_marl.first_edition.evaluation.seeds import (
        interquartile_mean as interquartile_mean,
        mean_over_seeds as mean_over_seeds,
        share_over_seeds as share_over_seeds,
    )
    from ethbrake_marl.first_edition.evaluation.shield_modes import (
        ShieldModes as ShieldModes,
        compare_modes as compare_modes,
    )
    from ethbrake_marl.first_edition.evaluation.statistics import (
        mean as mean,
        paired_difference as paired_difference,
        rate as rate,
        relative_decrease as relative_decrease,
        unpaired_difference as unpaired_difference,
    )
    from ethbrake_marl.first_edition.evaluation.summary import (
        RowsBeside as RowsBeside,
        SummaryTable as SummaryTable,
        summarise as summarise,
    )
    from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow as SummaryRow
    from ethbrake_marl.first_edition.evaluation.tally import Tally as Tally
    from ethbrake_marl.first_edition.evaluation.trial import (
        load_runnable as load_runnable,
        try_scenario as try_scenario,
    )
    from ethbrake_marl.first_edition.evaluation.varying import drawn_alike as drawn_alike, states_of as states_of
else:
    __getattr__ = front_door(__name__, __file__)
