"""Settings of a tethered camera, by a stand-in for python-gphoto2 with its calls and its kinds of settings."""

import sys
from types import SimpleNamespace
from typing import Any

import pytest

from faintfield.rig.cameras.gphoto2 import GPhoto2Camera
from faintfield.rig.cameras.settings import GPhoto2Settings
from faintfield.rig.errors import CameraError

# As in libgphoto2
WINDOW, SECTION, TEXT, RANGE, TOGGLE, RADIO, MENU, BUTTON, DATE = range(9)


class Failure(Exception):
    """The error of the library, with its code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"[{code}] error {code}")
        self.code = code


class Widget:
    """A setting, or a group of them."""

    def __init__(
        self, name: str, kind: int, value: Any = None, offered: Any = (), *, readonly: bool = False, children: Any = ()
    ) -> None:
        self.name, self.type, self.value, self.offered = name, kind, value, offered
        self.children, self.readonly = list(children), readonly

    def __getattr__(self, name: str) -> Any:
        """Return what `get_name` and the like would."""
        return lambda: vars(self)[name.removeprefix("get_")]

    def get_choices(self) -> Any:
        assert self.type in (RADIO, MENU)  # the library raises for the other kinds
        return iter(self.offered)

    def get_range(self) -> Any:
        assert self.type == RANGE
        return self.offered

    def set_value(self, value: Any) -> None:
        expected = {TOGGLE: int, RANGE: float}.get(self.type, str)
        if type(value) is not expected:  # as the library does
            raise TypeError(f"{expected} is expected")
        self.value = value


class Body:
    """A camera, whose settings reach it by `set_single_config`."""

    def __init__(self) -> None:
        self.sent: dict[str, Any] = {}
        self.broken = False
        self.settings = [
            Widget("iso", RADIO, "100", ["100", "200", "400"]),
            Widget("imageformat", MENU, "JPEG", ["JPEG", "RAW"]),
            Widget("reviewtime", RANGE, 2.0, (0.0, 10.0, 0.5)),
            Widget("autopoweroff", TOGGLE, 1),
            Widget("artist", TEXT, ""),
            Widget("batterylevel", TEXT, "80%", readonly=True),
            Widget("format", BUTTON),
        ]

    def init(self) -> None: ...

    def exit(self) -> None: ...

    def get_config(self) -> Widget:
        return Widget("main", WINDOW, children=[Widget("all", SECTION, children=self.settings)])

    def get_single_config(self, name: str) -> Widget:
        for widget in self.settings:
            if widget.name == name and not self.broken:
                return widget
        raise Failure(-2)

    def set_single_config(self, name: str, widget: Widget) -> None:
        self.sent[name] = widget.value

    def capture(self, kind: int) -> None:
        raise AssertionError("nothing may be exposed")


@pytest.fixture
def body(monkeypatch: pytest.MonkeyPatch) -> Body:
    """Return the camera that the library finds."""
    body = Body()
    kinds = ("WINDOW", "SECTION", "TEXT", "RANGE", "TOGGLE", "RADIO", "MENU", "BUTTON", "DATE")
    library = SimpleNamespace(
        Camera=lambda: body,
        GPhoto2Error=Failure,
        GP_ERROR_BAD_PARAMETERS=-2,
        **{f"GP_WIDGET_{name}": number for number, name in enumerate(kinds)},
    )
    monkeypatch.setitem(sys.modules, "gphoto2", library)
    return body


def open_with(**settings: str) -> None:
    GPhoto2Camera(GPhoto2Settings(settings=settings)).open()


def test_settings_are_sent_in_their_types(body: Body) -> None:
    open_with(iso="200", imageformat="RAW", reviewtime="2.5", autopoweroff="0", artist="none")
    assert body.sent == {"iso": "200", "imageformat": "RAW", "reviewtime": 2.5, "autopoweroff": 0, "artist": "none"}
    assert [type(value) for value in body.sent.values()] == [str, str, float, int, str]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("iso", "123", r"settings\.iso = '123' is not offered by the camera, which offers: 100, 200, 400; choose"),
        ("reviewtime", "11", r"settings\.reviewtime = '11' is not offered .* offers: 0 to 10 in steps of 0\.5; "),
        ("reviewtime", "nan", r"settings\.reviewtime = 'nan' is not offered"),
        ("batterylevel", "90%", r"settings\.batterylevel = '90%': the camera lets no program set this, it is '80%'; "),
        ("isospeed", "100", r"isospeed = '100': the camera has no setting isospeed, it has: artist, .*, reviewtime; "),
    ],
)
def test_setting_not_offered_is_named(body: Body, name: str, value: str, words: str) -> None:
    with pytest.raises(CameraError, match=words):
        open_with(**{name: value})
    assert body.sent == {}


def test_failing_camera_does_not_lack_a_setting(body: Body) -> None:
    body.broken = True
    with pytest.raises(CameraError, match=r"failed at setting iso = 200: \[-2\] error -2; "):
        open_with(iso="200")
