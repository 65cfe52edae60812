// The dashboard: one snapshot a second feeds whichever page is shown.
import {ask} from "./ask.js";
import {at, clock, seconds} from "./dom.js";
import {learn} from "./names.js";

// A page's code comes when it is opened, and the first snapshot with it: nobody waits for what isn't shown.
const PAGES = {
  overview: () => import("./overview.js"), workers: () => import("./workers.js"), lookahead: () => import("./lookahead.js"), timeline: () => import("./timeline.js"),
  failures: () => import("./failures.js"), training: () => import("./training.js"), tasks: () => import("./tasks.js"),
};
const REFRESH_MS = 1000;
/** Rows of workers that the page shows at once; the others show none. */
const ROWS = {workers: 50};
let page = null, told_s = 0;
let waiting = 0;
let opened = 0;

async function open() {
  const asked = location.hash.slice(1).split("?")[0], name = Object.hasOwn(PAGES, asked) ? asked : "overview", turn = ++opened;
  clearTimeout(waiting);
  const first = ask(`snapshot?${new URLSearchParams({limit: ROWS[name] ?? 1})}`);
  first.catch(() => {}); // it is asked for again
  let code;
  try {
    code = await PAGES[name]();
  } catch {
    at("dot").className = "dot lost";
    tell("a part of the page did not come: load it again");
    return;
  }
  if (turn !== opened) return;
  page?.close?.();
  page = code;
  for (const link of at("nav").children) {
    if (link.getAttribute("href") === `#${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  document.title = `${name[0].toUpperCase()}${name.slice(1)} · EmboMatrix cluster`;
  page.open(at("main"));
  await refresh(page.asksMore?.() ? null : first);
  // The other pages while there is time: they open at once then, and also while the manager is away.
  setTimeout(() => Promise.allSettled(Object.values(PAGES).map(load => load())), REFRESH_MS);
}

/** Ask, and show what is told; `first` is an answer that is on its way. */
async function refresh(first = null) {
  clearTimeout(waiting);
  if (!page) return;
  try {
    const asked = page, told = await (first ?? ask(`snapshot?${new URLSearchParams(asked.query?.() ?? {limit: 1})}`));
    if (asked === page) {
      say(told);
      await page.show(told);
      at("dot").className = "dot ready";
      at("main").classList.remove("old");
      learn(); // what is shown first waits for no names
    }
  } catch (error) {
    at("dot").className = "dot lost";
    tell(error.name === "TimeoutError" || error instanceof TypeError ? "the manager does not answer; trying again" : error.message);
    age();
  }
  clearTimeout(waiting);
  // A page that nobody sees asks for nothing.
  waiting = setTimeout(refresh, document.hidden ? 10 * REFRESH_MS : REFRESH_MS);
}

/** Screen readers hear the words when they change; how long it is up changes every second, and is left out of that. */
function tell(words, up = "") {
  at("up").textContent = up;
  if (at("states").textContent !== words) at("states").textContent = words;
}

/** What stands there is no longer so: it says from when it is. */
function age() {
  if (!told_s) return;
  at("main").classList.add("old");
  at("health").className = "health bad";
  const words = `What stands here is of ${clock(told_s)}: the manager has told nothing since.`;
  if (at("health").textContent !== words) at("health").textContent = words;
}

function say(told) {
  told_s = told.at_s;
  const states = Object.entries(told.overview.workers).map(([state, n]) => `${n} ${state}`).join(", ") || "no workers";
  tell(states, `up ${seconds(told.overview.uptime_s)} · `);
  at("health").hidden = false;
  at("health").className = `health ${told.health.mood}`;
  const words = told.overview.notice ? `${told.health.sentence} Note: ${told.overview.notice}.` : told.health.sentence;
  if (at("health").textContent !== words) at("health").textContent = words;
}

at("ask").addEventListener("submit", event => {
  event.preventDefault();
  sessionStorage.setItem("token", at("token").value);
  refresh();
});
// The address names the page: a jump within it must not.
at("skip").addEventListener("click", event => { event.preventDefault(); at("main").focus(); });
addEventListener("hashchange", open);
addEventListener("embomatrix-changed", () => refresh());
document.addEventListener("visibilitychange", () => { if (!document.hidden) refresh(); });
open();
