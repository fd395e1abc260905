"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "agents": {"vine": "recipes:VINE_AGENT", "rollout-classification": "recipes:ROLLOUT_CLASSIFICATION_AGENT"},
    "algorithms": {"vine": "recipes:VINE", "rollout-classification": "recipes:ROLLOUT_CLASSIFICATION"},
}
