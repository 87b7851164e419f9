"""Features: kinds of measurements and forces, each with all that it contributes to checks and runs.

Runs, checks, verdicts, results and reports iterate over the features and name none of them. To add
one, write a module with a `Feature` and add it to the registry; its residual, its force or its
recording belong into the packages `program`, `model` and `recording`.

- `feature`: `Feature`, the functions that a feature may declare.
- `registry`: the features, in the order of the residuals.
- `measurement_results`: predictions and errors of measurements, as in ``result.json``.
- `marker_feature`, `wrench_feature`, `custom_sensor_feature`, `camera_feature`: measurements.
- `wrench_causes`, `wrench_at_guess`: likely errors in the description of force sensors, after a fit
  and by the simulation at the guess.
- `camera_misspecifications`, `camera_image_misspecifications`, `camera_clock_misspecifications`:
  likely errors in the description of cameras, their images and times.
- `image_tracks`: tracks of points in the images of ordinary cameras, with all their parts.
- `contact_feature`: contact with obstacles.
"""
