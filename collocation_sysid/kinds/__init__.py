"""Rooms: everything that belongs to one kind of body, measurement or force alone.

A room has modules of several stages and one record, its `Kind`. Stages ask the records of `registry`,
and never a kind by its name.
"""
