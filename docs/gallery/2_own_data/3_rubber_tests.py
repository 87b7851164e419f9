"""
Which constants do the tests determine?
=======================================

Rubber is often tested in uniaxial tension alone, although it is loaded differently in use. The
combined intervals show which constants such a test determines. Kawabata's data contain several
kinds of test of one rubber, so that predictions can be compared with measurements. The deformation
is homogeneous, and no mesh is needed.
"""

# sphinx_gallery_thumbnail_path = 'pictures/3_rubber_tests.png'
import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs
from collocation_sysid.recording.specimen_files import specimen_strains

# Ogden's law with fixed exponents; the term with the exponent -2 matters little in tension.
LAW = "ogden-3"
EXPONENTS = {"alpha_1": 1.3, "alpha_2": -2.0, "alpha_3": 5.0}
MODULI = {
    "mu_1_pa": cs.Unknown(guess=6e5),
    "mu_2_pa": cs.Unknown(guess=-1e4),
    "mu_3_pa": cs.Unknown(guess=1e3),
}
KNOWN = {"kappa_pa": 1e9}  # nearly incompressible
LARGEST_STRETCH = 2.5


def specimens(*tests):
    """Return Kawabata's specimens of some kinds of test."""
    return cs.datasets.kawabata_1981(LAW, tests=tests, largest_stretch=LARGEST_STRETCH)


def fit(*tests, **fixed):
    """Fit the law to some kinds of test, with some constants fixed."""
    return cs.run(cs.Problem(specimens(*tests), {**MODULI, **EXPONENTS, **KNOWN, **fixed}))


# %%
# Uniaxial tension fits well. However, the combined interval of μ₂ contains zero and is much wider
# than its value: this test does not determine μ₂, and the output says so.
uniaxial = fit("uniaxial")
print(uniaxial.table())
low_pa, high_pa = uniaxial.estimates["mu_2_pa"].combined95
assert low_pa < 0 < high_pa

# %%
# In equibiaxial tension the term with μ₂ grows with the third power of the stretch. The prediction
# is far off, as the interval announced: fits with μ₂ at its two ends enclose the measurement.
(equibiaxial,) = specimens("equibiaxial")
measured_pa = equibiaxial.readings[0].measured_values[:, 0]


def predict(run):
    """Return the stress of the equibiaxial test [Pa] with the estimates of a run."""
    return cs.simulate(equibiaxial, run.parameters).custom_sensor_values[0][:, 0]


def rms_error(prediction_pa):
    """Return the root mean square error of a prediction of the equibiaxial test [Pa]."""
    return np.sqrt(np.mean((prediction_pa - measured_pa) ** 2))


failed_pa = predict(uniaxial)
ends_pa = [predict(fit("uniaxial", mu_2_pa=end)) for end in (low_pa, high_pa)]
assert rms_error(failed_pa) > 100e3
assert (measured_pa < np.maximum(*ends_pa))[-3:].all()
assert (measured_pa > np.minimum(*ends_pa))[-3:].all()

# %%
# Planar tension (pure shear) as a second test determines μ₂: its statistical uncertainty is a fifth
# of its value. Now the error of the prediction of the equibiaxial test, 10 kPa, is that of the
# measurements.
both = fit("uniaxial", "planar")
print(both.table())
mu_2 = both.estimates["mu_2_pa"]
assert mu_2.statistical_std_error < 0.3 * abs(mu_2.value)
assert uniaxial.estimates["mu_2_pa"].statistical_std_error is None
assert rms_error(predict(both)) < 15e3

# %%
# The equibiaxial test, which neither fit contains.
stretch = 1 + specimen_strains(equibiaxial)[0]
plt.fill_between(
    stretch, *(end_pa / 1e6 for end_pa in ends_pa), alpha=0.2, label="ends of the interval of μ₂"
)
plt.plot(stretch, failed_pa / 1e6, "--", label="predicted from uniaxial tension")
plt.plot(stretch, predict(both) / 1e6, label="predicted from uniaxial and planar tension")
plt.plot(stretch, measured_pa / 1e6, "k.", label="measured")
plt.xlabel("stretch")
plt.ylabel("nominal stress [MPa]")
plt.legend()
plt.show()
