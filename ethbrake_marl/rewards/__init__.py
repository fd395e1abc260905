"""Reward: a weighted sum of named terms, all computed from the ledger and the state that are also reported.

Terms, for vehicle i and one step (the paper's section on the reward, with its printed defects repaired):

=========  =======================================================================================================
harm       minus the harm of the whole line in this step, each impact once (``harm_count``: first | total); or by how
           much the step raised what the vehicle's ``objective`` makes of the harm so far (``objectives``)
collision  the paper's r_collision: minus ``sum_p k_energy w_p^2`` over every impact of the step
risk       the paper's r_risk over the vehicle's own pairs: ``-sigma(-TTC / tau) - sigma(k_d (d_target - d))``; an
           opening pair has TTC = infinity (first part 0) and ``d - d_safe`` is not negative
jerk       the paper's r_jerk: minus the squared rate of change of the own command
terminal   the paper's r_terminal: 1 when an episode ends without any collision
shaping    for learners: ``discount Phi(after) - Phi(before)``, Phi = minus the least harm ahead (``potential``); such a
           difference of potentials leaves the optimal policy as it is (Ng, Harada and Russell 1999) if
           ``shaping_discount`` is the learner's own discount
=========  =======================================================================================================
"""

from ethbrake_marl.rewards.params import (
    REWARDS,
    Reward,
    RewardParams,
    resolved_objective,
    reward_params,
    setting_names,
)
from ethbrake_marl.rewards.registry import TERMS, StepOutcome, Term, register_term
from ethbrake_marl.rewards.terms import (
    counted_terms,
    further_terms,
    moving_terms_of,
    own_terms,
    potential,
    registered_terms_of,
    reward_terms,
    shared_terms,
    weighted_sum,
)

__all__ = [
    "REWARDS",
    "TERMS",
    "Reward",
    "RewardParams",
    "StepOutcome",
    "Term",
    "counted_terms",
    "further_terms",
    "moving_terms_of",
    "own_terms",
    "potential",
    "register_term",
    "registered_terms_of",
    "resolved_objective",
    "reward_params",
    "reward_terms",
    "setting_names",
    "shared_terms",
    "weighted_sum",
]
