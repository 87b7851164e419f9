"""
Measured brain tissue: a prediction that the verdict rejects
============================================================

Budday et al. (2017) tested human brain tissue in tension, compression and shear, and in shear while
it was compressed. One term of Ogden's law fits the first three tests of the corona radiata. Is it
therefore a law of this tissue? The data are downloaded at the first use (``pip install
'collocation-sysid[datasets]'``); where they have not been fetched, this page shows the script
without its results.
"""

# sphinx_gallery_thumbnail_path = 'pictures/measured_brain.png'
import dataclasses

import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs
from collocation_sysid.recording.specimen_files import specimen_strains

FITTED = ["UT_T_corona_radiata", "UT_C_corona_radiata", "SS_corona_radiata"]
PREDICTED = "CSS_corona_radiata_lambda_0d75"
LABELS = ("tension", "compression", "shear", "shear at a stretch of 0.75")


# %%
# The last test is predicted only. σ = 20 Pa is an assumption: the curves are medians over donors.
*fitted, compressed = cs.datasets.hyperelastic_curves(
    "Budday_2017", "ogden-1", tests=[*FITTED, PREDICTED], sigma_pa=20.0
)
compressed = dataclasses.replace(compressed, validation=True)
unknown = {"mu_1_pa": cs.Unknown(), "alpha_1": cs.Unknown()}
run = cs.run(cs.Problem([*fitted, compressed], {**unknown, "kappa_pa": 1e6}))

# %%
# The law fits the three tests to about σ, with an exponent near −23. The verdict is "doubtful" all
# the same, and its first reason is the prediction.
print(run)
assert run.trust.verdict == "doubtful"
assert f"the prediction of '{PREDICTED}' misses stress" in str(run)
assert -25 < run.parameters["alpha_1"] < -22


# %%
# The computed stress of the compressed tissue is tens of times the measured one: with such an
# exponent the term grows with the 23rd power of a stretch, and no test that was fitted contains
# both stretches at once.
def computed(experiment):
    """Return the stress of a test with the estimates [Pa]."""
    return cs.simulate(experiment, run.parameters).custom_sensor_values[0][:, 0]


measured_pa = compressed.measurements[0].measured_values[:, 0]
assert np.abs(computed(compressed)).max() > 30 * np.abs(measured_pa).max()
figure, (left, right) = plt.subplots(1, 2, figsize=(7.0, 4.9))
for k, (experiment, label) in enumerate(zip([*fitted, compressed], LABELS, strict=True)):
    axes = right if experiment is compressed else left
    strain = specimen_strains(experiment)[0]
    measured_pa = experiment.measurements[0].measured_values[:, 0]
    axes.plot(strain, measured_pa / 1e3, ".", color=f"C{k}", label=f"{label}, measured")
    axes.plot(strain, computed(experiment) / 1e3, color=f"C{k}", label="computed")
left.set(xlabel="strain, amount of shear", ylabel="nominal stress [kPa]", title="fitted")
right.set(xlabel="amount of shear", title="predicted")
left.legend(fontsize="small")
right.legend(fontsize="small")
figure.tight_layout()
plt.show()
