"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"shields": {"robust": "robust:ROBUST", "step.estimated": "estimating:ESTIMATED_STEP"}}
