// The start page: makes a scene from a picture, a sample, letters or a template, and opens its page.
import { ask, element } from "./common.js";

const form = element("new"), drop = element("drop"), file = element("picture"), message = element("message");

const use = () => {
  const chosen = form.querySelector("input[name=use]:checked");
  return chosen.dataset.template === undefined ? { light: chosen.value } : { template: chosen.value };
};

// Size of a plate as in `bstcad new --size`: 80, or 80xphoto for the proportions of the photo.
const size = (photo) => {
  const side = element("side").value.trim().replace(",", ".");
  return photo && element("proportions").checked ? `${side ? `${side}x` : ""}photo` : side;
};

async function begin(given, words) {
  message.textContent = words;
  try {
    const { name } = await ask("/api/scenes", given);
    location.href = `/scene/${name}`;
  } catch (error) {
    message.textContent = error.message;
  }
}

async function take(picture) {
  if (!picture) return;
  message.textContent = "Reading the picture …";
  try {
    const kept = await ask("/api/picture", picture);
    await begin({ ...use(), size: size(true), ...kept }, "Making the scene …");
  } catch (error) {
    message.textContent = error.message;
  }
}

file.addEventListener("change", () => take(file.files[0]));
for (const kind of ["dragenter", "dragover"]) {
  drop.addEventListener(kind, (event) => { event.preventDefault(); drop.classList.add("over"); });
}
for (const kind of ["dragleave", "drop"]) drop.addEventListener(kind, () => drop.classList.remove("over"));
drop.addEventListener("drop", (event) => { event.preventDefault(); take(event.dataTransfer.files[0]); });
form.addEventListener("submit", (event) => event.preventDefault());
// Enter in the letters makes their scene, and in the size that of the chosen picture.
form.addEventListener("keydown", (event) => {
  if (event.key !== "Enter" || event.isComposing) return;
  if (event.target === element("letters")) form.querySelector("[data-letters]").click();
  else if (event.target === element("side") && file.files.length) take(file.files[0]);
  else if (event.target === element("side")) message.textContent = "Now drop a picture, or choose a sample or letters.";
  else return;
  event.preventDefault();
});
form.addEventListener("click", (event) => {
  const { sample, letters } = event.target.dataset;
  if (sample) begin({ ...use(), size: size(false), sample }, "Making the scene …");
  if (letters !== undefined) begin({ ...use(), size: size(false), text: element("letters").value }, "Making the scene …");
});
document.addEventListener("click", (event) => {
  const { start } = event.target.dataset;
  if (start) begin({ template: start }, "Making the scene …");
});
