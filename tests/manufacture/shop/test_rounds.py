"""Rounds of cutting and measuring in a simulated shop, whose errors the code under test does not know."""

import json
import os
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import bstcad
from bstcad import cli, commands
from bstcad.app import design_process
from bstcad.designs import folder as folders
from bstcad.manufacture.measured import alignment, compensation
from bstcad.manufacture.measured.alignment import BackFace
from bstcad.manufacture.measured.cloud import Cloud
from bstcad.manufacture.measured.compensation import CompensationSettings, Statistics
from bstcad.manufacture.shop import by_light
from bstcad.manufacture.shop import rounds as rounds_of_shop
from bstcad.optics.surfaces.bspline import BSplineSurface, interpolating_net
from bstcad.optics.surfaces.surfaces import sag
from bstcad.optics.trace.measure import Effort
from tests import suite
from tests.efforts import FEWEST_RAYS as EFFORT

POINTS, GAUGE, MISPLACED, TURNED = 4000, 20e-6, 0.03, 0.05  # number, noise (mm), mm, degrees


class Shop:
    """A machine with errors that repeat, and some that do not; a gauge that holds each part otherwise."""

    def __init__(self, lens, low=5e-3, mid=5e-4, varying=0.0, seed=0):
        self.lens, self.low, self.mid, self.varying, self.seed = lens, low, mid, varying, seed
        self.half = lens.outline.half_extent

    def error(self, x, y, part):
        u, v = x / self.half[0], y / self.half[1]
        low = self.low * (0.5 * (u * u + v * v) + 0.3 * (u**3 - u * v * v) + 0.4 * u * v)
        period = self.half[0] / 2
        mid = self.mid * np.sin(2 * np.pi * x / period + 0.3) * np.cos(2 * np.pi * y / (1.2 * period))
        phase = np.random.default_rng(self.seed + part).uniform(0, 2 * np.pi, 2)
        return low + mid + self.varying * np.sin(5 * u + phase[0]) * np.sin(4 * v + phase[1])

    def cut(self, net, part):
        """The height of the part that is cut from a net."""
        return lambda x, y: sag(net, x, y) + self.error(x, y, part)

    def measure(self, height, seed, points=POINTS, noise=GAUGE, misplaced=MISPLACED):
        chance = np.random.default_rng(self.seed + seed)
        place = chance.uniform(-1, 1, (2 * points, 2)) * self.half
        place = place[self.lens.outline.contains(*torch.from_numpy(place).T).numpy()][:points]
        found = np.column_stack([place, height(*place.T) + chance.normal(0.0, noise, len(place))])
        pivot = BackFace.of(self.lens).pivot
        turn = Rotation.from_rotvec(np.radians(TURNED) * chance.normal(size=3) / np.sqrt(3)).as_matrix()
        moved = (found - pivot) @ turn.T + pivot + misplaced * chance.normal(size=3) / np.sqrt(3)
        return Cloud(moved, "mm", Path(f"part-{seed}.csv"), sha256=str(seed))

    def deviation(self, height):
        """PV and RMS (mm) of a part after its alignment, without noise."""
        face, points = BackFace.of(self.lens), self.measure(height, 99, noise=0.0, misplaced=0.0).points
        found = alignment.align(face, points, alignment.first_pose(face, points)[0])
        return np.ptp(found.distances), found.rms


@pytest.fixture(scope="module")
def lens(small_design):
    return folders.read_nominal(small_design.folder).lens.plain()


def rounds(shop, count, settings=CompensationSettings(), parts=1):  # noqa: B008
    """Yield (round, part that is cut from it); all parts differ."""
    net, before = shop.lens.back_net, []
    for number in range(count):
        measured = [shop.measure(shop.cut(net, 10 * number + k), 100 + 10 * number + k) for k in range(parts)]
        found = compensation.next_round(shop.lens, net, measured, settings, before)
        net = found.net
        before.append(found.deviation)
        yield found, shop.cut(net, 10 * (number + 1))


def test_two_rounds_lower_the_deviation_tenfold(lens):
    shop = Shop(lens, varying=8e-5)
    first, _ = shop.deviation(shop.cut(lens.back_net, 0))
    *_, (found, part) = rounds(shop, 2)
    after, rms = shop.deviation(part)
    assert after < first / 10 and rms < 2e-4
    assert found.net.shape == lens.back_net.shape and (found.net.x, found.net.y) == (lens.back_net.x, lens.back_net.y)


@suite.in_turn(0, 2)
def test_a_gain_of_half_leaves_half(lens):
    shop = Shop(lens)
    _, before = shop.deviation(shop.cut(lens.back_net, 0))
    [(found, part)] = rounds(shop, 1, CompensationSettings(gain=0.5))
    assert shop.deviation(part)[1] == pytest.approx(before / 2, rel=0.1)
    assert found.expected.rms == pytest.approx(found.deviation.rms / 2, rel=0.02)


@pytest.mark.parametrize("period", [1.0, 2.0, 4.0])
def test_the_low_pass_keeps_what_iso_16610_61_states(period):
    """A wave as long as the cutoff keeps half of its height."""
    m, pitch = 129, 0.125
    net = BSplineSurface(0.0, torch.zeros((m, m), dtype=torch.float64), (0.0, pitch * (m - 1)), (0.0, pitch * (m - 1)))
    kept, along = compensation.transmission(net, 2.0), compensation.frequencies(net)[:, 0]
    expected = np.exp(-np.pi * (np.sqrt(np.log(2) / np.pi) * 2.0 / period) ** 2)
    assert np.interp(1 / period, along, kept[:, 0]) == pytest.approx(expected, abs=2e-3)


def test_a_part_is_aligned_by_its_fine_relief(lens):
    """Low orders of 5 µm displace the alignment by least squares; the relief of the part is found at its place again.

    The error along the steep direction of fine waves would otherwise be a form error of tens of nm in these waves.
    """
    net = lens.back_net
    x, y = np.meshgrid(
        *(np.linspace(*ends, m) for ends, m in zip((net.x, net.y), net.shape, strict=True)), indexing="ij"
    )
    relief = 2e-3 * np.sin(4.2 * x + 0.4) * np.cos(5.0 * y)
    fine = lens.with_back(replace(net, heights=net.heights + torch.from_numpy(interpolating_net(relief))))
    shop = Shop(fine, low=5e-3, mid=0.0)
    cloud = shop.measure(shop.cut(fine.back_net, 0), 1)
    form = compensation.measured_form(cloud, fine, None)
    inside = (np.abs(x) < 3.6) & (np.abs(y) < 2.6)
    off = (form.at(x.ravel(), y.ravel()) - shop.error(x.ravel(), y.ravel(), 0)).reshape(x.shape)
    smooth = np.stack([x**i * y**j for i in range(7) for j in range(7 - i)], axis=-1)[inside]
    rest = off[inside] - smooth @ np.linalg.lstsq(smooth, off[inside], rcond=None)[0]
    assert np.sqrt(np.mean(rest**2)) < 5e-6


def test_the_light_chooses_a_low_pass_that_keeps_noise_out(lens):
    """Noise alone gets the longest cutoff, short waves without noise the shortest one."""
    design = lens.back_net

    def roughness(back):
        change = (back.heights - design.heights).numpy()
        return float(np.square(np.diff(change[4:-4, 4:-4], 2, axis=0)).mean())

    cutoffs = []
    for mid, noise in ((0.0, 5e-4), (1e-3, 1e-6)):
        shop = Shop(lens, low=0.0, mid=mid)
        cloud = shop.measure(shop.cut(design, 0), 1, points=8_000, noise=noise)
        form = compensation.measured_form(cloud, lens, None)
        cutoffs.append(compensation.best_cutoff([form], design, roughness))
    assert cutoffs[0] > cutoffs[1] <= 4 * max(design.pitch)


@suite.in_turn(1, 2)
def test_by_light_less_is_cut_and_the_picture_is_the_same(small_design, lens):
    """Low orders that hardly move the light stay; what is left makes the RRMSD at most a tenth larger."""
    made = commands.read(small_design.folder)
    goal, effort = made.goals[0], Effort(rays=512, accuracy=0.0, witness=False)

    def rrmsd(change):
        back = replace(lens.back_net, heights=lens.back_net.heights + change)
        return made.light(made.lens.with_back(back), goal, effort).rrmsd

    shop = Shop(lens, low=2e-3, mid=0.0)
    cloud = shop.measure(shop.cut(lens.back_net, 0), 1)
    nominal = rrmsd(0.0 * lens.back_net.heights)
    staying = partial(by_light.staying, made, rrmsd=nominal)
    found = compensation.next_round(lens, lens.back_net, [cloud], CompensationSettings(by="light"), [], staying=staying)
    assert 0 < found.volume < found.volume_by_form and found.may_stay.pv > 0
    assert rrmsd(found.found.heights) > 1.5 * nominal
    assert rrmsd(found.left.heights) < 1.1 * nominal
    with pytest.raises(ValueError, match="--by colour: is not one of form, light"):
        compensation.next_round(lens, lens.back_net, [cloud], CompensationSettings(by="colour"), [])


@suite.in_turn(0, 2)
def test_what_does_not_repeat_is_told_from_what_repeats(lens):
    """Three parts show how far their mean is uncertain; a perfect part is not corrected by the noise of its gauge."""
    [(found, _)] = rounds(Shop(lens, varying=3e-4), 1, parts=3)
    assert 3e-5 < found.standard_error < 3e-4 and found.parts == 3
    perfect = [Shop(lens).measure(lambda x, y: sag(lens.back_net, x, y), seed, noise=2e-4) for seed in (1, 2)]
    with pytest.raises(ValueError, match="nothing is cut: the repeatable deviation is .* µm RMS, and it is known to"):
        compensation.next_round(lens, lens.back_net, perfect, CompensationSettings(), [])


@suite.in_turn(1, 2)
def test_rounds_that_diverge_are_refused(lens):
    shop = Shop(lens)
    cloud = shop.measure(shop.cut(lens.back_net, 0), 1)
    for gain in (0.0, 1.8, 2.5):
        with pytest.raises(ValueError, match=r"--gain .* a gain above 2 enlarges the deviation"):
            compensation.next_round(lens, lens.back_net, [cloud], CompensationSettings(gain=gain), [])
    with pytest.raises(ValueError, match=r"--cutoff 0.001: is not between"):
        compensation.next_round(lens, lens.back_net, [cloud], CompensationSettings(cutoff=1e-3), [])
    with pytest.raises(ValueError, match="the rounds diverge: the deviation was .* check datum, sign and axes"):
        compensation.next_round(lens, lens.back_net, [cloud], CompensationSettings(), [Statistics(1e-4, 1e-5)])
    half = replace(cloud, points=cloud.points[cloud.points[:, 0] > 0])
    with pytest.raises(ValueError, match=r"part-1.csv: no correction is computed .* measured fraction of the face"):
        compensation.next_round(lens, lens.back_net, [half], CompensationSettings(), [])


@suite.in_turn(1, 3)
def test_a_folder_remembers_its_rounds(lens, small_design, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "design"
    shutil.copytree(small_design.folder, folder)
    shop, net, lights = Shop(lens), lens.back_net, []
    for number in (1, 2):
        cloud = shop.measure(shop.cut(net, 0), number)
        path = tmp_path / f"part-{number}.csv"
        np.savetxt(path, cloud.points, delimiter=",", header="x [mm],y [mm],z [mm]", comments="", fmt="%.9f")
        found = commands.compensate(folder, [path], effort=EFFORT)
        place = folder / "compensated" / f"round-{number}"
        assert found.folder == place and found.figures["round"] == number
        assert json.loads((place / "compensation.json").read_text()) == found.figures
        assert {"lens.step", "lens.stl", "correction.csv", "correction.png", "design.npz"} <= {
            each.name for each in place.iterdir()
        }
        again = bstcad.open(place).lens.back_net
        change = found.figures["correction"]["pv_mm"]
        assert float((again.heights - net.heights).abs().max()) > 0.3 * change
        net, lights = again, [*lights, found.figures["rrmsd"]]
    page = (folder / "production.html").read_text()
    assert "2 rounds of cutting" in page and "round-2: measured from part-2.csv" in page and page.count("<img") == 2
    first, second = lights  # waves near the cutoff stay in part; the second round corrects half of what it finds
    assert first["design"] < first["expected"] < first["measured"] / 2
    assert second["expected"] < second["measured"] < first["measured"] / 2
    monkeypatch.setattr(commands, "compensate", partial(commands.compensate, effort=EFFORT))
    run = tmp_path / "run"  # the job of the page
    run.mkdir()
    cloud = shop.measure(shop.cut(net, 0), 3)
    np.savetxt(run / "cloud.csv", cloud.points, delimiter=",", header="x [mm],y [mm],z [mm]", comments="", fmt="%.9f")
    ended = design_process.compensate({}, run, folder, False)
    assert (ended.state, ended.folder) == ("finished", "round-3") and (folder / "compensated" / "round-3").is_dir()
    with pytest.raises(SystemExit) as ended:
        cli.main(["compensate", str(folder), "--measured", str(path)])
    assert ended.value.code == 2 and "an earlier round has used this cloud" in capsys.readouterr().err


def put(folder, **changes):
    """Write a first round of the design in `folder`, with these entries changed."""
    place = folder / "compensated" / "round-1"
    place.mkdir(parents=True)
    size = {"pv_mm": 1e-3, "rms_mm": 1e-4}
    figures = {
        "round": 1, "parts": 1, "clouds": [{"file": "a.csv", "sha256": "ab", "points": 100}], "gain": 1.0,
        "filter": "Gaussian", "cutoff_mm": 1.0, "deviation": size, "correction": size, "expected_deviation": size,
        "by": "form", "volume_mm3": 1.0, "volume_by_form_mm3": 1.0, "may_stay": None, "standard_error_mm": 1e-5,
        "noise_mm": 1e-5, "rrmsd": {"design": 0.01, "measured": 0.02, "expected": 0.01},
    }  # fmt: skip
    (place / "compensation.json").write_text(json.dumps(figures | changes))
    shutil.copy(folder / "design.npz", place / "design.npz")
    return place


def size_of(text):
    return lambda place: rewrite(place, lambda whole: whole.replace("0.001", text, 1))


def rewrite(place, change):
    path = place / "compensation.json"
    path.write_text(change(path.read_text()))


def flipped(place):
    """Change a byte in the compressed control points."""
    content = bytearray((place / "design.npz").read_bytes())
    content[200] ^= 255
    (place / "design.npz").write_bytes(content)


def net_of_nan(place):
    np.savez_compressed(place / "design.npz", control_points=np.full((33, 33, 3), np.nan))


DAMAGED_ROUNDS = {
    "NaN": size_of("NaN"),
    "a text NaN": size_of('"NaN"'),
    "beyond floats": size_of("1e400"),
    "a long integer": size_of("9" * 400),
    "negative": size_of("-0.001"),
    "true": size_of("true"),
    "deep": lambda place: rewrite(place, lambda whole: "[" * 200_000),
    "a hash that is a list": lambda place: rewrite(place, lambda whole: whole.replace('"ab"', "[1]")),
    "no figures": lambda place: rewrite(place, lambda whole: '{"deviation": {"pv_mm": 1e-3, "rms_mm": 1e-4}}'),
    "not UTF-8": lambda place: (place / "compensation.json").write_bytes(b'{"round": "\xff"}'),
    "missing": lambda place: (place / "compensation.json").unlink(),
    "a cut net": lambda place: os.truncate(place / "design.npz", 3000),
    "an empty net": lambda place: os.truncate(place / "design.npz", 0),
    "a changed byte": flipped,
    "a net of NaN": net_of_nan,
}


@pytest.mark.parametrize("damage", DAMAGED_ROUNDS)
def test_a_damaged_round_is_refused_in_one_sentence(small_design, lens, tmp_path, damage):
    folder = tmp_path / "design"
    folder.mkdir()
    shutil.copy(small_design.folder / "design.npz", folder)
    place = put(folder)
    assert rounds_of_shop._last(folder, lens)[1:] == ([Statistics(1e-3, 1e-4)], {"ab"})
    DAMAGED_ROUNDS[damage](place)
    with pytest.raises(bstcad.SceneError, match=r"round-1/\S+: cannot be read .*; remove the folder of this round"):
        rounds_of_shop._last(folder, lens)
