"""Edits of the small problem file that divide its body into two regions."""

from __future__ import annotations

from kit.problem_files import SIZE_M, both, replace_text

DENSITY = "density_kg_m3 = 30.0\n"


REGION = f"""{DENSITY}
[[object.region]]
name = "stiff"
cells = {{ box_m = [[-1, -1, 0.03], [1, 1, {SIZE_M[2]}]] }}
material = "yeoh"
density_kg_m3 = 50.0
"""


LAME = """lambda_pa   = { guess = 400.0, lower = 10.0, upper = 1e5 }
mu_pa       = { guess = 200.0, lower = 10.0, upper = 1e5 }
"""


OF_REGION = """young_pa = { guess = 700.0 }
poisson = 0.25
"stiff.c10_pa" = { guess = 300.0 }
stiff.c20_pa = { guess = 40.0, typical = 20.0 }
stiff.c30_pa = 0.0
"""


TWO_REGIONS = both(replace_text(DENSITY, REGION), replace_text(LAME, OF_REGION))
