// The page of a scene.  Each change goes to the server, which answers with the text, the form and the fault; then the
// preview follows.  While a change is being sent, only the latest further change is kept.  An older preview stays until
// the next one is there.
import { ask, element, embedded, pause, row } from "./common.js";
import * as crop from "./crop.js";

let state = embedded();
const at = `/api/scene/${encodeURIComponent(state.name)}`, page = crypto.randomUUID();
const QUALITIES = ["draft", "standard", "fine"], INTERVAL = 1500; // milliseconds between two checks for changes on other pages
let number = 0, sent = {}, waiting = null, busy = false, dragging = null, viewer = null, look = "lens", qualities = {};
const wrong = new Map(); // invalid entries: words and sentence, by key
const closed = new Set(); // closed locks, by their keys
let impossible = {}; // reasons why this scene cannot have a choice, by key and choice

// ---- the form ----

const form = element("form");

function take(reply) {
  const isNew = reply.revision !== state.revision || !form.firstChild;
  state = reply;
  element("saved").textContent = reply.saved ? "saved" : "unsaved changes; Save writes them to the scene file";
  element("save").disabled = element("drop-changes").disabled = reply.saved;
  const area = element("text");
  if (document.activeElement !== area || !area.dataset.changed) area.value = reply.text;
  const error = reply.error;
  if (isNew) impossible = {};
  if (reply.form !== null && dragging === null && (isNew || error)) replaceForm(reply.form);
  else markForm();
  showCrop();
  showFollowed(reply.followed ?? []);
  showFault();
  if (error) noEstimates(error.sentence);
  if (reply.sketch !== undefined) element("sketch").innerHTML = reply.sketch;
  const quality = /^\s*quality\s*=\s*"(\w+)"/m.exec(reply.text);
  const place = QUALITIES.indexOf(quality ? quality[1] : "standard");
  if (place >= 0 && dragging !== element("quality")) element("quality").value = place;
  showQuality();
}

// Replace the HTML of the form; open sections stay open, and the focus is kept.
function replaceForm(html) {
  const active = document.activeElement, key = form.contains(active) ? active.dataset.key : null, type = active?.type;
  const open = new Set([...form.querySelectorAll("details[open]")].map((part) => part.dataset.section));
  const selection = key && type === "text" ? [active.selectionStart, active.selectionEnd] : null;
  form.innerHTML = html;
  for (const part of form.querySelectorAll("details")) part.open ||= open.has(part.dataset.section);
  markForm();
  if (key === null) return;
  const again = [...form.querySelectorAll("[data-key]")].find((part) => part.dataset.key === key && part.type === type);
  again?.focus({ preventScroll: true });
  if (selection && again) again.setSelectionRange(...selection);
}

function change(given) {
  if (given.words !== undefined && given.key === sent.key && given.words === sent.words) return; // a slider sends the same value twice
  sent = given;
  waiting = given;
  if (!busy) send();
}

async function send() {
  busy = true;
  while (waiting !== null) {
    const given = waiting;
    waiting = null;
    try {
      const reply = await ask(`${at}/change`, given);
      if (given.key === undefined) wrong.clear();
      else wrong.delete(given.key);
      take(reply);
      if (waiting === null && !state.error) preview();
    } catch (error) {
      sent = {};
      wrong.set(given.key ?? "", { words: given.words, sentence: error.message });
      markForm();
      showFault();
    }
  }
  busy = false;
}

const controlsOf = (key) => [...form.querySelectorAll("[data-key]")].filter((part) => part.dataset.key === key && part.type !== "button");

// Mark what only the page knows: invalid entries, closed locks, and impossible choices.
function markForm() {
  for (const old of form.querySelectorAll("[data-typed]")) {
    if (old.tagName === "P") old.remove();
    else {
      old.removeAttribute("aria-invalid");
      old.setAttribute("aria-describedby", `${old.id}-help`);
      delete old.dataset.typed;
    }
  }
  for (const [key, { words, sentence }] of wrong) {
    for (const control of controlsOf(key)) {
      control.closest("details")?.setAttribute("open", "");
      if (control.type === "range") continue;
      if (words !== undefined && control.type !== "checkbox" && control.tagName !== "SELECT") control.value = words;
      control.setAttribute("aria-invalid", "true");
      control.dataset.typed = "wrong";
      const message = document.createElement("p");
      Object.assign(message, { className: "error", id: `${control.id}-typed`, textContent: sentence });
      message.setAttribute("role", "alert");
      message.dataset.typed = "wrong";
      control.closest(".field").append(message);
      control.setAttribute("aria-describedby", `${control.id}-help ${message.id}`);
    }
  }
  for (const lock of form.querySelectorAll(".lock")) lock.setAttribute("aria-pressed", closed.has(lock.dataset.locks));
  for (const [key, choices] of Object.entries(impossible)) for (const control of controlsOf(key)) grey(control, choices);
}

// Show the frame over the photo of the first target.
const numbersOf = (key) => (controlsOf(key)[0]?.value ?? "").split(/[;,]/).map(Number);
const firstTarget = () => (controlsOf("target[0].z").length ? "target[0]" : "target");

function showCrop() {
  const key = firstTarget(), given = ["image", "sample"].map((name) => controlsOf(`${key}.${name}`)[0]?.value).find(Boolean);
  const [x, y] = ["x", "y"].map((axis) => numbersOf(`${key}.${axis}`)), sides = [x[1] - x[0], y[1] - y[0]];
  if (state.error || !given || !(sides[0] > 0 && sides[1] > 0)) return crop.hide();
  const part = numbersOf(`${key}.crop`), fit = controlsOf(`${key}.fit`)[0]?.value || "crop";
  if (["90", "270"].includes(controlsOf(`${key}.rotate`)[0]?.value)) sides.reverse();
  const address = `${at}/photo.png?key=${encodeURIComponent(key)}&of=${encodeURIComponent(given)}`;
  crop.show(address, { sides, given: part.length === 4 ? part : null, fills: fit === "crop" }, (value) => change({ key: `${key}.crop`, value }));
}

element("whole").addEventListener("click", () => change({ key: `${firstTarget()}.crop`, value: null }));
element("in-proportions").addEventListener("click", async () => {
  while (busy) await pause(50);
  await order("proportions", { key: firstTarget() });
  if (!state.error) preview();
});

// Disable choices that this scene cannot have, with the reasons under the field.
function grey(control, choices) {
  if (control.tagName !== "SELECT" || control.dataset.greyed) return;
  control.dataset.greyed = "yes";
  const reasons = document.createElement("small");
  for (const option of control.options) {
    const why = choices[option.value];
    if (!why) continue;
    option.value = option.value; // keep the value, since the text changes below
    option.disabled = true;
    option.textContent = `${option.value} (not possible)`;
    reasons.append(`${option.value} is not possible in this scene: ${why}. `);
  }
  reasons.id = `${control.id}-reasons`;
  control.setAttribute("aria-describedby", `${control.getAttribute("aria-describedby")} ${reasons.id}`);
  control.closest(".field").append(reasons);
}

// Show the sentence at the top; no lens can be designed while an entry is invalid.
function showFault() {
  const { error } = state, typed = [...wrong.values()].map(({ sentence }) => sentence);
  const sentence = error ? (error.line ? `${error.sentence} (line ${error.line})` : error.sentence) : typed.join(" ");
  element("fault").hidden = !sentence;
  if (element("fault").textContent !== sentence) element("fault").textContent = sentence;
  element("make").disabled = Boolean(error) || wrong.size > 0;
}

// Name and mark the keys that changed with another key.
function showFollowed(keys) {
  element("followed").textContent = keys.length ? `Also changed: ${keys.map((key) => `${key} = ${controlsOf(key)[0]?.value ?? "(see the text)"}`).join("; ")}.` : "";
  for (const key of keys) for (const control of controlsOf(key)) control.classList.add("followed");
}

// The slider of a pair sets its width: both ends move about their middle.
function wordsOf(control) {
  if (control.type === "checkbox") return String(control.checked);
  if (!control.dataset.middle) return control.value;
  const half = Number(control.value) / 2, middle = Number(control.dataset.middle);
  return [middle - half, middle + half].map((end) => Number(end.toPrecision(12))).join("; ");
}

const given = (control) => {
  const key = control.dataset.key;
  return { key, words: wordsOf(control), locked: [...closed].some((keys) => keys.split(" ").includes(key)) };
};

form.addEventListener("change", ({ target }) => {
  if (target.dataset.key) change(given(target));
});
form.addEventListener("input", ({ target }) => {
  if (target.type !== "range") return;
  dragging = target;
  for (const other of form.querySelectorAll("input[type=text]")) {
    if (other.dataset.key === target.dataset.key) other.value = wordsOf(target);
  }
  change(given(target));
});
for (const kind of ["pointerup", "pointercancel", "keyup"]) {
  document.addEventListener(kind, () => {
    if (dragging === null) return;
    dragging = null;
    if (state.form !== null) replaceForm(state.form);
  });
}
form.addEventListener("click", ({ target }) => {
  const lock = target.closest(".lock")?.dataset.locks;
  if (lock) {
    if (!closed.delete(lock)) closed.add(lock);
    markForm();
  }
  if (target.type === "button" && target.dataset.key) change({ key: target.dataset.key, value: JSON.parse(target.dataset.value) });
});
for (const [kind, lit] of [["focusin", true], ["focusout", false]]) {
  form.addEventListener(kind, ({ target }) => {
    const key = target.dataset.key;
    for (const part of key ? element("sketch").querySelectorAll("[data-of]") : []) {
      part.classList.toggle("lit", lit && `${key}.`.startsWith(`${part.dataset.of}.`));
    }
  });
}

// A picture that is chosen, or dropped anywhere on the page, replaces the picture of the scene.
async function takePicture(file) {
  if (!file) return;
  try {
    const { picture } = await ask("/api/picture", file);
    change({ key: `${firstTarget()}.image`, value: `pictures/${picture}` });
    element("picture-fault").textContent = "";
  } catch (error) {
    element("picture-fault").textContent = error.message;
  }
  element("picture-fault").hidden = !element("picture-fault").textContent;
}

element("picture").addEventListener("change", ({ target }) => takePicture(target.files[0]));
document.addEventListener("dragover", (event) => event.preventDefault());
document.addEventListener("drop", (event) => {
  event.preventDefault();
  takePicture(event.dataTransfer.files[0]);
});

const area = element("text");
area.addEventListener("input", () => { area.dataset.changed = "yes"; });
area.addEventListener("change", () => {
  delete area.dataset.changed;
  change({ text: area.value });
});
element("quality").addEventListener("change", ({ target }) => change({ key: "tailoring.quality", words: QUALITIES[target.value] }));

for (const choice of ["grade", "lit"]) element(choice).addEventListener("change", () => {
  if (!state.error) preview();
});

// ---- the preview ----

async function preview() {
  const mine = ++number;
  element("targets").classList.add("waiting");
  element("status").className = "";
  element("status").textContent = "Computing a new preview …";
  let reply;
  try {
    reply = await ask(`${at}/preview`, { page, number: mine, made: element("grade").value, lit: element("lit").value });
    while (mine === number && !reply.replaced && !reply.stage) reply = await ask(answer(mine, 0));
  } catch (error) {
    if (mine === number) noEstimates(error.message);
    return;
  }
  if (mine !== number || reply.replaced) return;
  show(reply);
  if (reply.refused) return;
  findImpossible(mine);
  for (let stage = 1; stage < 5; stage++) {
    do {
      reply = await ask(answer(mine, stage)).catch(() => ({ replaced: true }));
      if (mine !== number || reply.replaced) return;
    } while (!reply.stage);
    show(reply);
  }
}

const answer = (mine, stage) => `${at}/answer?page=${page}&number=${mine}&stage=${stage}`;

async function findImpossible(mine) {
  await pause(INTERVAL);
  if (mine !== number || dragging !== null) return;
  const found = await ask(`${at}/impossible`).catch(() => null);
  if (mine !== number || found === null || dragging !== null) return;
  impossible = found;
  markForm();
}

function show(reply) {
  if (reply.stage === "preview" || reply.stage === "settled") showLight(reply);
  else if (reply.stage === "made") showMade(reply.made, reply.refused);
  else showPlan(reply);
}

// Clear all figures, which belong to an earlier scene, and show the reason instead.
function noEstimates(sentence) {
  number++; // answers that arrive from now on belong to the earlier scene
  const status = element("status");
  element("targets").classList.remove("waiting");
  element("targets").replaceChildren();
  status.textContent = `No preview: ${sentence}`;
  status.className = "error";
  for (const part of ["figures", "remarks"]) (element(part).tBodies?.[0] ?? element(part)).replaceChildren();
  showOffer(null);
  showMade(null);
  element("solid-figure").classList.remove("drawn");
  noPlan("");
}

// Show the light as designed beside the light as made and in another light, with the sentences on them.
function showMade(made, refused) {
  element("made-targets").replaceChildren(...(made?.targets ?? []).map((target) => {
    const pair = document.createElement("div"), of = made.several ? `${target.key}: ` : "";
    pair.className = "both";
    pair.append(figure(target.designed, `${of}Light as designed`, `${of}as designed: RRMSD ${target.rrmsds[0]}`));
    pair.append(figure(target.made, `${of}Light ${target.words}`, `${of}${target.words}: RRMSD ${target.rrmsds[1]}`));
    return pair;
  }));
  const sentences = refused ? [`No such picture: ${refused}.`] : made?.sentences ?? [];
  element("made-says").replaceChildren(...sentences.map((sentence) => {
    const words = document.createElement("p");
    words.textContent = sentence;
    return words;
  }));
}

function noPlan(sentence) {
  qualities = {};
  for (const table of [element("predicted"), element("left-out").querySelector("table")]) table.tBodies[0].replaceChildren();
  element("net").textContent = "";
  element("sharp").textContent = "";
  element("comes-to").textContent = "";
  element("notes").textContent = sentence;
  showQuality();
}

function showLight(reply) {
  element("targets").classList.remove("waiting");
  if (reply.refused) {
    if (reply.stage === "preview") noEstimates(reply.refused);
    else element("status").textContent += ` No finer preview: ${reply.refused}.`;
    return;
  }
  element("targets").replaceChildren(...reply.targets.map((target) => {
    const pair = document.createElement("div");
    pair.className = "both";
    const of = reply.targets.length > 1 ? `${target.key}: ` : "";
    pair.append(figure(target.light, `${of}Light through the lens`, `${of}light through the lens: RRMSD ${target.rrmsd} on ${target.pixels.join(" × ")} pixels${target.source_image ? `; the image of the source is ${target.source_image} wide and blurs finer detail` : ""}`, "light-on-wall"));
    pair.append(figure(target.wanted, `${of}Target picture`, `${of}target picture, ${target.seen.toLowerCase()}`));
    return pair;
  }));
  const kind = reply.stage === "settled" ? "Refined preview" : "Preview";
  element("status").textContent = `${kind} after ${reply.seconds.toFixed(1)} s; a design uses all pixels.`;
  element("figures").tBodies[0].replaceChildren(...reply.figures.map((cells) => row(cells)));
  element("remarks").replaceChildren(...reply.remarks.map((sentence) => {
    const item = document.createElement("li");
    item.textContent = sentence;
    return item;
  }));
  showOffer(reply.offer);
  if (!reply.solid) return;
  if (viewer === null) {
    viewer = solidView.begin(element("solid-figure"), reply.solid);
    viewer.look(look);
  } else {
    element("solid-figure").classList.add("drawn");
    viewer.update(reply.solid);
  }
}

// Show the offer of another kind of lens with its sentence; the button exists if the change is possible.
function showOffer(offer) {
  const place = element("offer"), button = place.querySelector("button");
  place.hidden = !offer;
  place.querySelector("p").textContent = offer?.sentence ?? "";
  button.hidden = !offer?.value;
  button.onclick = () => change({ key: offer.key, value: offer.value });
}

function figure(source, alt, caption, kind = "") {
  const made = document.createElement("figure"), image = document.createElement("img"), words = document.createElement("figcaption");
  Object.assign(image, { src: source, alt, className: kind });
  words.textContent = caption;
  made.append(image, words);
  return made;
}

element("solid-figure").addEventListener("click", ({ target }) => {
  if (!target.dataset.look) return;
  look = target.dataset.look;
  for (const button of element("solid-figure").querySelectorAll("[data-look]")) button.setAttribute("aria-pressed", button === target);
  viewer?.look(look);
});

// ---- time and accuracy, and what is left out ----

function showPlan(reply) {
  if (!reply.refused) {
    element("comes-to").textContent = reply.verdict?.sentence ?? "";
    element("comes-to").className = reply.verdict?.kind === "blurred" ? "error" : "";
  }
  qualities = reply.qualities ?? {};  // empty until predictions exist
  if (reply.refused) noPlan(`No estimate: ${reply.refused}.`);
  else if (reply.stage === "effects") {
    element("net").textContent = reply.net ?? "";
    element("sharp").textContent = reply.sharp ?? "";
    const several = reply.left_out.some((cells) => cells[4]);
    element("left-out").querySelector("th:last-child").hidden = !several;
    const rows = reply.left_out.map((cells) => row(several ? cells : cells.slice(0, 4), { numbers: [1, 2, 3] }));
    element("left-out").querySelector("tbody").replaceChildren(...rows);
  } else {
    element("notes").textContent = reply.not_predicted ? `No prediction: ${reply.not_predicted}.` : reply.notes.join(" ");
  }
  element("predicted").tBodies[0].replaceChildren(...QUALITIES.filter((quality) => qualities[quality]).map((quality) => {
    const made = row([quality, qualities[quality].seconds, qualities[quality].rrmsd, qualities[quality].half], { numbers: [1, 2, 3] });
    made.title = qualities[quality].range;
    made.dataset.quality = quality;
    return made;
  }));
  showQuality();
}

function showQuality() {
  const chosen = QUALITIES[element("quality").value], known = qualities[chosen];
  const words = known ? `${chosen}: ${known.seconds}, RRMSD ${known.rrmsd} on pixels, ${known.half} on half pixels (${known.range})` : chosen;
  if (element("quality-says").textContent !== words) element("quality-says").textContent = words;
  element("quality").setAttribute("aria-valuetext", known ? `${chosen}, ${known.seconds}, RRMSD ${known.rrmsd} on pixels` : chosen);
  for (const tr of element("predicted").tBodies[0].rows) {
    if (tr.dataset.quality === chosen) tr.setAttribute("aria-current", "true");
    else tr.removeAttribute("aria-current");
  }
}

// ---- saving and making ----

async function order(address, body = {}) {
  try {
    const reply = await ask(`${at}/${address}`, body);
    if (address === "drop") wrong.clear();
    take(reply);
  } catch (error) {
    if (address === "save" && /another program/.test(error.message) && confirm(error.message)) return order("save", { anyway: true });
    element("fault").hidden = false;
    element("fault").textContent = error.message;
  }
}

element("save").addEventListener("click", () => order("save"));
element("drop-changes").addEventListener("click", async () => {
  await order("drop");
  if (!state.error) preview();
});
element("make").addEventListener("click", async () => {
  element("make").disabled = true;
  try {
    while (busy) await pause(50);
    if (state.error || wrong.size) return showFault(); // the last entry was invalid
    const { design } = await ask(`${at}/make`, { page });
    location.href = `/design/${design}`;
  } catch (error) {
    element("make").disabled = false;
    element("fault").hidden = false;
    element("fault").textContent = error.message;
  }
});

// ---- other pages on the same scene ----

async function watch() {
  for (;;) {
    await pause(INTERVAL);
    if (busy || dragging !== null || document.hidden || area.dataset.changed) continue;
    const reply = await ask(`${at}?revision=${state.revision}`).catch(() => null);
    if (busy || reply === null || reply.text === undefined || reply.revision === state.revision) continue;
    take(reply);
    if (!reply.error) preview();
  }
}

take(state);
if (!state.error) preview();
watch();
