"""Inputs of an evaluation: agents from their specs, trained policies among them, and worlds."""

from __future__ import annotations

import copy
import hashlib
import json
import platform
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ethbrake_marl.agents.policy import LearnedAgent, PolicyAgent
from ethbrake_marl.agents.protocol import Agent, AgentAround, Driver, Team, team_of
from ethbrake_marl.agents.registry import make_agent, make_single_agent, parse_spec
from ethbrake_marl.agents.rollout import episode_engine, script_agents, set_others
from ethbrake_marl.defaults import EPISODES, LIST_SEED, MOST_NAMED_WORLDS, HarmCount
from ethbrake_marl.engine.stream import ask_script, begin_script
from ethbrake_marl.errors import InvalidInput, check_one_learner, naming_agent
from ethbrake_marl.files.plugins import files_run
from ethbrake_marl.files.yaml import Override, changed_parts, flow_text
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.policies.bundle import Policy
from ethbrake_marl.scenario import Sample, Scenario, load_scenario, read_initial_states, read_yaml, worlds_from_table
from ethbrake_marl.scenario.fields import QUANTITIES, quantity_columns
from ethbrake_marl.shield import ShieldedDriver
from ethbrake_marl.shield.uncertainty import Uncertainty

# The identity of a result: the worlds, the scenario and the policies that it is about, and what computed it.
#
# Two results can be compared where worlds and scenario have the same hashes. Versions are told, and no reason to
# refuse.

Kind = Literal[
    "evaluate",
    "evaluate-shards",
    "shield",
    "best-harm",
    "ablate",
    "generalise",
    "learning-curves",
    "robustness",
]
_PACKAGES = ("ethbrake-marl", "numba", "numpy")
_WORDS = {"name", "title", "description", "source"}  # what a scenario is called changes nothing
_BLOCK = 50_000  # worlds hashed at once: news of a world may be a view that takes no memory


def worlds_sha256(worlds: Worlds, index: Ints) -> str:
    """SHA-256 of a list of worlds: of every array (little-endian, by name) and the worlds' numbers in the list."""
    return _arrays_sha256({"index": index, **_arrays(worlds)})


def content_sha256(*parts: Any) -> str:
    """SHA-256 of every array of some dataclasses, one after the other."""
    return _arrays_sha256(
        {f"{k} {name}": array for k, part in enumerate(parts) for name, array in _arrays(part).items()}
    )


def _arrays_sha256(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in arrays.items():
        digest.update(f"{name} {array.dtype.kind} {array.shape}\n".encode())
        for first in range(0, len(array), _BLOCK):
            part = array[first : first + _BLOCK]
            digest.update(np.ascontiguousarray(part, part.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def _arrays(value: Any) -> dict[str, np.ndarray]:
    """The arrays of a dataclass and of those inside it, by name; not one without columns: messages that none sends."""
    found: dict[str, np.ndarray] = {}
    for field in fields(value):
        part = getattr(value, field.name)
        found |= _arrays(part) if is_dataclass(part) else {} if part.shape[1:] == (0,) else {field.name: part}
    return found


def scenario_sha256(scenario: Scenario) -> str:
    """SHA-256 of all that shapes an episode: every value of the scenario, defaults too, but neither name nor texts."""
    content = scenario.content(without=_WORDS)
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def driving_policy(agent: object) -> object:
    """What is inside everything that is around an agent: the policy that it drives by, or the agent itself."""
    while isinstance(agent, AgentAround | LearnedAgent | ShieldedDriver):
        agent = agent.policy
    return agent


def policy_sha256(agent: object) -> str | None:
    """The hash of the policy that an agent drives by, inside whatever is around it; None without one.

    Of a bundle it is that in its manifest, which binds names, network and weights (``Manifest.manifest_sha256``); of
    another library's, that of its weights (``agents.foreign.weights_sha256``).
    """
    agent = driving_policy(agent)
    if isinstance(agent, PolicyAgent):
        return agent.weights_sha256()
    return agent.manifest.manifest_sha256 if isinstance(agent, Policy) else None


def result_versions() -> dict[str, str]:
    """Name -> version of Python and of every package that a result's numbers depend on.

    Of the user's own files that this process ran (plug-ins, agents) the SHA-256 is told in its place.
    """
    versions = {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}
    return versions | {name: f"SHA-256 {sha256}" for name, sha256 in files_run().items()}


def identity_line(scenario: Scenario, sample: Sample) -> str:
    """One line for results that are a text: the hashes of worlds and scenario, and versions."""
    worlds, versions = worlds_sha256(sample.worlds, sample.index), result_versions()
    told = ", ".join(f"{name} {number}" for name, number in versions.items())
    return f"Worlds: SHA-256 {worlds}; scenario: SHA-256 {scenario_sha256(scenario)}; {told}."


def policies_by_name(policies: Mapping[int, str], scenario: Scenario) -> dict[str, str]:
    """Vehicle's name -> SHA-256 of its policy, from that by index."""
    return {scenario.vehicle_names[vehicle]: sha256 for vehicle, sha256 in policies.items()}


def result_identity(
    kind: Kind, scenario: Scenario, sample: Sample | None, left_out: Collection[int] = ()
) -> dict[str, Any]:
    """What a results file of this kind says of itself: ``kind``, hashes of worlds and scenario, ``versions``.

    ``left_out`` are rows of the sample that no figure counts. Without a sample nothing is said of worlds: they differ
    inside the file, which says it there.
    """
    found: dict[str, Any] = {"kind": kind, "scenario_sha256": scenario_sha256(scenario), "versions": result_versions()}
    if sample is not None:
        worlds, index = sample.worlds, sample.index
        if left_out:
            rows = np.setdiff1d(np.arange(worlds.n), list(left_out))
            worlds, index = worlds.take(rows), index[rows]
        found["worlds_sha256"] = worlds_sha256(worlds, index)
    return found


# Files of named worlds: what a search has found, to be driven again for ever.
#
# A file says which scenario its worlds are of, by its content, what drove there, and what that was measured to be.

FORMAT: Literal["ethbrake-worlds"] = "ethbrake-worlds"
VERSION = 1
SIZE_LIMIT = 8 << 20  # bytes of it: so many worlds of a long line

Number = Annotated[float, Field(allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class NamedWorld(_Strict):
    """One world: its name, its initial state by the columns of a table, and what was measured there (m2/s2)."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")]
    score: Number
    harm: Number
    reference: Number | None = None
    state: Annotated[dict[str, Number], Field(min_length=1, max_length=1000)]


class NamedWorlds(_Strict):
    """A file of named worlds."""

    format: Literal["ethbrake-worlds"]
    version: Annotated[int, Field(ge=VERSION, le=VERSION)]  # a literal would take true and 1.0, which equal 1
    scenario: str
    scenario_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    settings: list[str] = []  # what was set beside the scenario's name, as ``--set`` takes it
    agent: str
    measure: Literal["harm", "regret", "difference", "bound"]
    against: str | None = None
    harm_count: HarmCount
    found_by: str  # the command
    worlds: Annotated[list[NamedWorld], Field(min_length=1, max_length=MOST_NAMED_WORLDS)]

    def worlds_of(self, scenario: Scenario, where: str) -> Worlds:
        """The worlds at the alert; raises ``InvalidInput`` for another scenario than theirs."""
        if scenario_sha256(scenario) != self.scenario_sha256:
            raise InvalidInput(
                f"{where}: its worlds were found in scenario {self.scenario!r}"
                f"{''.join(f' with --set {each}' for each in self.settings)}, which {scenario.name!r} is not, or is no"
                " longer: their contents differ; use that scenario, or search again (ethbrake search falsify)"
            )
        columns = self.worlds[0].state.keys()
        for k, world in enumerate(self.worlds):
            if world.state.keys() != columns:
                raise InvalidInput(f"{where}: worlds[{k}].state has other columns than worlds[0]; all need the same")
        return worlds_from_table({name: [world.state[name] for world in self.worlds] for name in columns}, scenario)


def read_named_worlds(path: str | Path) -> NamedWorlds:
    """Read a file of named worlds; raises ``InvalidInput`` naming file, line and key."""
    document = read_yaml(path, SIZE_LIMIT)
    try:
        found = NamedWorlds.model_validate(document.content)
    except ValidationError as error:
        first = error.errors()[0]
        place = tuple(first["loc"])
        line = document.line_of(place) or document.line_of(place[:-1])
        key = ".".join(map(str, place)) or "the file"
        raise InvalidInput(f"{path}{f', line {line}' if line else ''}: {key}: {first['msg']}") from None
    names = [world.name for world in found.worlds]
    if twice := next((name for k, name in enumerate(names) if name in names[:k]), None):
        raise InvalidInput(f"{path}: world {twice!r} is given twice; names must differ")
    return found


def states_of(worlds: Worlds, scenario: Scenario) -> list[dict[str, float]]:
    """The initial state of each world: the columns that the scenario does not fix, and gaps and speeds."""
    columns = {name: values for name, values in quantity_columns(worlds).items() if _needed(name, values, scenario)}
    return [{name: float(values[k]) for name, values in columns.items()} for k in range(worlds.n)]


def _needed(column: str, values: Floats, scenario: Scenario) -> bool:
    if column.startswith(("gap_", "speed_")) and not column.startswith("speed_limit"):
        return True
    return column not in _fixed_columns(scenario)


def _fixed_columns(scenario: Scenario) -> set[str]:
    """Columns whose value the scenario fixes for every world."""
    return {
        rule.column_of(i)
        for key, rule in QUANTITIES.items()
        for i, (low, high) in enumerate(scenario.bounds(key))
        if low == high
    }


def named_worlds_text(found: NamedWorlds) -> str:
    """The file's text; reading it back gives the same worlds to the bit."""
    head = found.model_dump(exclude={"worlds"}, exclude_none=True)
    lines = [f"{key}: {flow_text(value)}" for key, value in head.items() if value != []]
    lines.append("worlds:")
    for world in found.worlds:
        kept: Mapping[str, object] = world.model_dump(exclude_none=True)
        entries: Sequence[str] = [f"{key}: {flow_text(value)}" for key, value in kept.items()]
        lines += [f"  - {entries[0]}", *(f"    {entry}" for entry in entries[1:])]
    return "\n".join(lines) + "\n"


PROGRESS_EVERY = 2_500  # worlds between two signs of life
TRIED_CANDIDATES = 16  # of a script that searches, when a scenario is only checked

LADDER = (  # from no decision at all up to the best that is known
    "coast",
    "copy_leader",
    "full_brake",
    "gentlest_front",
    "e_v2x_bm:pairwise",
    "e_v2x_bm",
    "planner",
    "best_harm",
)
_LADDER_SPEC = "ladder"


def load_runnable(name_or_path: str, settings: Sequence[Override] = ()) -> Scenario:
    """Load a scenario as ``load_scenario`` does, and try its scripts, which the file's own check cannot know.

    ``settings`` are put in the place of what the file says.

    Raises ``InvalidInput`` naming the file, line, role and script that no agent of that name and argument can play.
    """
    scenario = load_scenario(name_or_path)
    if settings:
        content = {**scenario.model_dump(mode="json", exclude_none=True), **scenario.declared()}
        scenario = scenario.replace(**changed_parts(content, settings))
    worlds = scenario.replace(early_impacts="keep").sample(1, LIST_SEED).worlds
    for vehicle, script in scenario.scripts.items():
        try:
            agent = make_single_agent(script, horizon_s=scenario.horizon_s, most_candidates=TRIED_CANDIDATES)
            _try_out(agent, worlds, vehicle)
        except InvalidInput as error:
            role = scenario.vehicle_names[vehicle]
            where = _place_of_role(name_or_path, role)
            raise InvalidInput(f"{where}: roles.{role} = {script}: {error}") from None
    return scenario


def load_driven(name_or_path: str, vehicle: str | None, settings: Sequence[Override] = ()) -> Scenario:
    """A runnable scenario with one learner, the vehicle to drive: ``vehicle``, by default the only learner.

    Raises ``InvalidInput`` when there is no such vehicle, or nothing says which one it is.
    """
    scenario = load_runnable(name_or_path, settings)
    if vehicle is not None:
        return scenario.with_learners([vehicle])
    learners = [scenario.vehicle_names[i] for i in scenario.learners]
    check_one_learner(scenario.name, learners, "say which vehicle is driven, for instance --vehicle vehicle_2")
    return scenario


def load_evaluated(name_or_path: str, vehicle: str | None, settings: Sequence[Override] = ()) -> Scenario:
    """A runnable scenario whose learners are to be driven: ``vehicle`` alone, by default all learners there are.

    Raises ``InvalidInput`` when there is no such vehicle, or no learner.
    """
    scenario = load_runnable(name_or_path, settings)
    if vehicle is not None:
        return scenario.with_learners([vehicle])
    if not scenario.learners:
        raise InvalidInput(
            f"scenario {scenario.name!r} has no learner to drive; give the scenario that the agents were trained for"
            " (--scenario), or say which vehicle is driven, for instance --vehicle vehicle_2"
        )
    return scenario


def check_agents(agents: Mapping[str, Driver], worlds: Worlds, scenario: Scenario) -> None:
    """Try every agent before the first of them starts a long evaluation; raises what it would raise then.

    Scripts that need no state are tried on all worlds, which takes no time; all others on the first.
    """
    for name, agent in agents.items():
        team = team_of(agent, scenario.learners)
        scripts = script_agents(scenario, except_for=team.drivers)
        if team.shield is not None:
            with naming_agent(name, [script.name for script in scripts.values()]):
                episode_engine(worlds.take([0]), team, scenario).step({})
            continue
        for vehicle, driver in team.drivers.items():
            set_others(driver, vehicle, scripts)
            with naming_agent(name, [script.name for script in scripts.values()]):
                _try_out(driver, worlds if getattr(driver, "state_free", False) else worlds.take([0]), vehicle)


def make_lineup(
    specs: Sequence[str],
    scenario: Scenario,
    *,
    harm_count: HarmCount = "first",
    uncertainty: Uncertainty | None = None,
) -> dict[str, Driver]:
    """One fresh agent per spec of ``make_agent``, by its spec, to drive the scenario's learners.

    ``ladder`` stands for every agent of ``LADDER``. ``harm_count`` is the harm that optimising and choosing agents
    minimise. ``uncertainty`` is what agents with ``+robust`` certify against. Raises ``InvalidInput`` for a spec given
    twice, an uncertainty that is missing or that nobody uses, and what ``make_agent`` raises.
    """
    specs = [each for spec in specs for each in (LADDER if spec == _LADDER_SPEC else [spec])]
    written = [parse_spec(spec) for spec in specs]
    for k, each in enumerate(written):
        if each in written[:k]:
            raise InvalidInput(f"agent {str(each)!r} is given twice; each agent drives every world once")
    if uncertainty is not None and not any(each.shield in ("robust", "robust:interior") for each in written):
        raise InvalidInput(f"uncertainty {uncertainty}: nobody uses it; an agent with +robust does: ppo@PATH+robust")
    return {
        str(each): make_agent(str(each), scenario=scenario, harm_count=harm_count, uncertainty=uncertainty)
        for each in written
    }


def make_agents(specs: Sequence[str], scenario: Scenario, *, harm_count: HarmCount = "first") -> dict[str, Agent]:
    """``make_lineup`` where one vehicle is driven; raises ``InvalidInput`` for a team too."""
    alone: dict[str, Agent] = {}
    for spec, agent in make_lineup(specs, scenario, harm_count=harm_count).items():
        if isinstance(agent, Team):
            raise InvalidInput(f"agent {spec!r}: is a team, one agent is needed here: ppo@RUN/policy/vehicle_2")
        alone[spec] = agent  # type: ignore[assignment]  # or one behind a shield
    return alone


def make_proposers(specs: Sequence[str], scenario: Scenario, *, harm_count: HarmCount = "first") -> dict[str, Driver]:
    """What goes behind a shield: ``make_lineup`` where several vehicles learn, else ``make_agents``.

    Raises ``InvalidInput`` for a spec that has a shield already.
    """
    make = make_lineup if len(scenario.learners) > 1 else make_agents
    agents: Mapping[str, Driver] = make(specs, scenario, harm_count=harm_count)
    for spec in agents:
        if parse_spec(spec).shield is not None:
            raise InvalidInput(
                f"agent {spec!r}: has a shield already; here the shields are put around what proposes: ppo@PATH"
            )
    return dict(agents)


def choose_worlds(
    scenario: Scenario, *, initial_states: Path | None = None, episodes: int | None = None, seed: int | None = None
) -> tuple[Sample, int | None]:
    """The user's own worlds, or the first ``episodes`` of the list of ``seed``; and that seed, None for own worlds.

    Raises ``InvalidInput`` when worlds are given and drawn at once, and what reading or drawing them raises.
    """
    if initial_states is None:
        list_seed = LIST_SEED if seed is None else seed
        return scenario.sample(EPISODES if episodes is None else episodes, list_seed), list_seed
    if episodes is not None or seed is not None:
        raise InvalidInput(
            f"{initial_states}: gives the worlds, and a number of episodes or a seed draws them; use one"
        )
    if initial_states.suffix.lower() in (".yaml", ".yml"):
        worlds = read_named_worlds(initial_states).worlds_of(scenario, str(initial_states))
    else:
        worlds = read_initial_states(initial_states, scenario)
    return Sample(worlds, np.arange(worlds.n, dtype=np.int64), 0), None


def _try_out(agent: Agent, worlds: Worlds, vehicle: int) -> None:
    """Let a copy of the agent begin and act once."""
    driver = copy.deepcopy(agent)
    begin_script(driver, worlds, vehicle, np.arange(worlds.n))
    ask_script(driver, worlds, vehicle)


def _place_of_role(name_or_path: str, role: str) -> str:
    """File and line of a role, or the name of a shipped scenario."""
    if not Path(name_or_path).is_file():
        return f"scenario {name_or_path!r}"
    return read_yaml(name_or_path).where(("roles", role))
