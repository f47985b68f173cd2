// The one stream of events of a browser, a worker that all its pages share. A browser has six connections for a server: if
// each page had a stream of its own, six pages would leave none for a request.

/** The server sends something each second; after so many milliseconds of silence it is taken for lost. */
const SILENCE = 6000;

const channel = new BroadcastChannel(location.pathname.replace(/[^/]*$/, ""));
let source = null;
let watch = 0;

function alive() {
  clearTimeout(watch);
  watch = setTimeout(() => {
    channel.postMessage({ how: "lost" });
    open();
  }, SILENCE);
}

function open() {
  source?.close();
  source = new EventSource(`events${location.search}`);
  source.onopen = () => {
    channel.postMessage({ how: null });
    alive();
  };
  source.onmessage = ({ data }) => {
    alive();
    channel.postMessage({ event: JSON.parse(data) });
  };
  source.onerror = () => {
    // The browser does not retry after a refusal: the server has another token, or too many browsers.
    channel.postMessage({ how: source.readyState === EventSource.CLOSED ? "ended" : "lost" });
    alive();
  };
  alive();
}

// One more page: the stream begins anew, with the whole state, for all of them.
onconnect = open;
