// Timeline of slots: loading, executing, delivering, idle. Zooms down to one rollout.
import {ask} from "./ask.js";
import {at, colour, count, decoded, h, none, put, seconds, signed} from "./dom.js";
import {named} from "./names.js";

const ROW = 20, NAMES = 150, NAMES_SHARE = 0.28, TYPING_MS = 250, HEAD = 22, GRIP = 5, LEAST_PX = 1, LEAST_S = 0.1, LEAST_VIEW_S = 0.001, TICK = 80;
const SPANS = [10, 60, 300, 1800];
const KINDS = [["execute", "warm"], ["load", "warming"], ["deliver", "queued"], ["failed", "bad"], ["idle", "chip"]];
let run = "", timeline = null, view = null, live = true, span = 60, painted = [], grabbed = null, edge = NAMES, search = "", typed = 0;
/** Raised when the page is opened or closed: answers to an earlier page are not shown. */
let turn = 0;

export function open(main) {
  turn += 1;
  run = decoded(location.hash.split("?")[1] ?? "");
  timeline = view = null; live = true;
  const legend = KINDS.map(([word, tint]) => [h("i", {style: `background:var(--${tint})`}), word]);
  main.replaceChildren(h("section", {},
    h("h2", {}, "Slots ", h("small", {id: "range"}), h("span", {class: "legend"}, legend)),
    h("div", {class: "bar"},
      h("select", {id: "run", "aria-label": "run", onchange: event => { run = event.target.value; timeline = view = null; live = true; dispatchEvent(new Event("embomatrix-changed")); }}),
      h("input", {type: "search", maxlength: 128, placeholder: "worker", "aria-label": "search by worker", value: search, oninput: event => { clearTimeout(typed); typed = setTimeout(() => { search = event.target.value; follow(); }, TYPING_MS); }}),
      h("select", {"aria-label": "time range", onchange: event => { span = Number(event.target.value); live = true; view = null; dispatchEvent(new Event("embomatrix-changed")); }}, SPANS.map(s => h("option", {value: s, selected: s === span}, `last ${seconds(s)}`))),
      h("button", {type: "button", onclick: () => zoom(0.5, live ? 1 : 0.5)}, "Zoom in"), h("button", {type: "button", onclick: () => zoom(2, live ? 1 : 0.5)}, "Zoom out"),
      h("button", {type: "button", onclick: () => pan(-0.25)}, "Earlier"), h("button", {type: "button", onclick: () => pan(0.25)}, "Later"),
      h("button", {type: "button", id: "live", onclick: follow}, "Follow")),
    h("p", {id: "one", class: "muted", role: "status"}),
    h("div", {id: "tracks"})));
}

export function close() {
  turn += 1;
  clearTimeout(typed);
}

const address = () => `runs/${encodeURIComponent(run)}/timeline?${new URLSearchParams({seconds: span, search})}`;

export async function show({runs}) {
  const known = runs.map(r => r.run_id);
  if (!run) run = (runs.findLast(r => r.pending || r.stats.delivered) ?? runs.at(-1))?.run_id ?? "";
  put(at("run"), (known.includes(run) || !run ? known : [run, ...known]).map(id => h("option", {value: id, selected: id === run}, runs.find(r => r.run_id === id)?.name || id)));
  if (!run) { put(at("tracks"), none("No open run. Closed runs are on the page Runs.")); return; }
  if (!live && timeline) { draw(); return; } // the window or the theme may be another by now
  const mine = turn, wanted = address(), found = await ask(wanted);
  // The viewer may have chosen something else, or left the page.
  if (mine !== turn || wanted !== address()) return;
  timeline = found;
  if (live) {
    const first = Math.min(...timeline.tracks.flatMap(track => track.spans.map(one => one.begin_s - one.load_s)));
    view = {from: Math.min(timeline.until_s - LEAST_S, Math.max(timeline.until_s - span, first)), until: timeline.until_s};
  }
  draw();
}

function draw() {
  const place = at("tracks");
  if (!place || !timeline) return;
  if (!timeline.tracks.length) { put(place, none(search ? "No matching worker executed a rollout in this time." : "No rollout was executed in this time.")); at("one").textContent = ""; return; }
  if (!at("one").textContent) at("one").textContent = matchMedia("(pointer: coarse)").matches ? "Tap a span for details; drag to move along the time axis." :
    "Point at a span for details. Zoom: Ctrl and the wheel, double click on a rollout, plus and minus. Move: drag, arrow keys. Escape follows the latest events.";
  let canvas = place.querySelector("canvas");
  if (!canvas) {
    canvas = h("canvas", {class: "gantt", tabindex: "0", role: "img", onwheel: wheel, onpointermove: point, onpointerdown: grab, onpointerup: release, onpointercancel: release, ondblclick: nearer, onkeydown: key});
    place.replaceChildren(canvas);
  }
  const wide = place.clientWidth;
  edge = Math.min(NAMES, Math.round(wide * NAMES_SHARE));
  const high = HEAD + timeline.tracks.length * ROW, dense = devicePixelRatio || 1;
  canvas.width = wide * dense; canvas.height = high * dense; canvas.style.height = `${high}px`;
  canvas.setAttribute("aria-label", `${timeline.tracks.length} slots, ${timeline.tracks.reduce((sum, track) => sum + track.spans.length, 0)} rollouts`);
  const pen = canvas.getContext("2d");
  pen.scale(dense, dense);
  const tint = Object.fromEntries(["ink", "soft", "line", "chip", "warm", "warming", "queued", "bad"].map(name => [name, colour(name)]));
  const x = at_s => edge + (at_s - view.from) / (view.until - view.from) * (wide - edge);
  scale(pen, tint, x, wide, high);
  painted = [];
  timeline.tracks.forEach((track, number) => {
    const top = HEAD + number * ROW;
    pen.fillStyle = tint.chip; pen.fillRect(edge, top + 2, wide - edge, ROW - 4);
    for (const one of track.spans) {
      if (one.end_s + one.deliver_s < view.from || one.begin_s - one.load_s > view.until) continue;
      const failed = one.outcome !== "completed";
      bar(pen, x, one.begin_s - one.load_s, one.begin_s, top, tint.warming);
      bar(pen, x, one.end_s, one.end_s + one.deliver_s, top, tint.queued);
      bar(pen, x, one.begin_s, one.end_s, top, failed ? tint.bad : tint.warm, true);
      painted.push({left: x(one.begin_s - one.load_s), right: Math.max(x(one.end_s + one.deliver_s), x(one.begin_s) + GRIP), top, one, track});
    }
    pen.fillStyle = tint.soft; pen.fillText(`${short(pen, track.worker_id, edge - 28)} ${track.slot}`, 0, top + ROW / 2 + 4, edge - 8);
  });
  const more = timeline.slots > timeline.tracks.length ? `; the first ${count(timeline.tracks.length)} of ${count(timeline.slots)} slots` : "";
  at("range").textContent = `${seconds(view.until - view.from)} shown${more}${timeline.dropped ? `; ${timeline.dropped} older events were discarded` : ""}`;
}

function bar(pen, x, begin, end, top, fill, always) {
  const left = Math.max(edge, x(begin)), wide = x(end) - left;
  if (wide <= 0 && !always) return;
  pen.fillStyle = fill;
  // A thin gap between neighbours, if there is room.
  pen.fillRect(left, top + 3, Math.max(LEAST_PX, wide > 3 ? wide - 0.5 : wide), ROW - 6);
}

function scale(pen, tint, x, wide, high) {
  const rough = (view.until - view.from) / Math.max(2, (wide - edge) / TICK), power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map(n => n * power).find(n => n >= rough);
  pen.font = "11px system-ui"; pen.strokeStyle = tint.line;
  for (let tick = Math.ceil((view.from - timeline.until_s) / step) * step; tick <= view.until - timeline.until_s + 1e-9; tick += step) {
    const left = x(timeline.until_s + tick);
    const words = Math.abs(tick) < step / 2 ? "latest" : signed(`${Number(tick.toPrecision(6))} s`), space = pen.measureText(words).width + 3;
    pen.fillStyle = tint.soft; pen.fillText(words, left + space > wide ? left - space : left + 3, 13);
    pen.beginPath(); pen.moveTo(left, 0); pen.lineTo(left, high); pen.stroke();
  }
}

/** Follow the latest events again. */
function follow() {
  live = true;
  view = null;
  dispatchEvent(new Event("embomatrix-changed"));
}

/** Shorten a worker's name in the middle to the available width. */
function short(pen, name, room) {
  if (pen.measureText(name).width <= room) return name;
  let kept = Math.floor(name.length / 2);
  while (kept > 1 && pen.measureText(`${name.slice(0, kept)}…${name.slice(-kept)}`).width > room) kept -= 1;
  return `${name.slice(0, kept)}…${name.slice(-kept)}`;
}

/** Show this interval, limited to the loaded data. */
function look(from, until) {
  const long = Math.min(span, Math.max(LEAST_VIEW_S, until - from)), begin = Math.max(timeline.until_s - span, Math.min(from, timeline.until_s - long));
  live = false;
  view = {from: begin, until: begin + long};
  draw();
}

function zoom(factor, middle = 0.5) {
  if (!view) return;
  const long = view.until - view.from, centre = view.from + long * middle;
  look(centre - long * factor * middle, centre + long * factor * (1 - middle));
}

function pan(share) {
  if (!view) return;
  const move = (view.until - view.from) * share;
  look(view.from + move, view.until + move);
}

function wheel(event) {
  if (!event.ctrlKey && !event.shiftKey) return;
  event.preventDefault();
  const box = event.target.getBoundingClientRect();
  // With Shift the wheel turns sideways.
  zoom((event.deltaY || event.deltaX) > 0 ? 1.25 : 0.8, Math.min(1, Math.max(0, (event.clientX - box.left - edge) / (box.width - edge))));
}

function key(event) {
  const moves = {ArrowLeft: () => pan(-0.1), ArrowRight: () => pan(0.1), "+": () => zoom(0.5, live ? 1 : 0.5), "-": () => zoom(2, live ? 1 : 0.5), Escape: follow};
  if (moves[event.key]) { event.preventDefault(); moves[event.key](); }
}

function hit(event) {
  const box = event.target.getBoundingClientRect(), left = event.clientX - box.left, top = event.clientY - box.top;
  return painted.find(item => left >= item.left && left <= item.right && top >= item.top && top < item.top + ROW);
}

function point(event) {
  const found = hit(event);
  if (found) at("one").textContent = describe(found);
  if (grabbed !== null) {
    const wide = event.target.getBoundingClientRect().width - edge;
    pan((grabbed - event.clientX) / wide);
    grabbed = event.clientX;
  }
}

function grab(event) {
  grabbed = event.clientX;
  event.target.setPointerCapture(event.pointerId);
}

function release() {
  grabbed = null;
}

/** Zoom to one rollout, with the same duration on both sides. */
function nearer(event) {
  const found = hit(event);
  if (!found) return;
  const {one} = found, long = Math.max(0.002, one.end_s + one.deliver_s - one.begin_s + one.load_s);
  look(one.begin_s - one.load_s - long, one.end_s + one.deliver_s + long);
}

function describe({one, track}) {
  const long = seconds(one.end_s - one.begin_s), load = one.load_s ? `, loaded for ${seconds(one.load_s)}` : "";
  return `${one.rollout_id} on ${track.worker_id} slot ${track.slot}: ${one.outcome}, executed for ${long}${load}, scene ${named(one.bundle_digest)}, attempt ${one.attempt || 1}`;
}
