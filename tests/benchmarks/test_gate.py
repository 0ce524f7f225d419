"""The gate: which ratios there are, and what of them is a regression; rows made up, nothing timed."""

import json

import pytest

import benchmarks.__main__ as command
from benchmarks import _gate, _page
from benchmarks.__main__ import main
from benchmarks._registry import WORKLOADS


def row(case: str, by: str, cpu: float | None, memory: float | None) -> dict:
    return {"case": case, "by": by, "CPU ms": cpu, "wall ms": cpu, "peak memory MB": memory}


ROWS = [
    row("walls", "spplanes", 10.0, 20.0),
    row("walls", "numpy", 40.0, 100.0),
    row("walls", "mrob", None, None),
    row("planes", "spplanes", 3.0, 1.0),
    row("planes", "Open3D", 2.0, 50.0),
]


def figures(**known: dict) -> _gate.Figures:
    return {name: known.get(name, {}) for name in ("time", "apart", "memory", "accuracy")}


def test_ratios_are_ours_to_every_other_of_the_same_case_and_a_growing_mission_gives_its_own():
    time = {"fit: walls, ours to numpy": 0.25, "fit: planes, ours to Open3D": 1.5}
    assert _gate.figures_of("fit", ROWS) == figures(time=time, memory={"fit: walls, ours to numpy": 0.2})
    timed_itself = [row("walls", "spplanes", 10.0, 1.0), {**row("walls", "mrob", 20.0, 1.0), "apart": True}]
    assert _gate.figures_of("fit", timed_itself) == figures(apart={"fit: walls, ours to mrob": 0.5})
    tenths = [{"scans": name, "of the first tenth": value} for name, value in (("first", 1.0), ("last", 1.3))]
    assert _gate.figures_of("growth", tenths) == figures(apart={"growth: last": 1.3})


def test_accuracy_is_that_of_ours_alone_and_grows_as_it_gets_worse():
    ours = {"case": "frame", "by": "spplanes", "correct": "10/17", "purity, %": 99.0, "chi2/dof": 0.97}
    theirs = {"case": "frame", "by": "Open3D", "correct": "4/17", "purity, %": 88.0}
    found = _gate.figures_of("scenes", [ours, theirs])["accuracy"]
    names = [f"scenes: frame: {column}" for column in ("correct", "purity, %", "chi2/dof")]
    assert found == pytest.approx(dict(zip(names, (7.0, 1.0, 0.03), strict=True)))


PURITY, SLACK = "scenes: frame: purity, %", _gate.ACCURACY["purity, %"].slack


@pytest.mark.parametrize(
    ("measured", "kept", "expected"),
    [
        ({"accuracy": {PURITY: 1.1 + 0.9 * SLACK}}, {"accuracy": {PURITY: 1.0}}, (0, [], 1)),
        ({"accuracy": {PURITY: 1.1 + 1.1 * SLACK}}, {"accuracy": {PURITY: 1.0}}, (1, [], 1)),
        ({"time": {"a": float("nan")}}, {"time": {"a": 0.5}}, (1, [], 1)),
        ({"time": {"new": 9.0}}, {"time": {"a": 0.5}}, (0, ["a"], 0)),
    ],
    ids=["within the slack", "beyond it", "no number", "not measured"],
)
def test_what_is_a_regression(measured, kept, expected):
    verdict = _gate.judge(figures(**measured), figures(**kept))
    assert (verdict.exit_code, verdict.missing, verdict.compared) == expected


def test_results_are_kept_of_every_gated_workload():
    gated = {name for name, one in WORKLOADS.items() if one.gated}
    results = {name: result for name, result in _page.kept().items() if name in gated}
    assert {name.split(":")[0] for some in _gate.figures_of_all(results).values() for name in some} == gated


def test_the_command_fails_on_a_worse_ratio_and_on_a_worse_accuracy(monkeypatch, tmp_path, capsys):
    """The whole way from a workload's rows to the exit code; the workload itself is replaced by its rows."""
    monkeypatch.setattr(_page.store, "__defaults__", (tmp_path / "results.json",))
    monkeypatch.setattr(_page.kept, "__defaults__", (tmp_path / "results.json",))
    monkeypatch.setattr(_page, "PAGE", tmp_path / "results.md")
    ours = {**row("c0", "spplanes", 10.0, 20.0), "error, mm": 5.0}

    def exit_code(words: list[str], **changed: float) -> int:
        rows = [ours | changed, row("c0", "mrob", 20.0, 30.0)]
        monkeypatch.setattr(command, "run_one", lambda *_: {"rows": rows, "seconds": 1.0, "peak_MB": 1.0})
        return main([*words, "scenes"])

    assert exit_code(["--write"]) == 0 and exit_code(["--gate"]) == 0 and exit_code(["--gate"], **{"CPU ms": 17.0}) == 1
    assert exit_code(["--gate"], **{"error, mm": 6.0}) == 1
    assert "scenes: c0: error, mm (accuracy): 6, kept 5" in capsys.readouterr().out


def stored(rows: list[dict], *, short: bool, date: str = "2026-01-02") -> dict:
    return {**_page.circumstances(), "date": date, "short": short, "seconds": 1.0, "peak_MB": 2.0, "rows": rows}


def test_a_partial_run_updates_only_its_own_rows(tmp_path):
    path = tmp_path / "results.json"
    _page.store({"fit": stored(ROWS, short=True), "growth": stored([{"scan": "room", "ms": 4.0}], short=True)}, path)
    kept = _page.store({"growth": stored([{"scan": "room", "ms": 3.0}], short=True)}, path)
    assert kept["fit"]["rows"] == ROWS == json.loads(path.read_text())["fit"]["rows"]
    assert kept["growth"]["rows"] == [{"scan": "room", "ms": 3.0}]
    page = _page.page(kept)
    assert page.index("## Plane fit") < page.index("## Growth of the map")
    assert "| walls | numpy | 40 | 40 | 100 |" in page and "| room | 3 |" in page


def test_a_short_run_leaves_the_rows_it_does_not_measure_with_their_date(tmp_path):
    path = tmp_path / "results.json"
    short, long = {"keyframes": "demo", "s": 1.0}, {"keyframes": "intel", "s": 90.0}
    _page.store({"growth": stored([short, long], short=False, date="2026-01-01")}, path)
    for seconds in (2.0, 3.0):  # the second time the old row is among the older ones already
        kept = _page.store({"growth": stored([{**short, "s": seconds}], short=True)}, path)
        page = _page.page(kept)
        assert f"| demo | {seconds:.0f} |" in page and "| demo | 1 |" not in page and "| intel | 90 |" in page
        assert "the full run of 2026-01-01" in page and "intel." in page
    kept = _page.store({"growth": stored([short], short=False)}, path)
    assert "intel" not in _page.page(kept)


def test_an_unknown_name_is_exit_code_2(capsys: pytest.CaptureFixture[str]):
    assert main(["fits"]) == 2 and "expected names out of fit, " in capsys.readouterr().err
