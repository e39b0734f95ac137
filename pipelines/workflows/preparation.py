"""Before a capture: a prediction of what it will show."""

from collections.abc import Sequence
from pathlib import Path

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.formats.toml_files import read_rig
from faintfield.pipelines.planning.known import calibration_file, known_lens, known_pace, known_sensor, planned_light
from faintfield.pipelines.planning.options import PlanOptions
from faintfield.pipelines.planning.predict import Predictor, parse_grids, scene_view
from faintfield.pipelines.planning.prediction import PredictionRecord, print_prediction


def predict_capture(rig: Path, options: PlanOptions) -> PredictionRecord:
    """Return and print what a capture by a rig.toml will show."""
    settings = read_rig(rig)
    sensor = known_sensor(
        settings,
        calibration_file(options.noise, NOISE_FILE, rig.parent),
        read_noise_e=options.read_noise_e,
        dark_current_e_per_s=options.dark_current_e_per_s,
        quantum_efficiency=options.quantum_efficiency,
    )
    lens = known_lens(settings, sensor, calibration_file(options.geometry, GEOMETRY_FILE, rig.parent), options.fx_px)
    exposure_s, view = scene_view(settings, options)
    depths_mm = options.depth_mm or settings.scene.depth_mm
    sides_px = [*(options.feature_px or []), *_in_px(options.feature_mm or [], depths_mm, lens.f_px)] or [10.0]
    grids = parse_grids(options.grids or [])
    light = planned_light(options, exposure_s, sensor)
    pace = known_pace(settings)
    predictor = Predictor(settings, options, sensor, lens, pace, light, exposure_s, view, depths_mm, sides_px, grids)
    record = predictor.record(str(rig))
    print_prediction(record)
    return record


def _in_px(sides_mm: list[float], depths_mm: Sequence[float], f_px: Estimate) -> list[float]:
    if not sides_mm:
        return []
    if not depths_mm or f_px.value is None:
        raise WrongUsage(
            f"--feature-mm {sides_mm[0]:g}: pixels of it are not known without a depth and a focal length; give "
            "--depth-mm and --fx-px or --geometry, or --feature-px"
        )
    return [side_mm * f_px.value / depths_mm[0] for side_mm in sides_mm]
