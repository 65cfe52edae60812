// How the cluster does: throughput, latency, hits, failures, runs.
import {chart} from "./charts.js";
import {at, count, h, none, put, seconds, share, signed, table} from "./dom.js";

const TILES = [
  ["rate", "Throughput", "rollouts/s, mean of 10 s"], ["p50", "Latency p50", "submitted to result"], ["p95", "Latency p95", "latest 2,048 rollouts"],
  ["hits", "Prewarm hits", ""], ["slots", "Slots busy", ""], ["bad", "Failures", ""],
];
let drawn = null;

export function open(main) {
  main.replaceChildren(
    ...TILES.map(([id, title, note]) => h("section", {class: "tile"}, h("h2", {}, title), h("b", {id}, "–"), h("span", {id: `${id}note`}, note))),
    h("section", {class: "most"}, h("h2", {}, "Completed rollouts per second ", h("small", {id: "peak"})), h("div", {id: "chart", role: "img", "aria-label": "rollouts per second over two minutes"})),
    h("section", {class: "third"}, h("h2", {}, "Runs"), h("div", {id: "runs"})),
    h("section", {}, h("h2", {}, "Outcomes ", h("small", {}, "of all rollouts since the manager started")), h("div", {id: "outcomes"})),
  );
  drawn = chart(at("chart"), ["rollouts/s"], {fill: true, legend: false, words: tick => tick === 0 ? "now" : signed(`${tick} s`)});
}

export function close() {
  drawn?.close();
  drawn = null;
}

export function show({overview: o, runs}) {
  const recent = o.throughput.slice(-10), mean = recent.reduce((a, b) => a + b, 0) / recent.length;
  const failed = Object.entries(o.outcomes).filter(([name]) => name !== "completed" && name !== "cancelled").reduce((sum, [, n]) => sum + n, 0);
  const told = {
    rate: mean >= 100 ? count(Math.round(mean)) : mean.toFixed(1), p50: seconds(o.latency_p50_s), p95: seconds(o.latency_p95_s),
    hits: share(o.prewarm_hits, o.prewarm_hits + o.prewarm_misses), hitsnote: `lead ${seconds(o.prewarm_lead_s)}, ${count(o.prewarm_wasted)} wasted`,
    slots: `${o.slots_busy}/${o.slots}`, slotsnote: `${count(o.queued)} rollouts waiting`,
    bad: count(failed), badnote: `${count(o.redispatched)} given again, ${count(o.stale_results)} late`,
    peak: `peak ${count(Math.max(...o.throughput))}, ${count(o.outcomes.completed || 0)} in all`,
  };
  for (const [id, text] of Object.entries(told)) at(id).textContent = text;
  at("bad").className = failed ? "bad" : "";
  drawn.draw(o.throughput.map((_, i) => i - o.throughput.length + 1), [o.throughput]);
  put(at("runs"), runs.length ? table(["run", ["done", "n"], ["open", "n"], ["warm", "n"], ["failed", "n"]], runs.slice(-8).reverse().map(run), "open runs") : none("No open runs."));
  const rows = Object.entries(o.outcomes).sort((a, b) => b[1] - a[1]).map(([name, n]) => h("tr", {}, h("td", {}, h("code", {}, name)), h("td", {class: "n"}, count(n))));
  put(at("outcomes"), rows.length ? table(["outcome", ["rollouts", "n"]], rows, "outcomes") : none("Nothing has been executed yet."));
}

function run(r) {
  return h("tr", {},
    h("td", {class: "named", title: `${r.name} ${r.run_id}`}, h("a", {href: `#timeline?${encodeURIComponent(r.run_id)}`}, r.name || r.run_id)),
    h("td", {class: "n"}, count(r.stats.delivered)), h("td", {class: "n"}, count(r.pending)),
    h("td", {class: "n"}, share(r.stats.warm_starts, r.stats.warm_starts + r.stats.cold_starts)),
    h("td", {class: r.stats.infra_failures ? "n bad" : "n"}, count(r.stats.infra_failures)));
}
