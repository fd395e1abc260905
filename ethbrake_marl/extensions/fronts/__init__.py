"""The command ``study front``: the harm that each vehicle bears if the vehicles' harms are weighted in many ways."""
