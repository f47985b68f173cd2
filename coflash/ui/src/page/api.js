// Requests to the server, and its stream of events.

import { $, notice, text } from "./dom.js";
import { follow, post } from "./events.js";

/** How long the answer to a file is waited for, in milliseconds: longer than the server takes at most. */
const FILE_PATIENCE = 70_000;

/** Asks the server for something. Shows a refusal to the user; true if there was none. */
export async function ask(what, value) {
  return send(what, { headers: { "content-type": "application/json" }, body: JSON.stringify(value ?? {}) });
}

/** Sends a file: a "firmware", or the memory map of a "board". */
export async function sendFile(what, file) {
  return send(`${what}?name=` + encodeURIComponent(file.name), {
    headers: { "content-type": "application/octet-stream" },
    body: file,
  }, FILE_PATIENCE);
}

async function send(what, options, patience) {
  let response;
  let words;
  try {
    response = await post(what, options, patience);
    if (response.ok) return true;
    words = await response.text();
  } catch (error) {
    if (error.name === "TimeoutError") notice(false, "coflash has not answered", "look whether it was done, close other pages of coflash, and try again");
    else notice(false, "the request did not get through", "check that coflash still runs, and try again");
    return false;
  }
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
  follow("?frames=1", take, say, renew);
}
