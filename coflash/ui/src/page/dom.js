// Functions that every part of the page uses. Text from outside is inserted as text, never as HTML.

export const $ = (id) => document.getElementById(id);

/** An element with attributes and children; what is null is left out. */
export function el(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value === true) element.setAttribute(key, "");
    else element.setAttribute(key, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Sets a text only where it changes: a live region is read out once for each change. */
export function text(element, words) {
  if (element.textContent !== words) element.textContent = words;
}

/** A number of 32 bits as CANopen's documents write it. */
export const hex = (number) =>
  number === null || number === undefined ? "not told" : number.toString(16).toUpperCase().padStart(8, "0") + "h";

/** `1A2Bh`, `0x1A2B` or decimal; null for anything else. */
export function number(words) {
  const given = words.trim();
  const match = /^(?:0x([0-9a-f]{1,8})|([0-9a-f]{1,8})h|([0-9]{1,10}))$/i.exec(given);
  if (!match) return null;
  const value = match[3] ? parseInt(match[3], 10) : parseInt(match[1] ?? match[2], 16);
  return value <= 0xffffffff ? value : null;
}

/** Terms and what they are. */
export function facts(list, pairs) {
  list.replaceChildren(...pairs.map(([term, value]) => el("div", {}, el("dt", {}, term), el("dd", {}, value))));
}

export function date(seconds) {
  return new Date(seconds * 1000).toLocaleString(undefined, { dateStyle: "medium", timeStyle: "medium" });
}

let shown = 0;

/** Shows the user how something went. */
export function notice(ok, words, advice) {
  const box = $("notice");
  shown += 1;
  const close = el("button", { type: "button", class: "close", "aria-label": "Close this message", onclick: () => (box.hidden = true) }, "×");
  const first = words.charAt(0).toUpperCase() + words.slice(1);
  box.className = ok ? "ok" : "bad";
  box.setAttribute("role", ok ? "status" : "alert");
  box.dataset.shown = shown;
  box.hidden = false;
  box.replaceChildren(
    el("p", {}, el("strong", {}, first + (/[.!?]$/.test(first) ? "" : ".")),
      advice ? " " + advice.charAt(0).toUpperCase() + advice.slice(1) + "." : ""),
    close,
  );
}
