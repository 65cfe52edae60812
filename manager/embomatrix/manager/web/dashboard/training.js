// Training: reward by tier, success, zero-variance groups, time, and sampled plans with their results.
import {Refused, ask} from "./ask.js";
import {chart} from "./charts.js";
import {asked, at, categoryWords, clock, count, counted, decoded, h, none, put, seconds, share, table} from "./dom.js";
import {sampledPlans} from "./parts.js";

const CHARTS = [
  ["tiers", "Reward by tier", "mean per step", {reward: "all", reward_goal: "goal", reward_relevance: "relevance", reward_format: "format"}],
  ["success", "Success", "share of rollouts", {success: "all"}, "success_by_category/"],
  ["groups", "Groups and plans", "shares", {zero_variance_groups: "zero-variance groups", well_formed: "well formed", clipped: "clipped tokens"}],
  ["spread", "Entropy and distance", "nats per token", {entropy: "entropy", kl: "KL to the reference", kl_to_old: "KL to the sampling policy"}],
  ["plans", "Plan length", "executed steps", {plan_steps: "steps per plan"}],
  ["loss", "Imitation", "loss per token", {loss: "loss", validation: "validation loss"}],
];
const TILES = [["step", "Step"], ["reward", "Reward"], ["solved", "Success"], ["flat", "Zero-variance groups"], ["entropy", "Entropy"], ["long", "Plan length"]];
/** Figure of each tile but the first, whose latest values are averaged. */
const MEANS = {reward: "reward", solved: "success", flat: "zero_variance_groups", entropy: "entropy", long: "plan_steps"};
const LATEST = 10;
/** Run of the page's address, whose reports the manager may have on disk only. */
let wanted = "";
let run = "", seen = "", drawn = {}, report = null;
/** Raised when the page is opened or closed: answers to an earlier page are not shown. */
let turn = 0;
/** Page of one plan, if the address names one. */
let inner = null;

export async function open(main) {
  turn += 1;
  const [named, plan] = asked().split("&").map(decoded);
  run = wanted = named;
  seen = ""; drawn = {}; report = null; inner = null;
  if (plan) {
    inner = await import("./sampled.js");
    inner.open(main, named, plan);
    return;
  }
  main.replaceChildren(
    h("section", {}, h("h2", {}, "Training ", h("small", {id: "when"})),
      h("div", {class: "bar"}, h("select", {id: "run", "aria-label": "run", onchange: event => { run = event.target.value; dispatchEvent(new Event("embomatrix-changed")); }}))),
    h("div", {id: "nothing", class: "wide"}),
    ...TILES.map(([id, title]) => h("section", {class: "tile", hidden: true}, h("h2", {}, title), h("b", {id}, "–"), h("span", {id: `${id}note`}, ""))),
    ...CHARTS.map(([id, title, note]) => h("section", {class: "half", hidden: true}, h("h2", {}, `${title} `, h("small", {}, note)), h("div", {id, role: "img", "aria-label": `${title}, ${note}`}))),
    h("section", {class: "half", hidden: true}, h("h2", {}, "Time by activity"), h("div", {id: "spent"})),
    h("section", {class: "half", hidden: true}, h("h2", {}, "Success on held-out tasks"), h("div", {id: "heldout"})),
    h("section", {hidden: true}, h("h2", {}, "Plans of one task ", h("small", {id: "which"})), h("div", {id: "sampled"})));
}

export function close() {
  turn += 1;
  inner?.close();
  clear();
}

function clear() {
  for (const one of Object.values(drawn)) one.close();
  drawn = {};
}

export async function show({training}) {
  if (inner) { await inner.show(); return; }
  if (!training.some(one => one.run_id === run) && (!run || run !== wanted)) run = training[0]?.run_id ?? "";
  if (!run && report) {  // another manager leads, and no trainer has reported to it yet
    close();
    await open(at("main"));
  }
  const archived = wanted && !training.some(one => one.run_id === wanted) ? [report?.run.run_id === wanted ? report.run : {run_id: wanted, name: "", revision: 1}] : [];
  const every = [...archived, ...training];
  put(at("run"), every.map(one => h("option", {value: one.run_id, selected: one.run_id === run}, one.name || one.run_id)));
  at("run").hidden = !run;
  put(at("nothing"), run ? [] : h("section", {}, none("No trainer has reported yet. Start one with embomatrix train, and --manager if the manager is on another machine.")));
  const view = every.find(one => one.run_id === run);
  if (!view || seen === `${run} ${view.revision}`) return;
  const mine = turn, chosen = run;
  let fresh;
  try {
    fresh = await ask(`training/${encodeURIComponent(chosen)}`);
  } catch (error) {
    if (!(error instanceof Refused) || !archived.length) throw error;
    if (mine === turn && chosen === run) put(at("nothing"), h("section", {}, none(error.message)));
    return;
  }
  // The viewer may have chosen another run, or left the page.
  if (mine !== turn || chosen !== run) return;
  if (report?.run.run_id !== run) clear();
  report = fresh;
  seen = `${run} ${fresh.run.revision}`;
  draw(fresh);
}

function draw({run: view, phases, plans, plans_step}) {
  for (const section of at("main").querySelectorAll("section[hidden]")) section.hidden = false;
  const named = Object.fromEntries(phases.map(phase => [phase.phase, phase]));
  const grpo = named.grpo ?? {steps: [], figures: {}};
  at("when").textContent = `${view.phase.replace("grpo", "GRPO")}, step ${count(view.step)}, reported at ${clock(view.reported_s)}`;
  tiles(grpo);
  for (const [id, , , names, prefix] of CHARTS) {
    const phase = id === "loss" ? named.imitation : grpo;
    lines(id, phase ?? {steps: [], figures: {}}, names, prefix);
  }
  spent(grpo.figures);
  heldout(named);
  at("which").textContent = plans.length ? `with the largest reward differences in step ${count(plans_step)}: ${plans[0].instruction}` : "";
  put(at("sampled"), plans.length ? sampledPlans(view.run_id, plans) : none("No plans yet."));
}

function tiles({steps, figures}) {
  // Some figures are not reported with every step.
  const latest = name => (figures[name] ?? []).filter(value => value !== null).slice(-LATEST);
  const mean = name => latest(name).length ? latest(name).reduce((a, b) => a + b, 0) / latest(name).length : null;
  const fixed = (name, digits) => mean(name) === null ? "–" : mean(name).toFixed(digits);
  const part = name => mean(name) === null ? "–" : share(mean(name), 1);
  const texts = {step: steps.length ? count(steps.at(-1)) : "–", reward: fixed(MEANS.reward, 2), solved: part(MEANS.solved), flat: part(MEANS.flat), entropy: fixed(MEANS.entropy, 3), long: fixed(MEANS.long, 1)};
  for (const [id, text] of Object.entries(texts)) at(id).textContent = text;
  for (const [id, name] of Object.entries(MEANS)) at(`${id}note`).textContent = latest(name).length ? `mean of ${counted(latest(name).length, "step")}` : "";
  at("stepnote").textContent = mean("seconds") === null ? "" : `${seconds(mean("seconds"))} each`;
}

/** Rebuild the chart when a line is added; otherwise add points. */
function lines(id, {steps, figures}, names, prefix = null) {
  const more = prefix ? Object.keys(figures).filter(name => name.startsWith(prefix)).sort() : [];
  const found = [...Object.keys(names).filter(name => name in figures), ...more];
  at(id).closest("section").hidden = !found.length;
  if (!found.length) return;
  const labels = found.map(name => names[name] ?? categoryWords(name.slice(prefix.length)));
  if (drawn[id]?.lines.join() !== labels.join()) {
    drawn[id]?.close();
    drawn[id] = chart(at(id), labels);
  }
  drawn[id].draw(steps, found.map(name => figures[name]));
}

function spent(figures) {
  const latest = Object.entries(figures).filter(([name]) => name.startsWith("spent_s/"))
    .map(([name, values]) => [name.slice("spent_s/".length), values.findLast(value => value !== null) ?? 0]).sort((a, b) => b[1] - a[1]);
  const all = latest.reduce((sum, [, s]) => sum + s, 0);
  const rows = latest.map(([name, s]) => h("tr", {}, h("td", {class: "fit"}, name), h("td", {}, h("span", {class: "share", style: `width:${(100 * s / (all || 1)).toFixed(1)}%`})),
    h("td", {class: "n fit"}, share(s, all)), h("td", {class: "n fit"}, seconds(s))));
  put(at("spent"), rows.length ? table(["activity", "", ["share", "n"], ["time", "n"]], rows, "time by activity") : none("No data yet."));
}

function heldout(named) {
  const times = ["before GRPO", "after GRPO"], successes = times.map(when => named[`success ${when}`]?.figures);
  const groups = [...new Set(successes.flatMap(figures => Object.keys(figures ?? {})))].sort((a, b) => (b === "all") - (a === "all") || a.localeCompare(b));
  const cell = (figures, group) => figures?.[group]?.at(-1) === undefined ? "–" : share(figures[group].at(-1), 1);
  const rows = groups.map(group => h("tr", {}, h("td", {}, group === "all" ? "all tasks" : categoryWords(group)), successes.map(figures => h("td", {class: "n"}, cell(figures, group)))));
  put(at("heldout"), rows.length ? table(["tasks", ...times.map(when => [when, "n"])], rows, "held-out success") : none("Not evaluated. Datasets with held-out tasks are evaluated before the first and after the last step."));
}
