// Coming steps by scenes: how far each scene is, and who holds it.
import {at, count, h, none, put} from "./dom.js";
import {named} from "./names.js";

const STEPS = 24;
const COLUMNS = 60;
const KINDS = [["warm", "warm"], ["warming", "warming"], ["queued", "cold"], ["unplaceable", "no worker can hold it"]];
const SWATCH = {warm: "warm", warming: "warming", queued: "queued", unplaceable: "bad"};

export function open(main) {
  const legend = KINDS.map(([kind, word]) => [h("i", {style: `background:var(--${SWATCH[kind]})`}), word]);
  main.replaceChildren(
    h("section", {}, h("h2", {}, "What coming steps need ", h("small", {id: "sum"}), h("span", {class: "legend"}, legend)), h("div", {id: "ahead"})));
}

export function show({lookahead, runs}) {
  const cells = lookahead.flatMap(step => step.cells), warm = cells.filter(cell => cell.warmth === "warm").length;
  at("sum").textContent = cells.length ? `${warm} of ${cells.length} scenes are warm` : "";
  const names = Object.fromEntries(runs.map(run => [run.run_id, run.name || run.run_id]));
  const byRun = Map.groupBy ? Map.groupBy(lookahead, step => step.run_id) : new Map([["", lookahead]]);
  const parts = [...byRun].map(([run, steps]) => [h("h3", {}, names[run] ?? run), grid(steps), problems(steps)]);
  put(at("ahead"), parts.length && lookahead.length ? parts : none("Nothing announced. A trainer announces the scenes of its coming steps."));
}

function problems(steps) {
  const told = new Map(steps.flatMap(step => step.cells.filter(cell => cell.problem).map(cell => [cell.bundle_digest, cell.problem])));
  return [...told].map(([scene, problem]) => h("p", {class: "bad message"}, h("code", {}, named(scene)), ` ${problem.replace(`scene ${scene} `, "")}`));
}

function grid(steps) {
  const scenes = [...new Set(steps.flatMap(step => step.cells.map(cell => cell.bundle_digest)))].slice(0, COLUMNS);
  const rows = steps.slice(0, STEPS).map(step => {
    const of = Object.fromEntries(step.cells.map(cell => [cell.bundle_digest, cell]));
    return h("tr", {}, h("th", {scope: "row"}, `step ${step.step}`), scenes.map(scene => h("td", {}, of[scene] && box(of[scene]))));
  });
  const heads = scenes.map(scene => h("th", {scope: "col", title: scene}, h("span", {}, named(scene))));
  return h("div", {class: "scroll", tabindex: "0", role: "region", "aria-label": "steps by scenes"},
    h("table", {class: "grid"}, h("thead", {}, h("tr", {}, h("td"), heads)), h("tbody", {}, rows)));
}

function box(cell) {
  const held = cell.worker_ids.length ? `on ${cell.worker_ids.join(", ")}` : "on no worker";
  const words = `${named(cell.bundle_digest)}: ${count(cell.count)} rollouts, ${cell.warmth}, ${held}`;
  return h("span", {class: `cell ${cell.warmth}`, title: words, "aria-label": words}, `${cell.count}${cell.worker_ids.length > 1 ? ` ×${cell.worker_ids.length}` : ""}`);
}
