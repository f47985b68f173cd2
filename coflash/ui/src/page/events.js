// The server's stream of events.

/** The server sends something each second; after so many milliseconds of silence it is taken for lost. */
const SILENCE = 6000;

/**
 * Has `take` called with each event, `renew` when they begin anew, and `say` with how the connection is: null while it is
 * there, "lost", or "ended" after a refusal. Returns what opens and closes it.
 */
export function follow(url, take, say, renew = () => {}) {
  let source = null;
  let watch = 0;
  const close = () => {
    clearTimeout(watch);
    source?.close();
  };
  const alive = () => {
    clearTimeout(watch);
    watch = setTimeout(() => {
      say("lost");
      open();
    }, SILENCE);
  };
  const open = () => {
    close();
    source = new EventSource(url);
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
      // The browser does not retry after a refusal: the server has another token, or too many pages.
      say(source.readyState === EventSource.CLOSED ? "ended" : "lost");
      alive();
    };
    alive();
  };
  open();
  return { open, close };
}
