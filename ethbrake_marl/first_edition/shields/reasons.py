"""Reasons why a shield accepts or replaces an action."""

from __future__ import annotations

from enum import IntEnum


class ShieldReason(IntEnum):
    """Reason why a shield accepted or replaced an action. The infos report the reason's number as ``shield_reason``.

    *Plan* means the shield's plan: one action for each decision up to the horizon. *Budget* means the largest harm that
    the shield accepts for the whole episode.

    >>> import ethbrake_marl.first_edition as eb
    >>> eb.ShieldReason(3).name, eb.ShieldReason.NO_CERTIFICATE.text
    ('NO_CERTIFICATE', 'no certificate')

    """

    NO_DECISION = -1  # before the first step of an episode, and always for a vehicle that follows a script
    SAME_AS_PLAN = 0  # accepted: the proposal equals the planned action
    PLAN_REMAINS = 1  # accepted: the proposal, followed by the rest of the plan, keeps the budget
    CONSTANT = 2  # accepted: the proposal, followed by a constant action, keeps the budget
    NO_CERTIFICATE = 3  # replaced by the planned action: no plan that was tried after the proposal keeps the budget
    NOT_A_NUMBER = 4  # replaced by the planned action: the proposal was not a number
    ENDED = 5  # the episode is over
    ASSUMPTION_BROKEN = 6  # replaced by an action chosen anew: the world differed from the prediction
    POLICY_ROLLOUT = 7  # accepted: the proposal, followed by a rollout of the policy, keeps the budget

    @property
    def text(self) -> str:
        """Reason in words, such as "no certificate"."""
        return self.name.lower().replace("_", " ")


# Codes that the compiled kernels return, as plain integers.
SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED = map(int, list(ShieldReason)[1:7])
