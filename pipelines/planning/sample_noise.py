"""Noise of a sample of the planes, predicted from the light that the frames of a capture show."""

from collections.abc import Callable, Sequence
from pathlib import Path

from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.planning.known import (
    calibration_file,
    fewest_seen,
    grid_centres_mm,
    known_lens,
    known_sensor,
    pixel_share,
    view_noise_e,
)
from faintfield.recon.prediction import information_of_views, sample_sigma_e
from faintfield.rig.plan import CaptureStep
from faintfield.rig.session.journal import FrameRecord
from faintfield.rig.settings import RigSettings


class MeasuredNoise:
    """Predictor of the noise of a sample, at the light of the brightest part of the frames so far.

    The sample is the one in the middle of the plane that the fewest views see. The level of the darkest parts counts as
    charge that every pixel has, if it is more than the dark current: stray light adds noise, too. `light_e_per_s`
    stands for the light until there is a frame; None if it is not planned.

    Raises
    ------
    MissingFile
        Read noise, gain, dark current or offset of the sensor are not known.
    """

    def __init__(
        self,
        settings: RigSettings,
        rig: Path,
        session: Path,
        noise: Path | None,
        geometry: Path | None,
        fx_px: float | None,
        *,
        light_e_per_s: float | None,
    ) -> None:
        folders = session, rig.parent
        sensor = known_sensor(settings, calibration_file(noise, NOISE_FILE, *folders))
        read_noise_e, gain = sensor.read_noise_e.value, sensor.gain_dn_per_e.value
        dark_e_per_s, offset_dn = sensor.dark_current_e_per_s.value, sensor.offset_dn()
        if read_noise_e is None or gain is None or dark_e_per_s is None or offset_dn is None:
            named = {name: getattr(sensor, name).value for name in ("read_noise_e", "gain_dn_per_e")}
            named |= {"dark_current_e_per_s": dark_e_per_s, "offset_dn": offset_dn}
            unknown = ", ".join(name for name, value in named.items() if value is None)
            raise MissingFile(
                f"{rig}: a step has until.sigma_e, but {unknown} of the sensor is not known by {sensor.source}; give "
                "the result of `faintfield noise` as --noise, or put it beside the rig.toml"
            )
        self._read_noise_e, self._gain, self._offset_dn = read_noise_e, gain, offset_dn
        self._dark_e_per_s = max(dark_e_per_s, 0.0)
        lens = known_lens(settings, sensor, calibration_file(geometry, GEOMETRY_FILE, *folders), fx_px)
        centres_mm = grid_centres_mm(settings.grid)
        self._sample = fewest_seen(
            [lens.sample(centres_mm, depth_mm) for depth_mm in settings.scene.depth_mm or (None,)]
        )
        self._share = pixel_share(settings, sensor)
        self._light_e_per_s = light_e_per_s

    def predict(self, step: CaptureStep, records: Sequence[FrameRecord]) -> Callable[[float], float] | None:
        """Return the noise of a sample by the number of rounds, in electrons of one frame of the first exposure.

        None if no light was measured and none is planned.
        """
        light = self._light(records)
        if light is None:
            return None
        light_e_per_s, dark_e_per_s = light
        exposure_s, frames = step.frames_per_node * sum(step.exposure_s), step.frames_per_stop()

        def sigma_e(rounds: float) -> float:
            total_s = rounds * exposure_s
            noise_e = view_noise_e(self._read_noise_e, self._gain, rounds * frames)
            information = information_of_views(
                light_e_per_s * total_s, dark_e_per_s * total_s, noise_e, self._sample.response
            )
            total = self._share * float(information.sum())
            return step.exposure_s[0] / total_s * sample_sigma_e(total, self._sample.spread)

        return sigma_e

    def _light(self, records: Sequence[FrameRecord]) -> tuple[float, float] | None:
        """Return the light of the brightest part, and the charge of the darkest ones, in electrons per pixel and s."""
        lit = [record for record in records if "light_dn" in record.checks]
        if not lit:
            return None if self._light_e_per_s is None else (self._light_e_per_s, self._dark_e_per_s)
        total_s = sum(record.exposure_s for record in lit)
        light_e = sum(record.checks["light_dn"] for record in lit) / self._gain
        dark_e = sum(record.checks["darkest_dn"] - self._offset_dn for record in lit) / self._gain
        return max(light_e, 0.0) / total_s, max(dark_e / total_s, self._dark_e_per_s)
