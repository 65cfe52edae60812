// Line charts over steps or seconds. Colours follow the theme, the width follows the page.
import {colour, h, signed} from "./dom.js";

/** uPlot is no module: it is loaded with the first page that has a chart. */
await Promise.all([
  new Promise((done, failed) => document.head.append(h("script", {src: "/static/vendor/uPlot.iife.min.js", onload: done, onerror: () => failed(new TypeError("the chart library failed to load"))}))),
  new Promise(done => document.head.append(h("link", {rel: "stylesheet", href: "/static/vendor/uPlot.min.css", onload: done, onerror: done}))),
]);

const DASHES = [[], [6, 3], [2, 2], [9, 3, 2, 3], [1, 4]];
/** Tick intervals: steps and seconds are whole numbers. */
const WHOLE = [1, 2, 5].flatMap(n => [0, 1, 2, 3, 4, 5, 6].map(power => n * 10 ** power)).sort((a, b) => a - b);
/** Tick intervals of times in seconds: whole numbers of the unit in which they are written. */
const TIMES = [1, 2, 5, 10, 20, 60, 120, 300, 600, 1200, 3600, 7200, 18000, 36000, 86400, 172800, 432000];
/** Smaller values are rounding errors and shown as 0. */
const LEAST = 1e-6;
const TINTS = ["c1", "c2", "c3", "c4", "c5"];

function latest(drawn) {
  const last = drawn.data[0].length - 1;
  if (drawn.cursor.idx == null && last >= 0) drawn.setLegend({idx: last});
}

/** A chart in an element. `lines` are the names of the series; `words` formats the ticks of the x axis, `across` names it and `steps` are its intervals; `most` is the
 * end of the y axis; `fill` fills a single line; `joined` lines cross steps without a value. */
export function chart(place, lines, {high = 190, words, across = "step", steps = words ? TIMES : WHOLE, most: end, fill = false, legend = true, joined = true} = {}) {
  const axis = {stroke: () => colour("faint"), grid: {stroke: () => colour("line"), width: 1}, ticks: {show: false}, font: "11px system-ui"};
  const series = lines.map((label, i) => ({
    label, width: 1.6, dash: DASHES[Math.floor(i / TINTS.length) % DASHES.length], spanGaps: joined,
    // A single value is shown as a point.
    points: {show: (drawn, number) => drawn.data[number].filter(value => value !== null && value !== undefined).length === 1, size: 6},
    stroke: () => colour(TINTS[i % TINTS.length]), ...(fill ? {fill: () => `${colour(TINTS[i])}22`} : {}),
    value: (_, value) => value === null || value === undefined ? "–" : signed(Math.abs(value) < LEAST ? 0 : Number(value.toPrecision(3))),
  }));
  const range = (_, low, top) => {
    if (end) return [0, end];
    const least = Math.min(0, low ?? 0), most = top > least ? top : least + 1;
    return [least && least * 1.08, fill ? Math.max(1, most) * 1.08 : most + (most - least) * 0.08];
  };
  const box = h("div", {class: "chart"});
  place.replaceChildren(box);
  const drawn = new uPlot({
    width: box.clientWidth, height: high, legend: {show: legend}, cursor: {y: false}, scales: {x: {time: false}, y: {range}},
    axes: [{...axis, size: 28, incrs: steps, ...(words ? {values: (_, ticks) => ticks.map(words)} : {})}, {...axis, size: 52}],
    series: [{label: across, value: (_, value) => value === null || value === undefined ? "–" : words ? words(value) : value}, ...series],
    // Without a cursor, the legend shows the latest values.
    hooks: {setCursor: [latest]},
  }, [[], ...lines.map(() => [])], box);
  const watcher = new ResizeObserver(() => drawn.setSize({width: box.clientWidth, height: high}));
  watcher.observe(box);
  return {
    lines,
    draw(at, columns) { drawn.setData([at, ...columns]); latest(drawn); },
    close() { watcher.disconnect(); drawn.destroy(); },
  };
}
