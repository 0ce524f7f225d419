"""Rows of long benchmarks are kept as they come: an interrupted run goes on, files of several add up."""

from __future__ import annotations

import pytest

from benchmarks import missions
from benchmarks._kept_rows import append_row, read_rows, seeds_left


def row(seed: int, nees: float = 3.0) -> dict:
    names = ("position rmse, m", "share of odometry", "plane distance, m", "plane angle, deg", "duplicates, %")
    return {"seed": seed, "planes": 10, "pose NEES": 3.0, "plane NEES": nees, "beyond, %": 0.0} | dict.fromkeys(
        names, 0.1
    )


def test_a_line_cut_short_loses_its_own_row_alone(tmp_path):
    path = tmp_path / "rows.jsonl"
    append_row(path, row(1))
    with path.open("a") as stream:
        stream.write('{"seed": 2, "planes"')
    append_row(path, row(3))
    assert [one["seed"] for one in read_rows([path])] == [1, 3]
    assert seeds_left(range(5), read_rows([path])) == [0, 2, 4]


def test_a_run_goes_on_where_it_was_interrupted(tmp_path, monkeypatch, capsys):
    path, ran = tmp_path / "rows.jsonl", []

    def stop_at_two(seeds):
        for seed in seeds:
            if seed == 2 and 2 not in ran:
                ran.append(seed)
                raise KeyboardInterrupt
            ran.append(seed)
            yield row(seed)

    monkeypatch.setattr(missions, "office_rows", stop_at_two)
    monkeypatch.setattr("sys.argv", ["missions", "office", "4", "--rows", str(path)])
    with pytest.raises(KeyboardInterrupt):
        missions.main()
    missions.main()
    assert ran == [0, 1, 2, 2, 3]
    assert "runs  over all" in capsys.readouterr().out
    assert [one["seed"] for one in read_rows([path])] == [0, 1, 2, 3]


def test_the_summary_of_files_holds_each_seed_once(tmp_path, monkeypatch, capsys):
    first, second = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    for path, seed, nees in ((first, 0, 2.0), (first, 1, 3.0), (second, 2, 3.0), (second, 0, 4.0)):
        append_row(path, row(seed, nees))
    monkeypatch.setattr("sys.argv", ["missions", "summary", str(first), str(second)])
    missions.main()
    lines = capsys.readouterr().out.splitlines()
    assert all(line.startswith("3 ") for line in lines[1:])
    assert any("planes, NEES (all planes)" in line and "3.333" in line for line in lines)


@pytest.mark.parametrize("words", [["attic"], ["office", "many"], ["summary", "nowhere.jsonl"]])
def test_words_that_mean_nothing_end_with_a_sentence(words, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["missions", *words])
    with pytest.raises(SystemExit):
        missions.main()
    assert "expected" in capsys.readouterr().err
