"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"commands": {"study.ablate": "commands:ABLATE", "study.front": "commands:FRONT_PART"}}
