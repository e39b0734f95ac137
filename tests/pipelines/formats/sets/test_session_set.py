"""The views of a session in rounds: as many whole rounds as give the most light."""

from collections import Counter
from pathlib import Path

import pytest
from msgspec.structs import replace

from faintfield.pipelines.formats.sets.session_set import files_of_scene
from faintfield.rig.capture.guide import OperatorRequest
from faintfield.rig.plan import Until
from faintfield.rig.settings import StepSettings
from tests.faults.capturing import SMALL_RIG, Operator, capture

RIG = replace(SMALL_RIG, step=(StepSettings("dark_scene", 0.1, 2, until=Until(0.1, 3)),))
PER_ROUND = 2 * 6


@pytest.mark.parametrize(
    ("stop_after", "skip_at", "frames_of_node", "message"),
    [
        (PER_ROUND + 5, None, {2: 6}, "5 frames of a round that is not whole are left out"),
        (2 * PER_ROUND + 6, None, {4: 6}, "6 frames of a round that is not whole"),
        # A frame that lacks in the second round costs a node, not the round
        (2 * PER_ROUND - 1, PER_ROUND + 3, {4: 5}, "1 nodes lack dark-scene frames"),
        (10, None, {2: 5}, "1 nodes lack"),
    ],
)
def test_whole_rounds_with_most_light_count(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    stop_after: int,
    skip_at: int | None,
    frames_of_node: dict[int, int],
    message: str,
) -> None:
    requests: dict[int, OperatorRequest] = {stop_after: "stop"}
    if skip_at is not None:
        requests[skip_at] = "skip"
    capture(tmp_path / "s", Operator({}, requests), RIG)
    names = [name for name in files_of_scene(tmp_path / "s") if name.startswith("frames/")]
    counts = Counter(Counter(name.split("_r")[1][:4] for name in names).values())
    assert counts == frames_of_node
    assert message in capsys.readouterr().err
