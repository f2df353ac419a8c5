"""docs/accuracy.md and docs/published.md are what their records give, and every piece of them is recorded."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from bstcad.figures.drawing import MAX_PNG_BYTES
from bstcad.scene.scene import load
from tests.benchmarks import accuracy, published
from tests.benchmarks.independent import judge
from tests.benchmarks.mitsuba_caustic import VERTICES, control_net
from tests.hard_cases.conftest import by_case

KNOWN, PUBLISHED = (accuracy.known(module.RECORDED) for module in (accuracy, published))


def test_each_page_is_what_its_records_give():
    """Else: python -m tests.benchmarks.accuracy --only, or published --only, which writes it anew."""
    assert accuracy.PAGE.read_text(encoding="utf-8") == accuracy.page(KNOWN)
    assert published.PAGE.read_text(encoding="utf-8") == published.page(PUBLISHED, KNOWN)


def test_figures_of_both_precisions_share_a_row_of_the_hard_cases():
    figures = {
        ("7. A plane.", "error, float32: sag"): (2e-7, 1e-6, "mm"), ("7. A plane.", "miss"): (0.0, 0.0, ""),
        ("7. A plane.", "error, float64: sag"): (3e-16, 1e-15, "mm"),
        ("2. A ray.", "slope, float64"): (1e-16, 1e-15, ""),
    }  # fmt: skip
    assert by_case(figures) == [
        ["2. A ray", "slope, float64", "1e-16", "1e-15"],
        ["7. A plane", "error, float32; float64: sag", "2e-07; 3e-16 mm", "1e-06; 1e-15 mm"],
        ["", "miss", "0", "0"],
    ]


def test_every_piece_is_recorded_with_its_circumstances_and_pictures():
    for piece in accuracy.pieces(600.0, 600.0).values():
        record = piece.find(KNOWN)
        circumstances = set(record["recorded"]) - {"pace"}  # older records have no pace
        assert circumstances == {"date", "version", "machine", "versions", "others"}
    pictures = [accuracy.PAGE.with_name(name) for name in accuracy.FIGURES.values()]
    for name, found in PUBLISHED.items():
        pictures.append(published.PICTURES / f"{name}.png")
        assert Image.open(pictures[-1]).size == (2 * published.SIDE + published.GAP, published.SIDE)
        assert found["stated"] == pytest.approx(found["rrmsd"], rel=0.01) and found["error"] < 0.01 * found["rrmsd"]
        if "rrmsd_half" in found:  # older records state pixels alone
            assert found["stated_half"] == pytest.approx(found["rrmsd_half"], rel=0.03)
    assert list(PUBLISHED) == list(published.CASES) and all(path.stat().st_size < MAX_PNG_BYTES for path in pictures)


@pytest.mark.bench
def test_a_record_and_its_row_state_the_rrmsd_on_pixels_and_on_half_pixels(monkeypatch, tmp_path):
    """A draft of a small net, judged by few rays."""
    changes = "tailoring.quality=draft", *accuracy.SMALLEST
    tiny = accuracy.designed("thu", "draft", accuracy.SMALLEST)
    assert 0 < tiny["rrmsd_noise"] < tiny["rrmsd"] and 0 < tiny["rrmsd_half_noise"] < tiny["rrmsd_half"]
    entry = tiny | {"recorded": KNOWN["designs"]["thu"]["draft"]["recorded"] | {"pace": 1.0}}
    designs = KNOWN["designs"] | {"thu": KNOWN["designs"]["thu"] | {"draft": entry}}
    row = f"| draft | {tiny['rrmsd']:.4f} | {tiny['rrmsd_noise']:.1g} | {tiny['rrmsd_half']:.4f} |"
    assert row in accuracy.page(KNOWN | {"designs": designs})

    monkeypatch.setattr(published, "PICTURES", tmp_path)
    monkeypatch.setattr(published, "generate", lambda scene, folder: accuracy.generate(scene, folder, *changes))
    monkeypatch.setattr(published, "judge", lambda folder, **given: judge(folder, points=1 << 16, **given))
    found = published.designed("thu", None)
    assert found["rrmsd_half"] == pytest.approx(found["stated_half"], rel=0.05)
    assert found["rrmsd_half"] == pytest.approx(tiny["rrmsd_half"], rel=0.05)
    page = published.page(PUBLISHED | {"thu": found}, KNOWN)
    assert f"**{found['rrmsd']:.4f}** ± {found['error']:.1g} | **{found['rrmsd_half']:.4f}** ± " in page


def test_mitsuba_the_paper_and_the_knobs_stand_on_the_axes_of_one_figure():
    [axes] = accuracy.figure(KNOWN, accuracy.PEER).axes
    named = {text.get_text().partition(":")[0] for text in axes.get_legend().get_texts()}
    assert {"Mitsuba 3", "the same, on its own 128² pixels"} <= named
    assert "the procedure of Wang et al. 2023" in [text.get_text() for text in axes.texts]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    for point in KNOWN["mitsuba"]["points"]:
        assert left < point["seconds"] < right and low < point["rrmsd"] < high


def test_only_what_is_missing_of_another_version_or_named_is_recorded():
    pieces = accuracy.pieces(600.0, 600.0)
    named = accuracy.wanted(pieces, ["thu-*", "mitsuba"], KNOWN)
    assert named[:2] == ["thu-draft", "thu-standard"] and named[-1] == "mitsuba" and len(named) == 7
    with pytest.raises(SystemExit, match="no piece is called mitzuba"):
        accuracy.wanted(pieces, ["mitzuba"], KNOWN)
    known: dict = {}
    for piece in pieces.values():
        piece.keep(known, {"recorded": {"version": "another"}})
    again = accuracy.wanted(pieces, None, known)
    assert {"thu-draft", "sweep-thu"} <= set(again) and not {"thu-paper", "mitsuba"} & set(again)
    del known["mitsuba"]
    assert "mitsuba" in accuracy.wanted(pieces, None, known)


def test_the_surface_of_a_mesh_has_its_vertex_normals_as_slopes():
    """A wavy height map: at inner vertices the slope is the mean over the facets around."""
    x = np.linspace(-50.0, 50.0, VERTICES)
    pitch = x[1] - x[0]
    heights = 0.05 * np.sin(0.4 * x)[None, :] * np.cos(0.3 * x)[:, None]  # y along the first axis
    assert control_net(heights).shape == (VERTICES + 1, VERTICES + 1)
    back, inner = accuracy.with_heights(heights).back, torch.from_numpy(x[2:-2])
    ours = back.relative_sag_and_slope(*torch.meshgrid(inner, inner, indexing="ij"))[1].numpy().T
    across = (heights[:, 2:] - heights[:, :-2]) / (2 * pitch)
    mean = ((across[:-2] + 2 * across[1:-1] + across[2:]) / 4)[1:-1, 1:-1]
    assert np.abs(ours - mean).max() < 1e-12 and np.abs(mean).max() > 0.019


def test_the_sunlight_picture_stands_in_its_border_and_every_scene_can_be_read(tmp_path):
    """A picture of the size of diffinytrace's, of which the middle square is shown."""
    values = np.full((1200, 1600), 10, np.uint8)
    values[:, 200:1400] = 200
    Image.fromarray(values).save(tmp_path / "given.png")
    made = published.bordered(tmp_path / "given.png")
    shown = np.asarray(made).astype(int)
    assert shown.shape == (256, 256) and (shown[22:-22, 22:-22] == 200).all() and shown.sum() == 200 * 212**2
    made.save(tmp_path / "sun_picture.png")
    for name, (_, path) in published.CASES.items():
        if name == published.SUN:
            (tmp_path / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
            path = tmp_path / path.name
        assert load(path).target.irradiance().sum() > 0
