"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"agents": {"plan.estimated": "estimating:AGENT"}, "shields": {"robust": "robust:ROBUST"}}
