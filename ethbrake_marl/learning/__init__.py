"""Training, and the policies that come out of it. torch is imported only by the modules that train."""
