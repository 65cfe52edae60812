// The dashboard: one snapshot a second feeds whichever page is shown.
import {ask} from "./ask.js";
import {at, seconds} from "./dom.js";
import * as failures from "./failures.js";
import * as lookahead from "./lookahead.js";
import * as overview from "./overview.js";
import * as tasks from "./tasks.js";
import * as timeline from "./timeline.js";
import * as training from "./training.js";
import * as workers from "./workers.js";

const PAGES = {overview, workers, lookahead, timeline, failures, training, tasks};
const REFRESH_MS = 1000;
let page = null;
let waiting = 0;

function open() {
  const name = location.hash.slice(1).split("?")[0] in PAGES ? location.hash.slice(1).split("?")[0] : "overview";
  page?.close?.();
  page = PAGES[name];
  for (const link of at("nav").children) {
    if (link.getAttribute("href") === `#${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  document.title = `${name[0].toUpperCase()}${name.slice(1)} · EmboMatrix cluster`;
  page.open(at("main"));
  refresh();
}

async function refresh() {
  clearTimeout(waiting);
  try {
    const asked = page, told = await ask(`snapshot?${new URLSearchParams(asked.query?.() ?? {limit: 1})}`);
    if (asked === page) {
      say(told);
      await page.show(told);
      at("dot").className = "dot ready";
    }
  } catch (error) {
    at("dot").className = "dot lost";
    at("link").textContent = error.name === "TimeoutError" || error instanceof TypeError ? "the manager does not answer; trying again" : error.message;
  }
  clearTimeout(waiting);
  // A page that nobody sees asks for nothing.
  waiting = setTimeout(refresh, document.hidden ? 10 * REFRESH_MS : REFRESH_MS);
}

function say(told) {
  const states = Object.entries(told.overview.workers).map(([state, n]) => `${n} ${state}`).join(", ") || "no workers";
  at("link").textContent = `up ${seconds(told.overview.uptime_s)} · ${states}`;
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
addEventListener("hashchange", open);
addEventListener("embomatrix-changed", refresh);
document.addEventListener("visibilitychange", () => { if (!document.hidden) refresh(); });
open();
