"""Twelve leaks that a step shield could have, small ones among them: each must be found by a search for harm alone.

A leak changes what the shield believes or applies before, or after, each decision. Nothing is compared with what was
predicted here, so that only the certificate stands between the search and the bound.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ethbrake_marl.physics.kernel import CLOCK
from ethbrake_marl.shield import StepShield
from ethbrake_marl.shield.step_shield import Decision, Running

Leak = Callable[[StepShield, Decision | None], None]  # changes the shield before a decision; the last one, or None


def _with_problem(shield: StepShield, **arrays: np.ndarray) -> None:
    running = shield.running
    shield.running = running._replace(problem=running.problem._replace(**arrays))


def _columns(running: Running, group: int) -> slice:
    """Columns of the state: 0 gaps, 1 hit flags, 2 first-impact harm, 3 total harm."""
    N = running.problem.mass.shape[1]
    return slice(N + group * (N - 1), N + (group + 1) * (N - 1))


def _with_states(shield: StepShield, group: int, values: np.ndarray | float) -> None:
    states = shield.running.states.copy()
    states[:, _columns(shield.running, group)] = values
    shield.running = shield.running._replace(states=states)


def budget_may_rise(percent: float) -> Leak:
    def leak(shield, last):
        shield.backup = shield.backup._replace(harm=shield.backup.harm * (1.0 + percent / 100.0))

    return leak


def harm_forgotten(share: float) -> Leak:
    """Of the harm so far this share is forgotten in each step."""

    def leak(shield, last):
        for group in (2, 3):
            _with_states(shield, group, shield.running.states[:, _columns(shield.running, group)] * (1.0 - share))

    return leak


def impacts_late(shield: StepShield, last: Decision | None) -> None:
    """What was done in the last step is counted two steps later only."""
    for group in (2, 3):
        columns = _columns(shield.running, group)
        now = shield.running.states[:, columns].copy()
        before = getattr(shield, f"late{group}", None)
        setattr(shield, f"late{group}", now)
        _with_states(shield, group, now if before is None else before)


def hits_assumed(shield: StepShield, last: Decision | None) -> None:
    """A pair that is close counts as hit before: its first impact costs nothing."""
    hit = shield.running.states[:, _columns(shield.running, 1)]
    near = shield.running.states[:, _columns(shield.running, 0)] < 0.5
    _with_states(shield, 1, np.maximum(hit, near))


def belief(name: str, factor: float) -> Leak:
    """The shield believes a parameter to be this many times what it is."""

    def leak(shield, last):
        if last is None:
            _with_problem(shield, **{name: getattr(shield.running.problem, name) * factor})

    return leak


def restitution_wrong(shield: StepShield, last: Decision | None) -> None:
    if last is None:
        clock = shield.running.problem.clock.copy()
        clock[:, CLOCK.RESTITUTION] *= 0.5
        _with_problem(shield, clock=clock)


def far_pairs_forgotten(shield: StepShield, last: Decision | None) -> None:
    """Harm of pairs that the shielded vehicle is no part of does not count."""
    vehicle, N = shield.vehicle, shield.running.problem.mass.shape[1]
    far = [p for p in range(N - 1) if vehicle not in (p, p + 1)]
    for group in (2, 3):
        harm = shield.running.states[:, _columns(shield.running, group)].copy()
        harm[:, far] = 0.0
        _with_states(shield, group, harm)


def plan_rounded(shield: StepShield, last: Decision | None) -> None:
    """The plan is kept with two decimals; its harm is believed unchanged."""
    shield.backup = shield.backup._replace(plan=np.round(shield.backup.plan, 2))


def gaps_blurred(shield: StepShield, last: Decision | None) -> None:
    """Gaps are believed 1 cm longer than they are, from the third step on."""
    if last is not None and int(shield.running.steps.max()) == 3:
        gaps = shield.running.states[:, _columns(shield.running, 0)]
        _with_states(shield, 0, gaps + 0.01)


LEAKS: dict[str, Leak] = {
    "the budget may rise by 1 % in each step": budget_may_rise(1.0),
    "the budget may rise by 0.1 % in each step": budget_may_rise(0.1),
    "1 % of the harm so far is forgotten in each step": harm_forgotten(0.01),
    "impacts are counted one step late": impacts_late,
    "a pair closer than 0.5 m counts as hit before": hits_assumed,
    "the latency of all is believed 10 % longer": belief("latency", 1.1),
    "the masses are believed equal": lambda s, d: _with_problem(s, mass=np.ones_like(s.running.problem.mass)),
    "the others are believed to brake 1 % harder": belief("command", 1.01),
    "restitution is believed half of what it is": restitution_wrong,
    "harm of pairs further off is forgotten": far_pairs_forgotten,
    "the plan is kept with two decimals": plan_rounded,
    "gaps are believed 1 cm longer": gaps_blurred,
}
