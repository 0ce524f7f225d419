"""The corpus names its drives, survives what its runs do, and puts rows together as it says."""

from dataclasses import replace

import numpy as np
import pytest
from shapely import box

from benchmarks.corpus import __main__ as corpus_main
from benchmarks.corpus import ablation
from benchmarks.corpus.catalogue import SHORT, Entry, corpus, drawn, simulated
from benchmarks.corpus.drives import DISTURBANCES, ODOMETRIES, SENSORS, WORLDS
from benchmarks.corpus.process import rows_of, run_entry
from benchmarks.corpus.score import _nees, doubles, judged
from benchmarks.corpus.summary import by_kind, compared
from slam.config import SlamConfig
from slam.evaluation import PlaneMatch
from spplanes import Plane


def test_every_kind_of_everything_is_in_the_corpus():
    for names in (simulated(), SHORT):
        words = [name.split("/") for name in names]
        assert {word[0] for word in words} == set(WORLDS) and {word[2] for word in words} == set(ODOMETRIES)
        assert {word[3] for word in words} == set(DISTURBANCES)
    assert {name.split("/")[1] for name in simulated()} == set(SENSORS)


def test_drives_are_chosen_by_part_pattern_and_name_and_by_seed():
    starts = [name for name in simulated() if name.endswith("/prior_start")]
    assert [entry.name for entry in corpus([0], kinds=["prior_start"])] == starts
    name = "hall/lidar64/worse3/half"
    assert corpus(range(2, 4), kinds=[name]) == [Entry(name, 2), Entry(name, 3)]
    assert [entry.name for entry in corpus([5], kinds=["real/*"], short=True)][:1] == ["real/3dtk_corridor"]
    assert all(entry.seed == 0 for entry in corpus([5], kinds=["real/*"]))
    with pytest.raises(ValueError, match="kind: expected a part of a drive's name"):
        corpus([0], kinds=["castle"])


def test_drawn_drives_are_those_of_their_seeds():
    first, again, later = drawn(12, range(100, 101)), drawn(12, range(100, 101)), drawn(6, range(106, 107))
    assert first == again and first[6:] == later and len({entry.name for entry in first}) > 6
    names = {entry.name for entry in drawn(400, range(400))}
    assert not any("pushbroom/absent" in name or "pushbroom/still" in name for name in names)
    assert any("level/absent" in name for name in names)  # a level laser measures the motion itself


@pytest.mark.parametrize(
    ("worst", "sigma", "expected"),
    [
        (0.009, 0.001, "right"),
        (0.09, 0.05, "right"),
        (0.02, 0.001, "between"),
        (0.2, 0.09, "between"),
        (0.2, 0.11, "open"),
        (0.2, 0.001, "wrong"),
    ],
)
def test_what_truth_says_of_a_run(worst, sigma, expected):
    assert judged(worst, worst, sigma) == expected
    assert judged(worst, worst, sigma, "backwards") == ("wrong" if expected == "wrong" else "misled")


def test_nees_of_a_wall_seen_by_lines_leaves_its_lean_out():
    """Truth drawn from the estimate's covariance: 2 degrees of freedom, whatever the lean is."""
    rng = np.random.default_rng(0)
    spread = rng.standard_normal((3, 3)) * 0.01
    wall, values = Plane.from_hesse((0.6, 0.8, 0.0), 2.0, spread @ spread.T, centre=(1.0, 3.0, 0.5)), []
    for _ in range(2000):
        z, theta, psi = spread @ rng.standard_normal(3)
        turn = np.array([[1.0, 0.0, theta, 0.0], [0.0, 1.0, -psi, 0.0], [-theta, psi, 1.0, z], [0.0, 0.0, 0.0, 1.0]])
        u, _, vt = np.linalg.svd(turn[:3, :3])
        turn[:3, :3] = u @ vt
        values.append(_nees(wall, Plane(frame=wall.frame @ turn, covariance=np.zeros((3, 3))), 2))
    assert np.mean(values) == pytest.approx(2.0, abs=0.2)


def test_doubles_are_landmarks_of_one_piece_of_a_plane_not_pieces_that_lie_apart():
    def patch(x):
        return Plane.from_hesse((0.0, 0.0, 1.0), 0.0, np.eye(3), centre=(x, 0.0, 0.0))

    planes = [replace(patch(x), outline=box(-0.5, -0.5, 0.5, 0.5)) for x in (0.0, 0.3, 5.0)]
    matches = [PlaneMatch(k, 7, 0.0, 0.0, 0.0) for k in range(3)]
    assert doubles(planes, matches) == 1 and doubles(planes, [matches[0], replace(matches[1], true=8), matches[2]]) == 0


def test_a_run_that_fails_or_hangs_is_a_row_and_the_next_one_runs():
    jobs = [(Entry("castle/level", 0), {}), (Entry("bare/lidar64", 0), {}), (Entry("castle/level", 1), {})]
    first, late, last = (row["state"] for row in rows_of(jobs, 1.0))
    assert "error: ValueError in drive.py" in first and "error: ValueError in drive.py" in last
    assert late == "time: not done within 1 s"


def test_a_drive_is_run_and_scored():
    """A corridor: what odometry adds between keyframes is part of the claim, so all scans are within a few sigmas."""
    row = run_entry(Entry("bare/level/good/half", 1), {})
    assert row["compared"] >= row["keyframes"] > 10 and row["worst, m"] < 4.0 * row["sigma, m"]
    assert row["worst, m"] >= row["rmse, m"] > 0.0 and row["judged"] in ("right", "open") and row["pose dof"] == 3
    assert row["pose NEES"] < 20.0 and row["matched"] == row["planes"] == 2
    assert row["duplicates"] == row["invented"] == 0


ROWS = [
    {"drive": "hall/level/good/none", "seed": k, "state": "ok", "rmse, m": 0.01 * k, "worst, m": 0.06 * k}
    | {"pose NEES": 3.0, "pose dof": 3, "plane NEES/dof": 1.0, "matched": 4, "planes": 5}
    | {"duplicates": 1, "invented": 1}
    | {"verdict": "broken" if k == 3 else "sound", "judged": "wrong" if k > 1 else "right"}
    for k in (1, 2, 3)
] + [{"drive": "bare/level/good/none", "seed": 1, "state": "error: ValueError in a.py:1: no"}]


def test_rows_are_put_together_by_kind():
    lines = {line["kind"]: line for line in by_kind(ROWS)}
    assert list(lines) == ["world hall", "world bare", "sensors level", "with nothing wrong", "all"]
    hall = lines["world hall"]
    assert hall["> 10 cm, %"] == pytest.approx(200.0 / 3.0) and hall["rmse, mm"] == pytest.approx(20.0)
    assert hall["duplicates, %"] == pytest.approx(20.0) and hall["sound/doubtful/broken"] == "2/0/1"
    assert (hall["wrong, warned"], hall["right, warned"]) == ("1 of 2", "0 of 1") and lines["world bare"]["failed"] == 1
    assert lines["all"]["runs"] == 4


def test_two_runs_of_the_corpus_side_by_side_over_what_both_have():
    after = [{**row, "rmse, m": 0.005, "worst, m": 0.02} for row in ROWS[:2]]
    lines = {line["kind"]: line for line in compared(ROWS, after)}
    assert lines["world hall"]["runs"] == 2 and lines["world hall"]["> 10 cm, %"] == "50 -> 0"
    assert lines["world hall"]["rmse, mm"] == "15 -> 5" and "world bare" not in lines


def test_switches_change_what_they_name_and_nothing_else():
    for without in ablation.SWITCHES.values():
        [(section, fields)] = without.items()
        config, default = SlamConfig.model_validate(without), SlamConfig()
        assert config != default == config.model_copy(update={section: getattr(default, section)})
        assert {name: getattr(getattr(config, section), name) for name in fields} == fields


def test_an_ablation_names_the_kinds_that_get_worse_beyond_their_spread():
    def rows(factor, scatter):
        rng = np.random.default_rng(0)
        return [
            {"drive": f"{world}/level/good/none", "seed": seed, "state": "ok", "worst, m": 0.05, "duplicates": 0}
            | {"rmse, m": 0.01 * (factor if world == "hall" else 1.0) * np.exp(scatter * rng.standard_normal())}
            for world in ("hall", "bare")
            for seed in range(6)
        ]

    lines = ablation.table({"": rows(1.0, 0.0), "this": rows(2.0, 0.1), "nothing": rows(1.0, 0.0)})
    assert [line["without"] for line in lines] == ["none", "this", "nothing"]
    assert "world hall (2." in lines[1]["kinds worse"] or "world hall (1.9" in lines[1]["kinds worse"]
    assert "bare" not in lines[1]["kinds worse"] and lines[2]["touched"] == 0 and lines[2]["kinds worse"] is None


@pytest.mark.parametrize(
    "words", [["--kind", "castle"], ["--kind", "castle/level"], ["--compare", "nowhere.json"], ["--resume"]]
)
def test_options_that_make_no_sense_end_with_code_2(words, capsys):
    assert corpus_main.main(words) == 2 and "benchmarks corpus: " in capsys.readouterr().err
    if words[0] == "--kind":
        assert ablation.main(words) == 2
