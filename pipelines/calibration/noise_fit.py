"""The part of noise.json that tells how well the series fit: saturation, response, scatter and goodness."""

from faintfield.calib.noise import Estimate, NoiseCalibration
from faintfield.calib.noise.misfit import Scatter, SeriesGoodness
from faintfield.calib.noise.series.statistics import Series
from faintfield.pipelines.formats.results.noise_fit import (
    FitRecord,
    GoodnessRecord,
    Measured,
    ResponseRecord,
    SaturationRecord,
)


def fit_record(calibration: NoiseCalibration) -> FitRecord:
    """Return the record of saturation, response and scatter of one phase."""
    estimates, saturation, response = calibration.estimates, calibration.saturation, calibration.response
    bends = None
    if response is not None:
        bends = ResponseRecord([float(bend) for bend in response.bends_per_dn], float(response.up_to_dn))
    series = [_goodness(goodness) for goodness in calibration.goodness]
    series += [_left_out(item, why) for item, why in saturation.left_out]
    names = ("saturation_e", "linearity_error", "noise_error", "drift_dn", "light_error", "lamp_flicker")
    return FitRecord(
        saturation=SaturationRecord(saturation.limit, saturation.level_dn, saturation.interval_dn),
        response=bends,
        series=series,
        telegraph_pixels=int(calibration.telegraph.sum()),
        maps_absent=calibration.maps.absent,
        **{name: _measured(estimates[name]) for name in names},
    )


def _measured(estimate: Estimate) -> Measured:
    """Return an estimate as the record has it."""
    return Measured(estimate.value, estimate.se, estimate.ci95, estimate.why)


def _left_out(series: Series, why: str) -> GoodnessRecord:
    """Return the record of a series that was left out."""
    conditions = series.conditions
    return GoodnessRecord(conditions.kind, conditions.exposure_s, conditions.level, series.frames, left_out=why)


def _goodness(fit: SeriesGoodness) -> GoodnessRecord:
    """Return the record of a series that was used."""
    conditions = fit.series.conditions
    return GoodnessRecord(
        conditions.kind,
        conditions.exposure_s,
        conditions.level,
        fit.series.frames,
        noise_excess=fit.noise_excess,
        noise_se=fit.noise_se,
        level_residual_dn=fit.level_residual_dn,
        blocks=_per_freedom(fit.blocks),
        rows=_per_freedom(fit.rows),
        columns=_per_freedom(fit.columns),
        by_frame=_per_freedom(fit.frames),
    )


def _per_freedom(scatter: Scatter | None) -> float | None:
    """Return a deviance per degree of freedom, None without any."""
    return scatter.deviance / scatter.freedom if scatter and scatter.freedom > 0 else None
