"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"agents": {"vine": "recipe:VINE_AGENT"}, "algorithms": {"vine": "recipe:VINE"}}
