"""Homogeneous specimens: likely mistakes in their description (`doubts`), concerns in their terms
(`concerns`), notes on tests of one kind and on the zero of the load cell (`notes`).
"""
