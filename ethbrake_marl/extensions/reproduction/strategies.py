"""The paper's strategies, and two assumptions on the time at which Vehicle 2 may act.

The first assumption gives Vehicle 2 the latency that the paper states, the second a latency of 0.2 s (``READINGS``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from ethbrake_marl.extensions.reproduction.folder import Reproduction
from ethbrake_marl.extensions.reproduction.trainings import EARLY, STOPPED
from ethbrake_marl.extensions.reproduction.verdicts import LIST_SEED, PREDICTED, PROVEN
from ethbrake_marl.extensions.search.limits import Unproven
from ethbrake_marl.extensions.search.regret import limits_of
from ethbrake_marl.first_edition.agents.learned import LearnedAgent
from ethbrake_marl.first_edition.agents.protocol import Agent
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.lineup import make_agents
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.policies.shipped import load_shipped
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.progress import Progress

FULL_BRAKE, PAIRWISE, COUPLED = "full_brake", "e_v2x_bm:pairwise", "e_v2x_bm"

SAC, PPO, UNIVERSAL = "sac", "ppo", "universal"

NAMES = {  # names of the strategies in tables and figures
    FULL_BRAKE: "Non-ethical (full braking)",
    PAIRWISE: "E-V2X-BM, realised",
    COUPLED: "E-V2X-BM, coupled",
    SAC: "SAC",
    PPO: "PPO",
    UNIVERSAL: "universal policy",
}


@dataclass(frozen=True, slots=True)
class Reading:
    """An assumption on the time at which Vehicle 2 may act, about which the paper is not clear."""

    name: str  # name of the assumption
    acts_s: float | None = None  # time at which Vehicle 2 may act (s); None: the latency of the scenario

    def scenario(self, name: str, **changes: object) -> Scenario:
        """Return the shipped scenario ``name``, in which Vehicle 2 has the latency ``acts_s`` (None: unchanged).

        ``changes`` are new values for other keys of the scenario.
        """
        scenario = load_scenario(name).replace(**changes) if changes else load_scenario(name)
        if self.acts_s is None:
            return scenario
        first, _, *others = scenario.model_dump()["latency_s"]
        return scenario.replace(latency_s=[first, self.acts_s, *others])


READINGS = (Reading("as stated"), Reading("Vehicle 2 acts at 0.2 s", 0.2))


def lineup(scenario: Scenario, *specs: str) -> dict[str, Agent]:
    """Return the agents with the specs ``specs``, such as ``"full_brake"``, as name -> agent.

    The name of an agent is the entry of its spec in ``NAMES``, or the spec itself if there is no entry.
    """
    return {NAMES.get(spec, spec): agent for spec, agent in make_agents(specs, scenario).items()}


def drive_list(scenario: Scenario, agents: Mapping[str, Agent], episodes: int, settings: Reproduction) -> Evaluation:
    """Evaluate every agent in the first ``episodes`` worlds of the scenario's evaluation list."""
    return evaluate(
        scenario.sample(episodes, LIST_SEED),
        agents,
        scenario=scenario,
        seed=LIST_SEED,
        aftermath=False,
        on_progress=lambda name, done: settings.tell(Progress(scenario.name, done, episodes)),
    )


def harms(evaluation: Evaluation) -> dict[str, Floats]:
    """Return the first-impact harm of each strategy: name of the strategy -> [n] harm in each world (m2/s2).

    The harm that E-V2X-BM predicts (key ``PREDICTED``) and a proven lower bound (key ``PROVEN``) are added if they are
    known.
    """
    each_harm = {name: outcome.first_impact_harm for name, outcome in evaluation.outcomes.items()}
    pairwise = evaluation.outcomes.get(NAMES[PAIRWISE])
    if pairwise is not None and pairwise.predicted_harm is not None:
        each_harm[PREDICTED] = pairwise.predicted_harm
    limits = limits_of(evaluation)
    if not isinstance(limits, Unproven) and limits.proof.harm is not None:
        each_harm[PROVEN] = limits.proof.harm
    return each_harm


_STAND_IN = "ppo-obstacle"  # shipped policy that is used if no policy stopped early was trained


def unconverged_policy(settings: Reproduction) -> tuple[Policy, str]:
    """Return a policy that has not converged, and its description.

    The paper uses a "PPO model obtained from training before convergence occurred". ``ethbrake reproduce --full``
    trains such a policy. If it has not been trained, a shipped policy is returned instead.
    """
    for (path,) in settings.trained([STOPPED]).values():
        about = f"PPO stopped early: the last policy of {EARLY.decisions:,} decisions on paper-random"
        return load_policy(RunDirectory(path).last_policy), about
    about = f"the shipped policy {_STAND_IN!r}, trained for other worlds, stands in for one that has not converged"
    return load_shipped(_STAND_IN), about


def hybrid(policy: Policy, scenario: Scenario, bound: Literal["coupled", "pairwise"]) -> Agent:
    """Return the paper's hybrid (Algorithm 1).

    H* is simulated if ``bound`` is ``coupled``, and predicted by a closed form if ``bound`` is ``pairwise``.
    """
    return HybridAgent(LearnedAgent(policy, "policy"), scenario, bound=bound)


FOUR = (FULL_BRAKE, PAIRWISE, COUPLED, SAC, PPO)  # the paper's four strategies, with two versions of E-V2X-BM

BASELINES = (NAMES[PAIRWISE], NAMES[COUPLED], PREDICTED)

ABOUT_BASELINE = (
    "E-V2X-BM, predicted: what the closed form expects, pair by pair. Realised: what that deceleration does once speeds"
    " are exchanged. Coupled: the constant deceleration of least harm in the same physics."
)
