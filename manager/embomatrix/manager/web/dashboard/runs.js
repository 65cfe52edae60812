// Runs by name, open and closed. Two of them can be compared; each has a page of its own.
import {ask} from "./ask.js";
import {asked, at, count, decoded, h, lastPage, moment, none, put, seconds, table} from "./dom.js";

const ROWS = 50, TYPING_MS = 250, LOOK_EVERY = 3;
const STATES = [["all", "open and closed"], ["open", "open"], ["closed", "closed"]];
const filters = {state: "all", search: "", offset: 0};
let chosen = [], inner = null, typed = 0, looks = 0, page = null;
/** Raised by each request for a page of runs, and when the page is opened or closed: answers of earlier requests are not shown. */
let asking = 0;

export async function open(main) {
  const ids = asked() ? asked().split("&").map(decoded) : [];
  inner = null; looks = 0; page = null; asking += 1;
  if (ids.length) {
    inner = await (ids.length > 1 ? import("./compare.js") : import("./run.js"));
    inner.open(main, ...ids);
    return;
  }
  main.replaceChildren(h("section", {}, h("h2", {}, "Runs ", h("small", {id: "total"})),
    h("div", {class: "bar"},
      h("input", {type: "search", maxlength: 128, placeholder: "name or id", "aria-label": "search by name or id", value: filters.search, oninput: event => { clearTimeout(typed); typed = setTimeout(() => turn({search: event.target.value}), TYPING_MS); }}),
      h("select", {"aria-label": "state", onchange: event => turn({state: event.target.value})}, STATES.map(([value, words]) => h("option", {value, selected: value === filters.state}, words))),
      h("button", {id: "before", type: "button", onclick: () => turn({offset: Math.max(0, filters.offset - ROWS)})}, "Previous"),
      h("button", {id: "after", type: "button", onclick: () => turn({offset: filters.offset + ROWS})}, "Next"),
      h("button", {id: "compare", type: "button", onclick: () => { location.hash = `#runs?${chosen.map(encodeURIComponent).join("&")}`; }}, "Compare"),
      h("span", {id: "picked", class: "muted", role: "status"})),
    h("div", {id: "runs"}, none("Loading the runs…"))));
  at("runs").addEventListener("change", pick);
}

export function close() {
  asking += 1;
  inner?.close();
  clearTimeout(typed);
}

export async function show(snapshot) {
  if (inner) { await inner.show(snapshot); return; }
  if (looks % LOOK_EVERY) looks += 1;
  else await look();
}

function turn(changes) {
  Object.assign(filters, {offset: 0}, changes);
  const mine = asking + 1;
  look().catch(error => { if (mine === asking) put(at("runs"), none(error.message)); });
}

async function look() {
  const mine = ++asking, found = await ask(`runs?${new URLSearchParams({...filters, limit: ROWS})}`);
  if (mine !== asking) return;
  if (!found.items.length && found.total) {
    filters.offset = lastPage(found.total, ROWS);
    await look();
    return;
  }
  page = found;
  looks = 1;
  list();
}

function list() {
  const last = page.offset + page.items.length, every = filters.search || filters.state !== "all";
  at("total").textContent = page.total ? `${count(page.offset + 1)} to ${count(last)} of ${count(page.total)}` : "";
  at("before").disabled = page.offset === 0;
  at("after").disabled = last >= page.total;
  at("compare").disabled = chosen.length !== 2;
  at("picked").textContent = chosen.length === 2 ? "" : `Tick ${chosen.length ? "another run" : "two runs"} to compare them.`;
  const headings = ["", "run", ["id", "wideonly"], "state", ["opened", "wideonly"], ["length", "n"], ["done", "n"], ["open", "n"], ["failed", "n"]];
  put(at("runs"), page.items.length ? table(headings, page.items.map(row), "runs", "loose") : none(every ? "No run matches." : "No run has been opened yet. A trainer opens one."));
  // A refresh that changes nothing keeps the old elements, whose ticks the viewer may have changed.
  for (const box of at("runs").querySelectorAll("input")) box.checked = chosen.includes(box.value);
}

function row(r) {
  const name = r.name || r.run_id, until_s = r.closed_s || page.at_s;
  return h("tr", {},
    h("td", {class: "fit"}, h("input", {type: "checkbox", value: r.run_id, "aria-label": `compare ${name} ${r.run_id}`})),
    h("td", {class: "named"}, h("a", {href: `#runs?${encodeURIComponent(r.run_id)}`}, name)), h("td", {class: "wideonly"}, h("code", {}, r.run_id)),
    h("td", {class: "fit"}, h("span", {class: `dot ${r.closed_s ? "" : "ready"}`}), r.closed_s ? "closed" : "open"), h("td", {class: "fit muted wideonly"}, moment(r.opened_s)),
    h("td", {class: "n", "data-name": "length"}, seconds(Math.max(1, until_s - r.opened_s))), h("td", {class: "n", "data-name": "done"}, count(r.stats.delivered)),
    h("td", {class: "n", "data-name": "open"}, count(r.pending)), h("td", {class: r.stats.infra_failures ? "n bad" : "n", "data-name": "failed"}, count(r.stats.infra_failures)));
}

/** Tick a run; of three, the first one is given up. */
function pick({target: box}) {
  chosen = box.checked ? [...chosen, box.value].slice(-2) : chosen.filter(id => id !== box.value);
  list();
}
