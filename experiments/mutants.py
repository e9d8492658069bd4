"""Which changes of the code do the tests notice? A seeded sample of mutants, made and judged with Cosmic Ray.

Works on a copy of the tree. The default tests run there once, under coverage, for which of them touch which file and
how long they take. Then each mutant (one change of an operator, a number, a condition) meets the tests that touch its
file, those that touch its lines first, up to the first that fails. Every place in the code that could be changed is as
likely as any other to be drawn. Survivors are printed with their diffs, and written to survivors.diff beside
mutants.sqlite, which Cosmic Ray's own reports read (``cr-report``, ``cr-html``).

Run as ``make mutants`` or ``python -m experiments.mutants --count 20 --tests tests/test_mpc.py``; 200 take some hours.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shlex
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections import Counter, defaultdict
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import MutationSpec, WorkItem
from coverage import CoverageData

ROOT = Path(__file__).parent.parent
PACKAGES = ("control", "loop", "study", "linearisation")
PYTEST = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
# Beyond a few times what the tests take, a mutant is in an endless loop.
LEAST_TIMEOUT, TIMEOUT_FACTOR = 60.0, 5.0  # s, of the time that the tests took


Touched = dict[int, set[str]]  # tests by the lines of a file; all that touch the file under 0


def copied(to: Path) -> None:
    """Copy the tracked and new files of the tree."""
    shutil.rmtree(to, ignore_errors=True)
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines():
        if (ROOT / name).exists():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, to / name)


def measured(arguments: list[str]) -> tuple[dict[str, float], dict[str, Touched]]:
    """Seconds of every test that passes, and the tests of every source file; run in the copy."""
    cover = ["--cov=pcr_mpc", "--cov-context=test", "--cov-report=", "--junitxml=times.xml"]
    done = subprocess.run([*PYTEST, *cover, *arguments], check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(f"the tests did not run: pytest ended with {done.returncode}")
    seconds, of_module = {}, defaultdict(set)
    for case in ElementTree.parse("times.xml").iter("testcase"):
        if not len(case):  # else it failed or was skipped
            name = f"{case.attrib['classname'].replace('.', '/')}.py::{case.attrib['name']}"
            seconds[name] = float(case.attrib["time"])
            of_module[name.partition("::")[0]].add(name)
    touched: dict[str, Touched] = defaultdict(lambda: defaultdict(set))
    (data := CoverageData()).read()
    for file in data.measured_files():
        found = touched[Path(file).relative_to(Path.cwd()).as_posix()]
        for line, contexts in data.contexts_by_lineno(file).items():
            for name, _, phase in (context.rpartition("|") for context in contexts):
                # What a fixture did, all tests of its module may rest on.
                tests = {name} & seconds.keys() if phase == "run" else of_module[name.partition("::")[0]]
                found[line] |= tests
                found[0] |= tests
    return seconds, touched


def annotations(path: Path) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Start and end, as (line, column), of every type annotation: nothing depends on them."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    found = [getattr(node, name, None) for node in nodes for name in ("annotation", "returns")]
    return [((at.lineno, at.col_offset), (at.end_lineno or 0, at.end_col_offset or 0)) for at in found if at]


def sample(database: WorkDB, count: int, seed: int) -> list[WorkItem]:
    """One mutant each of ``count`` places."""
    places: dict[tuple[Path, tuple[int, int]], list[WorkItem]] = defaultdict(list)
    ignored = {path: annotations(path) for path in {item.mutations[0].module_path for item in database.work_items}}
    for item in database.work_items:
        change = item.mutations[0]
        if not any(start <= change.start_pos < end for start, end in ignored[change.module_path]):
            places[change.module_path, change.start_pos].append(item)
    rng = random.Random(seed)
    chosen = rng.sample(sorted(places), min(count, len(places)))
    # The numbers of Cosmic Ray's jobs are random, the order of its operators is not.
    return [rng.choice(sorted(places[place], key=lambda item: repr(item.mutations[0]))) for place in chosen]


def ordered(change: MutationSpec, touched: Touched, seconds: dict[str, float]) -> list[str]:
    """Tests for a mutant: those of its lines first, each module's together, quick ones first."""
    near = touched.get(change.start_pos[0], set())
    totals: Counter[str] = Counter()
    for name in touched.get(0, set()):
        totals[name.partition("::")[0]] += seconds[name]

    def rank(name: str) -> tuple[bool, float, str, float]:
        module = name.partition("::")[0]
        return name not in near, totals[module], module, seconds[name]

    return sorted(touched.get(0, set()), key=rank)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="mutants")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tests", nargs="*", default=[], help="pytest's arguments; default: the default tests")
    parser.add_argument("--out", type=Path, default=Path("results/mutants"))
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    copied(out / "tree")
    os.chdir(out / "tree")
    os.environ["PYTHONPATH"] = os.getcwd()
    seconds, touched = measured(arguments.tests)
    counts, survivors = Counter(), []
    with use_db(str(out / "mutants.sqlite"), mode=WorkDB.Mode.create) as database:
        init(sorted(path for name in PACKAGES for path in Path("pcr_mpc", name).glob("*.py")), database, {})
        for number, item in enumerate(sample(database, arguments.count, arguments.seed), 1):
            change = item.mutations[0]
            tests = ordered(change, touched[change.module_path.as_posix()], seconds)
            timeout = LEAST_TIMEOUT + TIMEOUT_FACTOR * sum(seconds[name] for name in tests)
            # Where no test touches the file, pytest has nothing to do, and that is no death.
            command = shlex.join([*PYTEST, "-x", *tests]) if tests else shlex.join([sys.executable, "-c", ""])
            result = mutate_and_test([change], command, timeout)
            database.set_result(item.job_id, result)
            outcome = "not made" if result.test_outcome is None else result.test_outcome.value
            outcome = "timeout" if result.output == "timeout" else outcome
            counts[outcome] += 1
            if outcome == "survived":
                survivors.append(result.diff or "")
            where = f"{change.module_path}:{change.start_pos[0]} {change.operator_name.removeprefix('core/')}"
            print(f"{number:4d} {outcome:9s} {where} ({len(tests)} tests)", flush=True)
    (out / "survivors.diff").write_text("\n".join(survivors) + "\n", encoding="utf-8")
    print("\n".join(survivors))
    print(f"{100 - 100 * counts['survived'] / counts.total():.0f} % of {counts.total()} noticed: {dict(counts)}")


if __name__ == "__main__":
    main()
