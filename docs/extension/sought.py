"""Words by which somebody new looks for a page of docs/ and which its title does not hold; its search ranks by them."""

SOUGHT = {
    "installing": "install pip requirements setup gpu without torch docker container",
    "first-ten-minutes": "start tutorial example quick",
    "game": "what is harm units ethical definition meaning first-impact total count",
    "environments": "make create pettingzoo gymnasium wrapper parallel aec api observation features add my own"
    " reward custom shaping reset seed info dictionary render video gif watch",
    "scenarios": "new own custom add a scenario yaml vehicle data measured csv import cars mixture types",
    "train": "train ppo sac mappo sb3 multi-agent multi agent recipe resume rllib torchrl tianshou cleanrl"
    " known exploits a team several vehicles",
    "evaluate": "evaluation compare agents statistics confidence interval baselines e-v2x-bm e v2x bm",
    "shield": "shield my own policy safety wrap guarantee",
    "cooperation": "cooperation levels level v2x latency delay messages communication channel loss knows",
    "extend": "extending plugin package entry point custom agent algorithm register own policy onnx torch load"
    " carla sumo highway-env another simulator",
    "findings": "results figures related work paper",
    "extensions/benchmarl": "train benchmarl",
    "extensions/certified": "robust uncertainty intervals estimated",
    "extensions/cooperation": "ablation study sweep angle svo equilibria",
    "extensions/datasets": "offline parquet minari imitation",
    "extensions/field": "idm acc cacc rss r157 aeb",
    "extensions/fronts": "whose harm pareto trade-off",
    "extensions/learners": "vine rollout classification mixture experts",
    "extensions/proofs": "regret avoidability unavoidable lower bound",
    "extensions/recorded": "highd ngsim openacc traffic trajectories",
    "extensions/report": "html figures film picture",
    "extensions/reproduction": "reproduce replicate paper results",
    "extensions/search": "best known optimum optimal",
    "extensions/studies": "hyperparameters optuna tuning sweep parallel seeds ray cluster falsify worst",
    "internals/model": "physics collision restitution friction units",
    "internals/paper": "equations differences",
    "reference/cli": "commands options",
    "reference/policies": "shipped trained pretrained universal",
}
