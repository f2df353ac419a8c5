"""Time from the change of a slider to the new preview in the workbench, in Chromium: fifty changes for each light."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from skimage import data

from bstcad.scene.new_scene import LIGHTS, new_scene
from tests.app.conftest import PATIENCE, SEEN, begin, launched

pytestmark = pytest.mark.bench
CHANGES, SLIDERS = 50, ("target.z", "lens.outline.width", "source.wavelength")

# A question from outside every 10 ms would take time from each preview, so the page moves its sliders itself.
MOVE_SLIDERS = """async ([changes, keys]) => {
  const targets = document.getElementById("targets"), seconds = [];
  const waits = (waiting) => new Promise((done) => {
    const look = () => targets.classList.contains("waiting") === waiting && (observer.disconnect(), done());
    const observer = new MutationObserver(look);
    observer.observe(targets, { attributeFilter: ["class"] });
    look();
  });
  for (let k = 0; k < changes; k++) {
    const slider = document.querySelector(`input[type=range][data-key="${keys[k % keys.length]}"]`);
    const [least, most] = [Number(slider.min), Number(slider.max)];
    slider.value = least + (most - least) * (0.2 + 0.06 * ((k * 7) % 10));
    const began = performance.now();
    for (const kind of ["input", "change"]) slider.dispatchEvent(new Event(kind, { bubbles: true }));
    await waits(true);
    await waits(false);
    seconds.push((performance.now() - began) / 1000);
  }
  return seconds;
}"""


@pytest.fixture(scope="module")
def workbench(tmp_path_factory):
    """A workbench with a plate for each light, whose picture is a photo of twelve million pixels."""
    folder = tmp_path_factory.mktemp("previews")
    image = np.asarray(Image.fromarray(data.astronaut()).resize((4000, 3000), Image.Resampling.BICUBIC)).astype(int)
    grain = np.random.default_rng(0).integers(-8, 9, image.shape)
    Image.fromarray((image + grain).clip(0, 255).astype(np.uint8)).save(folder / "photo.jpg", quality=92)
    for light in LIGHTS:
        new_scene(light, folder, picture=folder / "photo.jpg", light=light, size="photo")
    served = begin(folder)
    yield served
    served.end()


@pytest.mark.parametrize("light", LIGHTS)
def test_fifty_changes_are_followed_by_their_previews(workbench, light):
    with launched() as browser:
        page = browser.new_page(viewport={"width": 1360, "height": 900})
        page.goto(workbench.address)
        page.goto(f"{workbench.root}/scene/{light}")
        page.wait_for_selector(SEEN, timeout=PATIENCE)
        seconds = page.evaluate(MOVE_SLIDERS, [CHANGES, list(SLIDERS)])
    median, most = np.percentile(seconds, (50, 95))
    print(f"\n{light}: from a slider to the preview {median:.2f} s in the median, 95 % within {most:.2f} s")
    assert len(seconds) == CHANGES
