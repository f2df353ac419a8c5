// A frame over the photo of the first target: the crop, with the proportions of the target.
import { element } from "./common.js";

const MIN_WIDTH = 0.05, STEP = 0.02; // smallest width of the frame, and the step of a key, as fractions of the photo
const [figure, photo, frame] = ["crop", "photo", "frame"].map(element);
let part = [0, 0, 1, 1], ratio = 1, drag = null, take = () => {}; // part: left, top, right, bottom, as fractions of the photo; ratio: width / height of the frame in these fractions

const clamp = (value, low, high) => Math.min(Math.max(value, low), Math.max(high, low));
const rounded = (value) => Math.round(value * 1e4) / 1e4;

function draw() {
  const [left, top, right, bottom] = part;
  Object.assign(frame.style, { left: `${100 * left}%`, top: `${100 * top}%`, width: `${100 * (right - left)}%`, height: `${100 * (bottom - top)}%` });
}

// Set the frame to a given width, with its middle as near to (x, y) as the photo allows.
function put(x, y, width) {
  const wide = clamp(width, MIN_WIDTH, Math.min(1, ratio)), high = wide / ratio;
  const left = clamp(x - wide / 2, 0, 1 - wide), top = clamp(y - high / 2, 0, 1 - high);
  part = [left, top, left + wide, top + high];
  draw();
}

const middle = () => [(part[0] + part[2]) / 2, (part[1] + part[3]) / 2];

// sides: width and height of the target, in the orientation of the photo; given: crop of the target, or null; fills: true if the crop gets the target's proportions; changed(crop): called after a drag or a key press.
export function show(address, { sides, given, fills }, changed) {
  take = changed;
  const begin = () => {
    figure.hidden = false;
    ratio = (sides[0] / sides[1]) / (photo.naturalWidth / photo.naturalHeight);
    part = given ?? [0, 0, 1, 1];
    if (fills) {
      const wide = Math.min(part[2] - part[0], (part[3] - part[1]) * ratio);
      put(...middle(), wide); // the crop by fit = "crop"
    } else draw();
  };
  photo.onload = begin;
  photo.onerror = () => { figure.hidden = true; };
  if (photo.getAttribute("src") !== address) photo.src = address;
  else if (photo.naturalWidth && drag === null) begin();
}

export const hide = () => { figure.hidden = true; };

const done = () => take(part.map(rounded));

frame.addEventListener("pointerdown", (event) => {
  const box = photo.getBoundingClientRect(), [x, y] = middle();
  drag = { sized: event.target !== frame, from: [event.clientX, event.clientY], x, y, width: part[2] - part[0], corner: [part[0], part[1]], box };
  frame.setPointerCapture(event.pointerId);
  event.preventDefault();
  frame.focus();
});
frame.addEventListener("pointermove", (event) => {
  if (drag === null) return;
  const across = (event.clientX - drag.from[0]) / drag.box.width, down = (event.clientY - drag.from[1]) / drag.box.height;
  if (!drag.sized) return put(drag.x + across, drag.y + down, drag.width);
  const most = Math.min(1 - drag.corner[0], (1 - drag.corner[1]) * ratio);
  const width = clamp(drag.width + Math.max(across, down * ratio), MIN_WIDTH, most);
  put(drag.corner[0] + width / 2, drag.corner[1] + width / ratio / 2, width);
});
for (const kind of ["pointerup", "pointercancel"]) {
  frame.addEventListener(kind, () => {
    if (drag === null) return;
    drag = null;
    done();
  });
}
frame.addEventListener("keydown", (event) => {
  const move = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, -STEP], ArrowDown: [0, STEP] }[event.key];
  const times = { "+": 1.05, "=": 1.05, "-": 1 / 1.05 }[event.key];
  if (!move && !times) return;
  event.preventDefault();
  const [x, y] = middle(), [across, down] = move ?? [0, 0];
  put(x + across, y + down, (part[2] - part[0]) * (times ?? 1));
  done();
});
