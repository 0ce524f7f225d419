"""The package itself: everything it promises is there, and loaded only when asked for."""

import subprocess
import sys

import pytest

import spplanes


def test_every_public_name_is_there():
    assert {name for name in spplanes.__all__ if getattr(spplanes, name) is None} == set()
    assert set(spplanes.__all__) <= set(dir(spplanes))


def test_a_name_that_is_none():
    with pytest.raises(AttributeError, match="module 'spplanes' has no attribute 'fit_sphere'"):
        spplanes.fit_sphere  # noqa: B018


def test_a_fit_needs_no_segmentation():
    words = [sys.executable, "-c", "import sys; from spplanes import fit_plane; print(*sys.modules)"]
    loaded = set(subprocess.run(words, capture_output=True, text=True, check=True).stdout.split())
    assert "spplanes.fitting.fit" in loaded
    assert not loaded & {"spplanes.segmentation", "shapely", "scipy.special"}
