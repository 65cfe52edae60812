// Questions to the manager, with the token that the viewer gave.

export class Refused extends Error {}

/** JSON of a path below /api/v1; throws Refused with a sentence. */
export async function ask(path, options = {}) {
  return (await answer(path, options)).json();
}

/** A picture as a URL that the page may show: an image of its own would carry no token. */
export async function picture(path) {
  const reader = new FileReader(), read = new Promise(done => reader.addEventListener("load", done));
  reader.readAsDataURL(await (await answer(path)).blob());
  await read;
  return reader.result;
}

async function answer(path, options = {}) {
  const token = sessionStorage.getItem("token");
  const headers = {...(token ? {authorization: `Bearer ${token}`} : {}), ...(options.body ? {"content-type": "application/json"} : {})};
  const told = await fetch(`/api/v1/${path}`, {cache: "no-store", headers, signal: AbortSignal.timeout(5000), ...options});
  if (told.status === 401) {
    document.getElementById("ask").hidden = false;
    throw new Refused("the token is missing or wrong");
  }
  if (!told.ok) {
    const text = await told.text();
    let why = text;
    try { why = JSON.parse(text).detail ?? text; } catch { /* a sentence already */ }
    throw new Refused(typeof why === "string" && why ? why : `the manager answers ${told.status}`);
  }
  document.getElementById("ask").hidden = true;
  return told;
}

export const change = (path, body) => ask(path, {method: "POST", body: body ? JSON.stringify(body) : undefined});
