// The server's events, for a page. All pages of a browser share one stream, which stream.js reads.

/**
 * Has `take` called with each event, `renew` when they begin anew, and `say` with how the connection is: null while it is
 * there, "lost", or "ended" after a refusal. `query` says what is wanted; the pages of a server want the same.
 */
export function follow(query, take, say, renew = () => {}) {
  // The path contains the token. The channel is there before the stream begins.
  const channel = new BroadcastChannel(location.pathname);
  channel.onmessage = ({ data: { event, how } }) => {
    if (event) return take(event);
    say(how);
    if (how === null) renew();
  };
  new SharedWorker(`stream.js${query}`);
}

/** How long an answer is waited for, in milliseconds. */
const PATIENCE = 10_000;

/** Sends a request. Without an answer in time it fails with a TimeoutError. */
export function post(what, options, patience = PATIENCE) {
  return fetch(what, { method: "POST", signal: AbortSignal.timeout(patience), ...options });
}
