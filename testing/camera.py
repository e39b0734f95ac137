"""The contract of a camera, which every implementation must meet."""

import pytest

from faintfield.rig.cameras.protocol import Camera
from faintfield.rig.errors import CameraError


def camera_contract(camera: Camera, exposure_s: float) -> None:
    """Check a closed camera, from opening to closing; it takes six frames.

    Parameters
    ----------
    camera : Camera
        The camera, not yet opened.
    exposure_s : float
        One of its exposure times; a short one will do.

    Raises
    ------
    AssertionError
        The camera does not meet the contract.
    """
    _check_closed(camera, exposure_s)
    camera.open()
    _check_report(camera, exposure_s)
    _check_exposures(camera, exposure_s)
    camera.open()  # a capture opens the camera again after a failure
    _check_exposures(camera, exposure_s)
    camera.close()
    camera.close()
    _check_closed(camera, exposure_s)
    camera.open()
    _check_exposures(camera, exposure_s)
    camera.close()


def _check_closed(camera: Camera, exposure_s: float) -> None:
    with pytest.raises(CameraError, match="; "):
        camera.report()
    with pytest.raises(CameraError, match="; "):
        camera.expose(exposure_s, 1)


def _check_report(camera: Camera, exposure_s: float) -> None:
    report = camera.report()
    assert report.name.strip()
    assert report.frame_bytes > 0
    assert report.readout_s >= 0.0
    assert report.offers(exposure_s)
    assert report.exposures_s is None or list(report.exposures_s) == sorted(report.exposures_s)


def _check_exposures(camera: Camera, exposure_s: float) -> None:
    for number in (1, 2):
        exposure = camera.expose(exposure_s, number)
        assert exposure.suffix.startswith(".")
        assert exposure.suffix == exposure.suffix.lower()
        if exposure.pixels is not None:
            assert exposure.pixels.dtype.kind == "u"
            assert exposure.pixels.ndim in (2, 3)
        else:
            assert exposure.content
            assert len(exposure.content) <= camera.report().frame_bytes
