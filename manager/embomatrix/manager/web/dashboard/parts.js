// Parts that several pages show: totals of a run, durations by phase, failures, and sampled plans.
import {count, counted, h, none, seconds, share, signed, stamp, table} from "./dom.js";
import {named, worded} from "./names.js";

const PHASES = {queue: "waiting for a lease", lease: "network and waiting for a slot", load: "loading the scene", execute: "executing the plan", deliver: "writing the result"};
const UNITS = {
  count: value => count(value), share: value => `${(100 * value).toFixed(1)}\u00a0%`, seconds: value => value ? seconds(value) : "0\u00a0s",
  rate: value => `${value >= 100 ? count(Math.round(value)) : value.toFixed(1)}/s`, number: value => signed(value.toFixed(2)),
};
const MESSAGES = 50;

/** Text of a total of a run; a dash without a value. */
export const totalText = ({value, unit}) => value === null ? "–" : UNITS[unit](value);

/** Durations of rollouts by phase: share of the time, median, and high percentiles. */
export function phaseTable(durations) {
  const all = Object.values(durations).reduce((sum, one) => sum + one.sum_s, 0);
  if (!all) return none("No rollout has been executed yet.");
  const rows = Object.entries(durations).map(([name, one]) => h("tr", {}, h("td", {class: "fit"}, name, h("span", {class: "muted wideonly"}, ` ${PHASES[name] ?? ""}`)),
    h("td", {}, h("span", {class: "share", style: `width:${(100 * one.sum_s / all).toFixed(1)}%`})), h("td", {class: "n fit"}, share(one.sum_s, all)),
    [one.p50_s, one.p95_s, one.p99_s].map(s => h("td", {class: "n fit"}, s ? seconds(s) : "0\u00a0ms"))));
  return table(["phase", "", ["share", "n"], ["median", "n"], ["95 %", "n"], ["99 %", "n"]], rows, "latency by phase");
}

/** Groups of items with an equal cause, in the order of their first items. `causeOf` returns a list of values. */
export function alike(items, causeOf) {
  const groups = new Map();
  for (const item of items) {
    const cause = JSON.stringify(causeOf(item));
    if (groups.has(cause)) groups.get(cause).push(item);
    else groups.set(cause, [item]);
  }
  return [...groups.values()];
}

/** Failed leases and rollouts of a run, the latest first, with their number by reason. */
export function failureParts(events, redispatched) {
  const again = `Rollouts were leased again ${counted(redispatched, "time")}, because their workers left, drained or fell silent before they had a result.`;
  if (!events.length) return [none(redispatched ? `No lease failed. ${again}` : "None: every lease brought a result.")];
  const reasons = {};
  for (const {code} of events) reasons[code] = (reasons[code] ?? 0) + 1;
  const counts = Object.entries(reasons).sort((a, b) => b[1] - a[1]).map(([code, n]) => `${code} (${count(n)})`).join(", ");
  const causes = alike([...events].reverse(), event => [event.kind, event.code, event.worker_id, event.bundle_digest, event.message]);
  const rows = causes.slice(0, MESSAGES).map(([event, ...others]) => h("tr", {}, h("td", {class: "muted fit"}, stamp(event.at_s)), h("td", {class: "fit"}, event.kind === "failed" ? "attempt" : "rollout"),
    h("td", {class: "fit"}, h("code", {class: "bad"}, event.code)), h("td", {class: "named"}, event.worker_id ?? ""), h("td", {class: "named"}, event.rollout_id ?? "", others.length ? h("span", {class: "muted"}, ` and ${count(others.length)} more`) : ""),
    h("td", {class: "named"}, event.bundle_digest && h("code", {title: event.bundle_digest}, named(event.bundle_digest))), h("td", {class: "message"}, worded(event.message ?? ""))));
  return [h("p", {}, `Latest: ${latestFailures(events)}, with the reasons ${counts}.`), table(["latest", "failed", "reason", "worker", "rollout", "scene", "message"], rows, "failures", "loose"),
    causes.length > MESSAGES ? none(`The table shows the last ${MESSAGES} causes.`) : ""];
}

/** Numbers of failed attempts and failed rollouts in a list of events. */
function latestFailures(events) {
  const attempts = events.filter(event => event.kind === "failed").length, rollouts = events.length - attempts;
  return [attempts && counted(attempts, "failed attempt"), rollouts && counted(rollouts, "failed rollout")].filter(Boolean).join(" and ");
}

const points = number => signed(number.toFixed(2));

/** Result of a plan or an episode: goal reached or not, reward by tier, and advantage. */
export function verdict({reward, advantage}) {
  if (!reward) return h("b", {class: "bad"}, "infrastructure failure, no reward");
  return h("span", {}, h("b", {class: reward.success ? "reached" : ""}, reward.success ? "reached the goal" : "did not reach the goal"),
    ` · reward ${points(reward.format + reward.relevance + reward.goal)} (format ${points(reward.format)}, relevance ${points(reward.relevance)}, goal ${points(reward.goal)}) · advantage ${points(advantage)}`);
}

/** Plans or episodes of a run that a policy wrote, each with its verdict and the result of each call. */
export function sampledPlans(run_id, plans) {
  return plans.map((plan, i) => h("div", {class: "plan"}, h("p", {}, verdict(plan), h("span", {class: "muted"}, ` · ${plan.task_id} `), h("a", {class: "watch", href: `#training?${encodeURIComponent(run_id)}&${i + 1}`}, plan.turns.length ? "Watch turn by turn" : "Watch call by call")),
    plan.problem && h("p", {class: "bad message"}, plan.problem), h("pre", {tabindex: "0"}, plan.text || "(nothing)"),
    plan.steps.length > 0 && h("ol", {class: "steps"}, plan.steps.map(step => h("li", {}, h("code", {class: step.ok ? "reached" : "bad"}, step.call || step.skill), ` ${step.message || (step.ok ? "done" : "failed")}`)))));
}
