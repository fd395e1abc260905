"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {
    "agents": {"vine": "recipes:VINE_AGENT", "rollout-classification": "recipes:ROLLOUT_CLASSIFICATION_AGENT"},
    "algorithms": {"vine": "recipes:VINE", "rollout-classification": "recipes:ROLLOUT_CLASSIFICATION"},
}
