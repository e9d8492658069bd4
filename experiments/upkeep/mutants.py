"""Which changes of the code do the tests notice? A seeded sample of mutants, made and judged with Cosmic Ray.

Works on a copy of the tree. The default tests run there once, under coverage, for which of them touch which file and
how long they take. Then each mutant (one change of an operator, a number, a condition) meets the tests that touch its
file, those that touch its lines first, up to the first that fails; a minute of them at first, and the rest when every
mutant has had its minute. Every place in the code that could be changed is as likely as any other to be drawn.
Survivors are printed with their diffs, and written to survivors.diff beside mutants.sqlite, which Cosmic Ray's own
reports read (``cr-report``, ``cr-html``).

Run as ``make mutants`` or ``python -m experiments.upkeep.mutants --count 20 --tests tests/control``; 200 take
some hours. ``--resume`` goes on where an earlier run into the same folder was stopped, and raises its number if asked
for more.
"""

from __future__ import annotations

import argparse
import ast
import multiprocessing
import os
import random
import shlex
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import accumulate
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import MutationSpec, TestOutcome, WorkerOutcome, WorkItem, WorkResult
from coverage import CoverageData
from scipy.stats import binomtest

ROOT = Path(__file__).parents[2]
PACKAGES = ("control", "loop", "study", "linearisation")
PYTEST = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
# Beyond a few times what the tests take, a mutant is in an endless loop. What counts is the time of the processor,
# which a busy machine does not lengthen; one that sleeps for ever is ended by the clock.
LEAST_TIMEOUT, TIMEOUT_FACTOR = 60.0, 5.0  # s, of the time that the tests took
CLOCK_FACTOR = 10.0
QUICK = 60.0  # s of tests that every mutant meets before any of them meets more


Touched = dict[int, set[str]]  # tests by the lines of a file; all that touch the file under 0


def copied(to: Path) -> None:
    """Copy the tracked and new files of the tree."""
    shutil.rmtree(to, ignore_errors=True)
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines():
        if (ROOT / name).exists():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, to / name)


def measure(arguments: list[str]) -> None:
    """Run the tests in the copy, under coverage, and leave times and lines there."""
    cover = ["--cov=pcr_mpc", "--cov-context=test", "--cov-report=", "--junitxml=times.xml"]
    done = subprocess.run([*PYTEST, *cover, *arguments], check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(f"the tests did not run: pytest ended with {done.returncode}")


def measured() -> tuple[dict[str, float], dict[str, Touched]]:
    """Seconds of every test that passed, and the tests of every source file."""
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


def statement(change: MutationSpec) -> range:
    """Lines of the statement that a mutant changes; of one with a body, those of its head."""
    line = change.start_pos[0]
    found = range(line, line + 1)
    for node in ast.walk(ast.parse(change.module_path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.stmt):
            inner = [child.lineno for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt)]
            end = min(inner) if inner else (node.end_lineno or node.lineno) + 1
            if node.lineno <= line < end:
                found = range(node.lineno, end)
    return found


def ordered(change: MutationSpec, touched: Touched, seconds: dict[str, float]) -> list[str]:
    """Tests for a mutant: those of its statement first, each module's together, quick ones first."""
    near = set[str]().union(*(touched.get(line, set()) for line in statement(change)))
    totals: Counter[tuple[bool, str]] = Counter()
    for name in touched.get(0, set()):
        totals[name in near, name.partition("::")[0]] += seconds[name]

    def rank(name: str) -> tuple[bool, float, str, float]:
        module = name.partition("::")[0]
        return name not in near, totals[name in near, module], module, seconds[name]

    return sorted(touched.get(0, set()), key=rank)


def divided(tests: list[str], seconds: dict[str, float]) -> tuple[list[str], list[str]]:
    """The first tests, as many as take a minute, and the others."""
    spent = accumulate(seconds[name] for name in tests)
    quick = max(1, sum(until <= QUICK for until in spent))
    return tests[:quick], tests[quick:]


def enter(trees: multiprocessing.Queue[Path]) -> None:
    """Give a worker its own tree."""
    os.chdir(trees.get())
    os.environ["PYTHONPATH"] = os.getcwd()


def judge(change: MutationSpec, tests: list[str], seconds: float) -> WorkResult:
    """Change the worker's tree and run the tests there, up to the first that fails."""
    limit = LEAST_TIMEOUT + TIMEOUT_FACTOR * seconds
    # Where no test touches the file, pytest has nothing to do, and that is no death.
    command = [*PYTEST, "-x", *tests] if tests else [sys.executable, "-c", ""]
    bounded = ["sh", "-c", 'ulimit -t "$0" && exec "$@"', f"{limit:.0f}", *command]
    return mutate_and_test([change], shlex.join(bounded), CLOCK_FACTOR * limit)


def doubtful(result: WorkResult) -> bool:
    """Whether a mutant has met its first tests only, and survived them."""
    return result.worker_outcome is WorkerOutcome.SKIPPED


def outcome(result: WorkResult) -> str:
    """How a mutant ended, in a word."""
    if doubtful(result):
        return "lives yet"
    if result.test_outcome is None:
        return "not made"
    # A process that ran into a limit says nothing at its end.
    late = result.test_outcome is TestOutcome.KILLED and " in " not in (result.output or "")[-40:]
    return "timeout" if late else result.test_outcome.value


def judged(
    items: list[WorkItem], tests: dict[str, list[str]], seconds: dict[str, float], trees: list[Path]
) -> Iterator[tuple[WorkItem, WorkResult]]:
    """Results as they come."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    for tree in trees:
        queue.put(tree)
    with ProcessPoolExecutor(len(trees), mp_context=context, initializer=enter, initargs=(queue,)) as pool:
        submitted = {}
        for item in items:
            mine = tests[item.job_id]
            submitted[pool.submit(judge, item.mutations[0], mine, sum(seconds[name] for name in mine))] = item
        try:
            for future in as_completed(submitted):
                yield submitted[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def report(chosen: list[WorkItem], results: dict[str, WorkResult], out: Path) -> None:
    """Print and write survivors, and the share that was noticed."""
    survivors = [r for item in chosen if (r := results[item.job_id]).test_outcome is TestOutcome.SURVIVED]
    diffs = "\n".join(result.diff or "" for result in survivors)
    (out / "survivors.diff").write_text(diffs + "\n", encoding="utf-8")
    print(diffs)
    count = len(chosen)
    low, high = binomtest(count - len(survivors), count).proportion_ci(method="wilson")
    print(
        f"{1 - len(survivors) / count:.1%} of {count} noticed (95 % of such samples: {low:.0%} to {high:.0%}): "
        f"{dict(Counter(outcome(results[item.job_id]) for item in chosen))}"
    )


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="mutants")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tests", nargs="*", default=[], help="pytest's arguments; default: the default tests")
    parser.add_argument("--jobs", type=int, default=1, help="mutants judged at a time, each in a tree of its own")
    parser.add_argument("--resume", action="store_true", help="go on with the run whose results are in --out")
    parser.add_argument("--out", type=Path, default=Path("results/mutants"))
    arguments = parser.parse_args()
    out, resume = arguments.out.resolve(), arguments.resume
    tree = out / "tree"
    if not resume:
        copied(tree)
    os.chdir(tree)
    os.environ["PYTHONPATH"] = os.getcwd()
    if not resume:
        measure(arguments.tests)
    seconds, touched = measured()
    with use_db(str(out / "mutants.sqlite"), mode=WorkDB.Mode.create) as database:
        if not (resume and database.num_work_items):
            init(sorted(path for name in PACKAGES for path in Path("pcr_mpc", name).rglob("*.py")), database, {})
        chosen = sample(database, arguments.count, arguments.seed)
        results = dict(database.results)
        quick, rest = {}, {}
        for item in chosen:
            change = item.mutations[0]
            tests = ordered(change, touched[change.module_path.as_posix()], seconds)
            quick[item.job_id], rest[item.job_id] = divided(tests, seconds)
        trees = [out / f"tree-{number}" for number in range(arguments.jobs)]
        for copy in trees:  # anew: a run that was killed leaves a mutant in them
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(tree, copy)
        for tests in (quick, rest):
            first = tests is quick
            left = [
                item for item in chosen if (item.job_id not in results if first else doubtful(results[item.job_id]))
            ]
            for item, result in judged(left, tests, seconds, trees):
                if first and result.test_outcome is TestOutcome.SURVIVED and rest[item.job_id]:
                    result = WorkResult(WorkerOutcome.SKIPPED, result.output, result.test_outcome, result.diff)
                database.set_result(item.job_id, result)
                results[item.job_id] = result
                change = item.mutations[0]
                place = f"{chosen.index(item) + 1:4d} {outcome(result):9s} {change.module_path}:{change.start_pos[0]}"
                operator = change.operator_name.removeprefix("core/")
                print(place, operator, f"({len(tests[item.job_id])} tests)", flush=True)
    report(chosen, results, out)


if __name__ == "__main__":
    main()
