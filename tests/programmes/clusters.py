"""Evaluations and trainings give the same bits in one process, on joblib, Ray and Dask, and in Ray Tune. See field.py.

Run in an environment with ray[tune], distributed and stable-baselines3.
"""

import hashlib
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from joblib import parallel_config

import ethbrake_marl as eb

AGENTS, WORLDS, STEPS, CORES = "full_brake,e_v2x_bm,plan", 3000, 4000, 2


def digest(result: eb.Result) -> str:
    sha256 = hashlib.sha256()
    for agent in result:
        for name in sorted(result[agent]):
            sha256.update(np.ascontiguousarray(result[agent][name]).tobytes())
    return sha256.hexdigest()[:16]


def evaluated(jobs: int | None) -> str:
    return digest(eb.evaluate("paper-random", AGENTS, episodes=WORLDS, jobs=jobs))


def trained(config: dict[str, Any]) -> dict[str, Any]:
    """Harm and weights of a short training, as a function that Ray Tune calls."""
    recipe = eb.load_recipe("ppo").replace(**config)
    with tempfile.TemporaryDirectory() as folder:
        eb.train(recipe, "paper-random", Path(folder) / "run", steps=STEPS)
        policy = eb.load_policy(Path(folder) / "run")
    agents = {"mine": eb.LearnedAgent(policy)}
    return {"digest": digest(eb.evaluate("paper-random", agents, episodes=100))}


def tell(where: str) -> None:
    """Print the digests of one place beside those of one process, as JSON."""
    if where == "Ray Tune":
        import ray
        from ray import tune

        ray.init(num_cpus=CORES, include_dashboard=False, logging_level="error", log_to_driver=False)
        grid = {"seed": tune.grid_search([0, 1]), "n_epochs": tune.grid_search([2, 4])}
        tuned = tune.Tuner(trained, param_space=grid).fit()
        there = [each.metrics["digest"] for each in tuned]
        here = [trained(each.config)["digest"] for each in tuned]
        ray.shutdown()
    else:
        here, there = [evaluated(None)], []
        if where == "joblib":
            there.append(evaluated(CORES))
        elif where == "Ray":
            import ray
            from ray.util.joblib import register_ray

            ray.init(num_cpus=CORES, include_dashboard=False, logging_level="error", log_to_driver=False)
            register_ray()
            with parallel_config(backend="ray"):
                there.append(evaluated(CORES))
            ray.shutdown()
        else:
            from dask.distributed import Client, LocalCluster

            with (
                LocalCluster(n_workers=CORES, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
                Client(cluster),
                parallel_config(backend="dask"),
            ):
                there.append(evaluated(CORES))
    print(json.dumps({"here": here, "there": there}))
