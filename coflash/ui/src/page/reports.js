// A report about each run, to print.

import { $, date, el, facts, hex, text } from "./dom.js";

let reports = [];
let known = "";

export function show(list) {
  reports = list;
  const now = String(list.length && list[list.length - 1].number);
  if (now === known) return;
  known = now;
  $("no-reports").hidden = list.length > 0;
  $("report").hidden = list.length === 0;
  const runs = [...new Map(list.map((one) => [one.run, one])).values()].reverse();
  $("run").replaceChildren(...runs.map((one) => el("option", { value: one.run }, `${one.run}: ${date(one.date)}, ${one.file}`)));
  fill();
}

function fill() {
  const run = reports.filter((one) => String(one.run) === $("run").value);
  if (run.length === 0) return;
  const first = run[0];
  const good = run.filter((one) => one.ok).length;
  text($("report-head"), `Update of ${date(first.date)}`);
  facts($("report-facts"), [
    ["File", first.file], ["CRC of the file", hex(first.file_crc)], ["Version of the file", first.file_version ?? "unknown"],
    ["Result", `${good} of ${run.length} devices updated`], ["Adapter", first.adapter], ["Tool", `coflash ${first.tool}`],
  ]);
  const cell = (label, ...content) => el("td", { "data-label": label }, ...content);
  $("report-rows").replaceChildren(...run.map((one) => el("tr", {},
    cell("Node", String(one.node)), cell("Device", one.device ?? "unknown"),
    cell("Serial number", el("code", {}, hex(one.serial_number))),
    cell("CRC", el("code", {}, one.crc ? hex(one.crc) : "–")),
    cell("Version", one.version ?? "unknown"),
    cell("Result", `${one.words}, ${one.seconds.toFixed(1)} s`))));
}

export function start() {
  $("run").addEventListener("change", fill);
  $("print").addEventListener("click", () => window.print());
  // A browser prints the address of the page, too, and that has the token.
  const address = location.pathname;
  addEventListener("beforeprint", () => history.replaceState(null, "", "/"));
  addEventListener("afterprint", () => history.replaceState(null, "", address));
}
