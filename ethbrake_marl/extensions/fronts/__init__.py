"""The command ``study front``: harm of each vehicle for many choices of whose harm counts."""
