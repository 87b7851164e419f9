"""Markers that cameras track: `association` with elements, and `residual`."""
