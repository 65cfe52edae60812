// One worker: its state, its machine's CPU and memory in the last half hour, its last log lines, and its scenes.
import {Refused, ask} from "./ask.js";
import {chart} from "./charts.js";
import {at, count, h, none, put, seconds, share, table} from "./dom.js";
import {named, worded} from "./names.js";
import {GONE, command, learnRole, showRefusal, steer, steering} from "./role.js";

const LOOK_EVERY = 2;
/** Ticks at whole minutes of the day. */
const MINUTES = [60, 120, 300, 600, 1800];
const timeOfDay = at_s => `${new Date(at_s * 1000).toISOString().slice(11, 16)} UTC`;
/** Scenes that are listed at first. */
const SCENES = 12;
let name = "", looks = 0, drawn = {}, held = null, whole = false;
/** Raised when the page is opened or closed: answers to an earlier page are not shown. */
let turn = 0;

export function open(main, worker_id) {
  turn += 1;
  name = worker_id; looks = 0; drawn = {}; whole = false;
  main.replaceChildren(
    h("section", {}, h("h2", {}, h("a", {href: "#workers"}, "All workers")), h("p", {class: "instruction", id: "title"}, worker_id),
      h("div", {class: "bar"}, h("span", {id: "command"}), h("span", {id: "allowed", class: "muted"}), h("span", {id: "answer", class: "bad", role: "alert"})), h("div", {id: "facts"})),
    h("section", {class: "half", hidden: true}, h("h2", {}, "CPU ", h("small", {id: "cpunow"})), h("div", {id: "cpu", role: "img", "aria-label": "CPU use of the machine in the last half hour"})),
    h("section", {class: "half", hidden: true}, h("h2", {}, "Memory ", h("small", {id: "memorynow"})), h("div", {id: "memory", role: "img", "aria-label": "memory use of the machine in the last half hour"})),
    h("section", {class: "wide machine", hidden: true}, none("The worker does not report the use of its machine: it is older than this manager, or has joined just now.")),
    h("section", {hidden: true}, h("h2", {}, "Log ", h("small", {}, "last lines of the worker, without secrets; times are UTC")), h("div", {id: "log"})),
    h("section", {hidden: true}, h("h2", {}, "Scenes ", h("small", {id: "held"})), h("div", {id: "scenes"}), h("div", {class: "bar"}, h("button", {type: "button", id: "all", hidden: true, onclick: () => { whole = true; drawScenes(); }}))));
}

/** Draw the scenes that the worker holds: the first ones, or all on wish. A worker of a training run holds hundreds. */
function drawScenes() {
  const {residents, loads} = held, rows = [...residents.map(scene), ...loads.map(digest => h("tr", {}, h("td", {class: "named"}, h("code", {title: digest}, named(digest))), h("td", {class: "fit"}, "requested"), h("td"), h("td"), h("td")))];
  const shown = whole ? rows : rows.slice(0, SCENES);
  at("held").textContent = rows.length ? count(rows.length) : "";
  at("all").hidden = shown.length === rows.length;
  at("all").textContent = `Show all ${count(rows.length)}`;
  put(at("scenes"), rows.length ? table(["scene", "state", ["load time", "n"], ["memory", "n"], "message"], shown, "scenes of the worker", "loose") : none("It holds no scene."));
}

export function close() {
  turn += 1;
  for (const one of Object.values(drawn)) one.close();
  drawn = {};
}

export async function show() {
  if (looks % LOOK_EVERY) {
    looks += 1;
    return;
  }
  const mine = turn, path = `workers/${encodeURIComponent(name)}`;
  try {
    const [{worker, host}, {lines}] = await Promise.all([ask(path), ask(`${path}/log`), learnRole()]);
    if (mine !== turn) return;
    looks = 1;
    at("title").textContent = name;
    for (const id of ["scenes", "log"]) at(id).closest("section").hidden = false;
    about(worker);
    machine(worker, host);
    held = worker;
    drawScenes();
    put(at("log"), lines.length ? h("pre", {class: "log", tabindex: "0"}, lines.join("\n")) : none("The worker has sent no lines: it has joined just now, runs with --no-send-log, or is older than this manager."));
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    if (mine === turn) refused(error.message);
  }
}

/** Show why there are no facts, and none of the earlier ones. */
function refused(why) {
  looks = 1;
  at("title").textContent = why;
  for (const id of ["command", "facts"]) put(at(id));
  for (const id of ["cpu", "memory", "scenes", "log"]) at(id).closest("section").hidden = true;
  at("main").querySelector(".machine").hidden = true;
}

function about(w) {
  const word = steering(w.state), labels = Object.entries(w.labels).map(([key, value]) => `${key} ${value}`).join(", ");
  put(at("command"), GONE.includes(w.state) ? [] : h("button", command({type: "button"}), word));
  const button = at("command").querySelector("button");
  if (button) button.onclick = () => steer(`workers/${encodeURIComponent(name)}/${word.toLowerCase()}`, () => { looks = 0; });
  showRefusal();
  const facts = [["state", [h("span", {class: `dot ${w.state}`}), w.state, w.reason && ` (${w.reason})`]], ["slots", `${w.busy} of ${w.slots} busy${w.waiting ? `, ${count(w.waiting)} rollouts wait behind them` : ""}`],
    ["completed", count(w.completed)], ["cores", count(w.cores)], ["memory for scenes", `${count(w.memory_used_mb)} of ${count(w.memory_mb)} MB`], ["GPU", w.gpu], ["labels", labels],
    ["versions", Object.entries(w.versions).map(pair => pair.join(" ")).join(", ")], ["audited results", w.audited ? `${count(w.audited)}, ${count(w.audit_mismatches)} of them different` : ""],
    ["last heard", w.silent_s < 5 ? "now" : `${seconds(Math.round(w.silent_s))} ago`]];
  put(at("facts"), h("dl", {class: "facts"}, facts.filter(([, value]) => value).map(([key, value]) => h("div", {}, h("dt", {}, key), h("dd", {}, value)))));
}

function machine(worker, host) {
  const known = host.at_s.length > 0;
  for (const id of ["cpu", "memory"]) at(id).closest("section").hidden = !known;
  at("main").querySelector(".machine").hidden = known;
  if (!known) return;
  const options = {across: "from", words: timeOfDay, steps: MINUTES, fill: true, joined: false};
  drawn.cpu ??= chart(at("cpu"), ["% of all cores"], {...options, most: 100});
  drawn.memory ??= chart(at("memory"), ["MB used"], {...options, most: host.memory_mb});
  drawn.cpu.draw(host.at_s, [host.cpu_share.map(used => used === null ? null : 100 * used)]);
  drawn.memory.draw(host.at_s, [host.memory_used_mb]);
  at("cpunow").textContent = worker.host ? `${share(worker.host.cpu_share, 1)} of ${count(worker.cores)} cores now, by all programs` : "";
  at("memorynow").textContent = worker.host ? `${count(worker.host.memory_used_mb)} of ${count(worker.host.memory_mb)} MB now, by all programs` : "";
}

function scene(r) {
  return h("tr", {}, h("td", {class: "named"}, h("code", {title: r.bundle_digest}, named(r.bundle_digest))), h("td", {class: "fit"}, r.state),
    h("td", {class: "n", "data-name": "load time"}, r.load_s ? seconds(r.load_s) : ""), h("td", {class: "n", "data-name": "memory"}, r.memory_mb ? `${count(Math.round(r.memory_mb))} MB` : ""), h("td", {class: "message"}, worded(r.error)));
}
