// REST API: each call with its parameters, its answer and an example, from the manager's OpenAPI description.
import {ask} from "./ask.js";
import {at, h, put} from "./dom.js";
import {saveJson} from "./save.js";

const SHOWN = 20_000;
let described = null;

export function open(main) {
  main.replaceChildren(h("section", {}, h("h2", {}, "REST API ", h("small", {id: "version"})), h("p", {id: "about"}, "Loading the description…"),
    h("div", {class: "bar"}, h("button", {type: "button", id: "openapi", onclick: () => saveJson("embomatrix-openapi.json", described)}, "Download OpenAPI"),
      h("input", {type: "search", id: "words", placeholder: "path or words", "aria-label": "search calls", oninput: filter}))),
    h("div", {id: "calls", class: "wide"}));
  at("openapi").disabled = true;
  described = null;
}

/** The description is asked for once. */
export async function show() {
  if (described || !at("calls")) return;
  described = await ask("openapi.json");
  if (!at("calls")) return;
  at("openapi").disabled = false;
  at("version").textContent = `version ${described.info.version}`;
  put(at("about"), coded(described.info.description));
  const calls = Object.entries(described.paths).flatMap(([path, methods]) => Object.entries(methods).map(([method, one]) => ({path, method, ...one})));
  put(at("calls"), described.tags.map(({name, description}) => {
    const own = calls.filter(one => one.tags?.includes(name));
    return own.length > 0 && h("section", {class: "calls-of"}, h("h2", {}, name, h("small", {}, description)), own.map(call));
  }));
}

function filter() {
  const words = at("words").value.toLowerCase();
  for (const one of at("calls").querySelectorAll("details.call")) one.hidden = !one.dataset.words.includes(words);
  for (const section of at("calls").querySelectorAll("section")) section.hidden = !section.querySelector("details.call:not([hidden])");
}

function call({path, method, summary, description, parameters = [], requestBody, responses}) {
  const id = `${method} ${path}`, body = requestBody && schemaOf(requestBody), answer = responses["200"]?.content ?? {}, kind = Object.keys(answer)[0] ?? "";
  return h("details", {class: "call", "data-words": `${id} ${summary} ${description}`.toLowerCase()},
    h("summary", {}, h("span", {class: `method ${method}`}, method.toUpperCase()), h("code", {}, path), h("span", {class: "muted"}, summary)),
    h("p", {}, coded(description)),
    parameters.length > 0 && h("table", {class: "loose"}, h("thead", {}, h("tr", {}, ["parameter", "value", "meaning"].map(text => h("th", {scope: "col"}, text)))), h("tbody", {}, parameters.map(parameter))),
    body && h("p", {}, "Body: ", fields(body)),
    h("p", {}, "Answer: ", kind.includes("json") && schemaOf(responses["200"]) ? fields(schemaOf(responses["200"])) : kind || "see the description"),
    h("pre", {tabindex: "0"}, example(path, method, parameters, body)),
    method === "get" && !path.endsWith("/stream") && trial(path, parameters, kind));
}

/** Text with the words between backticks as code. */
const coded = text => text.split(/`+/).map((part, i) => i % 2 ? h("code", {}, part) : part);

function parameter({name, in: place, required, schema = {}, description = ""}) {
  const type = typeWords(schema), limits = [schema.minimum !== undefined && `from ${schema.minimum}`, schema.exclusiveMinimum !== undefined && `above ${schema.exclusiveMinimum}`, schema.maximum !== undefined && `to ${schema.maximum}`].filter(Boolean).join(" ");
  const usual = required ? "required" : `default ${schema.default === "" ? "empty" : schema.default}`;
  return h("tr", {}, h("td", {class: "fit"}, h("code", {}, name), place === "path" && h("span", {class: "muted"}, " in the path")), h("td", {class: "fit"}, [type, limits, usual].filter(Boolean).join(", ")), h("td", {}, coded(description)));
}

const schemaOf = part => part.content?.["application/json"]?.schema;
const resolved = schema => schema?.$ref ? {name: schema.$ref.split("/").at(-1), ...described.components.schemas[schema.$ref.split("/").at(-1)]} : schema;

function typeWords(schema) {
  if (schema.$ref) { const found = resolved(schema); return found.enum ? found.enum.join(" or ") : found.name; }
  if (schema.enum) return schema.enum.join(" or ");
  if (schema.anyOf) return schema.anyOf.map(typeWords).join(" or ");
  if (schema.type === "array") return `list of ${schema.items ? typeWords(schema.items) : "values"}`;
  if (schema.type === "object" && schema.additionalProperties) return `${typeWords(schema.additionalProperties)} by name`;
  return {integer: "whole number", string: "text", boolean: "true or false", null: "nothing"}[schema.type] ?? schema.type ?? "value";
}

/** Name and fields of a schema; nested schemas open on demand. */
function fields(schema) {
  const inner = resolved(schema.type === "array" ? schema.items : schema), names = Object.entries(inner.properties ?? {});
  const title = typeWords(schema).replace("value", "JSON value");
  if (!names.length) return title;
  return h("details", {class: "schema"}, h("summary", {}, title, inner.description && h("span", {class: "muted"}, " ", coded(inner.description))),
    h("ul", {}, names.map(([name, one]) => h("li", {}, h("code", {}, name), ` ${typeWords(one)}`))));
}

function example(path, method, parameters, body) {
  const filled = parameters.filter(({in: place}) => place === "path").reduce((text, {name, schema}) => text.replace(`{${name}}`, schema.examples?.[0] ?? name.toUpperCase()), path);
  const data = body ? ` -H 'content-type: application/json' -d '${JSON.stringify(Object.fromEntries(Object.entries(resolved(body).properties ?? {}).map(([name, one]) => [name, one.type === "array" ? ["…"] : "…"])))}'` : "";
  return `curl ${method === "get" ? "" : `-X ${method.toUpperCase()} `}-H "Authorization: Bearer $EMBOMATRIX_TOKEN" '${location.origin}${filled}'${data}`;
}

/** Form that sends a reading call with the viewer's token. */
function trial(path, parameters, kind) {
  const said = h("pre", {tabindex: "0", hidden: true, "aria-live": "polite"});
  const inputs = parameters.map(({name, in: place, schema = {}}) => h("input", {name, "data-in": place, placeholder: name, "aria-label": name, required: place === "path", size: 14, value: schema.examples?.[0] && place === "path" ? "" : undefined}));
  return [h("form", {class: "bar", onsubmit: event => { event.preventDefault(); send(path, inputs, kind, said); }}, inputs, h("button", {}, "Send")), said];
}

async function send(path, inputs, kind, said) {
  const values = inputs.filter(input => input.value), own = values.filter(input => input.dataset.in === "path").reduce((text, {name, value}) => text.replace(`{${name}}`, encodeURIComponent(value)), path);
  const query = new URLSearchParams(values.filter(input => input.dataset.in !== "path").map(({name, value}) => [name, value]));
  said.hidden = false;
  said.textContent = "…";
  try {
    if (kind && !kind.includes("json")) { said.textContent = `The answer is ${kind}: open it with the example above.`; return; }
    const text = JSON.stringify(await ask(`${own.replace("/api/v1/", "")}${query.size ? `?${query}` : ""}`), null, 1);
    said.textContent = text.length > SHOWN ? `${text.slice(0, SHOWN)}\n… ${text.length - SHOWN} more characters` : text;
  } catch (error) {
    said.textContent = error.message;
  }
}
