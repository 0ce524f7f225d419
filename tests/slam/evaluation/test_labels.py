"""Label scores on segmentations small enough to count by hand."""

import numpy as np
import pytest

from slam.evaluation import LabelTable, hoover_counts, label_metrics


def metrics(labels, truth, **options):
    return {row.name: row.value for row in label_metrics(LabelTable.of(labels, truth), **options)}


def test_a_perfect_segmentation():
    truth = np.repeat([0, 1, -1], [300, 250, 50])
    scores = metrics(truth, truth)
    assert scores["label purity"] == scores["true planes found"] == 100.0
    assert scores["over-segmentation"] == 0.0 and scores["points represented"] == 100.0
    assert hoover_counts(LabelTable.of(truth, truth)).correct == 2


def test_measures_counted_by_hand():
    truth = np.repeat([0, 1, 2, -1], [400, 400, 100, 100])
    labels = truth.copy()
    labels[:150] = 3  # plane 0 in two regions
    labels[400:450] = 0  # and one of them takes 50 points of plane 1
    labels[-100:-60] = 2  # a region of plane 2 takes 40 points of none
    scores = metrics(labels, truth)
    assert scores["points"] == 940 and scores["regions"] == 4
    assert scores["label purity"] == pytest.approx(100.0 * (250 + 150 + 350 + 100) / 940)
    assert scores["true planes above 200 points"] == 2 and scores["true planes found"] == 100.0
    assert scores["over-segmentation"] == pytest.approx(100.0 / 3.0)


def test_a_plane_that_is_mostly_unlabelled_is_not_found():
    truth = np.zeros(1000, dtype=int)
    labels = np.where(np.arange(1000) < 499, 0, -1)
    assert metrics(labels, truth)["true planes found"] == 0.0
    labels[499] = 0
    assert metrics(labels, truth)["true planes found"] == 100.0
    assert metrics(labels, truth)["points represented"] == 50.0


def test_returns_that_belong_to_nothing_count_when_they_are_declared():
    truth, labels = np.array([0, 0, -1, -1]), np.array([0, 0, -1, -1])
    assert LabelTable.of(labels, truth).n_points == 2
    assert LabelTable.of(labels, truth, valid=np.array([True, True, True, False])).n_points == 3


def test_hoovers_classes():
    truth = np.repeat([0, 1, 2, 3, 4], 100)
    labels = np.full(500, -1)
    labels[:85] = 0  # correct: 85 % of plane 0
    labels[100:145], labels[145:195] = 1, 2  # plane 1 in two parts
    labels[200:400] = 3  # planes 2 and 3 in one
    labels[400:430] = 4  # noise; plane 4 missed
    counts = hoover_counts(LabelTable.of(labels, truth))
    assert (counts.correct, counts.over_segmented, counts.under_segmented) == (1, 1, 1)
    assert (counts.missed, counts.noise, counts.n_true) == (1, 1, 5)
    assert hoover_counts(LabelTable.of(labels, truth), overlap=0.9).correct == 0


def test_empty_and_mismatched():
    nothing = metrics(np.full(5, -1), np.full(5, -1))
    assert np.isnan(nothing["label purity"]) and nothing["regions"] == 0
    assert metrics(np.zeros(5, dtype=int), np.full(5, -1))["label purity"] == 0.0
    assert hoover_counts(LabelTable.of(np.full(5, -1), np.zeros(5, dtype=int))).missed == 1
    with pytest.raises(ValueError, match=r"labels: expected the shape \(4,\) of the truth, got \(5,\)"):
        LabelTable.of(np.zeros(5, dtype=int), np.zeros(4, dtype=int))
