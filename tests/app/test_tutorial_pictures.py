"""The tutorial of the workbench: its pictures, and the steps that it describes, done in a browser (make bench)."""

import base64
import io
import re
from pathlib import Path

import numpy as np
import pytest
import skimage.data
from PIL import Image

import bstcad
from bstcad.manufacture.tolerance.grades import GRADES
from bstcad.optics.surfaces.surfaces import sag
from bstcad.planning.reduction import QUICK, REFINED
from tests.app.conftest import begin

TUTORIALS = Path(__file__).parents[2] / "docs" / "tutorials"
PAGE = TUTORIALS / "workbench.md"
APP = Path(bstcad.__file__).parent / "app"
PICTURES = ("workbench-start.png", "workbench-scene.png", "workbench-run.png", "workbench-design.png")
LARGEST = 300_000  # bytes of a picture
WIDE, HIGH = 1200, 860  # pixels of the window
PATIENCE = 1_200_000  # milliseconds, on a busy machine
ALL_SEEN = "#status:has-text('Refined')"
DROP = """([place, data]) => {
  const bytes = Uint8Array.from(atob(data), (sign) => sign.charCodeAt(0)), files = new DataTransfer();
  files.items.add(new File([bytes], "photo.jpg", { type: "image/jpeg" }));
  document.querySelector(place).dispatchEvent(new DragEvent("drop", { dataTransfer: files, bubbles: true }));
}"""


def shown():
    """The pictures that the tutorial shows."""
    return re.findall(r"!\[[^\]]+\]\(([\w.-]+)\)", PAGE.read_text(encoding="utf-8"))


def test_the_pictures_of_the_tutorial_are_there_and_small():
    assert shown() == list(PICTURES)
    for name in PICTURES:
        assert (TUTORIALS / name).stat().st_size < LARGEST
        assert Image.open(TUTORIALS / name).width == WIDE


def test_the_tutorial_names_what_stands_on_the_pages():
    """Names of buttons, fields and headings are slanted in it; and the figures of its previews are theirs."""
    text = PAGE.read_text(encoding="utf-8")
    files = (path for path in APP.rglob("*") if path.suffix in (".j2", ".js", ".py"))
    words = " ".join((*(path.read_text(encoding="utf-8") for path in files), *GRADES))  # a page lists the grades
    named = {" ".join(found.split()) for found in re.findall(r"(?<![*\w])\*([^*]+)\*(?!\*)", text)}
    assert len(named) > 20 and [name for name in sorted(named) if name not in words] == []
    for words, size in (("preview", QUICK), ("refined preview", REFINED)):
        assert f"| {words} | {size.pixels} at most | {size.net} at most | {size.evaluations} |" in text


# ---- the steps of the tutorial ---------------------------------------------------------------------------------------


def photo():
    """The photograph of the other tutorials, as a JPEG file."""
    written = io.BytesIO()
    Image.fromarray(skimage.data.astronaut()[:512, 32:480]).save(written, "jpeg")
    return written.getvalue()


def keep(page, name, high=HIGH, whole=False):
    """A picture of the page in 256 colours; high: of the window; whole: of all that can be scrolled to."""
    page.set_viewport_size({"width": WIDE, "height": high})
    page.evaluate("window.scrollTo(0, 0)")
    page.wait_for_timeout(500)  # the lens is drawn anew
    data = page.screenshot(full_page=whole)
    page.set_viewport_size({"width": WIDE, "height": HIGH})
    picture = Image.open(io.BytesIO(data)).convert("RGB")
    picture.quantize(256, dither=Image.Dither.NONE).save(TUTORIALS / name, optimize=True)


def drop_the_picture(page):
    """1 and 2: the start, and the picture."""
    keep(page, "workbench-start.png")
    assert page.is_checked("input[value=laser]")
    page.evaluate(DROP, ["#drop", base64.b64encode(photo()).decode()])
    page.wait_for_url("**/scene/my-laser")
    page.wait_for_selector(ALL_SEEN, timeout=PATIENCE)


def value_of(page, key, typed):
    """Type a value into a field of the form, and leave the field."""
    field = page.locator(f"#form input[type=text][data-key='{key}']")
    field.fill(typed)
    field.press("Tab")


def text_has(page, words):
    """Wait until the text of the scene has some words."""
    page.wait_for_function("words => document.getElementById('text').value.includes(words)", arg=words)


def change_the_scene(page):
    """4: the wall nearer and back; then a draft of few points and pixels."""
    relief = page.locator("#figures tr:has-text('Sag of the back') td")
    before = relief.inner_text()
    value_of(page, "target.z", "308")
    page.wait_for_selector("#saved:has-text('unsaved')")
    page.wait_for_function("before => !document.getElementById('figures').innerText.includes(before)", arg=before)
    assert float(relief.inner_text().split()[0]) > float(before.split()[0])
    page.click("#drop-changes")
    text_has(page, "z = 408")
    page.focus("#quality")
    page.keyboard.press("ArrowLeft")
    text_has(page, 'quality = "draft"')
    page.click("#form details[data-section=target] > summary")
    value_of(page, "target.pixels", "128")
    text_has(page, "pixels = 128")
    page.click("#toml > summary")
    page.fill("#text", page.input_value("#text").replace("z = 8.0 }", "z = 8.0, control_points = 129 }"))
    page.locator("#text").blur()
    page.wait_for_selector("#predicted tr[data-quality=draft]:not([title*='rough'])", timeout=PATIENCE)
    page.click("#toml > summary")
    page.click("#form details[data-section=target] > summary")
    below = page.evaluate("document.getElementById('predicted').getBoundingClientRect().bottom + window.scrollY")
    keep(page, "workbench-scene.png", high=round(below) + 10)  # up to the end of the preview


def make_it(page):
    """5 and 6: the run, stopped and gone on with; and the finished design."""
    page.click("#make")
    page.wait_for_url("**/design/my-laser")
    page.wait_for_selector("#light:visible", timeout=PATIENCE)
    page.wait_for_selector("#curve path", state="attached", timeout=PATIENCE)
    keep(page, "workbench-run.png", high=720)
    page.click("#pause")
    page.click("#go-on", timeout=PATIENCE)
    page.wait_for_selector("#step", timeout=PATIENCE)
    keep(page, "workbench-design.png", whole=True)


def study(page, folder):
    """7: tolerances, the trade-off, and a made part."""
    back = bstcad.open(folder / "my-laser").lens.back
    x, y = np.meshgrid(np.linspace(-34.5, 34.5, 200), np.linspace(-39.5, 39.5, 200))
    np.savetxt(folder / "cloud.csv", np.stack([x, y, sag(back, x, y)], axis=-1).reshape(-1, 3), delimiter=",")
    page.select_option("form[data-job=tolerance] select", "moulded")
    page.click("text=Study tolerances")
    page.wait_for_selector("form[data-job=tolerance] a:has-text('tolerance.json')", timeout=PATIENCE)
    page.set_input_files("form[data-job=measured] input", folder / "cloud.csv")
    page.click("text=Judge the part")
    page.wait_for_selector("form[data-job=measured] a:has-text('report')", timeout=PATIENCE)
    page.fill("form[data-job=tradeoff] input", "1")  # the first run alone
    page.click("text=Run the trade-off")
    page.wait_for_selector("form[data-job=tradeoff] a:has-text('tradeoff.csv')", timeout=PATIENCE)


def compare(page):
    """8: the same scene with a nearer wall, beside the first."""
    page.click("#edit")
    page.fill("#title", "A nearer wall")
    page.click("text=Make the copy")
    page.wait_for_url("**/scene/my-laser-2")
    page.wait_for_selector(ALL_SEEN, timeout=PATIENCE)
    value_of(page, "target.z", "308")
    text_has(page, "z = 308")
    page.click("#make")
    page.wait_for_url("**/design/my-laser-2")
    page.wait_for_selector("#step", timeout=PATIENCE)
    page.click("nav >> text=Scenes and designs")
    for name in ("my-laser", "my-laser-2"):
        page.check(f"input[name=design][value={name}]")
    page.click("text=Compare the chosen designs")
    keys = {row.inner_text() for row in page.locator("tbody th").all()}
    assert {"name", "title", "target.z"} <= keys


@pytest.mark.bench
def test_the_steps_of_the_tutorial_lead_to_its_pictures(open_page, tmp_path):
    folder = tmp_path / "outputs"
    folder.mkdir()
    served = begin(folder, quick=False)
    try:
        page = open_page(served.address, viewport={"width": WIDE, "height": HIGH})
        drop_the_picture(page)
        change_the_scene(page)
        make_it(page)
        study(page, folder)
        compare(page)
    finally:
        served.end()
    again = begin(folder, quick=False)  # 9: closed, and come back to
    try:
        page = open_page(again.address)
        assert page.locator(".designs li").count() == 2
        assert page.locator("a:has-text('my-laser.toml')").count() == 1
    finally:
        again.end()
