// Comparison of two runs: their stories, totals with differences, and curves on common axes.
import {Refused, ask} from "./ask.js";
import {chart} from "./charts.js";
import {at, h, put, seconds, signed, table} from "./dom.js";
import {totalText} from "./parts.js";
import {savePage} from "./save.js";

const CURVES = [["reward", "Reward per step"], ["success", "Success per step"]];
let ids = [], drawn = [], details = null;
/** Raised when the page is opened or closed: answers to an earlier page are not shown. */
let turn = 0;

export function open(main, ...both) {
  turn += 1;
  ids = both.slice(0, 2); drawn = []; details = null;
  main.replaceChildren(
    h("section", {}, h("h2", {}, h("a", {href: "#runs", class: "back"}, "All runs"), h("small", {}, ids.join(", "))), h("p", {class: "instruction", id: "title"}, "Loading the runs…"),
      h("div", {class: "bar"}, h("button", {type: "button", onclick: () => savePage(`${ids.join("-")}.html`, at("title").textContent)}, "Download comparison"))),
    h("section", {hidden: true}, h("h2", {}, "Totals"), h("div", {id: "totals"})),
    h("section", {hidden: true}, h("h2", {}, "Completed rollouts per second ", h("small", {}, "since each run was opened")), h("div", {id: "speed", role: "img", "aria-label": "completed rollouts per second of both runs"})),
    ...CURVES.map(([name, words]) => h("section", {class: "half curve", hidden: true}, h("h2", {}, words), h("div", {id: `curve-${name}`, role: "img", "aria-label": `${words} of both runs`}))),
    h("section", {class: "half", hidden: true}, h("h2", {id: "first"}), h("div", {id: "story0"})), h("section", {class: "half", hidden: true}, h("h2", {id: "second"}), h("div", {id: "story1"})));
}

export function close() {
  turn += 1;
  for (const one of drawn) one.close();
  drawn = [];
}

/** Runs are compared as they were when the page was opened. */
export async function show() {
  if (details) return;
  const mine = turn, paths = ids.map(encodeURIComponent);
  try {
    const found = await Promise.all(paths.map(path => ask(`runs/${path}`)));
    const trained = await Promise.all(found.map((one, i) => one.trained ? ask(`training/${paths[i]}`) : null));
    if (mine !== turn || details) return;
    details = found;
    draw(trained);
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    if (mine === turn) at("title").textContent = error.message;
  }
}

/** Names of the runs, with their ids if they have one name. */
function names() {
  const plain = details.map(({run}) => run.name || run.run_id);
  return plain[0] === plain[1] ? details.map(({run}) => `${run.name} (${run.run_id})`) : plain;
}

function draw(trained) {
  const both = names();
  for (const section of at("main").querySelectorAll("section[hidden]:not(.curve)")) section.hidden = false;
  at("title").textContent = both.join(" and ");
  put(at("totals"), totals(both));
  const step_s = Math.max(...details.map(({series}) => series.step_s)), rates = details.map(({series}) => resampled(series, step_s));
  const long = Math.max(...rates.map(one => one.length)), at_s = Array.from({length: long}, (_, i) => i * step_s);
  lines("speed", both, at_s, rates.map(one => at_s.map((_, i) => one[i] ?? null)), {across: "since it was opened", words: tick => tick ? seconds(tick) : "0"});
  for (const [name] of CURVES) curve(name, both, trained);
  for (const [i, heading] of ["first", "second"].entries()) {
    at(heading).textContent = both[i];
    put(at(`story${i}`), details[i].story.map(sentence => h("p", {class: "sentence"}, sentence)));
  }
}

/** Completed rollouts per second in longer steps. Step lengths are doubled steps of one length, so whole steps are added. */
function resampled({completed, step_s}, longer_s) {
  const many = Math.max(1, Math.round(longer_s / step_s));
  return Array.from({length: Math.ceil(completed.length / many)}, (_, i) => completed.slice(i * many, (i + 1) * many).reduce((a, b) => a + b, 0) / longer_s);
}

function curve(name, both, trained) {
  const phases = trained.map(one => one?.phases.find(phase => phase.phase === "grpo")), present = phases.filter(phase => phase?.figures[name]);
  at(`curve-${name}`).closest("section").hidden = !present.length;
  if (!present.length) return;
  const steps = [...new Set(present.flatMap(phase => phase.steps))].sort((a, b) => a - b);
  const columns = phases.map(phase => { const of = Object.fromEntries((phase?.steps ?? []).map((step, i) => [step, phase.figures[name]?.[i] ?? null])); return steps.map(step => of[step] ?? null); });
  lines(`curve-${name}`, both, steps, columns);
}

function lines(id, both, across, columns, options) {
  const one = chart(at(id), both, options);
  one.draw(across, columns);
  drawn.push(one);
}

function totals(both) {
  const of = details.map(detail => Object.fromEntries(detail.totals.map(total => [total.name, total])));
  const every = [...new Set(details.flatMap(detail => detail.totals.map(total => total.name)))];
  const rows = every.map(name => {
    const [first, second] = of.map(totals => totals[name]), known = first ?? second;
    const [words, better] = difference(first, second);
    return h("tr", {}, h("td", {}, name), [first, second].map((total, i) => h("td", {class: "n", "data-name": both[i]}, total ? totalText(total) : "–")),
      h("td", {class: "n", "data-name": "difference"}, words), h("td", {class: better ? "reached" : "bad"}, better === null || known.aim === "none" ? "" : better ? "better" : "worse"));
  });
  return table(["total", ...both.map(name => [name, "n"]), ["difference", "n"], ""], rows, "totals of both runs", "loose");
}

/** Difference of the second run from the first, in words, and whether it is an improvement; null without a direction. */
function difference(first, second) {
  if (!first || !second || first.value === null || second.value === null) return ["–", null];
  const change = second.value - first.value, sign = change > 0 ? "+" : "", {unit, aim} = first;
  if (!change) return ["same", null];
  const better = aim === "none" ? null : (change > 0) === (aim === "up");
  if (unit === "share") return [signed(`${sign}${(100 * change).toFixed(1)}\u00a0points`), better];
  if (unit === "count" || unit === "number") return [signed(`${sign}${unit === "count" ? change.toLocaleString("en") : change.toFixed(2)}`), better];
  return [first.value ? signed(`${sign}${(100 * change / first.value).toFixed(0)}\u00a0%`) : "–", better];
}
