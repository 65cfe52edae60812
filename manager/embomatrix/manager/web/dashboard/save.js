// Files for the viewer: the open page as one HTML file that loads nothing, and data as JSON.
import {h} from "./dom.js";

const CONTROLS = "button, select, input, label, .bar, .back, .watch";

function save(name, text, type) {
  const link = h("a", {href: URL.createObjectURL(new Blob([text], {type})), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

export const saveJson = (name, value) => save(name, JSON.stringify(value, null, 1), "application/json");

/** Save the page as it is: charts become pictures, controls and links are left out, and the theme is the present one. It asks the manager for nothing. */
export function savePage(name, title) {
  const shown = document.getElementById("main"), copy = shown.cloneNode(true);
  const canvases = [...shown.querySelectorAll("canvas")];
  [...copy.querySelectorAll("canvas")].forEach((canvas, i) => canvas.replaceWith(h("img", {alt: "", src: canvases[i].toDataURL(), style: `width:${canvases[i].clientWidth}px;max-width:100%`})));
  for (const part of copy.querySelectorAll(`${CONTROLS}, [hidden]`)) part.remove();
  for (const link of copy.querySelectorAll("a")) link.replaceWith(...link.childNodes);
  const dark = matchMedia("(prefers-color-scheme: dark)").matches ? "all" : "not all";
  const rules = [...document.styleSheets].flatMap(sheet => [...sheet.cssRules]);
  const styles = rules.map(rule => rule.cssText).join("\n").replaceAll("(prefers-color-scheme: dark)", dark);
  const page = document.implementation.createHTMLDocument(`${title} · EmboMatrix run`);
  page.documentElement.lang = "en";
  page.head.append(page.createElement("style"));
  page.head.querySelector("style").textContent = styles;
  page.head.insertAdjacentHTML("afterbegin", '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">');
  page.body.append(page.adoptNode(copy));
  save(name, `<!doctype html>\n${page.documentElement.outerHTML}`, "text/html");
}
