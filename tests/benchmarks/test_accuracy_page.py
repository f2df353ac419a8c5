"""docs/accuracy.md is what docs/accuracy.json gives, which holds all that page and figures need."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import torch
from PIL import Image

from bstcad.report.drawing import HEAVIEST
from tests.benchmarks import accuracy, accuracy_page
from tests.benchmarks.mitsuba_caustic import VERTICES, control_net

KNOWN = accuracy.known()
DOCS = accuracy.PAGE.parent


def test_the_page_is_what_the_records_give():
    """Else: python -m tests.benchmarks.accuracy --only, which writes it anew."""
    beside = {path.name for path in DOCS.iterdir()}
    assert accuracy.PAGE.read_text(encoding="utf-8") == accuracy_page.page(KNOWN, beside)


def test_every_piece_is_recorded_with_its_circumstances():
    pieces = accuracy.pieces(600.0, 600.0)
    found = {name: piece.find(KNOWN) for name, piece in pieces.items()}
    for record in found.values():
        assert record and {"date", "version", "machine", "versions", "others"} == set(record["recorded"])


def test_the_figures_are_drawn_from_the_records_and_small():
    for scene, path in accuracy.FIGURES.items():
        assert path.is_file() and path.stat().st_size < HEAVIEST
        assert min(Image.open(io.BytesIO(accuracy_page.draw(KNOWN, scene))).size) > 600


def test_mitsuba_the_paper_and_the_knobs_stand_on_the_axes_of_one_figure():
    found = KNOWN["sweeps"][accuracy.PEER]
    drawn = accuracy_page.figure(KNOWN, accuracy.PEER)
    [axes] = drawn.axes
    named = [text.get_text() for text in axes.get_legend().get_texts()]
    said = [text.get_text() for text in axes.texts]
    assert any(name.startswith("Mitsuba 3") for name in named) and "the same, on its own 128² pixels" in named
    assert "the procedure of Wang et al. 2023" in said
    assert any("standard error" in name for name in named)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    for point in KNOWN["mitsuba"]["points"]:
        assert left < point["seconds"] < right and low < point["rrmsd"] < high
    for knob in found["knobs"]:
        if len(knob["places"]) > 1 and knob["key"] != "quality":
            assert any(name.startswith(knob["title"]) for name in named)


def test_only_what_is_missing_of_another_version_or_named_is_recorded():
    pieces = accuracy.pieces(600.0, 600.0)
    assert accuracy.wanted(pieces, [], KNOWN) == []
    assert accuracy.wanted(pieces, ["thu-*", "mitsuba"], KNOWN) == [
        "thu-draft", "thu-standard", "thu-fine", "thu-paper", "thu-stage-1", "thu-integration", "mitsuba"
    ]  # fmt: skip
    with pytest.raises(SystemExit, match="no piece is called mitzuba"):
        accuracy.wanted(pieces, ["mitzuba"], KNOWN)
    old = {"recorded": {"version": "another"}}
    known: dict = {}
    for piece in pieces.values():
        piece.keep(known, dict(old))
    again = accuracy.wanted(pieces, None, known)
    assert "thu-draft" in again and "sweep-thu" in again and not {"thu-paper", "mitsuba"} & set(again)
    del known["mitsuba"]
    assert "mitsuba" in accuracy.wanted(pieces, None, known)


def test_the_surface_of_a_mesh_has_its_vertex_normals_as_slopes():
    """A wavy height map: at inner vertices the slope is the mean over the facets around."""
    n = VERTICES
    x = np.linspace(-50.0, 50.0, n)
    pitch = x[1] - x[0]
    heights = 0.05 * np.sin(0.4 * x)[None, :] * np.cos(0.3 * x)[:, None]  # y along the first axis
    assert control_net(heights).shape == (n + 1, n + 1)
    back = accuracy.with_heights(heights).back
    assert back.pitch == pytest.approx((pitch, pitch))
    inner = torch.from_numpy(x[2:-2])
    ours = back.relative_sag_and_slope(*torch.meshgrid(inner, inner, indexing="ij"))[1].numpy().T
    across = (heights[:, 2:] - heights[:, :-2]) / (2 * pitch)
    mean = ((across[:-2] + 2 * across[1:-1] + across[2:]) / 4)[1:-1, 1:-1]
    assert np.abs(ours - mean).max() < 1e-12
    assert math.isclose(np.abs(mean).max(), 0.02, rel_tol=0.02)
