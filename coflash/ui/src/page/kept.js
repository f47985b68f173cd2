// What the user has chosen, kept over a reload of the page: in this tab, for this run of coflash.

import { $ } from "./dom.js";

/** The path contains the token, which is new with each start. */
const PLACE = location.pathname;

function stored() {
  try {
    return { ...JSON.parse(sessionStorage.getItem(PLACE)) };
  } catch {
    // Without a storage nothing is kept.
    return {};
  }
}

const values = stored();

/** The value of this name before the reload; undefined for none. */
export const kept = (name) => values[name];

/** Keeps a value. */
export function keep(name, value) {
  if (JSON.stringify(values[name]) === JSON.stringify(value)) return;
  values[name] = value;
  try {
    sessionStorage.setItem(PLACE, JSON.stringify(values));
  } catch {
    // It is full or switched off: the page works without it.
  }
}

/** Keeps what is entered into a field, and enters what was kept. */
export function keepField(id) {
  const field = $(id);
  const part = field.type === "checkbox" ? "checked" : "value";
  if (values[id] !== undefined) field[part] = values[id];
  field.addEventListener("input", () => keep(id, field[part]));
}
