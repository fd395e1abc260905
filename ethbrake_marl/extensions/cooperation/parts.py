"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {"commands": {"study.ablate": "commands:ABLATE", "study.front": "commands:FRONT_PART"}}
