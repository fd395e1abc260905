"""The reasons for which a shield accepts or replaces an action."""

from __future__ import annotations

from enum import IntEnum


class ShieldReason(IntEnum):
    """Why a shield accepted or replaced an action: the code ``shield_reason`` of the infos. ``text``: in words.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldReason(3).name, eb.ShieldReason.NO_CERTIFICATE.text
    ('NO_CERTIFICATE', 'no certificate')

    """

    NO_DECISION = -1  # before the first step of an episode, and always for a vehicle that follows a script
    SAME_AS_PLAN = 0  # the proposal is the plan's action
    PLAN_REMAINS = 1  # the rest of the plan still keeps the budget after the proposal
    CONSTANT = 2  # a constant action after the proposal keeps it
    NO_CERTIFICATE = 3  # neither does: the plan's action was applied
    NOT_A_NUMBER = 4  # nothing usable was proposed: the plan's action was applied
    ENDED = 5  # the episode is over
    ASSUMPTION_BROKEN = 6  # the world did not do what was predicted: the fallback was applied
    POLICY_ROLLOUT = 7  # nothing else kept the budget, but the policy itself does, rolled out after the proposal

    @property
    def text(self) -> str:
        """The reason in words."""
        return self.name.lower().replace("_", " ")


# The codes that kernels give, as plain integers.
SAME_AS_PLAN, PLAN_REMAINS, CONSTANT, NO_CERTIFICATE, NOT_A_NUMBER, ENDED = map(int, list(ShieldReason)[1:7])
