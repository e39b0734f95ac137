"""Commands that do what no command may do, to see that each is found out."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from tests.faults.contained import FORGED, SCRIPT


def well_behaved() -> int:
    Path("OUT").mkdir()
    Path("OUT/report.html").write_text("<html></html>\n")
    return 0


def well_refused() -> int:
    sys.stderr.write("reading\nfaintfield: BadValue: a.toml: x = 3, at most 2; correct it\n")
    return 1


def traceback() -> int:
    raise KeyError("planes")


def hang() -> int:
    while True:
        time.sleep(60)


def endless_loop() -> int:
    while True:
        pass


def hanging_thread() -> int:
    import threading

    threading.Thread(target=hang).start()
    return 0


def crash() -> int:
    os.kill(os.getpid(), signal.SIGSEGV)
    return 0


def much_memory() -> int:
    np.ones((3 << 30) // 8)
    return 0


def other_exit_code() -> int:
    return 3


def silent_failure() -> int:
    return 1


def two_lines_of_failure() -> int:
    sys.stderr.write("faintfield: BadValue: one\nfaintfield: BadValue: two\n")
    return 1


def failure_that_succeeds() -> int:
    sys.stderr.write("faintfield: BadValue: one\n")
    return 0


def forged_line() -> int:
    sys.stderr.write(f"faintfield: BadValue: a\n{FORGED} all is well\n")
    return 1


def control_character() -> int:
    sys.stderr.write("faintfield: BadValue: \x1b[31ma.toml\n")
    return 1


def python_warning() -> int:
    import warnings

    warnings.warn("overflow", RuntimeWarning, stacklevel=1)
    return 0


def writes_outside() -> int:
    Path("beside/new.txt").write_text("mine\n")
    return 0


def overwrites_another() -> int:
    Path("victim.txt").write_text("of someone else\n")
    return 0


def removes_an_input() -> int:
    Path("IN/elemental.toml").unlink()
    return 0


def leaves_unfinished() -> int:
    Path("OUT").mkdir()
    Path("OUT/.plane.tiff.ab12.unfinished").write_bytes(b"II*\0")
    return 0


def half_a_record() -> int:
    Path("OUT").mkdir()
    Path("OUT/reconstruction.json").write_text('{"format": 1,')
    return 0


def script_in_page() -> int:
    Path("OUT").mkdir()
    Path("OUT/report.html").write_text(f"<html>{SCRIPT}</html>")
    return 0


def leaves_a_process() -> int:
    subprocess.Popen(["sleep", "300"])
    return 0
