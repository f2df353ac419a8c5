// Functions common to all pages: requests to the server, whose answers are JSON (a refusal is one sentence), and drawing.

export const element = (id) => document.getElementById(id);

export class Refused extends Error {}

export async function ask(address, body, options = {}) {
  const request = { method: body === undefined ? "GET" : "POST", ...options };
  if (body instanceof Blob || body instanceof ArrayBuffer) {
    request.body = body;
    request.headers = { "Content-Type": "application/octet-stream" };
  } else if (body !== undefined) {
    request.body = JSON.stringify(body);
    request.headers = { "Content-Type": "application/json" };
  }
  let answer;
  try {
    answer = await fetch(address, request);
  } catch (error) {
    if (error.name !== "AbortError") offline("The workbench does not answer. Start it again with bstcad app; nothing is lost.");
    throw error;
  }
  const text = await answer.text();
  if (answer.status === 403) {
    offline(text);
    throw new Refused(text);
  }
  offline("");
  let reply;
  try {
    reply = text ? JSON.parse(text) : {};
  } catch {
    throw new Refused(text.slice(0, 300) || `The workbench failed (HTTP status ${answer.status}).`);
  }
  if (!answer.ok) throw new Refused(reply.sentence || `The workbench failed (HTTP status ${answer.status}).`);
  return reply;
}

export function offline(sentence) {
  const place = element("offline");
  place.hidden = !sentence;
  if (place.textContent !== sentence) place.textContent = sentence;
}

export const embedded = (id = "state") => JSON.parse(element(id).textContent);

export function row(cells, { head = true, numbers = [] } = {}) {
  const tr = document.createElement("tr");
  cells.forEach((text, k) => {
    const cell = document.createElement(head && k === 0 ? "th" : "td");
    if (head && k === 0) cell.scope = "row";
    if (numbers.includes(k)) cell.className = "n";
    cell.append(text);
    tr.append(cell);
  });
  return tr;
}

export const pause = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));

// Curves of [seconds, RRMSD] on a logarithmic scale of the RRMSD.
export function drawCurves(svg, curves) {
  const [wide, high, left, low] = [Math.max(Math.round(svg.getBoundingClientRect().width), 240) || 480, 240, 60, 38], name = "http://www.w3.org/2000/svg";
  const points = curves.flat().filter(([, value]) => value > 0);
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${wide} ${high}`); // one unit is one pixel, so that letters have the size of the page's
  if (points.length < 2) return;
  const last = Math.max(...points.map(([seconds]) => seconds)), values = points.map(([, value]) => Math.log10(value));
  const [least, most] = [Math.min(...values) - 0.05, Math.max(...values) + 0.05];
  const x = (seconds) => left + ((wide - left - 10) * seconds) / last;
  const y = (value) => 10 + ((high - low - 10) * (most - Math.log10(value))) / (most - least);
  const add = (kind, attributes, text) => {
    const made = document.createElementNS(name, kind);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text) made.textContent = text;
    svg.append(made);
  };
  add("line", { x1: left, y1: high - low, x2: wide - 10, y2: high - low, class: "axis" });
  add("line", { x1: left, y1: 10, x2: left, y2: high - low, class: "axis" });
  for (const power of [1, 0, -1, -2, -3]) {
    for (const step of most - least > 0.8 ? [5, 2, 1] : [9, 8, 7, 6, 5, 4, 3, 2, 1]) {
      const value = step * 10 ** power, log = Math.log10(value);
      if (log < least || log > most) continue;
      add("line", { x1: left - 4, y1: y(value), x2: left, y2: y(value), class: "axis" });
      add("text", { x: left - 8, y: y(value) + 4, "text-anchor": "end" }, String(Number(value.toPrecision(1))));
    }
  }
  add("text", { x: wide - 10, y: high - 12, "text-anchor": "end" }, `${last.toPrecision(3)} s`);
  add("text", { x: left, y: high - 12 }, "0 s");
  add("text", { x: left + 10, y: 24 }, "RRMSD");
  curves.forEach((curve, k) => {
    const path = curve.filter(([, value]) => value > 0).map(([s, v], i) => `${i ? "L" : "M"}${x(s).toFixed(1)} ${y(v).toFixed(1)}`);
    add("path", { d: path.join(" "), class: `line-${k}` });
  });
}
