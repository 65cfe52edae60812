// Requests to the manager, with the viewer's token.

/** The manager refused a request; the message is its sentence. */
export class Refused extends Error {}
/** No whole answer arrived in time. */
export class Unanswered extends Error {}

/** JSON of a path below /api/v1. Throws Refused or Unanswered. */
export async function ask(path, options = {}) {
  const response = await answer(path, options);
  return received(response.json());
}

/** Wait for a part of an answer. Every failure means that the manager is away or too slow. */
async function received(part) {
  try {
    return await part;
  } catch (error) {
    throw new Unanswered("the manager does not answer", {cause: error});
  }
}

/** A picture as a data URL, since an image element sends no token. */
export async function picture(path) {
  const reader = new FileReader(), read = new Promise(done => reader.addEventListener("load", done));
  const response = await answer(path);
  reader.readAsDataURL(await received(response.blob()));
  await read;
  return reader.result;
}

async function answer(path, options = {}) {
  const token = sessionStorage.getItem("token");
  const headers = {...(token ? {authorization: `Bearer ${token}`} : {}), ...(options.body ? {"content-type": "application/json"} : {})};
  const response = await received(fetch(`/api/v1/${path}`, {cache: "no-store", headers, signal: AbortSignal.timeout(5000), ...options}));
  if (response.status === 401) {
    document.getElementById("ask").hidden = false;
    throw new Refused(token ? "this token is unknown, expired or revoked: enter another" : "this manager asks for a token");
  }
  if (!response.ok) {
    const text = await received(response.text());
    let why = text;
    try { why = JSON.parse(text).detail ?? text; } catch { /* plain text */ }
    throw new Refused(typeof why === "string" && why ? why : `the manager answered with status ${response.status}`);
  }
  // A viewer who opened the form keeps it until the token is entered.
  const form = document.getElementById("ask");
  if (!form.dataset.wanted) form.hidden = true;
  return response;
}

export const change = (path, body) => ask(path, {method: "POST", body: body ? JSON.stringify(body) : undefined});
