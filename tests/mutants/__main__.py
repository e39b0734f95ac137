"""Makes wrong changes in the sources and counts how many the tests find; `make mutants`.

A test that no wrong change can fail is worth nothing, and code that can be changed unnoticed is not tested. Verdicts
are kept in build/mutants. A mutant is judged anew when its file has changed or, if it survived, when tests have.
"""

import argparse
import hashlib
import json
import math
import os
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

from tests.mutants.changes import Mutant, mutants_of
from tests.mutants.judge import PACKAGES, ROOT, WORK, digest, judge, preload, recorded, tests_digest

MODULES = ("recon", "calib", "rig/session", "rig/capture", "rig/stages")
_VERDICTS = WORK / "verdicts.jsonl"
_FOUND = ("killed", "timed out")


def all_mutants(modules: Iterable[str]) -> list[Mutant]:
    """Return the mutants of modules, given as folders or files."""
    files = {path for name in modules for path in [ROOT / name, *(ROOT / name).rglob("*.py")] if path.is_file()}
    return [it for path in sorted(files) for it in mutants_of(path.relative_to(ROOT).as_posix(), path.read_text())]


def equivalent() -> dict[str, str]:
    """Return the mutants that change nothing that anyone could notice, each with the reason."""
    kept = tomllib.loads((Path(__file__).parent / "equivalent.toml").read_text())
    return {mutant["name"]: mutant["why"] for mutant in kept.get("mutant", ())}


def sampled(mutants: Iterable[Mutant], size: int, seed: int) -> list[Mutant]:
    """Return a random sample that a change of one file changes little."""
    return sorted(mutants, key=lambda it: hashlib.sha256(f"{seed} {it.name}".encode()).digest())[:size]


def wilson(found: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927)."""
    z2 = 1.96**2
    centre = (found + z2 / 2) / (total + z2)
    half = math.sqrt(z2 * (found * (total - found) / total + z2 / 4)) / (total + z2)
    return centre - half, centre + half


def known_verdicts() -> dict[str, str]:
    """Return the verdicts that still hold, by name of the mutant."""
    tests = {package: tests_digest(package) for package in PACKAGES}
    verdicts = {}
    for line in _VERDICTS.read_text().splitlines() if _VERDICTS.exists() else ():
        row = json.loads(line)
        if row["source"] == digest([ROOT / row["file"]]) and (
            row["verdict"] in _FOUND or row["tests"] == tests[row["file"].partition("/")[0]]
        ):
            verdicts[row["name"]] = row["verdict"]
    return verdicts


def verdicts_of(mutants: list[Mutant], jobs: int) -> dict[str, str]:
    """Return the verdict of each mutant; those not yet known are found out, and kept."""
    verdicts = known_verdicts()
    waiting = [mutant for mutant in mutants if mutant.name not in verdicts]
    if waiting:
        sources = {file: digest([ROOT / file]) for file in {mutant.file for mutant in waiting}}
        tests = {package: tests_digest(package) for package in PACKAGES}
        terminal = os.dup(1)  # tests write elsewhere

        def keep(mutant: Mutant, verdict: str, by: str) -> None:
            row = {"name": mutant.name, "file": mutant.file, "verdict": verdict, "by": by}
            row |= {"source": sources[mutant.file], "tests": tests[mutant.file.partition("/")[0]]}
            with _VERDICTS.open("a") as out:
                out.write(json.dumps(row) + "\n")
            if verdict not in _FOUND:
                os.write(terminal, f"{verdict}: {mutant.name}\n".encode())

        begin = _VERDICTS.stat().st_size if _VERDICTS.exists() else 0
        preload()
        known = recorded(sorted({mutant.file.partition("/")[0] for mutant in waiting}), jobs)
        judge(waiting, known, jobs, keep)
        with _VERDICTS.open() as kept:
            kept.seek(begin)
            verdicts |= {row["name"]: row["verdict"] for row in map(json.loads, kept)}
    return {mutant.name: verdicts[mutant.name] for mutant in mutants}


def table(mutants: list[Mutant], verdicts: dict[str, str], every: list[Mutant]) -> list[str]:
    """Return the rows of a table of scores, one for each folder and a last one for all."""
    rows = ["| folder | mutants | judged | found | share | 95 % interval |", "|---|---|---|---|---|---|"]
    for folder in (*sorted({mutant.file.rpartition("/")[0] for mutant in mutants}), ""):
        there = [mutant for mutant in mutants if folder in ("", mutant.file.rpartition("/")[0])]
        total = sum(folder in ("", mutant.file.rpartition("/")[0]) for mutant in every)
        found = sum(verdicts[mutant.name] in _FOUND for mutant in there)
        low, high = wilson(found, len(there))
        share = f"{100 * found / len(there):.0f} % | {100 * low:.0f} to {100 * high:.0f} %"
        rows.append(f"| {f'`{folder}`' if folder else 'all'} | {total} | {len(there)} | {found} | {share} |")
    return rows


def main() -> int:
    """Judge a sample of mutants and print the scores."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("modules", nargs="*", default=MODULES, help="folders or files; default: %(default)s")
    parser.add_argument("--sample", type=int, default=300, help="mutants to draw at random; default: %(default)s")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sample")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time")
    parser.add_argument("--least", type=float, default=0.0, help="exit with 1 if a smaller share (%%) is found")
    options = parser.parse_args()
    WORK.mkdir(parents=True, exist_ok=True)
    same = equivalent()
    every = [mutant for mutant in all_mutants(options.modules) if mutant.name not in same]
    mutants = sampled(every, options.sample, options.seed)
    verdicts = verdicts_of(mutants, options.jobs)
    print(*table(mutants, verdicts, every), sep="\n")
    found = 100 * sum(verdict in _FOUND for verdict in verdicts.values()) / len(mutants)
    if found < options.least:
        print(f"the tests find {found:.0f} % of the wrong changes, fewer than {options.least:.0f} %")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
