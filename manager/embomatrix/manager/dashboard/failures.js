// What the infrastructure lost: reason, worker, scene, attempt, and the worker's own words.
import {ask} from "./ask.js";
import {at, brief, clock, count, h, none, put, table} from "./dom.js";

const BAD = ["failed", "worker_lost", "scene_failed"];
const KEPT = 200;
const LOOK_EVERY = 3;
let log = [], after = 0, looks = 0;

export function open(main) {
  log = []; after = 0; looks = 0;
  main.replaceChildren(
    h("section", {class: "half"}, h("h2", {}, "By reason"), h("div", {id: "reasons"})),
    h("section", {class: "half"}, h("h2", {}, "By worker"), h("div", {id: "blamed"})),
    h("section", {}, h("h2", {}, "Rollouts that were given up ", h("small", {}, "never scored as a reward")), h("div", {id: "failures"})),
    h("section", {}, h("h2", {}, "Attempts and workers that were lost ", h("small", {}, "their rollouts were given to others")), h("div", {id: "attempts"})));
}

export async function show({overview, runs}) {
  const given = overview.failures;
  put(at("reasons"), tally(given.map(note => note.code), "reason"));
  put(at("blamed"), tally(given.map(note => note.worker_id || "none"), "worker"));
  const rows = given.map(note => h("tr", {}, h("td", {class: "muted fit"}, clock(note.at_s)), h("td", {class: "fit"}, h("code", {class: "bad"}, note.code)), h("td", {class: "fit"}, note.worker_id || "–"), h("td", {class: "fit"}, note.rollout_id), h("td", {class: "message"}, note.message)));
  put(at("failures"), rows.length ? table(["when", "reason", "worker", "rollout", "what it said"], rows, "failures") : none("None. Lost rollouts are executed again before they count as failed."));
  if (looks++ % LOOK_EVERY === 0) await look(runs);
}

async function look(runs) {
  const pages = [await ask(`events?after=${after}`), ...await Promise.all(runs.slice(-3).map(run => ask(`runs/${encodeURIComponent(run.run_id)}`).then(told => ({events: told.failures}))))];
  const fleet = pages[0].events;
  if (fleet.length) after = fleet.at(-1).sequence;
  log = [...log, ...fleet.filter(event => BAD.includes(event.kind))].slice(-KEPT);
  const rows = [...log, ...pages.slice(1).flatMap(page => page.events)].sort((a, b) => b.at_s - a.at_s).slice(0, KEPT).map(event =>
    h("tr", {}, h("td", {class: "muted fit"}, clock(event.at_s)), h("td", {class: "fit"}, h("code", {class: "bad"}, event.code || event.kind)), h("td", {class: "fit"}, event.worker_id || "–"),
      h("td", {class: "fit"}, event.bundle_digest ? h("code", {title: event.bundle_digest}, brief(event.bundle_digest)) : "–"), h("td", {class: "fit n"}, event.attempt || ""), h("td", {class: "message"}, event.message || "")));
  put(at("attempts"), rows.length ? table(["when", "reason", "worker", "scene", ["attempt", "n"], "what it said"], rows, "attempts that failed") : none("None."));
}

function tally(names, heading) {
  const counts = {};
  for (const name of names) counts[name] = (counts[name] || 0) + 1;
  const rows = Object.entries(counts).sort((a, b) => b[1] - a[1]).map(([name, n]) => h("tr", {}, h("td", {}, h("code", {}, name)), h("td", {class: "n"}, count(n))));
  return rows.length ? table([heading, ["of the latest 50", "n"]], rows, `failures by ${heading}`) : none("None.");
}
