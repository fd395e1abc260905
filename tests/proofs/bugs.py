"""Bugs that the proofs must not let pass: each, in a copy of a function, leaves one statement unproven."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import NamedTuple

from ethbrake_marl.physics import kernel
from ethbrake_marl.shield import step_shield
from tests.proofs import statements
from tests.proofs.statements import Statement


class Bug(NamedTuple):
    """``old``, which stands in the function once, replaced by ``new``; and the statement that fails then."""

    module: ModuleType
    function: str
    old: str
    new: str
    breaks: Statement


BUGS = {
    "the earlier root of a contact": Bug(
        kernel, "contact", "return (speed - closing) / pressing, speed", "return -closing / pressing, speed",
        statements.contact,
    ),
    "a contact missed where the gap opens first": Bug(
        kernel, "contact", "if pressing > 0.0:", "if pressing > 0.0 and gap < 1.0:", statements.contact
    ),
    "the way while nothing is in force is forgotten": Bug(
        kernel, "solo_motion", "way = speed * onset", "way = 0.0", statements.stopping
    ),
    "restitution of what moves, not of what is left over": Bug(
        kernel, "resolve_cluster", "pooled + bounce * (pooled - table[ROW.SPEED, i])",
        "pooled + bounce * (pooled + table[ROW.SPEED, i])", statements.two,
    ),
    "blocks pooled without their masses": Bug(
        kernel, "pool", "table[ROW.BLOCK_LOW, count] / mass", "table[ROW.BLOCK_LOW, count] / 2.0", statements.energy
    ),
    "a plastic impact is not put in order": Bug(
        kernel, "resolve_cluster", "bounce = restitution if largest >= BOUND.PLASTIC_SPEED_MPS else 0.0",
        "bounce = restitution", statements.plastic,
    ),
    "the budget may rise": Bug(
        step_shield, "decide_world", "    if value <= budget:\n        for c in",
        "    if value <= 2.0 * budget:\n        for c in", statements.decision,
    ),
    "later proposals are not certified": Bug(
        step_shield, "decide_world", "    if value <= budget:\n        for c in",
        "    if value <= budget or step > 0:\n        for c in", statements.decision,
    ),
    "the fallback is the plan's first action": Bug(
        step_shield, "decide_world", "take_steps(world, states, ended, step, plan[step], after, over)",
        "take_steps(world, states, ended, step, plan[0], after, over)", statements.decision,
    ),
    "the plan is followed from the second decision on": Bug(
        step_shield, "try_action", "value = worst_of_plan(world, after, over, step + 1,",
        "value = worst_of_plan(world, after, over, 1,", statements.decision,
    ),
    "a constant begins one decision late": Bug(
        step_shield, "better_plan", "for j in range(step, plan.shape[0]):",
        "for j in range(step + 1, plan.shape[0]):",
        statements.decision,
    ),
    "a vehicle that never moves": Bug(
        kernel, "solo_motion", "    way = 0.0\n    steady",
        "    return speed, 0.0, math.nan\n    way = 0.0\n    steady",
        statements.stopping,
    ),
    "half the time": Bug(
        kernel, "solo_motion", "    way = 0.0\n    steady", "    duration = duration / 2.0\n    way = 0.0\n    steady",
        statements.stopping,
    ),
    "the plan that was certified with a proposal is not kept": Bug(
        step_shield, "try_action", "                copy_action(room[0, j], plan[j])", "                pass",
        statements.decision,
    ),
    "a constant counts without being certified": Bug(
        step_shield, "better_plan", "certified = worst_of_plan(world, states, ended, step, trial, most)",
        "certified = least", statements.decision,
    ),
    "the bound of the plan is told for the proposal": Bug(
        step_shield, "decide_world", "tell_action(out, plan[step], value, budget - value)",
        "tell_action(out, plan[step], certified, budget - value)", statements.decision,
    ),
    "of two, what was tried last is looked at, not what is applied": Bug(
        step_shield, "decide_world", "take_steps(world, states, ended, step, plan[step], after, over)",
        "take_steps(world, states, ended, step, tried[1], after, over)", statements.decision_of_two,
    ),
    "the first of two that is accepted keeps the bound from before": Bug(
        step_shield, "decide_world", "bound, accepted = value, accepted + 1", "accepted = accepted + 1",
        statements.decision_of_two,
    ),
    "a plan for two is written for the first alone": Bug(
        step_shield, "copy_action", "for c in range(to.shape[0]):", "for c in range(1):", statements.decision_of_two
    ),
}  # fmt: skip


@contextmanager
def planted(bug: Bug) -> Iterator[None]:
    """The module with the bug in it."""
    before = getattr(bug.module, bug.function)
    source = inspect.getsource(before)
    assert source.count(bug.old) == 1, (
        f"{bug.function}: {bug.old!r} stands there {source.count(bug.old)} times, not once"
    )
    try:
        exec(compile(source.replace(bug.old, bug.new), bug.function, "exec"), vars(bug.module))
        yield
    finally:
        setattr(bug.module, bug.function, before)


def misses() -> list[str]:
    """The bugs with which their statement is proven all the same."""
    missed = []
    for name, bug in BUGS.items():
        with planted(bug):
            try:
                bug.breaks()
            except AssertionError as error:
                print(f"{name}: {error}", file=sys.stderr, flush=True)
            else:
                missed.append(name)
    return missed
