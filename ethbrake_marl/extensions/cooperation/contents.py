"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"commands": {"study": "commands:study_group"}}
