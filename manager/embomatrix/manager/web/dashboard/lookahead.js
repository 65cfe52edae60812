// Look-ahead grid: coming steps by scenes, with loading states. The selected cell is described in words.
import {at, counted, h, none, put} from "./dom.js";
import {named, worded} from "./names.js";
import {alike} from "./parts.js";

const STEPS = 24;
const COLUMNS = 60;
const KINDS = [["warm", "warm"], ["warming", "warming"], ["queued", "cold"], ["unplaceable", "fits on no worker"]];
const WORDS = Object.fromEntries(KINDS);
const SWATCH = {warm: "warm", warming: "warming", queued: "queued", unplaceable: "bad"};

const HINT = "Each cell shows the number of rollouts, and ×2 if two workers hold the scene. Point at a cell, or move there with Tab and the arrow keys, for details.";
const MOVES = {ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0]};
let chosen = "", labels = {};

export function open(main) {
  chosen = "";
  const legend = KINDS.map(([kind, word]) => [h("i", {style: `background:var(--${SWATCH[kind]})`}), word]);
  main.replaceChildren(
    h("section", {}, h("h2", {}, "Scenes of coming steps ", h("small", {id: "sum"}), h("span", {class: "legend"}, legend)), h("p", {id: "cell", class: "muted", role: "status"}), h("div", {id: "ahead"})));
  at("ahead").addEventListener("keydown", walk);
  for (const kind of ["pointerover", "click", "focusin"]) at("ahead").addEventListener(kind, choose);
}

export function show({lookahead, runs}) {
  const cells = lookahead.flatMap(step => step.cells), warm = cells.filter(cell => cell.warmth === "warm").length;
  at("sum").textContent = cells.length ? `${warm} of ${counted(cells.length, "cell")} warm` : "";
  const names = Object.fromEntries(runs.map(run => [run.run_id, run.name || run.run_id]));
  labels = {};
  const parts = alike(lookahead, step => [step.run_id]).map(steps => {
    const run = steps[0].run_id;
    return [h("h3", {}, names[run] ?? run), grid(run, steps), problems(steps)];
  });
  put(at("ahead"), parts.length && lookahead.length ? parts : none("No scenes announced. A trainer announces the scenes of its coming steps."));
  say(lookahead.length > 0);
}

function choose(event) {
  const key = event.target.dataset?.key;
  if (!key) return;
  chosen = key;
  say(true);
}

function say(any) {
  const words = any ? labels[chosen] ?? HINT : "";
  if (at("cell").textContent !== words) at("cell").textContent = words;
}

/** Arrow keys move between cells; Tab enters a grid once. */
function walk(event) {
  const place = event.target.closest("td"), move = MOVES[event.key];
  if (!place || !move) return;
  event.preventDefault();
  const rows = [...place.closest("tbody").rows], [down, right] = move;
  let row = rows.indexOf(place.parentNode), column = place.cellIndex;
  do { row += down; column += right; } while (rows[row]?.cells[column] && !rows[row].cells[column].querySelector("button"));
  rows[row]?.cells[column]?.querySelector("button")?.focus();
}

function problems(steps) {
  const found = new Map(steps.flatMap(step => step.cells.filter(cell => cell.problem).map(cell => [cell.bundle_digest, cell.problem])));
  return [...found].map(([scene, problem]) => h("p", {class: "bad message"}, h("code", {}, named(scene)), ` ${worded(problem.replace(`scene ${scene} `, ""))}`));
}

function grid(run, steps) {
  const every = [...new Set(steps.flatMap(step => step.cells.map(cell => cell.bundle_digest)))], scenes = every.slice(0, COLUMNS);
  const left = [[steps.length - STEPS, "later step"], [every.length - COLUMNS, "more scene"]].filter(([n]) => n > 0).map(([n, noun]) => counted(n, noun));
  let entry = 0;
  const rows = steps.slice(0, STEPS).map(step => {
    const of = Object.fromEntries(step.cells.map(cell => [cell.bundle_digest, cell]));
    return h("tr", {}, h("th", {scope: "row"}, `step ${step.step}`), scenes.map(scene => h("td", {}, of[scene] && box(`${run} ${step.step} ${scene}`, of[scene], step.step, entry++ > 0))));
  });
  const heads = scenes.map(scene => h("th", {scope: "col", title: scene}, h("span", {}, named(scene))));
  return h("div", {class: "scroll", tabindex: "0", role: "region", "aria-label": "steps by scenes"},
    h("table", {class: "grid"}, h("thead", {}, h("tr", {}, h("td"), heads)), h("tbody", {}, rows)),
    left.length > 0 && none(`Not shown: ${left.join(", ")}.`));
}

function box(key, cell, step, inner) {
  const held = cell.worker_ids.length ? `on ${cell.worker_ids.join(", ")}` : "on no worker";
  labels[key] = `Step ${step}, ${named(cell.bundle_digest)}: ${counted(cell.count, "rollout")}, ${WORDS[cell.warmth]}, ${held}`;
  return h("button", {type: "button", class: `cell ${cell.warmth}`, "data-key": key, "aria-label": labels[key], title: labels[key], tabindex: inner && "-1"},
    `${cell.count}${cell.worker_ids.length > 1 ? `\u00a0×${cell.worker_ids.length}` : ""}`);
}
