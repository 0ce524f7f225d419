"""`python -m benchmarks [NAME ...]`: ours and its peers on the same input in the same run, and their ratios.

Each workload runs in a process of its own, on one thread. Without names, all that the page of results has.
"""

import argparse
import json
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from typing import Any

from benchmarks import _gate, _page
from benchmarks._measure import ONE_THREAD, workload
from benchmarks._registry import WORKLOADS
from benchmarks.peers import environment

#: Benchmarks that have options of their own, and where: `python -m benchmarks corpus --help`.
OWN_OPTIONS = {"corpus": "corpus.__main__", "ablation": "corpus.ablation", "joins": "joins"}


def parser() -> argparse.ArgumentParser:
    one = argparse.ArgumentParser(prog="python -m benchmarks", description=(__doc__ or "").splitlines()[0])
    one.add_argument("names", nargs="*", metavar="NAME", help=f"out of {', '.join(WORKLOADS)}")
    one.add_argument("--peers", action="store_true", help="first make the environment of the peers that need their own")
    one.add_argument("--short", action="store_true", help="few repeats and short missions")
    one.add_argument("--write", action="store_true", help="put the results into benchmarks/results.json and its page")
    one.add_argument("--page", action="store_true", help="only write the page again from the results kept")
    one.add_argument("--gate", action="store_true", help="exit code 1 where a ratio or an accuracy is worse than kept")
    return one


def main(words: list[str]) -> int:
    """Run what is asked for; exit code 2 for a name that is none, 1 for a regression or a workload that fails."""
    if words and words[0] in OWN_OPTIONS:
        return import_module(f"benchmarks.{OWN_OPTIONS[words[0]]}").main(words[1:])
    asked = parser().parse_args(words)
    unknown = [name for name in asked.names if name not in WORKLOADS]
    if unknown:
        print(f"benchmarks: expected names out of {', '.join(WORKLOADS)}, got {', '.join(unknown)}", file=sys.stderr)
        return 2
    if asked.peers:
        print(f"peers: {environment.make()}", flush=True)
        if not (asked.names or asked.write or asked.gate):
            return 0
    if asked.page and not asked.write:
        _page.PAGE.write_text(_page.page(_page.kept()))
        return 0
    gated_only = asked.gate and not asked.write
    by_default = [name for name, one in WORKLOADS.items() if one.gated or not (gated_only or name in OWN_OPTIONS)]
    names, kept = asked.names or by_default, _page.kept()
    results, failed = run_all(names, short=asked.short, write=asked.write)
    return max(failed, conclude(results, kept) if asked.gate else 0)


def run_all(names: list[str], *, short: bool, write: bool) -> tuple[dict[str, dict[str, Any]], int]:
    """Results of the workloads that ran, on the page as soon as they are there; and 1 where one did not run."""
    results, failed, here = {}, 0, _page.circumstances()
    for name in names:
        workload = WORKLOADS[name]
        try:
            measured = run_one(name, workload.short if short else workload.full)
        except RuntimeError as error:
            print(f"== {name}: {error}", file=sys.stderr, flush=True)
            failed = 1
            continue
        results[name] = {**here, "short": short, **measured}
        if write:
            _page.PAGE.write_text(_page.page(_page.store({name: results[name]})))
        head = f"== {name}: {workload.title} ({measured['seconds']:.0f} s)"
        print(f"{head}\n{_page.plain(measured['rows'])}\n", flush=True)
    return results, failed


def run_one(name: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """What a workload's own process found; a RuntimeError where it failed."""
    os.environ.update(ONE_THREAD)  # which the process has when it imports numpy
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        try:
            found = pool.submit(workload, name, arguments).result()
        except Exception as error:  # whatever a workload stumbles over is said, and the next one runs
            raise RuntimeError(f"{type(error).__name__}: {error}") from error
    return json.loads(json.dumps(found, default=_page.as_json))


def conclude(results: dict[str, dict[str, Any]], kept: dict[str, dict[str, Any]]) -> int:
    """Compare with the results that were kept of the same workloads; the exit code."""
    names = [name for name in results if WORKLOADS[name].gated and name in kept]
    figures, before = (_gate.figures_of_all({name: some[name] for name in names}) for some in (results, kept))
    verdict = _gate.judge(figures, before)
    for sentence in verdict.regressions:
        print(f"regression: {sentence}")
    for name in verdict.missing:
        print(f"not measured: {name}", file=sys.stderr)
    counts = f"{len(verdict.regressions)} regressions, {len(verdict.missing)} missing"
    print(f"{verdict.compared} figures compared, {counts}")
    return verdict.exit_code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
