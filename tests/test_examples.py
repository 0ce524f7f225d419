"""Every example runs, and what it prints is what it promises."""

import gzip
import re
import runpy
from itertools import islice
from pathlib import Path

import pytest

from slam import SlamConfig
from slam.evaluation.trajectories import read_relations, relation_errors
from slam.io.load import load
from slam.runs.scan_trajectory import scan_trajectory
from slam.runs.slam_run import run_slam
from tests.slam.real_data import needs

EXAMPLES = sorted((Path(__file__).resolve().parent.parent / "examples").glob("*.py"))


def millimetres(pattern: str, text: str) -> list[float]:
    """All numbers that a pattern with one group finds."""
    found = [float(number) for number in re.findall(pattern, text)]
    assert found, f"{pattern!r} not in\n{text}"
    return found


def run(name: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What an example prints."""
    (example,) = [path for path in EXAMPLES if path.stem == name]
    runpy.run_path(str(example), run_name="__main__")
    return capsys.readouterr().out


def test_every_example_is_tested():
    text = Path(__file__).read_text(encoding="utf-8")
    assert [path.stem for path in EXAMPLES if f'("{path.stem}"' not in text] == []


def test_fit_one_plane(capsys):
    assert "NEES" in run("fit_one_plane", capsys)


def test_planes_of_a_scan(capsys):
    errors = millimetres(r"([+-]\d+\.\d+) mm ", run("planes_of_a_scan", capsys))
    assert len(errors) >= 8 and max(map(abs, errors)) < 5.0


def test_lines_of_a_scan(capsys):
    ratios = millimetres(r" (\d\.\d\d)\n", run("lines_of_a_scan", capsys))
    assert min(ratios) > 0.4 and max(ratios) < 1.8


def test_factors_in_your_graph(capsys):
    text = run("factors_in_your_graph", capsys)
    without = millimetres(r"to +(\S+) mm without", text)
    with_planes = millimetres(r"planes, +(\S+) mm with", text)
    assert all(firm < loose for loose, firm in zip(without, with_planes, strict=True))


@pytest.mark.parametrize(
    ("name", "pattern", "most_mm", "alone_mm"),
    [
        ("own_graph_slam", r"(?:graph|alone) +(\S+) mm", 5.0, 20.0),
        ("line_slam_2d", r"(?:estimate|alone) +(\S+) mm", 5.0, 10.0),
        ("plane_slam_3d", r"rmse +(\S+) mm", 5.0, 20.0),
        ("corridor_slam", r"(?:estimate|alone) +(\S+) mm +\S+ mm", 10.0, 10.0),
    ],
)
def test_what_is_estimated_is_nearer_than_odometry_alone(name, pattern, most_mm, alone_mm, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", [f"{name}.py"])
    text = run(name, capsys)
    estimate, alone = millimetres(pattern, text)
    assert estimate < most_mm <= alone_mm < alone
    assert name != "plane_slam_3d" or "planes.glb" in text


def test_own_graph_slam_is_as_good_as_slam_on_a_real_log(tmp_path, capsys):
    """Freiburg 079, its first 600 of 4934 scans: on them slam closes no loop."""
    log_file, relations_file = needs("fr079/fr079.clf.gz"), needs("fr079/fr079.relations.gz")
    with gzip.open(log_file, "rt") as lines:
        until = [number for number, line in enumerate(lines) if line.startswith("FLASER")][600]
    with gzip.open(log_file, "rt") as lines:
        (tmp_path / "drive.clf").write_text("".join(islice(lines, until)))
    example = runpy.run_path(str(EXAMPLES[0].parent / "own_graph_slam.py"))
    example["main"]([str(tmp_path / "drive.clf"), str(relations_file)])
    own, alone = millimetres(r"(?:graph|alone) +(\S+) mm", capsys.readouterr().out)
    log, rig = load(tmp_path / "drive.clf")
    path = scan_trajectory(run_slam(log, rig, SlamConfig(), repair=False).trajectory, log, rig, SlamConfig())
    errors = relation_errors(path, read_relations(relations_file)).translation_m
    assert own < 1.1e3 * errors.mean() < alone / 1.5


def test_push_broom_map(capsys):
    text = run("push_broom_map", capsys)
    rows = re.findall(r"([+-]\d+\.\d+) mm +(\d+\.\d+) mm", text)
    assert len(rows) >= 4 and all(abs(float(error)) < 4.0 * float(sigma) for error, sigma in rows)
    assert millimetres(r"corridor (\S+) \+-", text)[0] == pytest.approx(2.7, abs=0.005)


def test_export_to_open3d(capsys):
    text = run("export_to_open3d", capsys)
    assert "Open3D is not here" in text or text.count("read back as") == 3


def test_join_missions(capsys):
    out = run("join_missions", capsys)
    assert "one map:" in out and out.count("joined, ") >= 2
    off, sigma = millimetres(r"robot [12] +(\d+\.\d) mm", out), millimetres(r"robot [12] +\S+ mm +(\d+\.\d) mm", out)
    assert len(off) == 2 and all(a < 4.0 * b < 200.0 for a, b in zip(off, sigma, strict=True))
