"""A graph that was edited or solved elsewhere comes back as the planes and the trajectory of its run."""

from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam.errors import LogError
from slam.io.g2o.reader import read_g2o
from slam.runs.graph_import import import_graph
from slam.runs.stored_run import StoredRun
from tests.slam.commands import command, refused, simulated_run

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
STILL, MOVED = gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.7), np.array([3.0, -2.0, 0.5]))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated_run(tmp_path_factory.mktemp("import"), "corridor", 80, 3)


def moved_file(run: Path, to: Path, motion: gtsam.Pose3 = STILL, noise: float = 0.0) -> Path:
    """The run's graph.g2o with its vertices moved; edges as they were."""
    read, rng, lines = read_g2o(run / "graph.g2o"), np.random.default_rng(0), []
    for words in (line.split() for line in (run / "graph.g2o").read_text().splitlines()):
        number = int(words[1]) if words[0].startswith("VERTEX") else None
        if number in read.poses:
            pose = motion.compose(read.values.atPose3(read.poses[number])).retract(noise * rng.normal(size=6))
            q = pose.rotation().toQuaternion()
            words[2:] = [repr(float(v)) for v in (*pose.translation(), q.x(), q.y(), q.z(), q.w())]
        elif number in read.planes:
            plane = read.values.atOrientedPlane3(read.planes[number]).transform(motion.inverse())
            words[2:6] = [repr(float(v)) for v in plane.retract(noise * rng.normal(size=3)).planeCoefficients()]
        lines.append(" ".join(words))
    to.write_text("\n".join(lines) + "\n")
    return to


def test_every_default_solver_takes_a_graph_that_was_read_back(run: Path, tmp_path: Path):
    """Once LM stopped at 0 iterations without a word, and the others threw on w0."""
    optimum = read_g2o(run / "graph.g2o")
    read = read_g2o(moved_file(run, tmp_path / "noisy.g2o", noise=0.003))
    least = optimum.graph.error(gtsam.LevenbergMarquardtOptimizer(optimum.graph, optimum.values).optimize())
    assert read.graph.error(read.values) > 2.0 * least
    for solver in (gtsam.LevenbergMarquardtOptimizer, gtsam.GaussNewtonOptimizer, gtsam.DoglegOptimizer):
        optimiser = solver(read.graph, read.values)
        result = optimiser.optimize()
        assert optimiser.iterations() > 0 and read.graph.error(result) == pytest.approx(least, rel=1e-3)
    covariance = gtsam.Marginals(read.graph, result).marginalCovariance(max(read.poses.values()))
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    assert set(read.values.keys()) == {*read.poses.values(), *read.planes.values(), gtsam.symbol("w", 0)}


@pytest.mark.parametrize(
    ("motion", "atol", "plane_atol"), [(STILL, 1e-9, 1e-6), (MOVED, 1e-6, 1e-5)], ids=["left alone", "moved"]
)
def test_a_graph_takes_the_map_along(run: Path, tmp_path: Path, motion: gtsam.Pose3, atol: float, plane_atol: float):
    given = StoredRun.read(run)
    back = import_graph(moved_file(run, tmp_path / "moved.g2o", motion), run, solve=False)
    assert [one.id for one in back.planes] == [one.id for one in given.planes]
    np.testing.assert_allclose(back.trajectory.poses, motion.matrix() @ given.trajectory.poses, atol=atol)
    for ours, theirs in zip(back.planes, given.planes, strict=True):
        np.testing.assert_allclose(ours.plane.frame, motion.matrix() @ theirs.plane.frame, atol=plane_atol)
        assert ours.plane.n_points == theirs.plane.n_points and ours.seen.equals(theirs.seen)
        ratio = np.sqrt(np.diag(ours.plane.covariance) / np.diag(theirs.plane.covariance))
        assert (ratio < 1.5).all() and (ratio > 0.6).all()


def test_what_is_off_its_optimum_is_solved(run: Path, tmp_path: Path):
    given, noisy = StoredRun.read(run), moved_file(run, tmp_path / "noisy.g2o", noise=0.003)
    far, back = import_graph(noisy, run, solve=False), import_graph(noisy, run)
    shifts = [np.abs(one.trajectory.poses - given.trajectory.poses)[:, :3, 3].max() for one in (far, back)]
    assert shifts[0] > 4e-3 and shifts[1] < 1e-3
    (tmp_path / "again.g2o").write_text(back.graph)
    again = read_g2o(tmp_path / "again.g2o")
    assert 2.0 * again.graph.error(again.values) == pytest.approx(back.table[-1].value, rel=1e-6)


def test_the_command_leaves_a_folder_that_goes_on(run: Path, tmp_path: Path):
    edited, lost = tmp_path / "edited.g2o", str(next(iter(read_g2o(run / "graph.g2o").planes)))
    lines = (run / "graph.g2o").read_text().splitlines()
    gone = [words for words in map(str.split, lines) if words[0].startswith(("VERTEX_PLANE", "EDGE_SE3_PLANE"))]
    kept = [line for line in lines if not (line.split() in gone and lost in line.split()[1:3])]
    edited.write_text("\n".join(kept) + "\n")
    out = tmp_path / "back"
    assert command("import", edited, "--run", run, "--out", out) == 0
    assert len(StoredRun.read(out).planes) == len(StoredRun.read(run).planes) - 1
    assert command("export", out, "--to", tmp_path / "map.glb", "--to", tmp_path / "again.g2o") == 0
    assert command("import", out / "graph.g2o", "--run", out, "--out", tmp_path / "twice", "--as-is") == 0
    assert command("import", edited, "--run", run, "--out", out) == 2


@pytest.mark.parametrize("world", [("corridor", 80, 4), ("hall", 6, 0)], ids=["same place", "elsewhere"])
def test_the_graph_of_another_run_is_refused(
    world: tuple[str, int, int], run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Once its planes came back wherever ids happened to be the same."""
    other, back = simulated_run(tmp_path, *world), tmp_path / "back"
    capsys.readouterr()
    said = refused(capsys, "import", other / "graph.g2o", "--run", run, "--out", back)
    assert "graph.g2o: expected the graph of" in said and "got that of another run" in said and not back.exists()
    assert command("import", run / "graph.g2o", "--run", other, "--out", back) == 2


def test_a_graph_in_six_digits_with_another_odometry_is_of_its_run(run: Path, tmp_path: Path):
    lines = [line.split() for line in (run / "graph.g2o").read_text().splitlines()]
    for words in lines:
        if words[0] == "EDGE_SE3:QUAT":
            words[3] = str(float(words[3]) + 0.01)
        first, size = {"EDGE_SE3:QUAT": (3, 7), "EDGE_SE3_PLANE_CALIB": (4, 4)}.get(words[0], (0, 0))
        words[first : first + size] = [f"{float(word):.6g}" for word in words[first : first + size]]
    (tmp_path / "edited.g2o").write_text("\n".join(" ".join(words) for words in lines) + "\n")
    assert len(import_graph(tmp_path / "edited.g2o", run, solve=False).planes) == len(StoredRun.read(run).planes)


def test_what_cannot_be_taken_back(run: Path, tmp_path: Path):
    other = tmp_path / "other.g2o"
    other.write_text("VERTEX_SE3:QUAT 999 0 0 0 0 0 0 1\nFIX 999\n")
    with pytest.raises(LogError, match=r"other.g2o: expected poses with the vertex ids of .*graph.g2o, found none"):
        import_graph(other, run)
    loose, lines = tmp_path / "loose.g2o", (run / "graph.g2o").read_text().splitlines()
    loose.write_text("\n".join(line for line in lines if "PRIOR" not in line and "EDGE_SE3:" not in line) + "\n")
    with pytest.raises(LogError, match=r"loose.g2o: expected a graph that holds every pose and plane"):
        import_graph(loose, run)
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match=r"expected the folder of a run, found no planes.json"):
        import_graph(other, tmp_path / "empty")
