// Infrastructure failures: reason, worker, scene, attempt, and the worker's message.
import {ask} from "./ask.js";
import {at, clock, count, counted, h, none, put, table} from "./dom.js";
import {named, worded} from "./names.js";
import {alike} from "./parts.js";

const BAD = ["failed", "worker_lost", "scene_failed"];
const KEPT = 200;
const ROWS = 50;
const LOOK_EVERY = 3;
/** Two starts of a manager are further apart than the clocks of one drift between two snapshots. */
const ONE_START_S = 1;
let log = [], after = 0, looks = 0, lost = [];
/** Start of the manager whose log is shown, in seconds since the epoch. */
let began_s = 0;
/** Raised when the page is opened or closed: answers to an earlier page are not shown. */
let turn = 0;

export function open(main) {
  turn += 1;
  began_s = 0;
  forget();
  main.replaceChildren(
    h("section", {}, h("h2", {}, "Since the manager started"), h("p", {id: "sum"})),
    h("section", {class: "half"}, h("h2", {}, "By reason ", h("small", {}, "all failed rollouts, and the attempts below")), h("div", {id: "reasons"})),
    h("section", {class: "half"}, h("h2", {}, "By worker ", h("small", {}, "of the rollouts and attempts below")), h("div", {id: "blamed"})),
    h("section", {}, h("h2", {}, "Failed rollouts ", h("small", {id: "listed"})), h("div", {id: "failures"})),
    h("section", {}, h("h2", {}, "Failed attempts ", h("small", {}, "latest failed leases of open runs, failed scenes and lost workers: their rollouts were re-dispatched")), h("div", {id: "attempts"})));
}

export function close() {
  turn += 1;
}

function forget() {
  log = []; after = 0; looks = 0; lost = [];
}

export async function show({at_s, overview, runs}) {
  const given = overview.failures, mine = turn, start_s = at_s - overview.uptime_s;
  // Another manager numbers its events from 1 again.
  if (Math.abs(start_s - began_s) > ONE_START_S) forget();
  began_s = start_s;
  if (looks % LOOK_EVERY) {
    looks += 1;
  } else {
    await look(runs, mine);
    if (mine !== turn) return;
  }
  const ended = Object.entries(overview.outcomes).filter(([name]) => name !== "completed" && name !== "cancelled"), attempts = lost.map(event => [event.code || event.kind, 1]);
  put(at("sum"), `${counted(overview.failed, "rollout")} ended in an infrastructure failure, which is never scored as a reward. Rollouts were leased again ${counted(overview.redispatched, "time")}, after a lease that failed or expired.`);
  put(at("reasons"), tally("reason", ended, attempts));
  put(at("blamed"), tally("worker", given.map(note => [note.worker_id || "none", note.count]), lost.map(event => [event.worker_id || "none", 1])));
  const listed = given.reduce((sum, note) => sum + note.count, 0);
  at("listed").textContent = listed < overview.failed ? `the latest ${count(listed)} of ${count(overview.failed)}` : "";
  const rows = merged(given).map(note => h("tr", {}, h("td", {class: "muted fit"}, clock(note.at_s)), h("td", {class: "fit"}, h("code", {class: "bad"}, note.code)), h("td", {class: "named"}, note.worker_id), h("td", {class: "named"}, note.rollout_id, note.count > 1 && h("span", {class: "muted"}, ` and ${count(note.count - 1)} more`)), h("td", {class: "message"}, worded(note.message))));
  put(at("failures"), rows.length ? table(["latest", "reason", "worker", "rollout", "message"], rows, "failures", "loose") : none("None. A rollout counts as failed only after its last attempt."));
  const every = fold(lost);
  const folded = every.slice(0, ROWS).map(({event, times}) =>
    h("tr", {}, h("td", {class: "muted fit"}, clock(event.at_s)), h("td", {class: "fit"}, h("code", {class: "bad"}, event.code || event.kind), times > 1 && ` × ${count(times)}`), h("td", {class: "named"}, event.worker_id),
      h("td", {class: "named"}, event.bundle_digest && h("code", {title: event.bundle_digest}, named(event.bundle_digest))), h("td", {class: "fit n", "data-name": event.attempt ? "attempt" : false}, event.attempt || ""), h("td", {class: "message"}, worded(event.message ?? ""))));
  put(at("attempts"), folded.length ? table(["latest", "reason", "worker", "scene", ["attempt", "n"], "message"], folded, "attempts that failed", "loose") : none("None."),
    every.length > ROWS ? none(`${count(every.length - ROWS)} more of the latest ${count(KEPT)}; list all with: embomatrix cluster events`) : "");
}

/** Find the latest events of the cluster and of the latest runs, newest first. */
async function look(runs, mine) {
  const from = after, pages = [await ask(`events?after=${from}`), ...await Promise.all(runs.slice(-3).map(run => ask(`runs/${encodeURIComponent(run.run_id)}`).then(summary => ({events: summary.failures.filter(event => event.kind === "failed")}))))];
  if (mine !== turn || from !== after) return;
  const fleet = pages[0].events;
  if (fleet.length) after = fleet.at(-1).sequence;
  log = [...log, ...fleet.filter(event => BAD.includes(event.kind))].slice(-KEPT);
  lost = [...log, ...pages.slice(1).flatMap(page => page.events)].sort((a, b) => b.at_s - a.at_s).slice(0, KEPT);
  looks = 1;
}

/** Merge failures of one reason, worker and message into the latest of them. */
function merged(notes) {
  return alike(notes, note => [note.code, note.worker_id, note.message]).map(group => ({...group[0], count: group.reduce((sum, note) => sum + note.count, 0)}));
}

/** Merge repeated events into one row. */
function fold(events) {
  return alike(events, event => [event.code || event.kind, event.worker_id, event.bundle_digest, event.attempt, event.message]).map(group => ({event: group[0], times: group.length}));
}

/** Table of numbers of rollouts and attempts by name, from pairs of a name and a number. */
function tally(heading, ended, lost) {
  const counts = {};
  for (const [i, pairs] of [ended, lost].entries()) for (const [name, n] of pairs) (counts[name] ??= [0, 0])[i] += n;
  const rows = Object.entries(counts).sort(([, a], [, b]) => b[0] - a[0] || b[1] - a[1]).map(([name, numbers]) => h("tr", {}, h("td", {class: "named"}, h("code", {}, name)), numbers.map(n => h("td", {class: "n"}, count(n)))));
  return rows.length ? table([heading, ["rollouts", "n"], ["attempts", "n"]], rows, `failures by ${heading}`) : none("None.");
}
