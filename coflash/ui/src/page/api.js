// Requests to the server, and its stream of events.

import { $, notice, text } from "./dom.js";

/** Asks the server for something. Shows a refusal to the user; true if there was none. */
export async function ask(what, value) {
  return send(what, { headers: { "content-type": "application/json" }, body: JSON.stringify(value ?? {}) });
}

/** Sends a file. */
export async function sendFile(file) {
  return send("firmware?name=" + encodeURIComponent(file.name), {
    headers: { "content-type": "application/octet-stream" },
    body: file,
  });
}

async function send(what, options) {
  let response;
  try {
    response = await fetch(what, { method: "POST", ...options });
  } catch {
    notice(false, "the request did not get through", "check that coflash ui still runs, and try again");
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

/** The server sends something each second; after so many milliseconds of silence it is taken for lost. */
const SILENCE = 6000;

/** Has `take` called with each event, and `renew` when they begin anew. */
export function listen(take, renew) {
  let source = null;
  let watch = 0;
  const say = (words) => {
    $("lost").hidden = words === null;
    if (words !== null) text($("lost"), words);
  };
  const lost = "The connection to coflash is lost; the page tries again. An update that was running goes on without the page.";
  const alive = () => {
    clearTimeout(watch);
    watch = setTimeout(() => {
      say(lost);
      open();
    }, SILENCE);
  };
  const open = () => {
    source?.close();
    source = new EventSource("events?frames=1");
    source.onopen = () => {
      say(null);
      renew();
      alive();
    };
    source.onmessage = (event) => {
      alive();
      take(JSON.parse(event.data));
    };
    source.onerror = () => {
      say(lost);
      // The browser does not retry after a refusal: the server has another token, or too many pages.
      if (source.readyState === EventSource.CLOSED) {
        say("coflash ui has ended or was restarted: open the URL that it prints. The page tries again.");
      }
      alive();
    };
    alive();
  };
  // A browser has few connections for each server: a hidden page frees its connection for others.
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) {
      clearTimeout(watch);
      source?.close();
    } else {
      open();
    }
  });
  open();
}
