"""Homogeneous specimens: likely mistakes in their description (`hypotheses`), concerns in their terms
(`concerns`), notes on tests of one kind (`notes`) and on the zero of the load cell (`offsets`).
"""
