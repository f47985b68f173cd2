// On a narrow screen the parts of the page are behind tabs; on a wide one all of them are there.

import { $ } from "./dom.js";
import { keep, kept } from "./kept.js";

/** Shows a part of the page. */
export function open(tab) {
  keep("tab", tab);
  document.body.dataset.tab = tab;
  for (const button of $("tabs").children) button.setAttribute("aria-pressed", String(button.dataset.tab === tab));
}

export function start() {
  for (const button of $("tabs").children) button.addEventListener("click", () => open(button.dataset.tab));
  open(kept("tab") ?? "update");
}
