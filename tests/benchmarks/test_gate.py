"""The gate: which ratios there are, and what of them is a regression; rows made up, nothing timed."""

import json

import pytest

from benchmarks import _gate, _page
from benchmarks.__main__ import main


def row(case: str, by: str, cpu: float | None, memory: float | None) -> dict:
    return {"case": case, "by": by, "CPU ms": cpu, "wall ms": cpu, "peak memory MB": memory}


ROWS = [
    row("walls", "spplanes", 10.0, 20.0),
    row("walls", "numpy", 40.0, 100.0),
    row("walls", "mrob", None, None),
    row("planes", "spplanes", 3.0, 1.0),
    row("planes", "Open3D", 2.0, 50.0),
]


def test_ratios_are_ours_to_every_other_of_the_same_case():
    assert _gate.ratios_of("fit", ROWS) == {
        "fit: walls, ours to numpy, time": 0.25,
        "fit: walls, ours to numpy, memory": 0.2,
        "fit: planes, ours to Open3D, time": 1.5,
    }


def test_other_tables_give_their_own_ratio():
    rows = [{"scan": "room", "ms": 2.0, "ratio": 4.0}, {"scan": "log", "ms": 1.0}, {"scan": "none", "ratio": None}]
    assert _gate.ratios_of("lines", rows) == {"lines: room": 4.0}


def test_within_the_tolerance_nothing_is_said():
    verdict = _gate.judge({"a": 0.74, "b": 1.2}, {"a": 0.5, "b": 2.0}, tolerance=1.5)
    assert (verdict.regressions, verdict.missing, verdict.compared, verdict.exit_code) == ([], [], 2, 0)


def test_a_regression_is_one_line_and_exit_code_1():
    verdict = _gate.judge({"a": 0.76, "b": 2.0}, {"a": 0.5, "b": 2.0}, tolerance=1.5)
    assert verdict.regressions == ["a: 0.76, baseline 0.5, 1.52 times as much"]
    assert verdict.exit_code == 1


def test_a_ratio_that_is_no_number_is_a_regression():
    assert _gate.judge({"a": float("nan")}, {"a": 0.5}).exit_code == 1


def test_what_was_not_measured_is_no_regression_but_said():
    verdict = _gate.judge({"new": 9.0}, {"a": 0.5})
    assert (verdict.missing, verdict.compared, verdict.exit_code) == (["a"], 0, 0)


def test_a_new_baseline_replaces_only_the_workloads_measured(tmp_path):
    path = tmp_path / "baseline.json"
    _gate.write_baseline({"fit: a": 0.123456, "lines: b": 2.0}, path)
    _gate.write_baseline({"fit: c": 0.5}, path)
    assert _gate.read_baseline(path) == ({"fit: c": 0.5, "lines: b": 2.0}, _gate.TOLERANCE)


def test_the_committed_baseline_holds_ratios():
    ratios, tolerance = _gate.read_baseline()
    assert ratios and all(0.0 < value < 1e4 for value in ratios.values())
    assert 1.0 < tolerance <= 2.0


def test_a_partial_run_updates_only_its_own_rows(tmp_path):
    path = tmp_path / "results.json"
    here = {**_page.circumstances(), "short": True, "seconds": 1.0, "peak_MB": 2.0}
    _page.store({"fit": {**here, "rows": ROWS}, "lines": {**here, "rows": [{"scan": "room", "ratio": 4.0}]}}, path)
    kept = _page.store({"lines": {**here, "rows": [{"scan": "room", "ratio": 3.0}]}}, path)
    assert kept["fit"]["rows"] == ROWS == json.loads(path.read_text())["fit"]["rows"]
    assert kept["lines"]["rows"] == [{"scan": "room", "ratio": 3.0}]
    page = _page.page(kept)
    assert page.index("## Plane fit") < page.index("## Line extraction")
    assert "| walls | numpy | 40 | 40 | 100 |" in page and "| room | 3 |" in page


def test_an_unknown_name_is_exit_code_2(capsys: pytest.CaptureFixture[str]):
    assert main(["fits"]) == 2
    assert "expected names out of fit, " in capsys.readouterr().err
