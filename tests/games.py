"""Random games, drawn from what the package declares, and what must hold in each of them.

Seed and index are the game: plain data, whose text is the example. Numbers of one unit are often equal, or half or
twice each other, so quantities meet at their edges and forces cancel. A game names few agents, so features meet.
"""

import contextlib
import copy
import hashlib
import pickle
import re
from collections.abc import Callable, Iterator
from functools import partial
from inspect import signature
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.agent_names import WRAPPERS, listed_agents
from ethbrake_marl.episode.counts import COUNTS, HONEST
from ethbrake_marl.episode.features import GROUPS
from ethbrake_marl.episode.layer import STATE, UNFILTERED, agent_through
from ethbrake_marl.episode.objectives import OBJECTIVES, amounts, objectives_of
from ethbrake_marl.episode.plans import PlanMemory
from ethbrake_marl.episode.reward import REWARDS
from ethbrake_marl.episode.state import END, ENDED, HORIZON, LAST, arrays_of
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.measure_registry import measures_called
from ethbrake_marl.extensions.messages.belief import CAR_PIECES, LINE_PIECES, known_pieces
from ethbrake_marl.extensions.messages.links import MESSAGES_KEY, P_INTENT, P_PLACE, P_PLAN, PIECES
from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.layout import Bools, Floats
from ethbrake_marl.worlds.channel import PRESETS, V2X
from ethbrake_marl.worlds.quantities import ALTERNATIVES, OF_A_TYPE, OPTIONAL, QUANTITIES, USUAL, Rule, table_columns
from ethbrake_marl.worlds.quantity import DISTRIBUTIONS
from tests.contract.interfaces import BARE, Turn
from tests.refused import refused

Drawn = dict[str, Any]  # a game as plain data
WORLDS = 2
HARM = 1e-6  # allowance for rounding, m2/s2
LIMIT = "speed_limit_mps"  # drawn last: at least the largest speed
NEVER = len(PIECES)  # stands for a piece that no message tells
SHIELD_OPTIONS: Drawn = {
    "allowance": [0.0, 5.0], "cap": ["baseline"], "bound": ["coupled", "pairwise"],
    "uncertainty": ["gaps_m=0.5", "mass_t=10%", "latency_s.vehicle_2=0.1"],
}  # fmt: skip
FEATURES = ("front_1", "rear_1", "front_2", "role", "obstacle", *GROUPS)
CHANNEL, REWARD = V2X.model_json_schema(), eb.RewardParams.model_json_schema()
TERMS = {key: part for key, part in REWARD["properties"].items() if part.get("type") == "number"}


# ---- the generator


def numbers_in(text: Any) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", str(text))]


class Dice:
    def __init__(self, seed: int, index: int) -> None:
        self.rng = np.random.default_rng([seed, index])
        self.usual: dict[str, float] = {}  # unit -> the number that most quantities of this unit have

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def pick(self, things: Any) -> Any:
        return [*things][int(self.rng.integers(len(things)))]

    def some(self, things: Any, probability: float) -> list[Any]:
        return [thing for thing in things if self.chance(probability)]

    def number(self, rule: Rule) -> float:
        scale = self.pick(numbers_in(rule.example)) * self.pick([0.25, 0.5, 1, 1, 2])
        usual = self.usual.setdefault(rule.unit or rule.key, scale)
        edges = [0.0, rule.low, *[usual / 2, 2 * usual] * 2, *[rule.high] * self.chance(0.1)]
        number = self.pick([*[usual] * 8, *usual * self.rng.uniform(0, 2, 4), *edges])
        return float(np.clip(number, rule.low + 1e-3 * rule.positive, rule.high))

    def entry(self, rule: Rule) -> Any:
        low, high = sorted([self.number(rule), self.number(rule)])
        parameters = {
            "normal": {"mean": low, "sd": high - low, "low": low, "high": high},
            "lognormal": {"median": high, "sigma": 0.5, "low": low, "high": high},
        }
        name = self.pick([name for name in DISTRIBUTIONS if low > 0.0 or "log" not in name])
        return {name: parameters.get(name, [low, high])} if self.chance(0.25) and low < high else low

    def quantity(self, rule: Rule, vehicles: int) -> Any:
        alike = rule.per == "world" or self.chance(0.5)
        return self.entry(rule) if alike else [self.entry(rule) for _ in range(rule.count(vehicles))]

    def filled(self, form: str, vehicles: int) -> str:
        """The form of a name, with arguments."""
        arguments = {
            "[@PATH]": "", "[:PHASES]": self.pick(["", ":1"]), ":A": f":{self.pick([0, 2.5, 5, -2])}",
            "ANGLE": f"{self.pick([0, 30, 90])}", "vehicle_K": f"vehicle_{vehicles}",
            "W1,W2,...": ",".join(f"{self.pick([0, 1, 1, 4])}" for _ in range(vehicles)),
            "OBJECTIVE": self.pick(["own", "total", "maximin", "vehicle_1"]),
        }  # fmt: skip
        form = re.sub("|".join(map(re.escape, arguments)), lambda match: str(arguments[match[0]]), form)
        return re.sub(r"\[(.*)\]|\|.*", r"\1" if self.chance(0.3) else "", form)

    def of_schema(self, schema: Drawn, names: Drawn, vehicles: list[str]) -> Any:
        """A value of a JSON Schema with the definitions ``names``. A text is the name of a vehicle."""
        schema = names.get(schema.get("$ref", "").rpartition("/")[2], schema)
        options = [part for part in schema.get("anyOf", schema.get("oneOf", [])) if part.get("type") != "null"]
        low, high = schema.get("minimum", 1e-3 * ("exclusiveMinimum" in schema)), schema.get("maximum", 2.0)
        inner = schema.get("properties") or dict.fromkeys(vehicles, schema.get("additionalProperties"))
        makers: dict[str, Callable[[], Any]] = {
            "any": lambda: self.of_schema(self.pick(options), names, vehicles),
            "object": lambda: {key: self.of_schema(inner[key], names, vehicles) for key in self.some(inner, 0.35)},
            "array": lambda: self.some(schema.get("items", {}).get("enum", []), self.pick([0.6, 1.0])) or [0.1, 0.5],
            "string": lambda: self.pick(schema.get("enum", vehicles)),
            "number": lambda: float(np.clip(self.pick([low, 0, 0.05, 0.1, self.rng.random(), high]), low, high)),
        }
        return makers["any" if options else schema.get("type", "number")]()


def repaired(content: Drawn) -> Drawn:
    """The content without what the package refuses. Each refusal must name a key, and change nothing."""
    for _ in range(20):
        before = copy.deepcopy(content)
        try:
            eb.open_game(content)
            break
        except InvalidInput as error:
            assert content == before, "a refusal changes the content"
            place = re.split(r"scenario[^:]*: (?!scenario)", str(error))[1]
            key, inner = re.findall(r"^(\w+)\b(?:\.(\w+))?", place)[0]
            assert key in eb.Scenario.model_fields, f"a refusal names no key: {error}"
            missing = {key: numbers_in(QUANTITIES[key].example)[0]} if key in QUANTITIES and key not in content else {}
            part = content[key] if isinstance(content.get(key), dict) and inner in content[key] else content
            part.pop(inner if part is not content else key, None)
            content |= missing
    return content


def scenario(dice: Dice, agents: list[str], light: bool) -> Drawn:
    """Content of a scenario file. ``light``: its agents need little time."""
    N, preset = dice.pick([2, 3, 3, 3, 4, 5, 8] if light else [2, 3, 3, 4]), dice.pick(PRESETS)
    vehicles = [f"vehicle_{i + 1}" for i in range(N)]
    keys = [ALTERNATIVES.get(key, key) if dice.chance(0.1) else key for key in (*USUAL, *dice.some(OPTIONAL, 0.15))]
    content: Drawn = {key: dice.quantity(QUANTITIES[key], N) for key in keys}
    fastest = max(numbers_in([content.get("speeds_mps"), content.get("line_speed_mps"), 1.0]))
    step_s = dice.pick([0.05, 0.1, 0.2, 0.25, 0.5] if light else [0.2, 0.25, 0.5])
    roles = {name: dice.pick([*["learner"] * 4, *["full_brake"] * 3, *agents]) for name in vehicles}
    columns = table_columns(tuple(key for key in keys if QUANTITIES[key].column and key != LIMIT), N)
    names, wrong = dice.some(columns, 0.3) or [*columns][:1], QUANTITIES[dice.pick(keys)]
    extras: list[tuple[float, Callable[[], Drawn]]] = [  # how often, what
        (0.4 if light else 0.8, lambda: {
            "v2x": {**dice.of_schema(CHANNEL["anyOf"][1], CHANNEL["$defs"], vehicles), "preset": preset}
        }),
        (0.0 if light else 0.4, lambda: {"v2x": {"preset": preset, "tells": [*PIECES]}}),
        (0.1, lambda: {"v2x": preset}),
        (0.3, lambda: {"objective": dice.filled(dice.pick([kind.form for kind in OBJECTIVES.usable().values()]), N)}),
        (0.2, lambda: {"observation": ["own", *dice.some(FEATURES, 0.5)]}),
        (0.1, lambda: {"early_impacts": "reject"}),
        (0.03, lambda: {"alert_s": dice.entry(QUANTITIES["alert_s"])}),
        (0.1, lambda: {
            "types": dice.pick(["any", [dice.pick(["car", "truck", "any"]) for _ in vehicles]]),
            "vehicle_types": {
                kind: {key: dice.entry(QUANTITIES[key]) for key in dice.some(OF_A_TYPE, 0.5) if key != LIMIT}
                for kind in ("car", "truck")
            },
        }),
        (0.1, lambda: {"table": {
            "columns": names,
            "rows": [[dice.number(QUANTITIES[columns[name][0]]) for name in names] for _ in range(3)],
        }}),
        (0.05, lambda: {wrong.key: dice.pick([wrong.low - 1.0, 2 * wrong.high, float("nan"), "many", [], [1.0] * 99])}),
    ]  # fmt: skip
    content |= {
        "name": "drawn", "vehicles": N, "time_step_s": step_s,
        "horizon_s": min(dice.pick([1.0, 2.0, 2.0, 4.0]), step_s * (40 if light else 8)),
        LIMIT: min(fastest * dice.pick([1.0, 1.0, 1.5, 2.0]), 200.0),
        "roles": roles if "learner" in [*roles.values()][1:] else {**roles, vehicles[-1]: "learner"},
    }  # fmt: skip
    for share, make in extras:
        content |= make() if dice.chance(share) else {}
    content = repaired(content)
    if dice.chance(0.9):
        return content
    other = content | {key: dice.quantity(QUANTITIES[key], N) for key in dice.some(keys, 0.3)} | {"name": "other"}
    return {"name": "mixed", "mixture": [{"scenario": content}, {"scenario": repaired(other), "weight": 2.0}]}


def agent_name(dice: Dice) -> str:
    """A shipped agent. Agents that tell plans are drawn more often."""
    forms = [entry.form for entry in listed_agents() if not re.search(r"^\+|\w@|CANDIDATES", entry.form)]
    return dice.filled(dice.pick([form for form in forms if form.startswith("plan") or dice.chance(0.25)]), 3)


def draw(seed: int, index: int, shielded: bool | None = None) -> Drawn:
    """A game. ``shielded``: whether it has a shield; None: sometimes."""
    dice = Dice(seed, index)
    agents = [agent_name(dice), agent_name(dice)] if dice.chance(0.4) else [agent_name(dice)] * 2
    guarded = dice.chance(0.3) if shielded is None else shielded
    content = scenario(dice, agents, light=not guarded and "plan" not in f"{agents}")
    learners = [*content.get("mixture", [{"scenario": content}])[0]["scenario"].get("roles", {}).values()].count(
        "learner"
    )
    reward = {**{key: dice.of_schema(TERMS[key], {}, []) for key in dice.some(TERMS, 0.3)}, "harm": 1.0}
    settings: Drawn = {"reward": dice.pick([*REWARDS, reward, reward])}
    drawn: Drawn = {
        "scenario": content, "settings": settings, "seed": int(dice.rng.integers(1000)), "agent": dice.pick(agents),
        "door": dice.pick(BARE if learners <= 1 else ["parallel", "in turn", "sb3"]),
        "levels": [dice.pick([-1.0, -1.0, 0.0, 1.0, float(dice.rng.uniform(-1, 1))]) for _ in range(3)],
        "changes": dice.pick([0.0, 0.1, 0.5]),  # how often a vehicle takes another level
    }  # fmt: skip
    settings |= {"max_cycles": dice.pick([1, 3, 5])} if dice.chance(0.15) else {}
    settings |= {"horizon_is_end": dice.chance(0.5)} if drawn["door"] == "sb3" else {}
    drawn["driven"] = not guarded and dice.chance(0.3)  # whether the game's agent drives the learners
    if guarded:
        shields = {
            name: entry.make.shield for name, entry in WRAPPERS.usable().items() if hasattr(entry.make, "shield")
        }
        values = {**SHIELD_OPTIONS, "policy": agents, "harm_count": [*COUNTS]}
        mode = dice.pick(shields)
        needs = {"episode": "policy", "robust": "uncertainty"}.get(mode)
        names = [name for name in ("policy", *signature(shields[mode]).parameters) if name in values]
        chosen = [name for name in names if name == needs or dice.chance(0.5)]
        drawn["shield"] = {"mode": mode, **{name: dice.pick(values[name]) for name in chosen}}
    return drawn


# ---- the game that is played


class Play(SimpleNamespace):
    """A game that was played: ``drawn``, ``interface``, ``scenario``, ``game``, ``learners``, ``team`` (drives the
    learners; None: the ``actions`` [n, T, L] do), ``alert``, ``states``, ``steps`` and the ``last`` state.
    """


def episode(game: eb.Game, alert: eb.State, actions: Floats, team: eb.Team | None = None) -> Any:
    """States and steps. A state after the alert goes on."""
    if team is not None:
        steps, states = zip(*eb.play(game, alert, team), strict=True)
        return [*states], [*steps[1:]]
    steps, states = [], [alert if alert.clock[0, LAST] else game.reset(alert)]
    while not states[-1].ended.all():
        state, step = game.step(states[-1], actions[:, min(len(steps), actions.shape[1] - 1)])
        steps, states = [*steps, step], [*states, state]
    return states, steps


def proposals(drawn: Drawn, shape: tuple[int, ...]) -> Floats:
    """Actions [n, T, L] that are held for some time. NaN proposes nothing to a shield."""
    rng, levels = np.random.default_rng(drawn["seed"]), [*drawn["levels"], *[np.nan] * ("shield" in drawn)]
    actions, changes = rng.choice(np.float32(levels), shape), rng.random(shape) < drawn["changes"]
    since = np.maximum.accumulate(np.where(changes, np.arange(shape[1])[:, np.newaxis], 0), axis=1)
    return np.take_along_axis(actions, since, axis=1).astype(np.float64)


def team_of(name: str, scenario: eb.Scenario, learners: list[int], count: Any = HONEST) -> eb.Team:
    return eb.Team(name, dict.fromkeys(learners, eb.make_agent(name, scenario=scenario, harm_count=count)))


def played(drawn: Drawn) -> Play:
    """Raises ``InvalidInput`` if the game is refused."""
    wrap = {"wrap": partial(eb.shield, **drawn["shield"])} if "shield" in drawn else {}
    interface = BARE[drawn["door"]](copy.deepcopy(drawn["scenario"]), WORLDS, **wrap, **drawn["settings"])
    worlds, game = interface.env.unwrapped.scenario, interface.env.unwrapped.game
    learners = game.settings.learners.tolist()
    alert = worlds.sample(WORLDS, drawn["seed"], purpose="training")
    actions = proposals(drawn, (WORLDS, int(worlds.horizon_s / worlds.time_step_s) + 2, len(learners)))
    team = team_of(drawn["agent"], worlds, learners) if drawn.get("driven") else None
    states, steps = episode(game, alert, actions, team)
    return Play(
        drawn=drawn, interface=interface, scenario=worlds, game=game, learners=learners, team=team, alert=alert,
        actions=actions, states=states, steps=steps, last=states[-1],
    )  # fmt: skip


# ---- what must hold


def bits(*things: Any) -> list[bytes]:
    return [np.asarray(array).tobytes() for array in arrays_of(things)]


def shield_keeps_its_bound(play: Play) -> None:
    """1. The cost is at most the bound told at the alert, which never rises and is at most the cost of E-V2X-BM."""
    shield = play.game.shield
    if shield is None or play.drawn["shield"].get("bound") == "pairwise":
        return
    infos = [shield.infos(play.game, state) for state in play.states]
    bounds, cost = np.array([info["bound_harm"] for info in infos]), play.last.harm(shield.harm_count)
    assert (cost <= bounds[0] + HARM).all(), f"cost above the bound: {cost}, {bounds[0]}"
    assert (np.diff(bounds, axis=0) <= HARM).all(), f"the bound rises: {bounds}"
    own, cap = (np.asarray(infos[-1].get(name, 0.0)) for name in ("own_harm", "baseline_own_harm"))
    assert (own <= cap + HARM).all(), f"own harm above the cap: {own}, {cap}"
    if play.drawn["shield"]["mode"] == "robust":  # its bound is that of the worst possible world
        return
    with contextlib.suppress(InvalidInput):  # E-V2X-BM does not drive in every game
        team = team_of("e_v2x_bm", play.scenario, play.learners, shield.harm_count)
        states, _ = episode(play.game._replace(shield=None), play.alert, play.actions, team)
        told, harm = bounds[0] - getattr(shield, "allowance", 0.0), states[-1].harm(shield.harm_count)
        assert (told <= harm + HARM).all(), f"the bound is above E-V2X-BM: {told}, {harm}"


def who_bears(play: Play) -> None:
    """2. Shares add up. Who touches nobody, does not drive and stands bears nothing. While a contact lasts, nobody
    answers for more than it brakes less than the vehicles ahead can. With equal brakes a push is unanswered only if all
    from its rear vehicle backwards brake fully, and always have.
    """
    last, car, time_s = play.last, play.last.car, np.array([state.time_s for state in play.states])[..., np.newaxis]
    if not last.is_exact:
        return
    for count in last.counts:
        shares = last.borne_harm(count).sum(axis=1)
        assert np.allclose(shares, last.harm(count), rtol=1e-9, atol=HARM), (
            f"shares do not add up: {shares}, {count.name}"
        )
    line = np.array([state.line for state in play.states])  # [T + 1, n, rows, N + 1]
    force, brakes = line[:, :, at.FORCE, 1:], last.braking_capacity_mps2
    met = (line[:, :, at.GAP] <= HARM) | (line[:, :, at.IMPACTS] > 0.0) | (line[:, :, at.PUSHED] > 0.0)
    met = np.logical_or.accumulate(met)
    free = ~(met[-1, :, :-1] | met[-1, :, 1:]) & (last.line[:, [at.DROVE, at.MOVING], :-1] == 0.0).all(axis=1)
    borne = last.borne_harm(HONEST)
    assert (np.abs(borne[free]) <= HARM).all(), f"bears without contact: {borne}"
    equal = np.ptp(np.log(car[:, [at.BRAKING, at.BRAKE_RATE, at.RELEASE_RATE], 1:]), axis=2)
    equal = (np.nan_to_num(equal) == 0.0).all(axis=1)[:, np.newaxis]
    force = np.where(time_s <= last.latency_s, np.maximum(force, 0.0), force)
    withheld = np.maximum(force[1:], force[:-1]) + brakes
    commands = np.array([state.commands_mps2 for state in play.states[1:]])
    full = (time_s[1:] <= last.latency_s + 1e-9) | (commands <= -brakes * (1.0 - 1e-9))
    full = np.logical_and.accumulate(full) & ((withheld <= 1e-9) | (line[1:, :, at.SPEED, 1:] == 0.0))
    for i in range(last.vehicles - 1, 0, -1):  # then: this vehicle and all behind it that have met
        full[..., i - 1] &= full[..., i] | ~met[1:, :, i]
    impacts, pushed, answered = (np.diff(line[:, :, row, :-1], axis=0) for row in (at.IMPACTS, at.PUSHED, at.ANSWERED))
    nobodys = (pushed - answered).sum(axis=2)
    excused = ~equal[:, 0] | ((pushed > 0.0) & full).any(axis=2) | (nobodys <= HARM)
    assert excused.all(), f"a push is unanswered: {nobodys[~excused]}"
    moves = np.minimum(line[1:, :, at.SPEED, 1:], line[:-1, :, at.SPEED, 1:]) > 0.0
    withheld = np.maximum(force[1:], force[:-1]) + np.maximum.accumulate(brakes, axis=1)
    most = withheld * np.diff(time_s, axis=0) * np.arange(last.vehicles) + HARM
    fair = ~moves | (impacts > 0.0) | (answered <= most)
    assert fair.all(), f"answers for too much: {answered[~fair]}, {most[~fair]}"


def motion_is_charged(play: Play) -> None:
    """3. With equal masses and e <= 0.1 no impact after the horizon is harder than what was charged for motion, if
    learners then brake, and scripts that move by themselves lead the line and do not brake.
    """
    last, car, game = play.last, play.last.car, play.game._replace(layers=())
    if not last.is_exact or game.scripts or play.drawn["settings"].get("max_cycles"):
        return
    alone = play.alert.speeds_mps + last.commands_mps2 * (last.time_s[:, np.newaxis] - last.latency_s)
    own = (car[:, at.SCRIPTED, 1:] == 1.0) & (alone > 0.0)  # would still move if it had touched nobody
    leads = np.logical_and.accumulate(own, axis=1) & (last.line[:, [at.GAP], 0] >= at.FAR_M)
    fair = (
        (np.ptp(car[:, at.MASS, 1:], axis=1) == 0.0) & (car[:, at.RESTITUTION, 1] <= 0.1) & (leads == own).all(axis=1)
    )
    fair &= np.isinf(car[:, at.BRAKE_RATE, 1:]).all(axis=1) & ~(own & (last.commands_mps2 < 0.0)).any(axis=1)
    charged, clock = last.line[:, at.MOVING].sum(axis=1), last.clock.copy()
    clock[:, [LAST, END, HORIZON]], clock[:, ENDED] = np.inf, 0.0
    before = last._replace(clock=clock)
    for _ in range(int(8.0 / play.scenario.time_step_s) if fair.any() else 0):
        after, _ = game.follow(before, -np.ones((last.n, len(play.learners))))
        impacts, harm = (after.line[:, row, :-1] - before.line[:, row, :-1] for row in (at.IMPACTS, at.TOTAL))
        hardest = np.where(leads, 0.0, harm / np.maximum(impacts, 1.0)).max(axis=1)
        assert (~fair | (hardest <= charged + 1.0)).all(), (
            f"motion is too cheap: {charged}, then an impact of {hardest}"
        )
        before = after


class Blind(eb.Layer):
    """Shows every vehicle the same other vehicles, whatever is true."""

    def seen(self, state: eb.State, body: int) -> eb.State:
        others, line = np.arange(state.vehicles + 1) != body, np.full(state.line.shape, 9.0)
        line[:, at.HIT :], line[:, : at.GAP] = 0.0, np.where(others, 5.0, state.line[:, : at.GAP])
        car = np.where(others, state.car[:, :, [body]], state.car)
        return state._replace(line=line, car=car, wanted=np.where(others, 0.0, state.wanted), know=0.0 * state.know)


def hidden_from(state: eb.State, body: int, knows: str) -> list[tuple[str, int, Bools]]:
    """What the vehicle ``body`` must not know: array, row (of plans: vehicle), mask [n, N + 1]."""
    bodies = np.tile(np.arange(state.vehicles + 1), (state.n, 1))
    others, own = (bodies > 0) & (bodies != body), (bodies == body - 1) | (bodies == body)
    if knows in UNFILTERED:
        return [("car", row, bodies > 0) for row in (at.MASS, at.RESTITUTION) if knows == STATE]
    known, old = np.zeros((*bodies.shape, NEVER), np.bool_), False
    known[:, :, :P_INTENT] = (state.know[:, body] <= state.time_s[:, np.newaxis])[..., np.newaxis]
    if MESSAGES_KEY in state.memories:
        known, old = known_pieces(state, body), state.memories[MESSAGES_KEY].is_periodic
    known = np.pad(known, [(0, 0), (0, 0), (0, 1)])
    placed = known[:, :, P_PLACE] & others
    ahead, behind = (np.logical_or.accumulate(side, axis=1) for side in (placed, placed[:, ::-1]))
    ahead[:, 0] = placed[:, 1]  # who knows the place of Vehicle 1 knows the obstacle's
    beyond = np.where(bodies < body, ~ahead, ~np.roll(behind[:, ::-1], -1, axis=1))  # gaps with nobody known past them
    tellers = [j for j, memory in state.memories.items() if isinstance(memory, PlanMemory) and j != body]
    return [
        *(("car", row, others & ~known[:, :, CAR_PIECES.get(row, NEVER)]) for row in range(at.SCRIPTED)),
        ("car", at.RESTITUTION, bodies > 0),
        *(("line", row, others & (old | ~known[:, :, piece])) for row, piece in LINE_PIECES.items()),
        ("line", at.GAP, beyond & ~own & (bodies < state.vehicles)),
        *(("line", row, ~own) for row in range(at.FIRST, at.LINE_ROWS)),
        ("wanted", 0, others & (old | ~known[:, :, P_INTENT])),
        *(("plan", j, old | ~known[:, [j], P_PLAN]) for j in tellers),
    ]


def altered(state: eb.State, hidden: list[tuple[str, int, Bools]]) -> eb.State:
    """The state with other values of what is hidden."""
    arrays = {"line": state.line.copy(), "car": state.car.copy(), "wanted": state.wanted[:, np.newaxis].copy()}
    memories = dict(state.memories)
    for name, row, mask in hidden:
        if name == "plan":
            memories[row] = memories[row]._replace(plan=np.where(mask, 0.75, 1.0) * memories[row].plan)
        else:
            arrays[name][:, row] *= np.where(mask & (arrays[name][:, row] < at.FAR_M), 0.75, 1.0)
    return state._replace(**{**arrays, "wanted": arrays["wanted"][:, 0]}, memories=memories)


def knows_no_more(play: Play) -> None:
    """4. No action depends on what ``knows`` excludes, whatever layers show; by hand an agent acts as in the game."""
    game, alert = play.game, play.game.marked(play.alert)
    roles = dict(enumerate(play.scenario.roles.values(), 1))
    for body, name in {**roles, **dict.fromkeys(play.learners[:1], play.drawn["agent"])}.items():
        with contextlib.suppress(InvalidInput):  # not every agent drives in every game
            agent = eb.make_agent(name, scenario=play.scenario)
            inside, blind = (agent_through(layers, agent) for layers in (game.layers, (*game.layers, Blind())))
            start, others = inside.begin(alert, body), np.arange(alert.vehicles + 1) != body
            blindly = inside.begin(altered(alert, hidden_from(alert, body, agent.knows)), body)
            assert bits(blindly) == bits(start), f"{agent.name} reads at the alert: vehicle_{body}"
            for state in play.states[:: len(play.states) // 3 + 1]:
                act = partial(commands_of, state.memories.get(body, start), body, ~state.ended)
                commands, hidden = act(inside, state), hidden_from(state, body, agent.knows)
                if act(inside, altered(state, hidden)) != commands:
                    rows = [part[:2] for part in hidden if act(inside, altered(state, [part])) != commands]
                    raise AssertionError(f"{agent.name} reads {rows}: vehicle_{body} at {state.time_s} s")
                if agent.knows not in UNFILTERED:
                    slower = altered(state, [("line", at.SPEED, others)])
                    assert act(blind, slower) == act(blind, state), f"{agent.name} sees past a layer: vehicle_{body}"
                    assert not game.layers or act(agent, state) == commands, f"{agent.name} by hand: vehicle_{body}"


def commands_of(memory: Any, body: int, running: Bools, agent: Any, state: eb.State) -> list[float]:
    return list(agent.act(state, memory, body)[0][running])


def same_bits(play: Play) -> None:
    """5. The same bits for parts, order, copy, pickle, and the applied actions played again."""
    end = [*play.last[:5]]
    for rows in ([1], [1, 0]):
        states, _ = episode(play.game, play.alert.take(rows), play.actions[rows], play.team)
        assert bits(*states[-1][:5]) == bits(*(array[rows] for array in end)), f"worlds apart: {rows}"
    middle = len(play.states) // 2
    for duplicate in (copy.deepcopy, lambda state: pickle.loads(pickle.dumps(state))) if play.team is None else ():
        states, _ = episode(play.game, duplicate(play.states[middle]), play.actions[:, middle:])
        assert bits(*states[-1][:5]) == bits(*end), f"a copy goes on differently: from step {middle}"
    if play.game.shield is not None and "intervention" not in play.game.rewarding.reported:
        applied = np.stack([state.memories["shield"].applied for state in play.states[1:]], axis=1)
        states, _ = episode(play.game._replace(shield=None), play.alert, applied)
        assert bits(*states[-1][:5]) == bits(*end), "the applied actions lead elsewhere"


def least_harm_is_proven(play: Play) -> None:
    """6. No harm is below the proven bound."""
    if not play.drawn["settings"].get("max_cycles"):
        with contextlib.suppress(InvalidInput):  # the proof covers few games
            bound = measures_called("proven_harm")[0].of(play.game, play.game.marked(play.alert), play.last)[""]
            harm = play.last.harm("first")
            assert (harm + HARM >= bound).all(), f"harm below the proof: {harm}, {bound}"


def doors_agree(play: Play) -> None:
    """5, 7. Every door gives the game's own bits, in its space. A cut is a truncation. A bad action is refused, and
    changes nothing.
    """
    interface, door, L = play.interface, play.drawn["door"], len(play.learners)
    rows, bodies = interface.n * L, np.array(play.learners)
    over = np.zeros(rows, np.bool_)
    turn = Turn(interface.reset(play.drawn["seed"]), *np.zeros((3, rows)))
    for t, state in enumerate(play.states if play.team is None else ()):
        if t and not over.all():
            if door != "in turn":  # which keeps the actions of other agents
                with refused("must be"):
                    interface.step(np.full((rows, 1), 1.5, np.float32))
            turn = interface.step(np.float32(play.actions[: interface.n, t - 1].reshape(-1, 1)))
            reward = np.float32(play.steps[t - 1].reward[:, bodies - 1]).reshape(-1)[:rows]
            ended = state.ended.repeat(L)[:rows]
            cut = (play.steps[t - 1].truncated & (state.time_s < play.scenario.horizon_s)).repeat(L)[:rows]
            assert (over | (np.float32(turn.reward) == reward)).all(), f"another reward: {turn.reward}, {reward}"
            assert (over | (turn.ended == ended)).all(), f"another end: {turn.ended}, {ended}"
            assert (over | turn.truncated | ~cut).all(), f"a cut is no truncation: {door} at step {t}"
        seen = np.stack(play.game.observe(state, bodies), axis=1).reshape(len(state.line) * L, -1)
        for row in np.flatnonzero(~over):
            observation = turn.final.get(int(row), turn.observation[row])
            assert np.array_equal(observation, seen[row]), f"another observation: {observation}, {seen[row]}"
            assert observation in interface.space, f"outside its space: {observation}"
        over |= state.ended.repeat(L)[:rows]


def rewards_add_up(play: Play) -> None:
    """7. A reward is the sum of its weighted terms, and the term harm sums to what the objective counts."""
    params, shape = play.game.rewarding.params, (play.last.n, play.last.vehicles)
    total = np.zeros(shape)
    for before, step in zip(play.states, play.steps, strict=False):
        terms = step.terms or play.game.rewarding.shared(step)
        wide = {name: np.broadcast_to(term.T, shape[::-1]).T for name, term in terms.items()}
        reward = sum((weight * wide[name] for name, weight in params.weights.items() if weight), np.zeros(shape))
        reward[before.ended] = 0.0
        assert np.allclose(step.reward, reward, rtol=1e-9, atol=HARM), f"terms do not add up: {reward}, {step.reward}"
        total += wide.get("harm", 0.0)
    objectives = objectives_of(play.scenario.objective if params.objective is None else params.objective, shape[1])
    if params.harm and all(objective.is_sum for objective in objectives):
        counted = amounts(objectives, play.states[0], play.last, params.harm_count)
        assert np.allclose(total, -counted, rtol=1e-9, atol=HARM), f"harm does not add up: {total}, {counted}"


def intervals_count_worlds(play: Play) -> None:
    """8. An interval counts the rows of a table that differ; where nothing is random there is none."""
    worlds = play.scenario.draw(12, 7).worlds
    different = len({str(bits(*world)) for world in zip(worlds.line, worlds.car, worlds.know, strict=True)})
    (row,) = eb.summarise(eb.evaluate(play.scenario, "full_brake", episodes=12))
    harm, most = row["total_harm"], different if play.scenario.table or different == 1 else 12
    assert harm.interval is None or harm.freedom < most, f"counts too many worlds: {harm}, {different} differ"


INVARIANTS = (
    shield_keeps_its_bound, who_bears, motion_is_charged, knows_no_more, same_bits, least_harm_is_proven, doors_agree,
    rewards_add_up, intervals_count_worlds,
)  # fmt: skip


# ---- the search


def broken(drawn: Drawn, invariants: Any = INVARIANTS) -> dict[str, str]:
    """What is wrong in a game, by the name of the invariant; ``error`` stands for any error that is not a refusal."""
    faults: dict[str, str] = {}
    try:
        play = played(drawn)
    except Exception as error:
        internal = "fails: " in str(error) or not isinstance(error, InvalidInput)
        return {"error": repr(error)} if internal else {}
    for invariant in invariants:
        try:
            invariant(play)
        except AssertionError as error:
            faults[invariant.__name__] = str(error)
        except Exception as error:
            faults["error"] = f"{invariant.__name__}: {error!r}"
    return faults


def simpler(thing: Any) -> Iterator[Any]:
    """Plain data with one part less, or with one entry in place of a list."""
    yield from thing if isinstance(thing, list) else ()
    for key in thing if isinstance(thing, dict) else ():
        yield {other: thing[other] for other in thing if other != key}
        yield from ({**thing, key: part} for part in simpler(thing[key]))


def shrunk(drawn: Drawn, name: str, tries: int = 200) -> Drawn:
    """A game without most of what the fault does not need."""
    for used, smaller in enumerate(islice(simpler(drawn), tries), 1):
        with contextlib.suppress(LookupError, TypeError):
            if name in broken(
                smaller, [invariant for invariant in INVARIANTS if name in (invariant.__name__, "error")]
            ):
                return shrunk(smaller, name, tries - used)
    return drawn


def digest(seed: int, games: int) -> str:
    """Hash of the last states of games; the same with ``python -O``."""
    ends = hashlib.sha256()
    for index in range(games):
        with contextlib.suppress(InvalidInput):
            ends.update(b"".join(bits(*played(draw(seed, index)).last[:5])))
    return ends.hexdigest()
