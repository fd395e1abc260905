"""Kernels that compare proposed actions with a shield's plan, and note what the shield decides about them.

``plan`` [n, T, L] has the L learners' actions at every decision, ``now`` [n] is the number of the present decision, and
``proposed`` [n, L] are the proposals; NaN is no proposal. ``ended`` [n]: whether the episode is over.
"""

from __future__ import annotations

import math

from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import Bools, Floats, Ints


@large
def compare(
    ended: Bools,
    now: Ints,
    plan: Floats,
    proposed: Floats,
    slack: Floats,
    reasons: tuple[int, int, int, int],
    candidates: Floats,
    margin: Floats,
    reason: Ints,
) -> None:
    """Write the actions to try to ``candidates``, and ``margin`` and ``reason`` as if all were rejected, [n, L] each.

    The margin is ``slack`` [n] (m2/s2). The reason is the first of ``reasons`` for the plan's own action, the second
    for any other action, the third for no proposal, and the last in an episode that is over.
    """
    same, deviates, silent, over = reasons
    for k in range(len(now)):
        for c in range(proposed.shape[1]):
            action, planned = proposed[k, c], plan[k, min(now[k], plan.shape[1] - 1), c]
            candidates[k, c], margin[k, c] = planned, slack[k]
            if ended[k]:
                reason[k, c] = over
            elif math.isnan(action):
                reason[k, c] = silent
            elif action == planned:
                reason[k, c] = same
            else:
                reason[k, c], candidates[k, c] = deviates, action


@large
def note_trial(rows: Ints, trial_mask: Bools, why: Ints, slack: Floats, reason: Ints, margin: Floats) -> None:
    """Write what came of a trial in the worlds ``rows`` [R] for the actions in ``trial_mask`` [R, L].

    The reasons ``why`` [R] go to ``reason`` [n, L], and ``slack`` [R] (m2/s2) goes to ``margin`` [n, L].
    """
    for r in range(len(rows)):
        for c in range(trial_mask.shape[1]):
            if trial_mask[r, c]:
                reason[rows[r], c], margin[rows[r], c] = why[r], slack[r]


@large
def follow_plan(
    ended: Bools,
    now: Ints,
    plan: Floats,
    proposed: Floats,
    learners: Ints,
    applied: Floats,
    intervened: Bools,
    replaced: Ints,
) -> None:
    """Write the actions of ``plan`` at the decisions ``now`` [n] to ``applied`` [n, L].

    Where an action differs from the proposal, ``intervened`` [n, N] becomes true and ``replaced`` [n] grows by 1.
    """
    for k in range(len(now)):
        for c in range(len(learners)):
            applied[k, c] = plan[k, min(now[k], plan.shape[1] - 1), c]
            if not ended[k] and applied[k, c] != proposed[k, c]:
                intervened[k, learners[c] - 1] = True
                replaced[k] += 1
