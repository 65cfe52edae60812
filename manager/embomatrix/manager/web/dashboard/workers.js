// Workers: scenes, slots, state, machine, and the commands drain and resume. Each has a page of its own.
import {asked, at, count, decoded, gauge, h, lastPage, none, put, seconds, share, table} from "./dom.js";
import {named, worded} from "./names.js";
import {GONE, command, learnRole, refusal, showRefusal, steer, steering} from "./role.js";

const ROWS = 50, CHIPS = 6;
const STATES = ["", "ready", "paused", "draining", "suspect", "lost", "quarantined", "left"];
const filters = {state: "", search: "", offset: 0, limit: ROWS};
let inner = null;

export const query = () => filters;
/** True if a filter or a later page is selected. */
export const asksMore = () => Boolean(filters.state || filters.search || filters.offset);

export async function open(main) {
  inner = null;
  learnRole().catch(() => {}); // the first refresh repeats the request
  if (asked()) {
    const name = decoded(asked());
    inner = await import("./worker.js");
    inner.open(main, name);
    return;
  }
  const options = STATES.map(state => h("option", {value: state, selected: state === filters.state}, state || "all states"));
  main.replaceChildren(h("section", {},
    h("h2", {}, "Workers ", h("small", {id: "total"})),
    h("div", {class: "bar"},
      h("input", {type: "search", maxlength: 128, placeholder: "name or label", "aria-label": "search by name or label", value: filters.search, oninput: event => ask({search: event.target.value})}),
      h("select", {"aria-label": "state", onchange: event => ask({state: event.target.value})}, options),
      h("button", {id: "before", type: "button", onclick: () => ask({offset: Math.max(0, filters.offset - ROWS)})}, "Previous"),
      h("button", {id: "after", type: "button", onclick: () => ask({offset: filters.offset + ROWS})}, "Next"),
      h("button", {id: "dispatch", type: "button"}, "Pause dispatch"),
      h("span", {id: "allowed", class: "muted"}), h("span", {id: "answer", class: "bad", role: "alert"})),
    h("div", {id: "workers"})));
}

export function close() {
  inner?.close();
}

export async function show({workers, paused}) {
  if (inner) { await inner.show(); return; }
  await learnRole();
  if (!at("workers")) return;
  if (!workers.items.length && workers.total) {
    ask({offset: lastPage(workers.total, ROWS)});
    return;
  }
  showRefusal();
  const last = Math.min(workers.total, workers.offset + workers.items.length);
  at("total").textContent = workers.total ? `${count(workers.offset + 1)} to ${count(last)} of ${count(workers.total)}` : "";
  at("before").disabled = workers.offset === 0;
  at("after").disabled = last >= workers.total;
  at("dispatch").textContent = paused ? "Resume dispatch" : "Pause dispatch";
  at("dispatch").disabled = Boolean(refusal());
  at("dispatch").title = refusal();
  at("dispatch").onclick = () => steer(`dispatch/${paused ? "resume" : "pause"}`);
  const headings = ["worker", "state", "slots", "scenes", ["scene memory", "wideonly"], ["completed", "n"], "machine", ["last heard", "n wideonly"], ""];
  const emptyText = filters.state || filters.search ? "No worker matches." : "No workers yet. Start one with: embomatrix worker run";
  put(at("workers"), workers.items.length ? table(headings, workers.items.map(row), "workers", "loose") : none(emptyText));
  for (const button of at("workers").querySelectorAll("button")) button.onclick = () => steer(button.dataset.path);
}

function row(w) {
  const used = w.residents.reduce((sum, r) => sum + r.memory_mb, 0);
  const word = steering(w.state), order = word.toLowerCase(), labels = Object.entries(w.labels).map(([name, value]) => `${name} ${value}`);
  return h("tr", {},
    h("td", {class: "named"}, h("a", {href: `#workers?${encodeURIComponent(w.worker_id)}`}, w.worker_id), w.gpu && h("span", {class: "muted"}, ` ${w.gpu}`), labels.length > 0 && h("div", {class: "muted labels"}, labels.join(", "))),
    h("td", {class: w.reason ? "why" : "fit"}, h("span", {class: `dot ${w.state}`}), w.state, w.reason && h("span", {class: "muted"}, ` ${w.reason}`)),
    h("td", {class: "fit"}, slots(w)),
    h("td", {"data-name": w.residents.length || w.loads.length ? false : "scenes"}, scenes(w)),
    h("td", {class: "wideonly"}, gauge(used, w.memory_mb, `${count(Math.round(used))} of ${count(w.memory_mb)} MB`)),
    h("td", {class: "n", "data-name": "completed"}, count(w.completed)), h("td", {class: "fit", "data-name": "machine"}, machine(w)),
    h("td", {class: "n muted wideonly"}, w.silent_s < 5 ? "now" : `${seconds(Math.round(w.silent_s))} ago`),
    h("td", {class: "fit act"}, !GONE.includes(w.state) && h("button", command({class: "small", type: "button", "data-path": `workers/${encodeURIComponent(w.worker_id)}/${order}`, "aria-label": `${order} ${w.worker_id}`}), word)));
}

/** Cores, and the use of CPU and memory by all programs of the machine. */
function machine(w) {
  const cores = `${count(w.cores)} core${w.cores === 1 ? "" : "s"}`;
  if (!w.host) return cores;
  return [h("div", {class: "wideonly"}, cores), `CPU ${share(w.host.cpu_share, 1)}, memory ${share(w.host.memory_used_mb, w.host.memory_mb)}`];
}

function slots(w) {
  if (w.slots > 64) return `${w.busy}/${w.slots}`;
  const boxes = Array.from({length: w.slots}, (_, i) => h("span", {class: i < w.busy ? "slot busy" : "slot"}));
  return h("span", {class: "slots", style: `--n:${w.slots}`, role: "img", "aria-label": `${w.busy} of ${w.slots} busy`, title: `${w.busy} of ${w.slots} busy`}, boxes);
}

function scenes(w) {
  const states = {};
  for (const r of w.residents) states[r.state] = (states[r.state] || 0) + 1;
  if (w.loads.length) states["requested"] = w.loads.length;
  const chips = [
    ...w.residents.map(r => h("span", {class: `chip ${r.state}`, title: r.error ? `${r.bundle_digest}: ${r.error}` : `${r.bundle_digest}, loaded in ${seconds(r.load_s)}`}, `${named(r.bundle_digest)}${r.load_s ? ` ${seconds(r.load_s)}` : ""}`)),
    ...w.loads.map(digest => h("span", {class: "chip", title: digest}, named(digest))),
  ];
  if (!chips.length) return h("span", {class: "muted"}, "none");
  const counts = Object.entries(states).map(([state, n]) => `${n} ${state}`).join(", ");
  const broken = w.residents.find(r => r.error);
  return [`${counts} `, chips.slice(0, CHIPS), chips.length > CHIPS && h("span", {class: "muted wideonly"}, `and ${count(chips.length - CHIPS)} more`), broken && h("div", {class: "bad message"}, worded(broken.error))];
}

function ask(changes) {
  Object.assign(filters, {offset: 0}, changes);
  dispatchEvent(new Event("embomatrix-changed"));
}
