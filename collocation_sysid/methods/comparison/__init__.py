"""The paper's penalty, and others that the main methods are compared with."""
