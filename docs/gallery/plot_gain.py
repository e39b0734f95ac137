"""
Is the gain right?
==================

The gain turns electrons into the camera's numbers (DN). It is the slope of the photon transfer curve, the variance of
a pixel against its signal. Every quantity comes with a 95 % interval, or with the reason why the frames do not
determine it.
"""

import matplotlib.pyplot as plt
import numpy as np

from faintfield import Conditions, calibrate_noise, measure_series

GAIN_DN_PER_E, READ_NOISE_E = 0.5, 3.0
rng = np.random.default_rng(1)


def series(kind: str, exposure_s: float, light_e: float, level: int = 0):
    """Return the statistics of ten frames of a simulated sensor: 2 e/s of dark current, half an electron per photon."""
    shape = (10, 128, 128)
    electrons = rng.poisson(light_e + 2.0 * exposure_s, shape) + rng.normal(0.0, READ_NOISE_E, shape)
    frames = np.round(100.0 + GAIN_DN_PER_E * electrons).astype(np.uint16)
    named = ((f"{kind} {number}", frame) for number, frame in enumerate(frames))
    return measure_series(named, Conditions(kind, exposure_s, level, photons=2.0 * light_e if light_e else None))


# %%
# Two short dark exposures do not determine the gain: the dark current adds hardly any noise.

darks = [series("dark", exposure_s, 0.0) for exposure_s in (0.1, 0.2)]
gain = calibrate_noise(darks).estimates["gain_dn_per_e"]
print(gain.value, "-", gain.why)

# %%
# Flats determine it. The points lie on the line, and the interval holds the true 0.5 DN/e.

flats = [series("flat", 0.1, light_e, level) for level, light_e in enumerate((50, 200, 1000, 4000, 10000))]
calibration = calibrate_noise([*darks, *flats])
gain = calibration.estimates["gain_dn_per_e"]
print(f"K = {gain.value:.4f} DN/e, 95 % interval {gain.ci95[0]:.4f} to {gain.ci95[1]:.4f}")

points = [point for point in calibration.points if point.kind == "flat"]
signal_dn = np.array([point.mean_dn for point in points]) - calibration.estimates["offset_dn"].value
variance_dn2, error_dn2, model_dn2 = np.array(
    [(point.variance_dn2, point.variance_se_dn2, point.model_variance_dn2) for point in points]
).T

figure, (transfer, residual) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
transfer.loglog(signal_dn, model_dn2, color="0.6")
transfer.loglog(signal_dn, variance_dn2, "o")
transfer.set(xlabel="signal, DN", ylabel="variance, DN²", title="photon transfer")
residual.axhline(0, color="0.6")
residual.errorbar(signal_dn, 100 * (variance_dn2 / model_dn2 - 1), 196 * error_dn2 / model_dn2, fmt="o", capsize=3)
residual.set(
    xscale="log", xlabel="signal, DN", ylabel="residual, %", title="with 95 % bars: about zero, as it should be"
)
plt.show()
