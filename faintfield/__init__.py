"""Photon-starved integral imaging: calibrate a camera on a grid of nodes, and reconstruct what it saw in the dark.

`__all__` lists the public names, and docs/how-to/use_python.md shows them in use. A name is loaded from its module at
its first use, so `import faintfield` is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING

# Public name: its module below faintfield, and after a colon its name there if that differs.
_MODULES = {
    "Board": "calib.board",
    "BoardObservation": "calib.geometry",
    "CalibrationError": "calib.errors",
    "CapturePlan": "rig.plan",
    "Conditions": "calib.noise",
    "Denoiser": "recon.prior.denoiser",
    "DataFit": "recon.solver.data_fit",
    "ElementalImages": "recon.likelihood.images",
    "Grid": "rig.plan",
    "InputError": "pipelines.errors",
    "Lens": "calib.lens",
    "LightField": "pipelines.notebook.light_field",
    "MotionLimits": "rig.stages.protocol",
    "NoiseModel": "calib.noise_model",
    "OutsideTravel": "rig.errors",
    "Plane": "pipelines.notebook.results",
    "PlaneGrid": "recon.operator.grid",
    "PlaneOperator": "recon.operator.single_plane",
    "PlaneOptions": "pipelines.notebook.options",
    "Planes": "pipelines.notebook.results",
    "Point": "rig.stages.protocol",
    "ProximalPenalty": "recon.solver.custom_penalty",
    "ReconstructionError": "recon.errors",
    "RigError": "rig.errors",
    "RigSettings": "rig.settings",
    "StageSettings": "rig.stages.protocol",
    "Surface": "pipelines.notebook.results",
    "SyntheticOptions": "pipelines.simulation.options",
    "CaptureStep": "rig.plan",
    "Target": "calib.geometry",
    "back_projection": "recon.solver.initialization",
    "calibrate_geometry": "calib.geometry",
    "calibrate_noise": "calib.noise:calibrate",
    "channel_layouts": "pipelines.reconstruction.channels",
    "detect_all": "calib.detection",
    "fronto_parallel_rt_ref_plane": "calib.homography",
    "linear_operator": "recon.operator.linear",
    "load_channel": "pipelines.reconstruction.channels",
    "load_set": "pipelines.formats.sets.elemental_set",
    "measure_series": "calib.noise",
    "open": "pipelines.notebook.opening:open_path",
    "open_rig": "rig.devices",
    "open_stage": "rig.devices",
    "plane_from_ray": "calib.homography",
    "pmlem": "recon.solver.pmlem",
    "read_frame": "pipelines.formats.frames",
    "reconstruct": "pipelines.notebook.light_field",
    "simulate": "pipelines.commands.simulation",
    "smooth_start": "recon.solver.initialization",
    "taken_frames": "rig.session.session",
    "universal_penalty_weight": "recon.solver.penalty_weight",
}
__all__ = list(_MODULES)

if TYPE_CHECKING:  # type checkers and editors read these lines; a test compares them with the table
    from faintfield.calib.board import Board as Board
    from faintfield.calib.detection import detect_all as detect_all
    from faintfield.calib.errors import CalibrationError as CalibrationError
    from faintfield.calib.geometry import BoardObservation as BoardObservation
    from faintfield.calib.geometry import Target as Target
    from faintfield.calib.geometry import calibrate_geometry as calibrate_geometry
    from faintfield.calib.homography import fronto_parallel_rt_ref_plane as fronto_parallel_rt_ref_plane
    from faintfield.calib.homography import plane_from_ray as plane_from_ray
    from faintfield.calib.lens import Lens as Lens
    from faintfield.calib.noise import Conditions as Conditions
    from faintfield.calib.noise import calibrate
    from faintfield.calib.noise import measure_series as measure_series
    from faintfield.calib.noise_model import NoiseModel as NoiseModel
    from faintfield.pipelines.commands.simulation import simulate as simulate
    from faintfield.pipelines.errors import InputError as InputError
    from faintfield.pipelines.formats.frames import read_frame as read_frame
    from faintfield.pipelines.formats.sets.elemental_set import load_set as load_set
    from faintfield.pipelines.notebook.light_field import LightField as LightField
    from faintfield.pipelines.notebook.light_field import reconstruct as reconstruct
    from faintfield.pipelines.notebook.opening import open_path
    from faintfield.pipelines.notebook.options import PlaneOptions as PlaneOptions
    from faintfield.pipelines.notebook.results import Plane as Plane
    from faintfield.pipelines.notebook.results import Planes as Planes
    from faintfield.pipelines.notebook.results import Surface as Surface
    from faintfield.pipelines.reconstruction.channels import channel_layouts as channel_layouts
    from faintfield.pipelines.reconstruction.channels import load_channel as load_channel
    from faintfield.pipelines.simulation.options import SyntheticOptions as SyntheticOptions
    from faintfield.recon.errors import ReconstructionError as ReconstructionError
    from faintfield.recon.likelihood.images import ElementalImages as ElementalImages
    from faintfield.recon.operator.grid import PlaneGrid as PlaneGrid
    from faintfield.recon.operator.linear import linear_operator as linear_operator
    from faintfield.recon.operator.single_plane import PlaneOperator as PlaneOperator
    from faintfield.recon.prior.denoiser import Denoiser as Denoiser
    from faintfield.recon.solver.custom_penalty import ProximalPenalty as ProximalPenalty
    from faintfield.recon.solver.data_fit import DataFit as DataFit
    from faintfield.recon.solver.initialization import back_projection as back_projection
    from faintfield.recon.solver.initialization import smooth_start as smooth_start
    from faintfield.recon.solver.penalty_weight import universal_penalty_weight as universal_penalty_weight
    from faintfield.recon.solver.pmlem import pmlem as pmlem
    from faintfield.rig.devices import open_rig as open_rig
    from faintfield.rig.devices import open_stage as open_stage
    from faintfield.rig.errors import OutsideTravel as OutsideTravel
    from faintfield.rig.errors import RigError as RigError
    from faintfield.rig.plan import CapturePlan as CapturePlan
    from faintfield.rig.plan import CaptureStep as CaptureStep
    from faintfield.rig.plan import Grid as Grid
    from faintfield.rig.session.session import taken_frames as taken_frames
    from faintfield.rig.settings import RigSettings as RigSettings
    from faintfield.rig.stages.protocol import MotionLimits as MotionLimits
    from faintfield.rig.stages.protocol import Point as Point
    from faintfield.rig.stages.protocol import StageSettings as StageSettings

    __version__: str
    calibrate_noise = calibrate
    open = open_path
else:

    def __getattr__(name: str) -> object:
        """Load a public name, or the version of the installed package, when it is first asked for."""
        if name == "__version__":
            return import_module("importlib.metadata").version("faintfield")
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, _, name_there = _MODULES[name].partition(":")
        value: object = getattr(import_module(f"{__name__}.{module}"), name_there or name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """List the public names besides those of every module."""
    return sorted({*globals(), *__all__, "__version__"})
