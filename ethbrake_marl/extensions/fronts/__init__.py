"""The command ``study front``: the harm of each vehicle under commands that minimise a weighted sum of the harms."""
