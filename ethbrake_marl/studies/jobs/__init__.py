"""Independent jobs: in processes of this machine or on a Ray cluster, tried again where one is lost."""
