"""Bodies, experiments, problems and files that several tests use."""
