"""Steps from a captured session to its results: each is done only if its results are out of date."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import NAMED_FAILURES, MissingFile
from faintfield.pipelines.formats.files import Hashes, exclusive
from faintfield.pipelines.formats.provenance import first_difference, provenance
from faintfield.pipelines.formats.reading import JSON_FAILURES, read_content
from faintfield.pipelines.formats.results.records import REPORT_FILE
from faintfield.pipelines.formats.results.verification import is_record, records_of, verify_results
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS
from faintfield.rig.session.session import taken_frames


@dataclass(frozen=True)
class Step:
    """One thing that is made from a session.

    Attributes
    ----------
    name : str
        Its name in messages.
    results : dict of str to callable
        Returns the options of each result file, a mapping or Struct, if it is up to date; None if it records none. It
        is called when the file exists and the steps that this one needs are done.
    make : callable
        Does it.
    needs : tuple of str
        Names of the steps whose results it reads.
    inputs : callable
        Returns the names of all files that it reads.
    command : str, optional
        Name of the command that does it alone, which its results record; by default that of the step.
    """

    name: str
    results: Mapping[str, Callable[[], object] | None]
    make: Callable[[], object]
    needs: tuple[str, ...] = ()
    inputs: Callable[[], Sequence[str]] = tuple
    command: str | None = None


class StepOutcome(msgspec.Struct, frozen=True):
    """A step, whether it was run, and why."""

    step: str
    ran: bool
    why: str


class RunOutcome(msgspec.Struct, frozen=True):
    """The result of `faintfield run`."""

    session: str
    report: str
    steps: list[StepOutcome]
    altered_frames: list[str]


def run_steps(session: Path, steps: Sequence[Step]) -> RunOutcome:
    """Do the steps that are out of date, in order, except those that need one that failed.

    Raises
    ------
    RigError, CalibrationError, ReconstructionError, InputError
        The first failure, after all other steps were done.
    """
    folders = {session, *((session / file).parent for step in steps for file in step.results)}
    for folder in sorted(folders, reverse=True):  # the inner ones first, as one that is empty is not kept
        with exclusive(folder):
            pass  # removes what a killed command left there, even if all steps are up to date
    hashes = Hashes(session)
    altered = _altered_frames(session, hashes)
    done: list[StepOutcome] = []
    failed: dict[str, Exception] = {}
    for step in steps:
        if missing := [name for name in step.needs if name in failed]:
            failed[step.name] = failed[missing[0]]
            inform(f"{step.name}: skipped, because it needs {missing[0]}")
            continue
        try:
            reason = _out_of_date(session, step, hashes)
            inform(f"{step.name}: {reason or 'up to date'}")
            if reason is not None:
                step.make()
        except NAMED_FAILURES as failure:
            failed[step.name] = failure
            inform(f"{step.name}: failed: {failure}")
        else:
            done.append(StepOutcome(step.name, reason is not None, reason or "up to date"))
    hashes.save()
    for first in failed.values():
        again = f"mend that and run `faintfield run {session}` again; still to be done: {', '.join(failed)}"
        raise type(first)(f"{first}; {again}") from first
    return RunOutcome(str(session), str(session / RECONSTRUCTIONS / REPORT_FILE), done, altered)


def _altered_frames(session: Path, hashes: Hashes) -> list[str]:
    """Return the frames that are not as they were captured, and inform the user: results are made from them anyway."""
    altered = [
        str(path.relative_to(session))
        for _, taken, path in taken_frames(session)
        if path.is_file() and hashes.of(str(path.relative_to(session))) != taken.sha256
    ]
    if altered:
        inform(
            f"warning: {altered[0]} and {len(altered) - 1} other frames are not what was captured; results are made "
            f"from them as they are now. Restore them from a copy; `faintfield verify {session}` names the first"
        )
    return altered


def _out_of_date(session: Path, step: Step, hashes: Hashes) -> str | None:
    """Return why a step has to be done, None if its results are of its inputs, options and versions."""
    inputs: dict[str, str] = {}
    for name in step.inputs():
        if not (session / name).is_file():
            raise MissingFile(f"{session / name}: is missing; restore it from a copy")
        inputs[name] = hashes.of(name)
    for file, options in step.results.items():
        if not (session / file).is_file():
            return f"{file} does not exist yet"
        if problem := _problem_of(session / file):
            return problem.removeprefix(f"{session}/")
        if options is None:
            continue
        try:
            now = provenance(step.command or step.name, options(), inputs)
            difference = first_difference(read_content(session / file), now)
        except (MissingFile, *JSON_FAILURES):
            return f"{file} is damaged"
        if difference:
            return f"{file} was made with another {difference}"
    return None


def _problem_of(path: Path) -> str | None:
    """Return why a result does not stand, None if it does, or is none that vouches for itself."""
    if not is_record(path):
        return None
    verdict = verify_results(records_of(path))
    return next(iter(verdict.problems + verdict.unchecked), None)
