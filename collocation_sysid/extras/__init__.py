"""Optional features that use the core and a solved problem; nothing else depends on them.

- `live`: estimation while the recording is being made.
- `studies`: plans of many runs, comparisons of methods and of models.
- `planning`: motions of the hand for a task, or that determine the parameters best.
- `export`: identified bodies and motions in the formats of simulators and viewers.
"""
