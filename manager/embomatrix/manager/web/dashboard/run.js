// One run, open or closed: its story, totals, speed, workers, failures, and plans. The page can be saved as a file.
import {Refused, ask} from "./ask.js";
import {chart} from "./charts.js";
import {at, count, counted, h, none, put, seconds, share, table} from "./dom.js";
import {failureParts, phaseTable, sampledPlans, totalText} from "./parts.js";
import {saveJson, savePage} from "./save.js";

const CURVES = [["reward", "Reward per step"], ["success", "Success per step"]];
const LOOK_EVERY = 3;
let run_id = "", detail = null, drawn = {}, looks = 0, trained = null;
/** Raised when the page is opened or closed: answers to an earlier page are not shown. */
let turn = 0;

export function open(main, id) {
  turn += 1;
  run_id = id; detail = trained = null; looks = 0; drawn = {};
  main.replaceChildren(
    h("section", {}, h("h2", {}, h("a", {href: "#runs", class: "back"}, "All runs"), h("small", {id: "id"}, id)), h("p", {class: "instruction", id: "title"}, "Loading the run…"),
      h("div", {id: "story"}), h("div", {class: "bar", id: "ways", hidden: true},
        h("button", {type: "button", onclick: () => savePage(`${run_id}.html`, detail.run.name || run_id)}, "Download report"), h("button", {type: "button", onclick: () => saveJson(`${run_id}.json`, detail)}, "Download figures"),
        h("a", {href: `#timeline?${encodeURIComponent(id)}`}, "Timeline"), h("a", {id: "curves", href: `#training?${encodeURIComponent(id)}`}, "Training"),
        h("label", {for: "other"}, "compare with"), h("select", {id: "other", onchange: event => { location.hash = `#runs?${encodeURIComponent(run_id)}&${encodeURIComponent(event.target.value)}`; }}))),
    h("div", {id: "totals", class: "wide tiles"}),
    h("section", {class: "most", hidden: true}, h("h2", {}, "Rollouts per second"), h("div", {id: "speed", role: "img", "aria-label": "completed and failed rollouts per second since the run was opened"})),
    h("section", {class: "third", hidden: true}, h("h2", {}, "Work by worker"), h("div", {id: "work"})),
    h("section", {hidden: true}, h("h2", {}, "Latency by phase"), h("div", {id: "phases"})),
    ...CURVES.map(([name, words]) => h("section", {class: "half curve", hidden: true}, h("h2", {}, words), h("div", {id: `curve-${name}`, role: "img", "aria-label": words}))),
    h("section", {hidden: true}, h("h2", {}, "Failures ", h("small", {}, "leases and rollouts without a result")), h("div", {id: "lost"})),
    h("section", {hidden: true}, h("h2", {}, "Plans of one task ", h("small", {id: "which"})), h("div", {id: "sampled"})));
}

export function close() {
  turn += 1;
  for (const one of Object.values(drawn)) one.close();
  drawn = {};
}

export async function show() {
  if (detail?.run.closed_s) return;
  if (looks % LOOK_EVERY) {
    looks += 1;
    return;
  }
  const mine = turn, path = encodeURIComponent(run_id);
  try {
    const [fresh, others] = await Promise.all([ask(`runs/${path}`), ask("runs?state=all")]);
    const reports = fresh.trained ? await ask(`training/${path}`) : null;
    if (mine !== turn) return;
    looks = 1;
    detail = fresh; trained = reports;
    draw(others.items.filter(run => run.run_id !== run_id));
  } catch (error) {
    if (!(error instanceof Refused) || detail) throw error;
    if (mine !== turn) return;
    looks = 1;
    at("title").textContent = error.message;
  }
}

function draw(others) {
  const {run, story, totals, series, workers, phases, failures} = detail;
  for (const section of at("main").querySelectorAll("section[hidden]:not(.curve)")) section.hidden = false;
  at("ways").hidden = false;
  at("title").textContent = run.name || run.run_id;
  at("id").textContent = `${run.run_id}, EmboMatrix ${detail.version}`;
  put(at("story"), story.map(sentence => h("p", {class: "sentence"}, sentence)));
  at("curves").hidden = !detail.trained;
  put(at("other"), h("option", {value: ""}, others.length ? "choose a run" : "there is no other run"), others.map(one => h("option", {value: one.run_id}, `${one.name || one.run_id} (${one.run_id})`)));
  at("other").disabled = !others.length;
  put(at("totals"), totals.map(total => h("section", {class: "tile"}, h("h2", {}, total.name), h("b", {class: total.name === "infrastructure failures" && total.value ? "bad" : ""}, totalText(total)))));
  drawn.speed ??= chart(at("speed"), ["completed", "failed"], {across: "since it was opened", words: tick => tick ? seconds(tick) : "0"});
  drawn.speed.draw(series.completed.map((_, i) => i * series.step_s), [series.completed, series.failed].map(counts => counts.map(n => n / series.step_s)));
  const all_s = workers.reduce((sum, worker) => sum + worker.execute_s, 0);
  const rows = [...workers].sort((a, b) => b.completed - a.completed).map(worker => h("tr", {}, h("td", {class: "named"}, worker.worker_id), h("td", {class: "n"}, count(worker.completed)),
    h("td", {class: worker.failed ? "n bad" : "n"}, count(worker.failed)), h("td", {class: "n"}, share(worker.execute_s, all_s))));
  put(at("work"), rows.length ? table(["worker", ["completed", "n"], ["failed", "n"], ["share", "n"]], rows, "work by worker") : none("No worker has finished anything."));
  put(at("phases"), phaseTable(phases));
  put(at("lost"), ...failureParts(failures, run.stats.redispatched));
  learned();
}

function learned() {
  const grpo = trained?.phases.find(phase => phase.phase === "grpo");
  for (const [name, words] of CURVES) {
    const values = grpo?.figures[name], place = at(`curve-${name}`);
    place.closest("section").hidden = !values;
    if (!values) continue;
    drawn[name] ??= chart(place, [words.split(" ")[0].toLowerCase()]);
    drawn[name].draw(grpo.steps, [values]);
  }
  const plans = trained?.plans ?? [];
  at("which").textContent = plans.length ? `of step ${count(trained.plans_step)}, ${counted(plans.length, "plan")}: ${plans[0].instruction}` : "";
  put(at("sampled"), plans.length ? sampledPlans(run_id, plans) : none("Its trainer sent no plans to this manager."));
}
