"""Files of named worlds: what a search has found, to be driven again for ever.

A file says which scenario its worlds are of, by its content, what drove there, and what that was measured to be.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ethbrake_marl.agents.driving import Episodes, episode_engine, script_agents
from ethbrake_marl.agents.protocol import Agent, Driver, Team
from ethbrake_marl.agents.registry import find_entry, make_agent, make_role, parse_spec, shield_forms, split_specs
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.memory import ask_script, begin_script
from ethbrake_marl.errors import AgentFailed, InvalidInput, Unfamiliar, check_one_learner
from ethbrake_marl.evaluation.identity import LIST_SEED, MOST_NAMED_WORLDS, driving_policy, scenario_sha256
from ethbrake_marl.extensions.certified.uncertainty import UNCERTAINTY_EXAMPLE, Uncertainty
from ethbrake_marl.extensions.search.best_harm import task_problem
from ethbrake_marl.files.yaml import FileModel, Override, Wording, flow_text, read_model, read_yaml
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.state import Floats, Ints, Worlds
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.scenario.catalogue import load_scenario, scenario_path
from ethbrake_marl.scenario.fields import QUANTITY
from ethbrake_marl.scenario.roles import ScriptSpec
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.task import Task

SIZE_LIMIT = 8 << 20  # bytes of it: so many worlds of a long line

Number = Annotated[float, Field(allow_inf_nan=False)]


class NamedWorld(FileModel):
    """One world: its name, its initial state by the columns of a table, and what was measured there (m2/s2)."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")]
    score: Number
    harm: Number
    reference: Number | None = None
    state: Annotated[dict[str, Number], Field(min_length=1, max_length=1000)]


class NamedWorlds(FileModel):
    """A file of named worlds."""

    format: Literal["ethbrake-worlds"]
    version: Annotated[int, Field(ge=1, le=1)]  # a literal would take true and 1.0, which equal 1
    scenario: str
    scenario_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    settings: list[str] = Field(default=[])  # what was set beside the scenario's name, as ``--set`` takes it
    agent: str
    measure: Literal["harm", "regret", "difference", "bound"]
    against: str | None = None
    harm_count: HarmCount
    found_by: str  # the command
    worlds: Annotated[list[NamedWorld], Field(min_length=1, max_length=MOST_NAMED_WORLDS)]

    @classmethod
    def of(cls, scenario: Scenario, /, **told: Any) -> NamedWorlds:
        """The file of worlds of this scenario."""
        return cls(format="ethbrake-worlds", version=1, scenario_sha256=scenario_sha256(scenario), **told)

    @classmethod
    def read(cls, path: str | Path) -> NamedWorlds:
        """Read such a file; raises ``InvalidInput`` naming file, line and key."""
        document = read_yaml(path, SIZE_LIMIT)
        found = read_model(document, cls, Wording(cls, "search again (ethbrake study falsify)"), "of named worlds")
        names = [world.name for world in found.worlds]
        if twice := next((name for k, name in enumerate(names) if name in names[:k]), None):
            raise InvalidInput(f"{path}: world {twice!r} is given twice; names must differ")
        return found

    @property
    def text(self) -> str:
        """The file's text; reading it back gives the same worlds to the bit."""
        head = self.model_dump(exclude={"worlds"}, exclude_none=True)
        lines = [f"{key}: {flow_text(value)}" for key, value in head.items() if value != []]
        lines.append("worlds:")
        for world in self.worlds:
            entries = [f"{key}: {flow_text(value)}" for key, value in world.model_dump(exclude_none=True).items()]
            lines += [f"  - {entries[0]}", *(f"    {entry}" for entry in entries[1:])]
        return "\n".join(lines) + "\n"

    def worlds_of(self, scenario: Scenario, where: str) -> Worlds:
        """The worlds at the alert; raises ``InvalidInput`` for another scenario than theirs."""
        if scenario_sha256(scenario) != self.scenario_sha256:
            raise InvalidInput(
                f"{where}: its worlds were found in scenario {self.scenario!r}"
                f"{''.join(f' with --set {each}' for each in self.settings)}, which {scenario.name!r} is not, or is no"
                " longer: their contents differ; use that scenario, or search again (ethbrake study falsify)"
            )
        columns = self.worlds[0].state.keys()
        for k, world in enumerate(self.worlds):
            if world.state.keys() != columns:
                raise InvalidInput(f"{where}: worlds[{k}].state has other columns than worlds[0]; all need the same")
        return scenario.worlds_from_table({name: [world.state[name] for world in self.worlds] for name in columns})


def states_of(worlds: Worlds, scenario: Scenario) -> list[dict[str, float | None]]:
    """The initial state of each world: the columns that the scenario does not fix, and gaps and speeds.

    The distance to an obstacle is None where only other worlds have one.
    """
    fixed = {
        rule.column_of(i)
        for key, rule in QUANTITY.usual.items()
        for i, (low, high) in enumerate(scenario.bounds(key, dry=bool(np.isfinite(worlds.friction).all())))
        if low == high
    }
    columns = {
        name: values
        for name, values in QUANTITY.columns(worlds).items()
        if name not in fixed or (name.startswith(("gap_", "speed_")) and not name.startswith("speed_limit"))
    }
    return [
        {name: None if np.isnan(values[k]) else float(values[k]) for name, values in columns.items()}
        for k in range(worlds.n)
    ]


_LONGEST_OWNERS = 30  # characters


def drawn_alike(worlds: Worlds, scenario: Scenario) -> dict[str, dict[str, Floats]]:
    """Every quantity in which the worlds differ, by key, apart for vehicles and pairs that have other bounds.

    Their values [n, entries] stand under who they are, in a few words; under "" if they are all that there are.
    """
    found: dict[str, dict[str, Floats]] = {}
    for key, rule in QUANTITY.of(worlds).items():
        values, groups = rule.of(worlds), dict[object, list[int]]()
        values = values[~np.isnan(values).any(axis=1)]
        for i in np.flatnonzero(np.ptp(values, axis=0)).tolist():
            groups.setdefault(None if rule.per == "world" else scenario.bounds(key, dry=True)[i], []).append(i)
        for number, alike in enumerate(groups.values()):
            names = ", ".join(map(rule.owner, alike))
            few = names if len(names) <= _LONGEST_OWNERS else f"{len(alike)} {rule.per}s"
            of_key = found.setdefault(key, {})
            few += f" ({number + 1})" if few in of_key else ""
            of_key["" if len(alike) == values.shape[1] else few] = values[:, alike]
    return found


TRIED_CANDIDATES = 16  # of a script that searches, when a scenario is only checked

LADDER = (  # from no decision at all up to the best that is known
    "coast",
    "full_brake",
    "e_v2x_bm:pairwise",
    "e_v2x_bm",
    "planner",
    "best_harm",
)

FIELD = ("idm", "acc", "cacc", "rss", "r157_human", "r157_fsm", "aeb")  # of other people

_GROUPS = {"ladder": LADDER, "field": FIELD}


def load_runnable(
    name_or_path: str, settings: Sequence[Override] = (), *, drives: Literal["nobody", "one", "some"] = "nobody"
) -> Scenario:
    """Load a scenario as ``load_scenario`` does, and try its scripts, which the file's own check cannot know.

    ``settings`` are put in the place of what the file says. ``drives``: one vehicle, or some, must be a learner.

    Raises ``InvalidInput`` naming the file, line, role and script that no agent of that name and argument can play, and
    when there is no learner, or several where one is needed.
    """
    scenario = load_scenario(name_or_path)
    if settings:
        content = {**scenario.model_dump(mode="json", exclude_none=True), **scenario.declared()}
        scenario = scenario.replace(**Override.put(content, settings))
    worlds = scenario.replace(early_impacts="keep").sample(1, LIST_SEED).worlds
    for i, script in scenario.scripts.items():
        try:
            agent = make_role(scenario, i, most_candidates=TRIED_CANDIDATES)
            ask_script(agent, worlds, begin_script(agent, worlds, i, {}), i)
        except InvalidInput as error:
            role = scenario.vehicle_names[i]
            where = f"scenario {name_or_path!r}"
            if not any(setting.top == "roles" for setting in settings):
                where = read_yaml(scenario_path(name_or_path)).where(("roles", role))
            raise InvalidInput(f"{where}: roles.{role} = {script}: {error}") from None
    learners = [scenario.vehicle_names[i] for i in scenario.learners]
    if drives == "one":
        check_one_learner(scenario.name, learners, "give the others a script: --set roles.vehicle_3=full_brake")
    elif drives == "some" and not learners:
        raise InvalidInput(
            f"scenario {scenario.name!r} has no learner to drive; give the scenario that the agents were trained for"
            " (--scenario), or say which vehicle is driven, for instance --set roles.vehicle_2=learner"
        )
    return scenario


def try_scenario(scenario: Scenario, worlds: Worlds) -> dict[str, Any]:
    """Drive worlds at the alert, and tell, as plain data, in how many what happens that may not be meant.

    Scripts are as they are, but for a search, which has few candidates; learners brake fully. Where a command is beyond
    its vehicle's capacities, each world is driven alone: ``commands_out_of_range`` is vehicle -> row -> message.
    ``refused_by`` is what does not take scripts that depend on the state -> its message. Raises ``InvalidInput`` for
    whatever a script raises, ``PhysicsError`` as ``drive``.
    """
    searches = {
        scenario.vehicle_names[i]: f"{ScriptSpec.parse(script).name}:{TRIED_CANDIDATES}"
        for i, script in scenario.scripts.items()
        if "CANDIDATES" in find_entry(script).form
    }
    tried = scenario.replace(roles={**scenario.roles, **searches})
    braking = {scenario.vehicle_names[i]: "full_brake" for i in scenario.learners}
    scripts = script_agents(tried.replace(roles={**tried.roles, **braking}))
    early, moving = np.zeros((2, worlds.n), np.bool_)
    beyond: dict[str, dict[int, str]] = {}

    def drive_rows(rows: Ints) -> None:
        some = worlds.take(rows)
        engine = Engine(scenario, some.n, learners=(), scripts=scripts, deciders=scenario.learners, worlds=some)
        engine.roster.warns = False  # of a world that fails ``Episodes`` tells
        early[rows] = engine.ledger.count.any(axis=1) | (engine.ledger.obstacle_count > 0)
        moving[rows] = ~Episodes.of(engine, some).at_rest

    try:
        drive_rows(np.arange(worlds.n))
    except AgentFailed:
        for row in range(worlds.n):
            try:
                drive_rows(np.array([row]))
            except AgentFailed as error:
                beyond.setdefault(error.reason.partition(" ")[0], {})[row] = str(error.renumbered([row]))
    odd = {
        scenario.vehicle_names[i]: script
        for i, script in scenario.scripts.items()
        if not ScriptSpec.parse(script).is_state_free()
    }
    usual = scenario.replace(roles={**scenario.roles, **dict.fromkeys(odd, "full_brake")})
    refused, anyway = (_refusals(each, worlds.take([0])) if odd else {} for each in (tried, usual))
    return {
        "early_impacts": int(early.sum()),
        "moving_at_horizon": int(moving.sum()),
        "vehicle_1_late": int((worlds.vehicles.latency_s[:, 0] > 0.0).sum()),
        "commands_out_of_range": beyond,
        "not_state_free": odd,
        "refused_by": {what: why for what, why in refused.items() if what not in anyway},
    }


def _refusals(scenario: Scenario, worlds: Worlds) -> dict[str, str]:
    """What refuses the scenario, each asked itself: agents, shields, a search, ``early_impacts: reject``; and why."""

    def drive_by(spec: str) -> None:
        agent = make_agent(spec, scenario=scenario, most_candidates=TRIED_CANDIDATES, uncertainty=UNCERTAINTY_EXAMPLE)
        check_agents({spec: agent}, worlds, scenario)

    asked: dict[str, Callable[[], object]] = {spec: partial(drive_by, spec) for spec in LADDER}
    asked |= {f"+{shield}": partial(drive_by, f"full_brake+{shield}") for shield in shield_forms()}
    asked["search_list"] = lambda: task_problem(worlds, Task(scenario, scenario.learners))
    asked["early_impacts: reject"] = lambda: scenario.replace(early_impacts="reject")
    refused = {}
    for what, ask in asked.items():
        try:
            ask()
        except InvalidInput as error:
            refused[what] = str(error)
    return refused


def check_agents(agents: Mapping[str, Driver], worlds: Worlds, scenario: Scenario, *, warn: bool = False) -> None:
    """Try every agent before the first of them starts a long evaluation; raises what it would raise then.

    Scripts that need no state are tried on all worlds, which takes no time; all others on the first. ``warn``: as
    ``warn_unfamiliar``.
    """
    if warn:
        warn_unfamiliar(agents, worlds, scenario, scenario.learners)
    for name, agent in agents.items():
        team = Team.of(agent, scenario.learners)
        scripts = script_agents(scenario, except_for=team.drivers)
        if team.shield is not None:
            with AgentFailed.naming(name, [script.name for script in scripts.values()]):
                episode_engine(worlds.take([0]), team, scenario).step({})
            continue
        for vehicle, driver in team.drivers.items():
            tried = worlds if getattr(driver, "state_free", False) else worlds.take([0])
            with AgentFailed.naming(name, [script.name for script in scripts.values()]):
                ask_script(driver, tried, begin_script(driver, tried, vehicle, scripts), vehicle)


_MOST_BEYOND = 0.05  # share of the worlds: as many may lie beyond without a word

_TRAINED = 2_000  # worlds of a training that say where it took place


def warn_unfamiliar(agents: Mapping[str, Driver], worlds: Worlds, scenario: Scenario, vehicles: Sequence[int]) -> None:
    """Warn (``Unfamiliar``) where a trained policy drives in worlds beyond those that it was trained in.

    These are drawn from the scenario in its manifest. Where that cannot be drawn here, nothing is said. Of the channel
    only what a world has of it is compared: latencies.
    """
    drives: dict[str, tuple[str, Policy, dict[str, None]]] = {}  # by hash: the first agent, vehicles in order
    for name, agent in agents.items():
        for vehicle, driver in Team.of(agent, vehicles).drivers.items():
            if isinstance(policy := driving_policy(driver), Policy):
                sha256 = policy.manifest.manifest_sha256
                drives.setdefault(sha256, (name, policy, {}))[2][f"vehicle_{vehicle + 1}"] = None
    for name, policy, driven in drives.values():
        try:
            trained = Scenario.of_dump(policy.manifest.scenario)
            before = trained.sample(_TRAINED, 0).worlds
        except ValueError:
            continue
        found = [each for each in driven if each not in policy.manifest.learners]
        if not np.isclose(trained.time_step_s, scenario.time_step_s):
            found.append("time_step_s")
        found += [f"{worlds.N} vehicles"] if worlds.N != before.N else _beyond(before, worlds)
        for i, script in scenario.scripts.items():
            if str(trained.scripts.get(i, script)) != str(script):
                found.append(f"{scenario.vehicle_names[i]} by {script}")
        if found:
            beyond = f"trained on {trained.name}, and not for what {scenario.name} has: {', '.join(found)}"
            warnings.warn(f"{name}: {beyond}", Unfamiliar, stacklevel=2)


def _beyond(before: Worlds, worlds: Worlds) -> list[str]:
    """The quantities that lie beyond those ``before``."""
    found, known, here = [], QUANTITY.of(before), QUANTITY.of(worlds)
    for key, rule in here.items():
        if key not in known:
            found.append(key)
            continue
        values, seen = rule.of(worlds), rule.of(before)
        low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
        margin = 0.01 * (high - low) + 1e-9 * np.abs(high)
        share = ((values < low - margin) | (values > high + margin)).any(axis=1).mean()
        none = np.isnan(values).any(axis=1).mean()
        if none > _MOST_BEYOND and not np.isnan(seen).any():
            found.append(f"no {key} in {100.0 * none:.0f} % of the worlds")
        if share > _MOST_BEYOND:
            found.append(f"{key} in {100.0 * share:.0f} % of the worlds")
    gone = {key: rule.of(before) < rule.high for key, rule in known.items() if key not in here}
    return found + [f"no {key}" for key, there in gone.items() if there.any(axis=1).all()]  # all had it before


def make_lineup(
    specs: str | Sequence[str],
    scenario: Scenario,
    *,
    harm_count: HarmCount = "first",
    uncertainty: Uncertainty | None = None,
    alone: bool = False,
    bare: bool = False,
) -> dict[str, Driver]:
    """One fresh agent per spec of ``make_agent``, by its spec, to drive the scenario's learners.

    A text has commas between specs. ``ladder`` stands for every agent of ``LADDER``, ``field`` of ``FIELD``.
    ``harm_count`` is the harm that optimising and choosing agents minimise. ``uncertainty`` is what agents with
    ``+robust`` certify against. ``alone``: each drives one vehicle. ``bare``: they go behind a shield, and have none.
    Raises ``InvalidInput`` for a spec given twice, an uncertainty that is missing or that nobody uses, a team or a
    shield that has no place, and what ``make_agent`` raises.
    """
    listed = split_specs(specs) if isinstance(specs, str) else specs
    specs = [each for spec in listed for each in _GROUPS.get(spec, (spec,))]
    written = [parse_spec(spec) for spec in specs]
    for k, each in enumerate(written):
        if each in written[:k]:
            raise InvalidInput(f"agent {str(each)!r} is given twice; each agent drives every world once")
    if uncertainty is not None and not any(each.shield in ("robust", "robust:interior") for each in written):
        raise InvalidInput(f"uncertainty {uncertainty}: nobody uses it; an agent with +robust does: ppo@PATH+robust")
    found = {
        str(each): make_agent(str(each), scenario=scenario, harm_count=harm_count, uncertainty=uncertainty)
        for each in written
    }
    for spec, agent in found.items():
        if isinstance(agent, Team) and (alone or (bare and len(scenario.learners) == 1)):
            raise InvalidInput(f"agent {spec!r}: is a team, one agent is needed here: ppo@RUN/policy/vehicle_2")
        if bare and parse_spec(spec).shield is not None:
            raise InvalidInput(
                f"agent {spec!r}: has a shield already; this command puts its own around each agent, so name the agent"
                " alone, for instance ppo@PATH"
            )
    return found


def make_agents(specs: Sequence[str], scenario: Scenario, *, harm_count: HarmCount = "first") -> dict[str, Agent]:
    """``make_lineup`` where one vehicle is driven."""
    return make_lineup(specs, scenario, harm_count=harm_count, alone=True)  # type: ignore[return-value]  # no teams
