"""Comparison of measurements with predictions, for all kinds, and the kinds that recordings have.

- `registry`: the kinds that experiments have, with their messages declared.
- `measurements`: comparison of predictions with measurements.
"""
