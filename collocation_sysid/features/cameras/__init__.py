"""Likely mistakes in the description of depth cameras, and concerns about them."""
