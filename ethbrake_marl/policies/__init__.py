"""Policies as plain files (JSON and safetensors, never a pickle), run without torch."""
