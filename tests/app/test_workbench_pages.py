"""The workbench in a browser, as a person uses it: with a picture, a mouse, the keyboard, a telephone, two windows."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

from bstcad import cli, commands
from bstcad.app import scene_text
from bstcad.app.design_process import JOB, PROGRESS, State
from bstcad.app.design_runs import Run
from bstcad.designs import folder as folders
from bstcad.scene.scene import load
from tests import suite
from tests.app.conftest import PATIENCE, SEEN, SMALL, open_scene


def picture() -> bytes:
    """A PNG of 3 : 2 with light in it."""
    x, y = np.meshgrid(np.linspace(-1, 1, 96), np.linspace(-0.67, 0.67, 64))
    grey = (255 * np.exp(-3 * (x**2 + (y - 0.2) ** 2))).astype(np.uint8)
    written = io.BytesIO()
    Image.fromarray(grey).save(written, "png")
    return written.getvalue()


def type_into(page, key: str, words: str) -> None:
    """Type into a field of the form, and leave it."""
    page.fill(f"input[type=text][data-key='{key}']", words)
    page.keyboard.press("Tab")


def tab_to(page, condition: str) -> None:
    """Press Tab until a condition on the focused element holds."""
    for _ in range(80):
        page.keyboard.press("Tab")
        if page.evaluate(condition):
            return
    raise AssertionError(f"the keyboard does not lead to {condition}")


def text_has(page, words: str) -> None:
    """Wait until the text of the scene has some words."""
    page.wait_for_function("words => document.getElementById('text').value.includes(words)", arg=words)


def test_a_dropped_picture_is_a_scene_whose_crop_is_dragged_and_moved_by_keys(open_page, shared):
    page = open_page(shared.address)
    page.click("text=A plate for the sun")
    page.uncheck("#proportions")
    page.set_input_files("#picture", {"name": "../../etc/evil.png", "mimeType": "image/png", "buffer": picture()})
    page.wait_for_selector(SEEN, timeout=PATIENCE)
    assert page.url.endswith("/scene/my-sun")  # and no token in it
    [kept] = (shared.folder / "pictures").iterdir()
    assert kept.read_bytes() == picture() and "evil" not in kept.name
    assert load(shared.folder / "my-sun.toml").source.divergence == 0.53
    shown = base64.b64decode(page.get_attribute(SEEN, "src").partition(",")[2])
    assert np.asarray(Image.open(io.BytesIO(shown))).std() > 10  # there is a picture on it
    page.wait_for_selector("#remarks li:has-text('cropped to the central')", timeout=PATIENCE)
    frame = page.locator("#frame")
    frame.scroll_into_view_if_needed()
    box = frame.bounding_box()
    assert box["width"] == pytest.approx(page.locator("#photo").bounding_box()["height"], abs=1)  # as the target is
    page.mouse.move(box["x"] + 20, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] - 200, box["y"] + 20, steps=3)  # as far to the left as it goes
    page.mouse.up()
    text_has(page, "crop = [0.0, 0.0, 0.6667, 1.0]")
    frame.focus()
    page.keyboard.press("ArrowRight")
    text_has(page, "crop = [0.02, 0.0, 0.6867, 1.0]")
    assert page.evaluate("document.activeElement.id") == "frame"
    page.click("#whole")
    page.wait_for_function("() => !document.getElementById('text').value.includes('crop = [')")
    page.click("#in-proportions")
    text_has(page, "width = 80.0, height = 53.33")


@pytest.mark.thorough
def test_a_change_is_seen_in_every_window_and_kept_beside_the_file_until_it_is_saved(open_page, shared):
    page, other = open_page(shared.address), open_page(shared.address)
    path = open_scene(page, shared, "both")
    other.goto(f"{shared.root}/scene/both")
    before, seen = path.read_bytes(), page.get_attribute(SEEN, "src")
    type_into(page, "target.z", "60,5")  # a decimal comma
    page.wait_for_selector("#saved:has-text('unsaved')")
    page.wait_for_selector(f"{SEEN}:not([src='{seen}'])", timeout=PATIENCE)
    assert "z = 60.5" in page.input_value("#text") and path.read_bytes() == before
    other.wait_for_selector("#form input[type=text][data-key='target.z'][value='60.5']", timeout=PATIENCE)
    page.reload()
    assert "z = 60.5" in page.input_value("#text")
    page.click("text=scene.toml")
    page.fill("#text", page.input_value("#text").replace("pixels = 48", "pixels = 64"))
    page.locator("#text").blur()
    page.wait_for_selector("figcaption:has-text('64 × 64 pixels')", timeout=PATIENCE)
    page.click("#save")
    page.wait_for_selector("#saved:text-is('saved')")
    assert path.read_bytes() == before.replace(b"100.0", b"60.5").replace(b"48", b"64")  # comments and all


@pytest.mark.thorough
def test_the_picture_as_made_stands_beside_the_picture_as_designed(open_page, shared):
    page = open_page(shared.address)
    open_scene(page, shared, "printed")
    page.click("#as-made summary")
    page.select_option("#grade", "resin-printed")
    page.wait_for_selector("#made-targets img", timeout=PATIENCE)
    shown = [image.get_attribute("src") for image in page.locator("#made-targets img").all()]
    assert len(set(shown)) == 2 and "printed in resin" in page.inner_text("#made-says")
    page.select_option("#lit", "phone")
    page.wait_for_selector(":nth-match(#made-targets img, 4)", timeout=PATIENCE)
    assert "in the light of the flashlight of a phone" in page.inner_text("#made-says")
    page.select_option("#grade", "")
    page.select_option("#lit", "")
    page.wait_for_function("() => !document.querySelector('#made-targets img')", timeout=PATIENCE)


def test_a_wrong_entry_stays_in_its_field_and_no_lens_is_made_of_it(open_page, shared, capsys):
    """The message is the terminal's, it stands beside the entry, and no figure of the scene before stays."""
    page = open_page(shared.address)
    path = open_scene(page, shared, "wrong")
    type_into(page, "target.z", "2")
    page.wait_for_selector("[aria-invalid=true]")
    told = page.inner_text("#form .error")
    assert cli.run(["generate", str(path), "--set", "target.z=2.0"]) == 2
    assert told and told in capsys.readouterr().err and page.is_disabled("#make")
    control = page.locator("[aria-invalid=true]").first
    assert control.get_attribute("data-key") == "target.z"
    assert page.locator(f"#{control.get_attribute('aria-describedby').split()[-1]}").inner_text() == told
    assert page.locator("#targets img, #figures td, #predicted td").count() == 0 and told in page.inner_text("#status")
    type_into(page, "target.z", "100")
    page.wait_for_selector("#figures td", timeout=PATIENCE)
    assert page.is_enabled("#make")
    lock = page.locator(".lock[data-locks='target.x target.y']")
    assert "proportions" in lock.inner_text().lower() and lock.get_attribute("aria-pressed") == "false"
    page.focus("input[type=range][data-key='target.x']")
    page.keyboard.press("Tab")  # the lock stands between the two
    page.keyboard.press("Enter")
    assert lock.get_attribute("aria-pressed") == "true"
    type_into(page, "target.x", "wide")
    page.wait_for_selector("#form .error:has-text('wide')")
    type_into(page, "lens.back.z", "4,5")  # another field is right, and the first is wrong still
    text_has(page, "z = 100.5")
    assert "target.z = 100.5" in page.inner_text("#followed")
    field = page.locator("input[type=text][data-key='target.x']")
    assert field.input_value() == "wide" and field.get_attribute("aria-invalid") == "true"
    assert page.is_disabled("#make") and "y = [-8.0, 8.0]" in page.input_value("#text")
    type_into(page, "target.x", "-16; 16")
    text_has(page, "y = [-16.0, 16.0]")
    assert lock.get_attribute("aria-pressed") == "true" and page.is_enabled("#make")
    assert page.locator("#form .error").count() == 0 and page.is_hidden("#fault")
    refused = {"stage": "preview", "number": 1, "refused": "no memory"}
    page.route("**/preview", lambda route: route.fulfill(json=refused))
    type_into(page, "target.z", "102")
    page.wait_for_selector("#status:has-text('No preview: no memory')")
    assert page.locator("#targets img, #figures td, #remarks li, #predicted td, #left-out td").count() == 0
    assert page.inner_text("#comes-to") == ""


@pytest.mark.thorough
def test_a_damaged_scene_opens_with_its_fault(open_page, shared):
    page = open_page(shared.address)
    for text in ("name = ", SMALL.replace("kind", "knd", 1)):
        (shared.folder / "damaged.toml").write_text(text, encoding="utf-8")
        page.goto(f"{shared.root}/scene/damaged")
        page.wait_for_selector("#fault:visible")
        assert page.input_value("#text") == text and page.is_disabled("#make")


@pytest.mark.thorough
def test_the_keyboard_alone_leads_from_the_start_to_a_changed_preview(open_page, shared):
    page = open_page(shared.address)
    tab_to(page, "document.activeElement.dataset.letters !== undefined")
    page.keyboard.press("Enter")
    page.wait_for_selector(SEEN, timeout=PATIENCE)
    seen = page.get_attribute(SEEN, "src")
    tab_to(page, "document.activeElement.type === 'range' && document.activeElement.dataset.key === 'target.z'")
    page.keyboard.press("ArrowRight")
    page.wait_for_selector(f"{SEEN}:not([src='{seen}'])", timeout=PATIENCE)
    assert page.evaluate("document.activeElement.dataset.key") == "target.z"  # the focus stays


@pytest.mark.thorough
def test_enter_in_the_letters_makes_their_scene(open_page, shared):
    page = open_page(shared.address)
    page.press("#side", "Enter")
    assert "drop a picture" in page.inner_text("#message")
    page.fill("#side", "4 cm")
    page.press("#letters", "Enter")
    page.wait_for_url("**/scene/*")
    text_has(page, "width = 40.0, height = 40.0")


@pytest.mark.thorough
def test_time_left_falls_between_two_lines_and_no_pause_counts(open_page, shared, small_design):
    """A stage of ten steps had its fourth one 6 s ago, and had paused for 1000 s before; so 9 s - 6 s are left."""
    folder = shutil.copytree(small_design.folder, shared.folder / "timed")
    run = Run(folder)
    run.folder.mkdir()
    lines = [[0, "stage 2", 0], [4, "stage 2", 2], [1004, "", 0], [1006, "stage 2", 4]]  # s, stage, steps done of ten
    now = time.time()
    written = "".join(json.dumps([now - 1012 + at, stage, done, 10, ""]) + "\n" for at, stage, done in lines)
    (run.folder / PROGRESS).write_text(written, encoding="utf-8")
    (run.folder / JOB).write_text("{}", encoding="utf-8")
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)", str(run.folder)])
    try:
        State("running", process.pid, now - 1012).put(run.folder)
        page = open_page(shared.address)
        page.goto(f"{shared.root}/design/timed")
        page.wait_for_selector("#state-says:has-text('left of this stage')")
        said = page.inner_text("#state-says")
        assert 1 <= float(re.search(r"(\d+) s left", said)[1]) <= 4, said
        assert page.inner_text("#stages tr td.n") == "6.0 s"
    finally:
        process.kill()
        process.wait()
    shutil.rmtree(run.folder)


@pytest.mark.thorough
def test_a_design_goes_on_without_its_page(open_page, shared, tmp_path):
    page = open_page(shared.address)
    open_scene(page, shared, "made")
    page.click("#make")
    page.wait_for_url("**/design/made")
    page.reload()  # in mid-run
    page.close()
    again = open_page(shared.address)
    again.goto(f"{shared.root}/design/made")
    again.wait_for_selector("#step", timeout=PATIENCE)
    with again.expect_download() as download:
        again.click("#step")
    step = tmp_path / "lens.step"
    download.value.save_as(step)
    assert commands.verify(step).passed
    with again.expect_download() as download:
        again.click("text=All files (ZIP)")
    assert download.value.suggested_filename == "made.zip"
    with again.expect_popup() as report:
        again.click("text=Report")
    report.value.wait_for_load_state()
    assert "made" in report.value.title() or "made" in report.value.inner_text("body")


LOOKS = {
    "light": {"color_scheme": "light"},
    "dark, telephone": {"color_scheme": "dark", "viewport": {"width": 340, "height": 700}},
}  # fmt: skip


@pytest.mark.parametrize(("look", "pages"), suite.in_turns([(look, pages) for look in LOOKS for pages in (0, 1)], 4))
def test_two_designs_are_compared_and_nobody_is_shut_out(open_page, shared, small_design, look, pages):
    """axe-core finds no serious fault on any page, in light and dark, and on a telephone; two of the four at a time."""
    from axe_playwright_python.sync_playwright import Axe

    options, left, right = LOOKS[look], f"left-{look[:4]}-{pages}", f"right-{look[:4]}-{pages}"
    for name, z in ((left, 100.0), (right, 90.0)):
        path = shutil.copytree(small_design.folder, shared.folder / name) / folders.SCENE
        text = scene_text.changed(path.read_text(encoding="utf-8"), "name", name)
        path.write_text(scene_text.changed(text, "target.z", z), encoding="utf-8")
    page = open_page(shared.address)
    for name in (left, right):
        page.check(f"input[name=design][value={name}]")
    page.click("text=Compare the chosen designs")
    page.wait_for_selector("#curve path.line-1", state="attached")
    assert {row.locator("th").inner_text() for row in page.locator("tbody tr").all()} == {"name", "target.z"}
    addresses = ("/", "/scene/small", f"/design/{left}", f"/compare?design={left}&design={right}")
    found = []
    page = open_page(shared.address, bypass_csp=True, **options)
    for address in addresses[pages::2]:
        page.goto(shared.root + address)
        if "scene" in address:
            page.wait_for_selector(SEEN, timeout=PATIENCE)
            page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
        faults = Axe().run(page).response["violations"]
        found += [
            (address, options["color_scheme"], fault["id"], node["target"], node["failureSummary"][:150])
            for fault in faults if fault["impact"] in ("serious", "critical") for node in fault["nodes"][:3]
        ]  # fmt: skip
        wide = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        if wide > 0:
            found.append((address, options["color_scheme"], f"{wide} pixels wider than the window"))
    assert found == []
