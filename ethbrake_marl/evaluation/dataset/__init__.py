"""Datasets of episodes: recorded by the actions that replay them, written as Parquet or for Minari."""
