"""Policies: stored as JSON and safetensors files (never a pickle), and run without torch."""
