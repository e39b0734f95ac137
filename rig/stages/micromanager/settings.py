"""The keys of `[stage]` that belong to protocol = "micromanager"."""

from typing import Literal

from msgspec import Struct


class MicroManagerStage(Struct, frozen=True, forbid_unknown_fields=True):
    """An XY stage of Micro-Manager.

    Parameters
    ----------
    configuration : str
        Micro-Manager's .cfg file; by default that of the demonstration devices. The same as that of the camera, if
        Micro-Manager drives the camera, too.
    adapters : str
        Folder of the device adapters; by default the one that pymmcore-plus finds.
    device : str
        Label of the stage in the configuration; by default its XY stage.
    properties : dict
        Properties of the stage, set when it is connected, such as its speed.
    origin : str
        `home`: homing makes the adapter find its origin. `confirmed`: the adapter cannot; the origin is the one that
        the stage had when it was connected, and you say with this setting that it is right.
    rate_mm_per_s, acceleration_mm_per_s2 : float
        Speed and acceleration of both axes, which no adapter reports: motions are timed by them, and fail if they take
        much longer.
    tolerance_mm : float
        How far a report may be from its target.
    homing_bound_s : float
        Time after which homing counts as failed.
    answer_s : float
        Time limit for every other call, in addition to the motion.
    """

    configuration: str = ""
    adapters: str = ""
    device: str = ""
    properties: dict[str, str] = {}
    origin: Literal["home", "confirmed"] = "home"
    rate_mm_per_s: float = 5.0
    acceleration_mm_per_s2: float = 50.0
    tolerance_mm: float = 0.005
    homing_bound_s: float = 240.0
    answer_s: float = 20.0

    def __post_init__(self) -> None:
        for name in ("rate_mm_per_s", "acceleration_mm_per_s2", "tolerance_mm", "homing_bound_s", "answer_s"):
            if not 0.0 < (given := getattr(self, name)) <= 3600.0:
                raise ValueError(f"{name} = {given:g}; give more than 0 and at most 3600")
