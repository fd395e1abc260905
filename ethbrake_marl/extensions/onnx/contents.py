"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"commands": {"agent.export": "commands:EXPORT"}}
