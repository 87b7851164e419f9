"""Motion-capture files, one format per module, and the tables that they and others are made of."""
