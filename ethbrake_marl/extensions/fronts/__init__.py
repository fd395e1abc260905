"""The command ``study front``: the harm of each vehicle if commands minimise a weighted sum of these harms."""
