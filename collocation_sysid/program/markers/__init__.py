"""Markers that cameras track: `marker_association` with elements, and `marker_residual`."""
