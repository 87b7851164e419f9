"""Likely mistakes in the description of measured wrenches."""
