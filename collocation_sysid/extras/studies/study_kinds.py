"""Kinds of studies: the names of their commands, which are in summary.json and in folder names."""

METHOD_STUDY = "compare-methods"
MODEL_STUDY = "compare-models"
SWEEP_STUDY = "sweep"
STUDY_TITLES = {
    METHOD_STUDY: "Comparison of methods",
    MODEL_STUDY: "Comparison of models",
    SWEEP_STUDY: "Sweep",
}
