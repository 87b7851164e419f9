"""Likely mistakes in the description of obstacles and of the body among them, and concerns about contact."""
