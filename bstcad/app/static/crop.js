// A frame over the photo of the first target: the part of it that is shown, in the proportions of the target.
import { element } from "./common.js";

const LEAST = 0.05, STEP = 0.02; // of the photo: the narrowest frame, and a step of a key
const [figure, photo, frame] = ["crop", "photo", "frame"].map(element);
let part = [0, 0, 1, 1], ratio = 1, held = null, take = () => {}; // left, top, right, bottom; width over height, in parts

const clamp = (value, low, high) => Math.min(Math.max(value, low), Math.max(high, low));
const rounded = (value) => Math.round(value * 1e4) / 1e4;

function draw() {
  const [left, top, right, bottom] = part;
  Object.assign(frame.style, { left: `${100 * left}%`, top: `${100 * top}%`, width: `${100 * (right - left)}%`, height: `${100 * (bottom - top)}%` });
}

// A frame of a width, its middle as near to a place as the photo allows.
function put(x, y, width) {
  const wide = clamp(width, LEAST, Math.min(1, ratio)), high = wide / ratio;
  const left = clamp(x - wide / 2, 0, 1 - wide), top = clamp(y - high / 2, 0, 1 - high);
  part = [left, top, left + wide, top + high];
  draw();
}

const middle = () => [(part[0] + part[2]) / 2, (part[1] + part[3]) / 2];

// key: of the target; sides: its width and height, as the photo lies; given: its crop, or null; changed(value): a drag ended.
export function show(address, { sides, given, fills }, changed) {
  take = changed;
  const begin = () => {
    figure.hidden = false;
    ratio = (sides[0] / sides[1]) / (photo.naturalWidth / photo.naturalHeight);
    part = given ?? [0, 0, 1, 1];
    if (fills) {
      const wide = Math.min(part[2] - part[0], (part[3] - part[1]) * ratio);
      put(...middle(), wide); // as `fit` crops it
    } else draw();
  };
  photo.onload = begin;
  photo.onerror = () => { figure.hidden = true; };
  if (photo.getAttribute("src") !== address) photo.src = address;
  else if (photo.naturalWidth && held === null) begin();
}

export const hide = () => { figure.hidden = true; };

const done = () => take(part.map(rounded));

frame.addEventListener("pointerdown", (event) => {
  const box = photo.getBoundingClientRect(), [x, y] = middle();
  held = { sized: event.target !== frame, from: [event.clientX, event.clientY], x, y, width: part[2] - part[0], corner: [part[0], part[1]], box };
  frame.setPointerCapture(event.pointerId);
  event.preventDefault();
  frame.focus();
});
frame.addEventListener("pointermove", (event) => {
  if (held === null) return;
  const across = (event.clientX - held.from[0]) / held.box.width, down = (event.clientY - held.from[1]) / held.box.height;
  if (!held.sized) return put(held.x + across, held.y + down, held.width);
  const most = Math.min(1 - held.corner[0], (1 - held.corner[1]) * ratio);
  const width = clamp(held.width + Math.max(across, down * ratio), LEAST, most);
  put(held.corner[0] + width / 2, held.corner[1] + width / ratio / 2, width);
});
for (const kind of ["pointerup", "pointercancel"]) {
  frame.addEventListener(kind, () => {
    if (held === null) return;
    held = null;
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
