"""Processes that fail, hang or take too much memory are told apart and ended; functions are changed in memory."""

import os
import sys
from functools import partial

import numpy as np
import pytest

from faintfield.rig.stages import motion
from tests.mutants.changes import mutants_of
from tests.mutants.judge import ROOT
from tests.mutants.plugins import change_in_memory
from tests.mutants.processes import Processes


def _work_for_ever() -> int:
    while True:
        pass


def _take_memory() -> int:
    return len(np.ones(2 << 30))


def _fail() -> int:
    raise RuntimeError("as a wrong change may")


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded")  # as the workers of pytest-xdist are
def test_each_process_ends_with_its_status_and_what_hangs_is_told() -> None:
    processes = Processes(2)
    sys.stderr.flush()
    for name, action in (("good", int), ("bad", partial(int, 3)), ("hung", _work_for_ever), ("large", _take_memory)):
        processes.start(name, action, 1)
    ended = {name: (status, hung) for name, status, hung in processes.ended()}
    assert ended["good"] == (0, False)
    assert os.waitstatus_to_exitcode(ended["bad"][0]) == 3
    assert ended["hung"][1]
    assert ended["large"][0] != 0
    assert not ended["large"][1]


def test_a_function_changed_in_memory_is_the_function_of_the_changed_file() -> None:
    file = "rig/stages/motion.py"
    (mutant,) = (
        it
        for it in mutants_of(file, (ROOT / file).read_text())
        if it.name.endswith("⇒ return -(1.5 * predicted_s + 2.0)")
    )
    kept = motion.timeout_s.__code__
    try:
        assert change_in_memory(mutant)
        assert motion.timeout_s(10.0) == -17.0
    finally:
        motion.timeout_s.__code__ = kept
    assert motion.timeout_s(10.0) == 17.0


def test_a_change_outside_functions_is_not_made_in_memory() -> None:
    file = "rig/stages/workspace.py"
    (mutant, *_) = mutants_of(file, (ROOT / file).read_text())
    assert "(module)" in mutant.name
    assert not change_in_memory(mutant)
