// Overview: throughput, latency, prewarm hits, failures, runs.
import {chart} from "./charts.js";
import {at, count, counted, h, none, put, seconds, share, signed, table} from "./dom.js";
import {phaseTable} from "./parts.js";

const TILES = [
  ["rate", "Throughput", "rollouts/s, 10\u00a0s mean"], ["p50", "Latency", ""], ["hits", "Prewarm hits", ""],
  ["slots", "Slots at work", ""], ["overhead", "Overhead", ""], ["bad", "Failures", ""],
];
let drawn = null;

export function open(main) {
  main.replaceChildren(
    ...TILES.map(([id, title, note]) => h("section", {class: "tile"}, h("h2", {}, title), h("b", {id}, "–"), h("span", {id: `${id}note`}, note))),
    h("section", {class: "most"}, h("h2", {}, "Completed rollouts per second ", h("small", {id: "peak"})), h("div", {id: "chart", role: "img", "aria-label": "rollouts per second over two minutes"})),
    h("section", {class: "third"}, h("h2", {}, "Open runs ", h("small", {}, h("a", {href: "#runs"}, "all runs"))), h("div", {id: "runs"})),
    h("section", {class: "most"}, h("h2", {}, "Latency by phase ", h("small", {}, "of completed rollouts since the manager started")), h("div", {id: "phases"})),
    h("section", {class: "third"}, h("h2", {}, "Outcomes"), h("div", {id: "outcomes"})),
  );
  drawn = chart(at("chart"), ["rollouts/s"], {fill: true, legend: false, words: tick => tick === 0 ? "now" : signed(`${tick} s`)});
}

export function close() {
  drawn?.close();
  drawn = null;
}

export function show({overview: o, runs}) {
  const recent = o.throughput.slice(-10), mean = recent.reduce((a, b) => a + b, 0) / recent.length;
  const texts = {
    rate: mean >= 100 ? count(Math.round(mean)) : mean.toFixed(1), p50: seconds(o.latency_p50_s), p50note: o.latency_p95_s ? `median; 95th percentile ${seconds(o.latency_p95_s)}` : "from submission to result",
    overheadnote: `manager's share of CPU time; ${share(o.core_share, 1)} of its core`,
    overhead: o.overhead ? `${(100 * o.overhead).toFixed(o.overhead < 0.1 ? 1 : 0)}\u00a0%` : "–",
    hits: share(o.prewarm_hits, o.prewarm_hits + o.prewarm_misses), hitsnote: o.prewarm_hits ? `lead ${seconds(o.prewarm_lead_s)}, ${count(o.prewarm_wasted)} wasted` : "scenes warm when their batch arrived",
    slots: `${o.slots_at_work.toFixed(1)}/${o.slots}`, slotsnote: `mean of a minute; ${counted(o.queued, "rollout")} queued`,
    bad: count(o.failed), badnote: `${count(o.redispatched)} re-dispatch${o.redispatched === 1 ? "" : "es"}, ${counted(o.stale_results, "late result")}`,
    peak: `peak ${count(Math.max(...o.throughput))}, ${count(o.outcomes.completed || 0)} in total`,
  };
  for (const [id, text] of Object.entries(texts)) at(id).textContent = text;
  at("bad").className = o.failed ? "bad" : "";
  const ago = o.throughput.map((_, i) => i - o.throughput.length + 1);
  drawn.draw(ago, [o.throughput.map((done, i) => -ago[i] > o.uptime_s ? null : done)]);
  put(at("runs"), runs.length ? table(["run", ["done", "n"], ["open", "n"], ["warm", "n"], ["shared", "n"], ["failed", "n"]], runs.slice(-8).reverse().map(run), "open runs") : none("No open runs."));
  put(at("phases"), phaseTable(o.phases));
  const rows = Object.entries(o.outcomes).sort((a, b) => b[1] - a[1]).map(([name, n]) => h("tr", {}, h("td", {}, h("code", {}, name)), h("td", {class: "n"}, count(n))));
  put(at("outcomes"), rows.length ? table(["outcome", ["rollouts", "n"]], rows, "outcomes") : none("No rollout has been executed yet."));
}

function run(r) {
  return h("tr", {},
    h("td", {class: "named", title: `${r.name} ${r.run_id}`}, h("a", {href: `#runs?${encodeURIComponent(r.run_id)}`}, r.name || r.run_id)),
    h("td", {class: "n"}, count(r.stats.delivered)), h("td", {class: "n"}, count(r.pending)),
    h("td", {class: "n"}, share(r.stats.warm_starts, r.stats.warm_starts + r.stats.cold_starts)),
    h("td", {class: "n", title: "steps that were known from equal plans or beginnings and not executed"}, share(r.stats.shared_steps, r.stats.steps)),
    h("td", {class: r.stats.infra_failures ? "n bad" : "n"}, count(r.stats.infra_failures)));
}
