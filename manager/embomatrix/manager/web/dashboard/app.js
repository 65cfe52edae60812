// Dashboard: one snapshot a second feeds the page that is open.
import {Refused, Unanswered, ask} from "./ask.js";
import {at, clock, h, seconds} from "./dom.js";
import {learn} from "./names.js";

// The code of a page is loaded when it is opened, together with the first snapshot.
const PAGES = {
  overview: () => import("./overview.js"), workers: () => import("./workers.js"), lookahead: () => import("./lookahead.js"), timeline: () => import("./timeline.js"),
  failures: () => import("./failures.js"), training: () => import("./training.js"), tasks: () => import("./tasks.js"),
  runs: () => import("./runs.js"), rest: () => import("./rest.js"),
};
const PARTS = [() => import("./worker.js"), () => import("./run.js"), () => import("./compare.js"), () => import("./sampled.js")];
const REFRESH_MS = 1000;
/** Rows of workers in the snapshot, by page; other pages need none. */
const ROWS = {workers: 50};
let page = null, shown_s = 0;
let waiting = 0;
let opened = 0;

async function open() {
  const asked = location.hash.slice(1).split("?")[0], name = asked || "overview", turn = ++opened;
  clearTimeout(waiting);
  const first = ask(`snapshot?${new URLSearchParams({limit: ROWS[name] ?? 1})}`);
  first.catch(() => {}); // the next refresh repeats the request
  let code;
  try {
    code = Object.hasOwn(PAGES, name) ? await PAGES[name]() : unknown(name);
  } catch {
    lost();
    return;
  }
  if (turn !== opened) return;
  page?.close?.();
  page = code;
  for (const link of at("nav").children) {
    if (link.getAttribute("href") === `#${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  document.title = `${name === "rest" ? "REST" : name[0].toUpperCase() + name.slice(1)} · EmboMatrix cluster`;
  try {
    await page.open(at("main"));
  } catch {
    lost();
    return;
  }
  if (turn !== opened) return;
  await refresh(page.asksMore?.() ? null : first);
  // Load the other pages in the background, so that they open at once, even while the manager is away.
  setTimeout(() => Promise.allSettled([...Object.values(PAGES), ...PARTS].map(load => load())), REFRESH_MS);
}

function lost(what = "failed to load") {
  at("dot").className = "dot lost";
  showStatus(`a part of the dashboard ${what}: reload the page`);
}

/** Page for a name that is none. */
function unknown(name) {
  const words = `There is no page “${name}”: choose one of ${Object.keys(PAGES).join(", ")}.`;
  return {open: main => main.replaceChildren(h("section", {class: "most"}, h("p", {class: "none", id: "unknown"}, words))), show: () => {}};
}

/** Request a snapshot and show it; `first` is a request already under way. */
async function refresh(first = null) {
  clearTimeout(waiting);
  if (!page) return;
  const asked = page, turn = opened;
  let seen = false;
  try {
    const snapshot = await (first ?? ask(`snapshot?${new URLSearchParams(asked.query?.() ?? {limit: 1})}`));
    seen = true;
    if (asked === page) {
      showOverview(snapshot);
      await page.show(snapshot);
      at("dot").className = snapshot.health.mood === "bad" ? "dot lost" : "dot ready";
      at("main").classList.remove("old");
      learn(); // scene names must not delay the first view
    }
  } catch (error) {
    if (turn !== opened) return; // the page that failed is closed, and the next one refreshes itself
    complain(error, seen);
  }
  clearTimeout(waiting);
  // A hidden page refreshes rarely.
  waiting = setTimeout(refresh, document.hidden ? 10 * REFRESH_MS : REFRESH_MS);
}

/** Tell the viewer why the page is not up to date. The lists of an answered snapshot are. */
function complain(error, seen) {
  at("dot").className = "dot lost";
  if (error instanceof Unanswered) {
    showStatus(`${error.message}; retrying`);
    age("the manager has not answered since");
  } else if (error instanceof Refused) {
    showStatus(error.message);
    if (!seen) age(error.message);
  } else {
    lost("failed");
    console.error(error);
  }
}

/** Screen readers announce changed text. The uptime changes every second and is kept out of it. */
function showStatus(words, up = "") {
  at("up").textContent = up;
  if (at("states").textContent !== words) at("states").textContent = words;
}

/** Mark the page as outdated, with the time of its data and the reason. */
function age(why) {
  if (!shown_s) return;
  at("main").classList.add("old");
  at("health").className = "health bad";
  const words = `This page shows the state of ${clock(shown_s)}: ${why}.`;
  if (at("health").textContent !== words) at("health").textContent = words;
}

function showOverview(snapshot) {
  shown_s = snapshot.at_s;
  const states = Object.entries(snapshot.overview.workers).map(([state, n]) => `${n} ${state}`).join(", ") || "no workers";
  showStatus(states, `up ${seconds(snapshot.overview.uptime_s)} · `);
  at("health").hidden = false;
  at("health").className = `health ${snapshot.health.mood}`;
  const words = snapshot.overview.notice ? `${snapshot.health.sentence} Note: ${snapshot.overview.notice}.` : snapshot.health.sentence;
  if (at("health").textContent !== words) at("health").textContent = words;
}

at("ask").addEventListener("submit", event => {
  event.preventDefault();
  sessionStorage.setItem("token", at("token").value);
  delete at("ask").dataset.wanted;
  refresh();
});
// The URL's fragment names the page, so the skip link must not change it.
at("skip").addEventListener("click", event => { event.preventDefault(); at("main").focus(); });
addEventListener("hashchange", open);
addEventListener("embomatrix-changed", () => refresh());
document.addEventListener("visibilitychange", () => { if (!document.hidden) refresh(); });
open();
