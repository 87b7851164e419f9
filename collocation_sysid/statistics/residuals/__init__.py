"""Analysis of residuals: noise, correlation and differences between recordings.

- `noise_level`: noise of each kind of measurement; `diagnostics`: residuals of each
  marker.
- `autocorrelation`: correlation in time and space.
- `recording_scatter`: between-recording variance.
"""
