// Questions to the manager, with the token that the viewer gave.

export class Refused extends Error {}

/** JSON of a path below /api/v1; throws Refused with a sentence. */
export async function ask(path, options = {}) {
  const token = sessionStorage.getItem("token");
  const headers = {...(token ? {authorization: `Bearer ${token}`} : {}), ...(options.body ? {"content-type": "application/json"} : {})};
  const answer = await fetch(`/api/v1/${path}`, {cache: "no-store", headers, signal: AbortSignal.timeout(5000), ...options});
  if (answer.status === 401) {
    document.getElementById("ask").hidden = false;
    throw new Refused("the token is missing or wrong");
  }
  if (!answer.ok) {
    const text = await answer.text();
    let told = text;
    try { told = JSON.parse(text).detail ?? text; } catch { /* a sentence already */ }
    throw new Refused(typeof told === "string" && told ? told : `the manager answers ${answer.status}`);
  }
  document.getElementById("ask").hidden = true;
  return answer.json();
}

export const change = (path, body) => ask(path, {method: "POST", body: body ? JSON.stringify(body) : undefined});
