// Elements and number formats. Names of workers and tasks never become markup.

/** An element: h("td", {class: "n"}, "3"). Children are elements, text, or nothing. */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== undefined && value !== null) element.setAttribute(name, value);
  }
  element.append(...children.flat(3).filter(child => child !== null && child !== undefined && child !== false));
  return element;
}

/** An SVG element. */
export function shape(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children.flat().filter(Boolean));
  return element;
}

export const at = id => document.getElementById(id);
export const brief = digest => digest.replace(/^sha256:/, "").slice(0, 8);
export const count = number => Number(number).toLocaleString("en");
/** Number and unit with a no-break space. */
const unit = (number, of) => `${number}\u00a0${of}`;
export const share = (part, all) => all ? unit(Math.round(100 * part / all), "%") : "–";
/** Offset of the last page of a list. */
export const lastPage = (total, rows) => Math.max(0, Math.ceil(total / rows) - 1) * rows;
export const counted = (number, noun) => `${count(number)} ${noun}${number === 1 ? "" : "s"}`;
/** Time of day; with the date unless it is today. */
export function clock(seconds) {
  const [day, time] = new Date(seconds * 1000).toISOString().split("T"), [today] = new Date().toISOString().split("T");
  return day === today ? `${time.slice(0, 8)} UTC` : `${day} ${time.slice(0, 5)} UTC`;
}
/** Text with a minus sign instead of a hyphen. */
export const signed = text => String(text).replace("-", "\u2212");
/** Date and time to the minute. */
export const moment = seconds => `${new Date(seconds * 1000).toISOString().slice(0, 16).replace("T", " ")} UTC`;
/** Date and time to the second, which a saved page needs. */
export const stamp = seconds => `${new Date(seconds * 1000).toISOString().slice(0, 19).replace("T", " ")} UTC`;
/** The part of the page's address after the question mark. */
export const asked = () => location.hash.split("?").slice(1).join("?");
/** Text of an encoded part of an address; a malformed one as it is. */
export const decoded = text => { try { return decodeURIComponent(text); } catch { return text; } };
/** Name of a task's category, as all pages and reports write it. */
export const categoryWords = category => category.replaceAll("_", " ");
export const splitWords = split => split === "heldout" ? "held out" : split;
export const none = text => h("div", {class: "none"}, text);
export const colour = name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

/** Duration. The bounds are of the rounded number, so that it is never 1000 ms or 120 s. */
export function seconds(s) {
  if (s === 0) return "–";
  if (s < 0.9995) return unit((s * 1000).toFixed(s < 0.00995 ? 1 : 0), "ms");
  if (s < 119.5) return unit(s.toFixed(s < 9.95 ? 1 : 0), "s");
  if (s < 7170) return unit(Math.round(s / 60), "min");
  return s < 172_620 ? unit((s / 3600).toFixed(1), "h") : unit(Math.round(s / 86400), "days");
}

/** Fill level. */
export function gauge(used, all, label) {
  const part = Math.min(100, 100 * used / Math.max(1, all));
  return h("span", {class: "gauge", role: "meter", "aria-valuemin": 0, "aria-valuemax": all, "aria-valuenow": Math.round(used), "aria-label": label, title: label},
    h("span", {style: `width:${part.toFixed(1)}%`}));
}

/** Table; a heading is its text, or [text, class]. Tables of kind "loose" wrap on narrow pages. */
export function table(headings, rows, caption, kind = "") {
  const head = headings.map(heading => {
    const [text, kind] = Array.isArray(heading) ? heading : [heading, ""];
    return h("th", {class: kind, scope: "col"}, text);
  });
  return h("div", {class: "scroll", tabindex: "0", role: "region", "aria-label": caption},
    h("table", {class: kind || false}, h("thead", {}, h("tr", {}, head)), h("tbody", {}, rows)));
}

const last = new WeakMap();
const nameOf = part => part.getAttribute("aria-label") ?? part.getAttribute("href") ?? part.textContent;

/** Save the focus and scroll positions inside an element; the returned function restores them. */
function held(place) {
  const parts = [...place.querySelectorAll("a, button, [tabindex]")], focused = parts.indexOf(document.activeElement);
  const name = focused < 0 ? "" : nameOf(parts[focused]), ways = [...place.querySelectorAll(".scroll, pre")].map(part => [part.scrollLeft, part.scrollTop]);
  return () => {
    place.querySelectorAll(".scroll, pre").forEach((part, i) => { if (ways[i]) [part.scrollLeft, part.scrollTop] = ways[i]; });
    if (focused < 0) return;
    const now = [...place.querySelectorAll("a, button, [tabindex]")];
    (now.find(part => nameOf(part) === name) ?? now[Math.min(focused, now.length - 1)])?.focus({preventScroll: true});
  };
}

/** Replace the content of an element if it differs. Selections survive a refresh, and the focus also a change. */
export function put(place, ...children) {
  const fresh = h("div", {}, ...children), html = fresh.innerHTML;
  const before = last.get(place);
  if (before?.html === html && before.first === place.firstChild) return;
  last.set(place, {html, first: fresh.firstChild});
  const giveBack = held(place);
  place.replaceChildren(...fresh.childNodes);
  giveBack();
}
