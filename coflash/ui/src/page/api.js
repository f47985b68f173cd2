// Requests to the server, and its stream of events.

import { $, notice, text } from "./dom.js";
import { follow } from "./events.js";

/** Asks the server for something. Shows a refusal to the user; true if there was none. */
export async function ask(what, value) {
  return send(what, { headers: { "content-type": "application/json" }, body: JSON.stringify(value ?? {}) });
}

/** Sends a file: a "firmware", or the memory map of a "board". */
export async function sendFile(what, file) {
  return send(`${what}?name=` + encodeURIComponent(file.name), {
    headers: { "content-type": "application/octet-stream" },
    body: file,
  });
}

async function send(what, options) {
  let response;
  try {
    response = await fetch(what, { method: "POST", ...options });
  } catch {
    notice(false, "the request did not get through", "check that coflash still runs, and try again");
    return false;
  }
  if (response.ok) return true;
  const words = await response.text();
  try {
    const refused = JSON.parse(words);
    notice(false, refused.words, refused.advice);
  } catch {
    notice(false, words || "the server refuses it: " + response.status, "reload the page");
  }
  return false;
}

const LOST = {
  lost: "The connection to coflash is lost; the page tries again. An update that was running goes on without the page.",
  ended: "coflash has ended or was restarted: open the URL that it prints. The page tries again.",
};

/** Has `take` called with each event, and `renew` when they begin anew. */
export function listen(take, renew) {
  const say = (how) => {
    $("lost").hidden = how === null;
    if (how !== null) text($("lost"), LOST[how]);
  };
  const events = follow("events?frames=1", take, say, renew);
  // A browser has few connections for each server: a hidden page frees its connection for others.
  document.addEventListener("visibilitychange", () => (document.hidden ? events.close() : events.open()));
}
