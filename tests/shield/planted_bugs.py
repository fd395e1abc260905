"""Thirty-six bugs that a shield could have: each, planted in a copy of the repository, must turn some test red.

``make shield-bugs`` (or ``python -m tests.shield.planted_bugs [--only WORD]``). A bug is a textual patch of the shield,
applied to a temporary copy. There ``test_certify``, ``test_step_shield`` and some other tests run with
compilation switched off, and where they stay green, the other tests of the shield, compiled. Those must be green
without any bug.
"""

from __future__ import annotations

import sys

from tests.programme.planting import Patch, try_bugs

BY_HAND = "test_by_hand__what_the_nominal_shield_certifies_breaks_its_bound_in_a_corner"
OF_BOXES = tuple(
    f"tests/shield/test_interior.py::test_{name}"
    for name in (
        "forms__enclose_what_they_stand_for",
        "states__of_every_world_are_those_of_some_path",
        "by_hand__an_impact_before_the_first_decision_is_not_waited_for",
        "bound__is_never_above_what_speeds_allow",
    )
)
OF_TEAMS = tuple(
    f"tests/shield/test_joint.py::test_{name}"
    for name in (
        "by_hand__of_two_proposals_the_harmless_one_is_accepted_the_other_replaced",
        "by_hand__proposals_that_are_harmless_alone_and_collide_together_go_to_the_front_one",
        "by_hand__what_one_of_two_makes_better_is_in_the_bound_at_once",
        "by_hand__who_says_no_number_keeps_the_plan_and_the_other_is_clipped",
        "shares__are_those_of_the_ledger_and_the_light_one_bears_more",
        "caps__reject_what_only_moves_harm_to_another",
    )
)
QUICK = (
    "tests/shield/test_certify.py", "tests/shield/test_step_shield.py", f"tests/shield/test_robust.py::{BY_HAND}",
    *OF_TEAMS, *OF_BOXES,
)  # fmt: skip
WHOLE = tuple(
    f"tests/shield/test_{name}.py"
    for name in ("joint", "engine_shield", "step", "rollouts", "interfaces", "interference", "interior")
)
SHIELD = "ethbrake_marl/shield/step_shield.py"
GUARD = "ethbrake_marl/shield/guard.py"
ENGINE = "ethbrake_marl/engine.py"
ENCLOSURE = "ethbrake_marl/shield/enclosure.py"

BUGS: dict[str, tuple[Patch, ...]] = {
    "pairwise bound used as if it were coupled": (
        Patch(
            SHIELD,
            "harm, alone = plan_harm(running, plan), np.full(worlds.n, np.inf)",
            "harm, alone = plan_harm(running, plan) / 2.0, np.full(worlds.n, np.inf)",
        ),
    ),
    "the budget may rise": (
        Patch(
            SHIELD,
            "    if value <= budget:\n        copy_action(action, plan[step])",
            "    if value <= 2.0 * budget:\n        copy_action(action, plan[step])",
        ),
        Patch(SHIELD, "    if value <= budget:\n        for c in", "    if value <= 2.0 * budget:\n        for c in"),
    ),
    "clipped after certifying": (
        Patch(SHIELD, "min(max(proposed[c], -1.0), 1.0) if usable", "max(proposed[c], -1e300) if usable"),
        Patch(
            SHIELD,
            "applied, bound, margin = out[:, :, 0].reshape(shape),",
            "applied, bound, margin = np.clip(out[:, :, 0], -1, 1).reshape(shape),",
        ),
    ),
    "an impact counted again where the pair was hit before": (
        Patch(
            SHIELD,
            "    save(world.table, after)\n",
            "    world.table[ROW.HIT, 0] = 0.0\n    save(world.table, after)\n",
        ),
    ),
    "harm so far forgotten": (
        Patch(SHIELD, "    save(world.table, after)\n", "    world.table[-2:] = 0.0\n    save(world.table, after)\n"),
    ),
    "latency ignored": (
        Patch(
            SHIELD,
            "problem = profile_problem(\n                possible,",
            "problem = profile_problem(\n                _at_once(possible),",
        ),
        Patch(
            SHIELD,
            "def held(",
            "def _at_once(worlds: Worlds) -> Worlds:\n    from dataclasses import replace\n\n    v = worlds.vehicles\n"
            "    return replace(worlds, vehicles=replace(v, latency_s=0.0 * v.latency_s))\n\n\ndef held(",
        ),
    ),
    "the rest of the plan begins one decision late": (
        Patch(
            SHIELD,
            "value = worst_of_plan(world, after, over, step + 1, plan, budget)",
            "value = worst_of_plan(world, after, over, step + 2, plan, budget)",
        ),
    ),
    "the plan of a rejected proposal is kept": (
        Patch(
            SHIELD,
            "        if value <= budget:\n            for j in",
            "        if value < math.inf:\n            for j in",
        ),
        Patch(SHIELD, "plan, budget)\n        reason", "plan, math.inf)\n        reason"),
        Patch(SHIELD, "constants, value, budget, room[0]", "constants, value, math.inf, room[0]"),
    ),
    "a constant counts without being certified step by step": (
        Patch(SHIELD, "certified = worst_of_plan(world, states, ended, step, trial, most)", "certified = least"),
    ),
    "a policy's rollout counts without being followed step by step": (
        Patch(SHIELD, "    harm = plan_harm(part, plan)\n", "    harm = 0.0 * plan_harm(part, plan)\n"),
    ),
    "a rollout disturbs the policy's memory": (
        Patch(ENGINE, "(take_memory(memory, np.arange(worlds.n)),)", "(memory,)"),
    ),
    "a rollout writes another past into the plan": (
        Patch(SHIELD, "from_now(held[rows], -1.0, episodes.steps)", "np.full_like(held[rows], -1.0)"),
        Patch(
            SHIELD, "    assert (plan == from_now(decision.backup.plan[rows], plan, found.after.steps - 1)).all()", ""
        ),
    ),
    "only the world as told is certified, not its corners": (
        Patch(
            SHIELD,
            "m = (first + j) % ended.shape[0]\n        worst = max(worst, follow_plan",
            "m = 0\n        worst = max(worst, follow_plan",
        ),
    ),
    "what is seen of the harm so far is not compared": (
        Patch(SHIELD, "first : first + len(GROUPS) * pairs]], axis=1)", "first : first + 2 * pairs]], axis=1)"),
    ),
    "the shield goes on before the engine does": (
        Patch(
            GUARD,
            "        after = copy.copy(shield)\n        decision = after.decide(",
            "        after = shield\n        decision = after.decide(",
        ),
    ),
    "what is proposed is applied": (
        Patch(
            ENGINE,
            "columns = np.ascontiguousarray(ruling.applied)",
            "columns = np.nan_to_num(np.ascontiguousarray(ruling.proposed))",
        ),
    ),
    "what a step led to is not compared": (
        Patch(GUARD, "wanted & ~shield.expects(seen)", "wanted & (seen != seen).all(axis=1)"),
    ),
    "the memory moves on where the step is refused": (
        Patch(
            ENGINE,
            "        step = new._advance(columns)\n        if self.guard",
            "        if self.guard is not None:\n            self.guarded = ruling.memory\n"
            "        step = new._advance(columns)\n        if self.guard",
        ),
    ),
    "each proposal of a team is certified beside the plan as it was, not as it is by then": (
        Patch(SHIELD, "copy_action(plan[step], tried[1])", "copy_action(tried[2], tried[1])"),
        Patch(
            SHIELD,
            "    bound, accepted = certified, 0\n",
            "    bound, accepted = certified, 0\n    copy_action(plan[step], tried[2])\n",
        ),
        Patch(SHIELD, "np.zeros((2, plans.shape[2]))", "np.zeros((3, plans.shape[2]))"),
    ),
    "of a team only the first vehicle's action is certified": (
        Patch(
            SHIELD,
            "going = take_steps(world, states, ended, step, action, after, over)\n    value",
            "copy_action(plan[step], room[1, 0])\n    room[1, 0, 0] = action[0]\n"
            "    going = take_steps(world, states, ended, step, room[1, 0].copy(), after, over)\n    value",
        ),
    ),
    "a team's accepted action keeps the bound of the plan before it": (
        Patch(SHIELD, "bound, accepted = value, accepted + 1", "bound, accepted = bound, accepted + 1"),
    ),
    "a team's plan is followed with the first vehicle's actions for all": (
        Patch(SHIELD, "command_of(plan[step, c], -bounds", "command_of(plan[step, 0], -bounds"),
    ),
    "one acceptable proposal lets the whole team's through": (
        Patch(
            SHIELD,
            "    bound, accepted = certified, 0\n",
            "    bound, accepted = certified, 0\n    first = tried[0].copy()\n",
        ),
        Patch(
            SHIELD,
            "    tell_action(out, plan[step], bound, budget - bound)\n    return going >= 0",
            "    if accepted > 0:\n        copy_action(first, plan[step])\n"
            "        going = take_steps(world, states, ended, step, first, after, over)\n"
            "    tell_action(out, plan[step], bound, budget - bound)\n    return going >= 0",
        ),
    ),
    "what the rear one of a pair bears is forgotten by its cap": (
        Patch(
            SHIELD,
            "        value += table[row, i - 1] - "
            "front_share(table[row, i - 1], table[ROW.MASS, i - 1], table[ROW.MASS, i])\n",
            "        value += 0.0\n",
        ),
    ),
    "a cap is looked at in none of the plans": (
        Patch(SHIELD, "return value if within_caps(world, m) else math.inf", "return value"),
    ),
    "each member of a team is certified alone": (
        Patch(
            GUARD,
            "self.vehicles = tuple(engine.learners)",
            "self.vehicles = tuple(engine.learners)[:1] * len(engine.learners)",
        ),
    ),
    "what is of second order is left out of a product": (Patch(ENCLOSURE, " + radius(x) * radius(y)", ""),),
    "a square root is taken for its chord": (Patch(ENCLOSURE, "error = 0.5 * (0.25 / slope - start)", "error = 0.0"),),
    "a plan without a certificate inside the box is held": (
        Patch(SHIELD, "good = found <= least", "good = found <= np.inf"),
    ),
    "a plan that is kept is told the harm of its corners": (
        Patch(SHIELD, "np.where(asked & ~other, held.harm, decision.bound)", "decision.bound.copy()"),
    ),
    "an impact before the first decision is passed over in a box": (
        Patch(ENCLOSURE, "max(fastest - slowest[i - 1], 0.0) * high(late) + 1e-9", "-1.0"),
    ),
    "in a box no speed limit ends a drive": (
        Patch(ENCLOSURE, "if fastest > cell.limit[i]:", "if fastest > math.inf:"),
    ),
    "a gap in contact stays as wide as it was": (
        Patch(ENCLOSURE, "touch[WIDE] = max(wide, min(height, wide + fastest * length))", "touch[WIDE] = wide"),
    ),
    "what no path follows does no harm": (
        Patch(
            ENCLOSURE, "return high(path.forms[-1]) + rough_rest(", "return high(path.forms[-1]) + 0.0 * rough_rest("
        ),
    ),
    "with an uncertain own latency worlds of the box are distrusted": (
        Patch(SHIELD, "anywhere |= boxes.high[:, own] > boxes.low[:, own]", "anywhere |= boxes.high[:, own] < 0.0"),
    ),
    "a surprise is not flagged": (Patch(SHIELD, "if not surprising.any():", "if surprising.any() or True:"),),
}

if __name__ == "__main__":
    sys.exit(try_bugs("planted shield bugs", BUGS, QUICK, WHOLE, jobs=1))
