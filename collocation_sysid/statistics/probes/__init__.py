"""Probes: what changes in the fit when an assumption is relaxed or data are left out.

- `routine`: one linear step each, in every solve; `deep`: refits of parts of the
  data.
- `relaxed_assumptions`: the assumptions that can be relaxed.
- `profile_likelihood`: intervals from refits with one parameter fixed.
"""
