"""The words of the guide."""

import msgspec
import pytest

from faintfield.rig.capture.guide import TITLES, format_duration, step_prompt
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.plan import planned_frames
from faintfield.rig.settings import StepSettings
from tests.faults.capturing import BOARD, SMALL_RIG


def test_the_guide_has_words_for_every_kind() -> None:
    for kind in TITLES:
        settings = msgspec.structs.replace(SMALL_RIG, step=(StepSettings(kind, 0.1),), board=(BOARD,))
        frame = planned_frames(survey(open_rig(settings), settings).plan)[0]
        prompt = step_prompt(frame, 1, 1, 10, 100.0)
        assert TITLES[kind] in prompt.title
        assert len(prompt.lines) >= 3
        assert all(line.endswith(".") for line in prompt.lines)
        assert any("10 frames follow, about 2 min" in line for line in prompt.lines)


@pytest.mark.parametrize(
    ("duration_s", "words"),
    [
        (0.2, "about 1 s"),
        (59.6, "about 60 s"),
        (100, "about 2 min"),
        (3600, "about 60 min"),
        (7500, "about 2 h 05 min"),
    ],
)
def test_durations_in_words(duration_s: float, words: str) -> None:
    assert format_duration(duration_s) == words
