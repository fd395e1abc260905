"""Other libraries: every program of libraries.md in this folder runs unchanged, and its policy can be used as an agent.

Each library has its own environment in ``.venvs/``; one that cannot be installed is skipped with the reason. A policy
is evaluated on a fixed list of worlds, together with full braking, and compared, world by world, with the library's own
evaluation if there is one. ``--ci`` runs only the libraries that are cheap to install.
"""

import json
import os
import re
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.programmes import KEPT, Cases, Given, NotInstalled, Told, ready_python, watched

PAGE = Path(__file__).with_name("libraries.md")
SCENARIO, EPISODES, SEED = "paper-random", 500, 7
OWN_EPISODES, CLOSE = 50, 1e-5  # worlds of the library's own evaluation, and tolerance in m2/s2
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
BLOCK = re.compile(
    r"^(?P<title>[^\n]+) \((?P<ran>[^\n]+)\):\n\n"
    r"(?:With:\n\n```python\n(?P<before>.*?)```\n\n)?"
    r"```(?P<language>\w+)\n(?P<code>.*?)```\n(?:\nThen:\n\n```python\n(?P<after>.*?)```\n)?",
    re.MULTILINE | re.DOTALL,
)


class Way(NamedTuple):
    """One program for a library, as the page shows it."""

    library: str
    title: str
    ran: str  # algorithm and length of the training
    language: str
    code: str  # the part that a user copies
    whole: str  # the code with the networks or settings before it and the loop after it


class Library(NamedTuple):
    """Requirements of a library's environment, at the versions that were tried."""

    requires: tuple[str, ...]
    package: str = ""  # distribution whose version is reported; empty: the first of ``requires``
    in_ci: bool = False
    finish: Callable[[dict[str, Any]], Any] = lambda names: names.get("agent")  # names of a block -> agent or policy
    overrides: tuple[str, ...] = ()  # versions that replace requirements of these packages

    @property
    def told(self) -> str:
        return self.package or re.split(r"[\[=<]", self.requires[0])[0]


def ways() -> list[Way]:
    """All programs, in the order of the page."""
    found = []
    for section in PAGE.read_text("utf-8").split("\n## ")[1:]:
        for each in BLOCK.finditer(section):
            whole = "\n".join(each[part] or "" for part in ("before", "code", "after"))
            found.append(
                Way(section.partition("\n")[0], each["title"], each["ran"], each["language"], each["code"], whole)
            )
    return found


# ---------------------------------------------------------------- what becomes of a block: an agent, or a policy


def deterministic(policy: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Policy of TorchRL without exploration."""
    import torch
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    def act(seen: Any) -> Any:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return policy(torch.tensor(seen))

    return act


def of_torchrl(names: dict[str, Any]) -> Any:
    from tensordict import TensorDict

    actor = names.get("actor")
    return actor and deterministic(lambda seen: actor(TensorDict({"observation": seen}, [len(seen)]))["action"])


def of_benchmarl(names: dict[str, Any]) -> Any:
    if "experiment" not in names:
        assert list(Path("outputs").rglob(".hydra")), "its command line wrote no files"
        return None
    from tensordict import TensorDict

    policy = names["experiment"].group_policies["learners"]

    def benchmarl(seen: Any) -> Any:
        each = TensorDict({"observation": seen[:, None]}, [len(seen), 1])
        return policy(TensorDict({"learners": each}, [len(seen)]))["learners", "action"][:, 0]

    return deterministic(benchmarl)


def of_zoo(names: dict[str, Any]) -> Any:
    from stable_baselines3 import PPO

    (file,) = Path("logs").glob("ppo/*/EthBrake-v3.zip")
    return PPO.load(file)


def of_cleanrl(names: dict[str, Any]) -> None:
    env = names["env"]
    env.reset(seed=1)
    for _ in range(2_048):
        if any(env.step(env.action_space.sample())[2:4]):
            env.reset()
    env.close()
    assert list(Path("videos").rglob("*.mp4")), "no film was written"


def of_skrl(names: dict[str, Any]) -> Any:
    import torch

    def skrl(seen: Any) -> Any:
        with torch.no_grad():
            _, told = names["agent"].policy.act({"observations": torch.tensor(seen)}, role="policy")
        return told["mean_actions"].clamp(-1, 1)

    return skrl


def of_tianshou(names: dict[str, Any]) -> Any:
    from tianshou.data import Batch

    policy = names["result"].world.algorithm.policy.eval()
    return lambda seen: policy.map_action(policy(Batch(obs=seen, info=Batch())).act)


def of_agilerl(names: dict[str, Any]) -> Any:
    agent = names["ppo"]
    agent.set_training_mode(False)
    return lambda seen: agent.get_action(seen)[0].reshape(-1, 1)


def of_omnisafe(names: dict[str, Any]) -> Any:
    import torch

    actor = names["model"].agent._actor_critic.actor
    return lambda seen: actor.predict(torch.as_tensor(seen), deterministic=True).detach().numpy()


def of_minari(names: dict[str, Any]) -> None:
    """Check that the recovered environment repeats every episode, bit for bit."""
    env = names["data"].recover_environment()
    assert "front_2.gap" in env.unwrapped.observation_space.features
    for k, episode in enumerate(names["data"].iterate_episodes()):
        observed = [env.reset(seed=k)[0]]
        for action, paid, cost in zip(episode.actions, episode.rewards, episode.infos["cost"][1:], strict=True):
            seen, reward, *_, info = env.step(action)
            observed.append(seen)
            assert (reward, info["cost"]) == (paid, cost)
        assert np.array_equal(observed, episode.observations)


LIBRARIES = {  # by the heading of their section
    "Stable-Baselines3": Library(("stable-baselines3==2.9.2",), in_ci=True),
    "RL Baselines3 Zoo": Library(("rl_zoo3==2.9.2",), finish=of_zoo),
    "CleanRL": Library(("moviepy==2.2.1",), "gymnasium", in_ci=True, finish=of_cleanrl),
    "TorchRL": Library(("torchrl==0.14.1",), in_ci=True, finish=of_torchrl),
    "BenchMARL": Library(
        ("benchmarl==1.5.2", "torchrl<0.12", "tensordict<0.12", "stable-baselines3==2.9.2"), finish=of_benchmarl
    ),
    "RLlib": Library(("ray[rllib]==2.60.0",)),
    "skrl": Library(("skrl==2.1.1",), finish=of_skrl),
    "Tianshou": Library(("tianshou[eval]==2.0.1",), finish=of_tianshou),
    "AgileRL": Library(("agilerl==2.7.1",), finish=of_agilerl),
    "OmniSafe": Library(
        ("omnisafe==0.5.0",), finish=of_omnisafe, overrides=("safety-gymnasium; python_version < '3'", "pandas>=2.0.3")
    ),
    "Minari": Library(("minari[create,hdf5]==0.5.4",), in_ci=True, finish=of_minari),
    "SuperSuit": Library(("supersuit==3.11.0", "stable-baselines3==2.9.2"), in_ci=True),
    "MO-Gymnasium": Library(("mo-gymnasium==1.3.2", "stable-baselines3==2.9.2"), in_ci=True),
    "MOMAland": Library(("momaland==0.2.0", "supersuit==3.11.0", "stable-baselines3==2.9.2")),
    "morl-baselines": Library(("morl-baselines==1.3.0",)),
}
BRIEF = ("Tianshou", "AgileRL")  # two iterations are too few to learn: these need not beat full braking


# ---------------------------------------------------------------- in the library's own environment


def tell(k: int) -> None:
    """Run the k-th program in the current folder, evaluate its policy, and print the cells of its row as JSON."""
    import ethbrake_marl as eb

    way = ways()[k]
    library, scenario = LIBRARIES[way.library], eb.load_scenario(SCENARIO)
    drive = partial(eb.evaluate, scenario=scenario)
    drive(scenario.sample(10, SEED), {"coast": eb.make_agent("coast")})  # compiles the physics before the measurement
    begun, names = cpu_seconds(), {"__name__": "copied"}
    if way.language == "sh":
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        subprocess.run(["bash", "-ec", way.code], check=True, env={**os.environ, "PATH": path})
    else:
        exec(compile(way.whole, way.title, "exec"), names)
    seconds = cpu_seconds() - begun
    policy = library.finish(names)
    harm = braking = own = ""
    verdict = "runs"
    if policy is not None:
        ready = hasattr(policy, "begin") or isinstance(policy, eb.Team)
        agent = policy if ready else eb.policy_agent(policy, clip=True)
        result = drive(scenario.sample(EPISODES, SEED), {"full_brake": eb.make_agent("full_brake"), "theirs": agent})
        theirs, full = (float(result[name]["first_impact_harm"].mean()) for name in ("theirs", "full_brake"))
        harm, braking = f"{theirs:.2f}", f"{full:.2f}"
        if way.library == "Stable-Baselines3":
            difference = evaluated_by_itself(names["model"], agent)
            assert difference <= CLOSE, f"our harm differs by {difference:.2g} m2/s2 from the library's own evaluation"
            own = f"{difference:.0e}"
        if way.library not in BRIEF:
            assert theirs < full, f"harm {harm} is not below the harm of full braking, {braking}"
            verdict = "beats full braking"
    print(json.dumps([version(library.told), harm, braking, own, f"{seconds:.0f}", verdict]))


def evaluated_by_itself(model: Any, agent: Any) -> float:
    """Largest difference in a world's harm between our and the library's evaluation, m2/s2.

    The library's ``evaluate_policy`` gives returns, which are minus the harm.
    """
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    import ethbrake_marl as eb

    scenario = eb.load_scenario(SCENARIO)
    sample = scenario.sample(OWN_EPISODES, SEED, purpose="training")  # the worlds of ``env.reset(seed=SEED)``
    ours = eb.evaluate(sample, {"theirs": agent}, scenario=scenario)["theirs"]["first_impact_harm"]
    worlds = make_vec_env("EthBrake-v3", seed=SEED, env_kwargs={"actions": getattr(model.action_space, "n", None)})
    returns, _ = evaluate_policy(model, worlds, OWN_EPISODES, deterministic=True, return_episode_rewards=True)
    return float(np.abs(ours + returns).max())


def cpu_seconds() -> float:
    """Processor seconds of this process and of its ended children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


# ---------------------------------------------------------------- here


OPTIONS = {
    "--ci": {"action": "store_true", "help": "only the libraries that are cheap to install"},
    "--limit": {"type": float, "default": 900.0, "help": "limit for one program, in seconds"},
}


def cases(given: Given) -> Cases:
    taken = {library for library in LIBRARIES if LIBRARIES[library].in_ci or not given.ci}
    for k, way in enumerate(ways()):
        if way.library in taken:
            yield f"{way.library}: {way.title} ({way.ran})", partial(run, way.library, k, given)


def run(library: str, k: int, given: Given) -> Told:
    """Run the k-th program in the environment of its library."""
    name = re.sub(r"\W+", "_", library.lower())
    try:
        python = ready_python(name, LIBRARIES[library].requires, LIBRARIES[library].overrides)
    except NotInstalled as reason:
        return Told(None, f"skipped: {reason}")
    folder = KEPT / "work" / f"{name}-{k}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    call = f"import os; os.chdir({str(folder)!r}); from tests.programmes import libraries; libraries.tell({k})"
    variables = {"MINARI_DATASETS_PATH": str(folder), "PYTHONUNBUFFERED": "1", **ONE_THREAD}  # apart from the user's
    limit = min(given.limit, given.until - time.monotonic())
    status, told = watched([str(python), "-W", "ignore", "-c", call], limit, **variables)
    if status is None:
        return Told(None if limit < given.limit else False, f"not finished after {limit:.0f} s")
    lines = told.strip().splitlines() or [""]
    if status:
        return Told(False, f"exit status {status}: {lines[-1]}")
    row = next(line for line in reversed(lines) if line.startswith('["'))  # a library may print something after it
    return Told(True, "  ".join(filter(None, json.loads(row))))
