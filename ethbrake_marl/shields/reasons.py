"""Reasons why a shield accepts or replaces an action."""

from __future__ import annotations

from enum import IntEnum


class ShieldReason(IntEnum):
    """Reason why a shield accepted or replaced an action: the code ``shield_reason`` in the infos.

    The shield holds a plan, one action for each later decision. The budget is the largest harm that it accepts.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldReason(3).name, eb.ShieldReason.NO_CERTIFICATE.text
    ('NO_CERTIFICATE', 'no certificate')

    """

    NO_DECISION = -1  # before the first step of an episode, and always for a vehicle that follows a script
    SAME_AS_PLAN = 0  # accepted: the proposal is the plan's action
    PLAN_REMAINS = 1  # accepted: the rest of the plan keeps the budget after the proposal
    CONSTANT = 2  # accepted: a constant action after the proposal keeps the budget
    NO_CERTIFICATE = 3  # replaced by the plan's action: nothing that was tried after the proposal keeps the budget
    NOT_A_NUMBER = 4  # replaced by the plan's action: the proposal was not a number
    ENDED = 5  # the episode is over
    ASSUMPTION_BROKEN = 6  # replaced by the fallback's action: the world did not behave as predicted
    POLICY_ROLLOUT = 7  # accepted: only a rollout of the policy after the proposal keeps the budget

    @property
    def text(self) -> str:
        """The reason in words, such as "no certificate"."""
        return self.name.lower().replace("_", " ")


# Codes that the compiled kernels return, as plain integers.
SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED = map(int, list(ShieldReason)[1:7])
