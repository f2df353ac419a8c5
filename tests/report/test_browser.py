"""The report in a real browser, Chromium without a window: quiet, alone, legible, and with a lens that turns.

The script that turns it also serves a page that draws a lens again and again, with its rays and the wall they light.
"""

import base64
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from bstcad import commands
from bstcad.designs import folder as folders
from bstcad.figures import rendering
from bstcad.report import prescription, record, report
from bstcad.verify.judges.comparison import Judge
from tests.app.conftest import launched

# Text of the lens's picture for those who cannot see it.
LENS = "The lens in three dimensions, seen from the side of its back surface."
LEGIBLE = 4.5  # contrast of small text, WCAG 2.2, 1.4.3
LARGEST = 6_000_000  # bytes of a report
MOVED = {"dx": 1e-5, "dy": -2e-5, "dz": 3e-3, "rotation_x": 1e-4, "rotation_y": -1e-4, "rotation_z": 9e-5}
PART = {  # entry of a made part in report.json
    "cloud": "cloud.csv", "points": 40000, "left_out": {"off the face": 12}, "deviation_map": ["deviation.npz"],
    "outliers": {"points": 40, "share": 1e-3, "above": 39, "farthest": 0.1}, "scale": 1.0,
    "alignment": MOVED | {"undetermined": []}, "minimum_zone": MOVED | {"width": 7e-4},
    "worst_at": [-7.58297, -2.32557], "pv": 7e-4, "pvr": 1e-3, "rms": 1e-4,
    "form_pv": 4e-4, "form_rms": 1e-4, "slope_rms": 1.6e-4, "noise": 5e-5,
    "goals": [{"key": "target", "rrmsd_predicted": 0.02, "rrmsd_high": 0.03}],
    "bands": [{"period": period, "rms": 1e-6, "slope_rms": 1e-6} for period in (None, [44.8, 22.4], [0.7, 0.35])],
}  # fmt: skip
JUDGE = Judge(
    "batoid", "0.9.0", by="", rays=16773632, pixels=(128, 128), losses="none", rrmsd=0.0201, rrmsd_ours=0.0194,
    difference=0.00496, noise=0.00494, over_noise=1.003, limit=1.544, agrees=True, on_target=0.21, on_target_ours=0.21,
    heights_off=2.2e-7, slopes_off=5.5e-6, moved_by=4.1e-4, seconds=25.1,
)  # fmt: skip

HIDDEN = """(selector) => [...document.querySelectorAll(selector)].filter((e) => !e.checkVisibility()).length"""
CONTRASTS = """() => {
  const numbers = (text) => [...text.matchAll(/rgba?\\(([^)]*)\\)/g)].map((found) => found[1].split(",").map(Number));
  const opaque = (colour) => colour.length < 4 || colour[3] > 0;
  const linear = (value) => value / 255 <= 0.04045 ? value / 255 / 12.92 : ((value / 255 + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const grounds = (element) => {
    const style = getComputedStyle(element);
    const found = numbers(style.backgroundImage + style.backgroundColor).filter(opaque);
    return found.length || !element.parentElement ? found : grounds(element.parentElement);
  };
  const said = (element) => [...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
  return [...document.querySelectorAll("body *")].filter((e) => said(e) && e.checkVisibility()).map((element) => {
    const ink = light(numbers(getComputedStyle(element).color)[0]);
    const ratios = grounds(element).map(light).map((g) => (Math.max(ink, g) + 0.05) / (Math.min(ink, g) + 0.05));
    return [Math.min(...ratios), element.textContent.trim().slice(0, 40)];
  });
}"""


@pytest.fixture(scope="module")
def browser():
    """Chromium as the system has it."""
    with launched() as chromium:
        yield chromium


@pytest.fixture(scope="module")
def path(small_design, tmp_path_factory):
    """The report of the small design, with a picture of its lens, a made part and another program's judgement."""
    folder, path = small_design.folder, tmp_path_factory.mktemp("page") / "report.html"
    nominal = folders.read_nominal(folder)
    scene = nominal.scene
    drawn = io.BytesIO()
    Image.new("RGBA", (40, 30), "#d3d9e0").save(drawn, "PNG")
    pictures = {picture.stem: picture.read_bytes() for picture in (folder / "figures").iterdir()}
    contents = replace(record.read(folder / "report.json"), measured=PART, judges=(JUDGE,))
    sections = prescription.sections(prescription.prescription(scene, nominal.lens, contents.shape))
    solid = rendering.turnable(nominal.lens)
    shown = pictures | {"lens": drawn.getvalue()}
    path.write_bytes(report.html(contents, shown, scene="name = 'x'", prescription=sections, solid=solid))
    return path


@pytest.fixture
def opened(browser, path):
    """Opens the report as somebody has it: opened(color_scheme="dark") …; what the page says and asks for is kept."""
    contexts = []

    def open_page(script="", path=path, **somebody):
        contexts.append(browser.new_context(**somebody))
        page = contexts[-1].new_page()
        page.said, page.asked = [], []
        page.on("console", lambda message: page.said.append(message.text))
        page.on("pageerror", lambda error: page.said.append(str(error)))
        page.on("request", lambda request: page.asked.append(request.url))
        if script:
            page.add_init_script(script)
        page.goto(path.as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()


def seen(page):
    """Pixels (rows, columns, 4) of the 3-D view, once what was asked of it is drawn."""
    drawn = page.evaluate("""() => new Promise((done) => requestAnimationFrame(() =>
      requestAnimationFrame(() => done(document.querySelector("canvas").toDataURL()))))""")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(drawn.partition(",")[2])))).astype(int)


def changed(one, other):
    """The part of the pixels that differ by more than rounding."""
    return float((np.abs(one - other).max(axis=2) > 3).mean())


def test_nothing_leaves_the_file_and_every_picture_is_there(opened, path):
    page = opened()
    assert page.said == []
    assert [url for url in page.asked if not url.startswith("data:image/png;")] == [path.as_uri()]
    widths = page.evaluate("[...document.images].map((picture) => picture.complete && picture.naturalWidth)")
    assert len(widths) >= 7 and min(widths) > 0
    assert path.stat().st_size < LARGEST


def test_the_lens_turns_by_keys_buttons_and_mouse_and_comes_back(opened):
    page = opened(viewport={"width": 360, "height": 480})
    canvas, start = page.locator("canvas"), seen(page)
    assert 0.15 < (start[..., 3] > 0).mean() < 0.9  # the lens before its ground
    on_screen = np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB")).astype(int)
    middle = tuple(side // 2 for side in start.shape[:2])
    assert np.abs(on_screen[middle] - start[middle][:3]).max() <= 6  # and no other layer before it
    assert np.ptp(start[start[..., 3] == 255, :3].mean(axis=1)) > 60  # its faces differ in brightness
    canvas.focus()
    before = start
    for key in ("ArrowRight", "ArrowUp", "+", "Shift+ArrowUp"):
        page.keyboard.press(key)
        now = seen(page)
        assert changed(before, now) > 0.02, key
        before = now
    page.keyboard.press("Home")
    assert changed(start, seen(page)) == 0
    page.get_by_role("button", name="Turn left").click()
    assert changed(start, seen(page)) > 0.05
    page.get_by_role("button", name="Reset the view").click()
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2, steps=2)
    turned = seen(page)
    assert changed(start, turned) > 0.1
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)  # a drag and its way back
    page.mouse.up()
    assert changed(start, seen(page)) < 0.01
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2)  # let go of: nothing follows
    assert changed(start, seen(page)) < 0.01 and page.said == []


@pytest.mark.thorough
def test_two_fingers_zoom_and_a_page_still_scrolls_under_one(opened):
    page = opened(has_touch=True, viewport={"width": 390, "height": 844})
    page.locator("canvas").scroll_into_view_if_needed()
    assert page.evaluate("getComputedStyle(document.querySelector('canvas')).touchAction") == "pan-y"
    start = seen(page)
    box = page.locator("canvas").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    session = page.context.new_cdp_session(page)
    for kind, apart in (("touchStart", 30), ("touchMove", 45), ("touchMove", 70)):
        fingers = [{"x": middle[0] + side * apart, "y": middle[1], "id": side + 1} for side in (-1, 1)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    assert changed(start, seen(page)) > 0.1


@pytest.mark.parametrize(
    ("script", "javascript"),
    [("HTMLCanvasElement.prototype.getContext = () => null", True), ("", False)],
    ids=["no WebGL", "no script"],
)
def test_without_webgl_or_scripts_the_picture_stays(opened, script, javascript):
    page = opened(script, java_script_enabled=javascript)
    picture = page.get_by_alt_text(LENS)
    assert picture.is_visible() and not page.locator("canvas").is_visible() and page.said == []
    assert not page.get_by_role("button", name="Turn left").is_visible()
    assert page.locator("noscript p").is_visible() is not javascript


def test_on_paper_there_is_the_picture(opened):
    page = opened()
    page.emulate_media(media="print")
    assert page.get_by_alt_text(LENS).is_visible()
    assert not page.locator("canvas").is_visible() and not page.locator(".turns").is_visible()
    assert page.evaluate(HIDDEN, "details th[scope=row], details pre") == 0  # paper has no folds
    sheets = page.pdf(format="A4")
    assert sheets.startswith(b"%PDF") and 2 <= len(re.findall(rb"/Type\s*/Page\b", sheets)) <= 13


def test_every_text_is_legible(opened):
    page = opened()
    page.evaluate("for (const details of document.querySelectorAll('details')) details.open = true")
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, re.findall(r"\d+", ground))) < 200) is (scheme == "dark")
        found = page.evaluate(CONTRASTS)
        assert len(found) > 100
        assert [(ratio, text) for ratio, text in found if ratio < LEGIBLE] == []


def test_a_phone_scrolls_up_and_down_only_and_nothing_is_cut(opened):
    """But for what lies in a box that scrolls sideways by itself: a wide table, the scene's text."""
    page = opened(viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True, device_scale_factor=2)
    page.evaluate("for (const details of document.querySelectorAll('details')) details.open = true")
    assert page.evaluate("[document.scrollingElement.scrollWidth, innerWidth]") == [390, 390]
    beyond = page.evaluate(
        """[...document.querySelectorAll("main *")].filter((e) => e.checkVisibility() && !e.closest(".scroll > *, pre"))
           .filter((e) => e.getBoundingClientRect().right > 390.5 || e.scrollWidth > e.clientWidth + 1
                          && getComputedStyle(e).display !== "inline" && !e.matches(".scroll"))
           .map((e) => [e.outerHTML.slice(0, 80), e.getBoundingClientRect().right])"""
    )
    assert beyond == []
    boxes = page.evaluate("[...document.querySelectorAll('.scroll')].map((e) => getComputedStyle(e).overflowX)")
    assert set(boxes) == {"auto"} and page.evaluate("document.querySelectorAll('table').length") > 15


def test_the_page_opens_with_the_verdict_pictures_and_first_figures(opened):
    page = opened(viewport={"width": 1280, "height": 900})
    order = ".verdict", "header li", "main > figure img", ".turnable", ".tiles", "table"
    tops = [page.locator(f"{selector} >> visible=true").first.bounding_box()["y"] for selector in order]
    assert tops[0] < 200 and tops == sorted(tops) and tops[2] < 900
    assert page.locator("h2", has_text="Failed checks").count() == 0
    assert page.locator("details.fold").count() > 3
    assert page.evaluate(HIDDEN, "details table") == page.locator("details table").count() > 5
    page.get_by_role("heading", name="Checks", exact=True).click()
    assert page.locator("details[open] td.pass").first.is_visible()


# --- a page that draws a lens again and again -------------------------------------------------------------------------

BENCH = """<!DOCTYPE html><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; script-src 'unsafe-inline';
  style-src 'unsafe-inline'">
<style>canvas {{ display: none; }} .drawn canvas {{ display: block; width: 400px; height: 300px; }}
  .drawn p {{ display: none; }}</style>
<figure><p>No picture.</p><canvas tabindex="0"></canvas></figure>
<script>{viewer}</script>
<script>const given = {given}, shown = solidView.begin(document.querySelector("figure"), given[0]);</script>"""
COUNTED = """
const made = window.made = {};
for (const kind of ["Buffer", "Texture", "VertexArray", "Program", "Shader"]) {
  for (const [act, step] of [["create", 1], ["delete", -1]]) {
    const plain = WebGL2RenderingContext.prototype[act + kind];
    WebGL2RenderingContext.prototype[act + kind] = function (...given) {
      made[kind] = (made[kind] ?? 0) + step;
      return plain.apply(this, given);
    };
  }
}"""
PATIENCE = 5000  # ms until a picture is decoded and drawn, at most


@pytest.fixture(scope="module")
def at_work(small_design):
    """The lens of the small design and its light, on a wider wall, white where x and y are large, and seen along +z."""
    nominal = folders.read_nominal(small_design.folder)
    path = commands.light_path_in(small_design.folder)
    picture = np.zeros((64, 64), np.uint8)
    picture[:32, 32:] = 255
    [screen] = path.screens
    wall = screen.mean(axis=0) + 4 * (screen - screen.mean(axis=0))
    return nominal.lens, replace(path, screens=(wall,), pictures=(picture,), seen_along=1)


@pytest.fixture(scope="module")
def bench(at_work, tmp_path_factory):
    """The path of such a page: given[0] with the light, [1] without, [2] a mirror's and with a wall more."""
    lens, path = at_work
    walls = (*path.screens, path.screens[0] + [0, 0, 20])
    two = replace(path, mirror=True, screens=walls, pictures=path.pictures * 2)
    given = [rendering.turnable(lens, light, 32) for light in (path, None, two)]
    viewer = report.VIEWER.read_text(encoding="utf-8")
    file = tmp_path_factory.mktemp("bench") / "bench.html"
    file.write_text(BENCH.format(viewer=viewer, given=f"[{','.join(given)}]"), encoding="utf-8")
    return file


def settled(page):
    """Return the picture of a page whose pictures on the walls are decoded: two shots of it are alike."""
    now = seen(page)
    for _ in range(PATIENCE // 50):
        page.wait_for_timeout(50)
        before, now = now, seen(page)
        if before.shape == now.shape and changed(before, now) == 0:
            return now
    raise AssertionError("it changes all the time")


def kinds(pixels):
    """Return the pixels in which rays, glass, and the white and the black of a wall are seen."""
    red, green, blue, opacity = np.moveaxis(pixels, 2, 0)
    grey, opaque = np.ptp(pixels[..., :3], axis=2) < 12, opacity == 255
    return {
        "rays": (red - blue > 60) & (opacity > 60),
        "glass": (blue - red > 15) & (opacity > 60) & ~opaque,
        "white": grey & opaque & (red > 240), "black": grey & opaque & (red < 15), "ground": opacity == 0,
    }  # fmt: skip


def test_a_lens_at_work_is_seen_from_near_by_and_with_the_wall(opened, bench, at_work):
    page = opened(path=bench)
    near = {kind: where.mean() for kind, where in kinds(settled(page)).items()}
    assert near["rays"] > 0.01 and near["glass"] > 0.02 and near["ground"] > 0.3 and near["white"] == 0
    page.evaluate("shown.look('way')")
    way = kinds(settled(page))
    share = {kind: where.mean() for kind, where in way.items()}
    assert share["rays"] > 0.005 and share["white"] > 0.002 and share["black"] > 0.01 and share["glass"] > 1e-4
    place = {kind: np.argwhere(way[kind]).mean(axis=0) for kind in ("white", "black")}
    assert place["white"][0] < place["black"][0] - 3  # row 0 is the upper one
    assert json.loads(rendering.turnable(*at_work))["aside"][2] < 0  # seen along +z, so that x max is at the left
    assert place["white"][1] < place["black"][1] - 3
    assert page.said == []


@pytest.mark.thorough
def test_a_lens_drawn_anew_keeps_the_view_and_what_was_made_for_it(opened, bench):
    page = opened(COUNTED, path=bench)
    page.evaluate("shown.look('way')")
    start = settled(page)
    page.locator("canvas").focus()
    for key in ("ArrowRight", "ArrowUp", "+"):
        page.keyboard.press(key)
    turned = settled(page)
    made = page.evaluate("shown.update(given[0]), ({...made})")
    assert changed(turned, settled(page)) == 0 and changed(start, turned) > 0.02
    for _ in range(3):
        page.evaluate("shown.update(given[2])")
        two = settled(page)
        page.evaluate("shown.update(given[1])")
        clay = settled(page)
        page.evaluate("shown.update(given[0])")
        assert changed(turned, settled(page)) == 0 and changed(turned, two) > 0.01
    assert (clay[..., 3] == 255).any() and set(np.unique(clay[..., 3])) >= {0, 255}
    assert not kinds(clay)["rays"].any() and not kinds(clay)["white"].any()
    assert page.evaluate("made") == made  # of buffers, textures and programs as many as at first
    page.keyboard.press("Home")
    assert changed(start, settled(page)) == 0 and page.said == []


@pytest.mark.thorough
def test_a_lens_comes_back_as_it_is_by_then_when_the_context_was_lost(opened, bench):
    page = opened(path=bench)
    page.evaluate("shown.look('way')")
    page.locator("canvas").focus()
    page.keyboard.press("ArrowRight")
    page.evaluate("shown.update(given[2])")
    wanted = settled(page)
    page.evaluate("shown.update(given[0])")
    page.evaluate("""window.context = document.querySelector("canvas").getContext("webgl2")
      .getExtension("WEBGL_lose_context"), context.loseContext()""")
    page.locator("p").wait_for(state="visible")
    page.evaluate("shown.update(given[1]), shown.look('lens'), shown.update(given[2]), shown.look('way')")
    page.evaluate("context.restoreContext()")
    page.locator("canvas").wait_for(state="visible")
    assert changed(wanted, settled(page)) == 0 and [text for text in page.said if "CONTEXT_LOST" not in text] == []
