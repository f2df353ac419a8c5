// The page of a design follows its run by the run's own files: closed and opened again, it shows the same.
import { ask, drawCurves, element, embedded, pause, row } from "./common.js";

const { name, run, jobs, finished } = embedded(), at = `/api/design/${encodeURIComponent(name)}`;
const EVERY = 700; // milliseconds between two looks
const stages = new Map(), curve = [];
let next = 0, began = null, light = "";

const WORDS = { running: "Being designed", stopped: "Stopped", refused: "Refused", failed: "Failed", finished: "Finished", none: "" };

function take(news) {
  for (const [when, stage, done, total, text] of news.lines) {
    if (began === null) began = when;
    stages.set(stage, { done, total, text, first: stages.get(stage)?.first ?? when, last: when });
    const value = /RRMSD ([0-9.]+)/.exec(text);
    if (value && stage.startsWith("stage")) curve.push([when - began, Number(value[1])]);
  }
  next = news.next;
  const body = element("stages").tBodies[0];
  body.replaceChildren(...[...stages].map(([stage, { done, total, text, first, last }]) => {
    const bar = document.createElement("progress");
    bar.max = Math.max(total, 1);
    bar.value = Math.min(done, bar.max);
    bar.setAttribute("aria-label", `${stage}: ${done} of ${total}`);
    return row([stage, bar, `${(last - first).toFixed(1)} s`, text === "evaluations" ? "" : text], { numbers: [2] });
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
  const seconds = running && news.began ? `, ${Math.max(0, news.now - news.began).toFixed(0)} s` : "";
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
      await pause(3 * EVERY);
      continue;
    }
    take(news);
    element("running").hidden = ["none", "finished"].includes(news.state) && finished;
    if (before === "running" && news.state !== "running" && news.folder) return location.assign(`/design/${news.folder}`);
    before = news.state;
    await pause(news.state === "running" ? EVERY : 4 * EVERY);
  }
}

const order = (id, address) => element(id).addEventListener("click", () => ask(address, {}).catch((error) => alert(error.message)));
order("stop", `${at}/stop`);
order("pause", `${at}/stop?at_once`);
order("go-on", `${at}/go-on`);
element("edit").addEventListener("click", async () => {
  const { name: scene } = await ask(`${at}/edit`, {});
  location.href = `/scene/${scene}`;
});
if (run.state !== "none" && !(run.state === "finished" && finished)) follow();

// ---- work on a finished design ----

const RESULTS = {
  tolerance: () => [[`/design/${name}/files/report.html`, "the report's section on tolerances"], [`/design/${name}/files/tolerance.json`, "tolerance.json"]],
  tradeoff: (state) => [[`/design/${state.folder}/files/tradeoff.html`, "time against accuracy"], [`/design/${state.folder}/files/tradeoff.csv`, "tradeoff.csv"]],
  measured: () => [[`/design/${name}/files/measured/cloud/report.html`, "the part's report"]],
};

function show(form, state) {
  const place = form.querySelector("[role=status]"), kind = form.dataset.job;
  const last = state.lines.at(-1), text = last ? [`${last[1]}:`, last[4], last[3] ? `(${last[2]} of ${last[3]})` : ""].join(" ") : "";
  if (state.state === "running") place.textContent = `Under way … ${text}`;
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
    await pause(EVERY);
  }
}

for (const form of document.querySelectorAll("form.job")) {
  const kind = form.dataset.job;
  show(form, jobs[kind]);
  if (jobs[kind].state === "running") followJob(form);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const fields = new FormData(form), cloud = fields.get("cloud");
    try {
      if (cloud && !cloud.size) throw new Error("Choose the file of measured points first.");
      const number = (key) => (fields.get(key) ?? "").trim().replace(",", ".");
      await ask(`${at}/${kind}`, cloud || { grade: fields.get("grade"), yield: number("yield"), budget: number("budget") });
      form.next = 0;
      followJob(form);
    } catch (error) {
      form.querySelector("[role=status]").textContent = error.message;
    }
  });
}
