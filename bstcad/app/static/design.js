// The page of a design follows its run through the run's files, so that it can be closed and opened again.
import { ask, drawCurves, element, embedded, pause, row } from "./common.js";

const { name, run, jobs, finished } = embedded(), at = `/api/design/${encodeURIComponent(name)}`;
const INTERVAL = 700; // milliseconds between two requests
const stages = new Map(), curve = [];
const source = { size: 0, last: 0 }; // latest size of the source (percent) and RRMSD
let next = 0, began = null, light = "", latest = null; // latest: time of the last line

// Names of the stages, as in the tutorial.
const STAGES = {
  "control points": "number of control points", reach: "area that light can reach", "stage 1": "stage 1: first face, by optimal transport",
  "stage 2": "stage 2: better face, by ray tracing", "stage 3": "stage 3: better face, for the size of the source",
  write: "writing the files", verify: "verification of the files", report: "report",
};
const named = (stage) => STAGES[stage] ?? stage;
const left = (seconds) => (seconds < 90 ? `${Math.ceil(seconds)} s left` : `${Math.ceil(seconds / 60)} min left`);

// Seconds left of a stage by its pace up to its last line, less the time since then.
const rest = ({ done, total, first, last }, now) => (done && total > done ? Math.max(((last - first) * (total - done)) / done - (now - last), 1) : 0);

const WORDS = { running: "Designing", stopped: "Stopped", refused: "Refused", failed: "Failed", finished: "Finished", none: "" };

function take(news) {
  for (const [when, stage, done, total, text] of news.lines) {
    if (began === null) began = when;
    if (!stage) { // the run was continued: the time since its last line was a pause
      const paused = latest === null ? 0 : when - latest;
      began += paused;
      for (const each of stages.values()) if (each.done < each.total) each.first += paused;
      continue;
    }
    latest = when;
    stages.set(stage, { done, total, text, first: stages.get(stage)?.first ?? when, last: when });
    const value = /RRMSD ([0-9.]+)/.exec(text);
    if (!value || !stage.startsWith("stage")) continue;
    const percent = /with (\d+) %/.exec(text), size = stage !== "stage 3" ? 0 : percent ? Number(percent[1]) : 100;
    if (size > source.size && source.last && Number(value[1]) > 1.01 * source.last) {
      element("growth").textContent = `The RRMSD rises from ${source.last} to ${value[1]}, since stage 3 increases the size of the source, now to ${size} %, and a larger source blurs more.`;
    }
    Object.assign(source, { size, last: Number(value[1]) });
    curve.push([when - began, Number(value[1])]);
  }
  next = news.next;
  const body = element("stages").tBodies[0];
  body.replaceChildren(...[...stages].map(([stage, { done, total, text, first, last }]) => {
    const bar = document.createElement("progress");
    bar.max = Math.max(total, 1);
    bar.value = Math.min(done, bar.max);
    bar.setAttribute("aria-label", `${named(stage)}: ${done} of ${total}`);
    return row([named(stage), bar, `${(last - first).toFixed(1)} s`, text === "evaluations" ? "" : text], { numbers: [2] });
  }));
  element("curve").parentElement.hidden = curve.length < 2;
  drawCurves(element("curve"), [curve]);
  element("light").parentElement.hidden = !news.light;
  if (news.light && news.light !== light) {
    light = news.light;
    element("light").src = `${at}/light.png?${light}`;
    element("light").hidden = false;
  }
  const running = news.state === "running";
  element("stop").hidden = element("pause").hidden = !running;
  element("go-on").hidden = !news.resumable;
  const last = [...stages.values()].at(-1), remaining = running && last ? rest(last, news.now) : 0;
  const seconds = running && news.began ? `, ${Math.max(0, news.now - news.began).toFixed(0)} s${remaining ? `, ${left(remaining)} of this stage` : ""}` : "";
  const sentence = [WORDS[news.state] + (news.state === "running" ? seconds : ""), news.sentence].filter(Boolean).join(": ");
  if (element("state-says").textContent !== sentence) element("state-says").textContent = sentence;
}

async function follow() {
  let before = run.state;
  for (;;) {
    let news;
    try {
      news = await ask(`${at}/run?since=${next}`);
    } catch {
      await pause(3 * INTERVAL);
      continue;
    }
    take(news);
    element("running").hidden = ["none", "finished"].includes(news.state) && finished;
    if (before === "running" && news.state !== "running" && news.folder) return location.assign(`/design/${news.folder}`);
    before = news.state;
    await pause(news.state === "running" ? INTERVAL : 4 * INTERVAL);
  }
}

const order = (id, address) => element(id).addEventListener("click", () => ask(address, {}).catch((error) => alert(error.message)));
order("stop", `${at}/stop`);
order("pause", `${at}/stop?at_once`);
order("go-on", `${at}/go-on`);
element("edit").addEventListener("click", () => {
  element("copy").hidden = !element("copy").hidden;
  element("title").select();
});
element("copy").addEventListener("submit", async (event) => {
  event.preventDefault();
  const { name: scene } = await ask(`${at}/edit`, { title: element("title").value });
  location.href = `/scene/${scene}`;
});
if (run.state !== "none" && !(run.state === "finished" && finished)) follow();

// ---- work on a finished design ----

const RESULTS = {
  tolerance: () => [[`/design/${name}/files/report.html`, "the report's section on tolerances"], [`/design/${name}/files/tolerance.json`, "tolerance.json"]],
  tradeoff: (state) => [[`/design/${state.folder}/files/tradeoff.html`, "time against accuracy"], [`/design/${state.folder}/files/tradeoff.csv`, "tradeoff.csv"]],
  measured: () => [[`/design/${name}/files/measured/cloud/report.html`, "the part's report"]],
  compensate: (state) => [[`/design/${name}/files/production.html`, "the page to sign"], [`/design/${name}/files/compensated/${state.folder}/lens.step?download`, "lens.step to cut next"]],
  export: (state) => state.files.map((file) => [`/design/${name}/files/${file}?download`, file]),
  retailor: (state) => [[`/design/${state.folder}`, "the new design"]],
};

function show(form, state) {
  const place = form.querySelector("[role=status]"), kind = form.dataset.job;
  const running = state.state === "running", bar = form.querySelector("progress");
  form.began ??= new Map();
  for (const [when, stage] of state.lines) if (!form.began.has(stage)) form.began.set(stage, when);
  const last = state.lines.at(-1), [when, stage, done, total, words] = last ?? [];
  bar.hidden = form.querySelector(".stop").hidden = !running;
  if (total) Object.assign(bar, { max: total, value: Math.min(done, total) });
  else bar.removeAttribute("value");
  const remaining = last ? rest({ done, total, first: form.began.get(stage), last: when }, state.now) : 0;
  const text = last ? [`${named(stage)}:`, words, total ? `${done} of ${total},` : "", remaining ? left(remaining) : ""].filter(Boolean).join(" ").replace(/,$/, "") : "";
  if (running) place.textContent = `Running … ${text}`;
  else if (state.state === "finished") {
    place.replaceChildren("Finished: ", ...RESULTS[kind](state).flatMap(([address, words], k) => {
      const link = document.createElement("a");
      Object.assign(link, { href: address, textContent: words, target: "_blank", rel: "noopener" });
      return k ? [", ", link] : [link];
    }));
  } else if (state.state !== "none") place.textContent = [WORDS[state.state], state.sentence].filter(Boolean).join(": ");
}

async function followJob(form) {
  const kind = form.dataset.job;
  for (;;) {
    const state = await ask(`${at}/run?kind=${kind}&since=${Math.max(0, form.next ?? 0)}`).catch(() => null);
    if (state) {
      form.next = state.next - 1;
      show(form, state);
      if (state.state !== "running") return;
    }
    await pause(INTERVAL);
  }
}

for (const form of document.querySelectorAll("form.job")) {
  const kind = form.dataset.job;
  show(form, jobs[kind]);
  if (jobs[kind].state === "running") followJob(form);
  form.querySelector(".stop").addEventListener("click", () => ask(`${at}/stop?kind=${kind}`, {}).catch((error) => alert(error.message)));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const fields = new FormData(form), cloud = fields.get("cloud");
    try {
      if (cloud && !cloud.size) throw new Error("Choose the file of measured points first.");
      const number = (key) => (fields.get(key) ?? "").trim().replace(",", ".");
      await ask(`${at}/${kind}`, cloud || { grade: fields.get("grade"), yield: number("yield"), budget: number("budget"), thickness: number("thickness"), index: number("index"), kind: fields.get("kind"), tool_radius: number("tool_radius"), tiles: fields.get("tiles") });
      form.next = 0;
      form.began = new Map();
      followJob(form);
    } catch (error) {
      form.querySelector("[role=status]").textContent = error.message;
    }
  });
}
