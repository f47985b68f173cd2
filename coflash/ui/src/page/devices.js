// The table of devices, and what can be done with them.

import { ask } from "./api.js";
import { $, el, facts, hex, text } from "./dom.js";
import { keep, kept } from "./kept.js";
import * as tabs from "./tabs.js";

/** Nodes that the user has chosen. */
const chosen = new Set(kept("chosen"));
let shown = "";
let state = null;

const devices = () => Object.values(state?.devices ?? {});
const program = (device) => device.programs.find((one) => one.number === state.settings.program);

/** Shows the devices. The rows are made anew only when one has changed. */
export function show(next) {
  state = next;
  const list = devices();
  for (const node of chosen) if (!list.some((device) => device.node === node)) chosen.delete(node);
  const now = JSON.stringify([list, state.settings.program]);
  if (now !== shown) {
    shown = now;
    rows(list);
  }
  $("table").hidden = list.length === 0;
  $("no-devices").hidden = list.length !== 0;
  text($("no-devices"), state.devices === null
    ? "The bus has not been searched yet."
    : "No device answers, and no frame of a device was received.");
  buttons();
}

function rows(list) {
  const focused = document.activeElement?.dataset?.key;
  $("rows").replaceChildren(...list.map(row));
  if (focused) document.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
}

function row(device) {
  const one = program(device);
  const cell = (label, ...content) => el("td", { role: "cell", "data-label": label }, ...content);
  const name = `Node ${device.node}`;
  const check = el("input", {
    type: "checkbox", "data-key": `choose-${device.node}`, "aria-label": `Choose node ${device.node}`,
    onchange: (event) => {
      if (event.target.checked) chosen.add(device.node);
      else chosen.delete(device.node);
      buttons();
    },
  });
  check.checked = chosen.has(device.node);
  const verdict = device.verdict;
  return el("tr", { role: "row", "data-node": device.node, class: device.answers ? "" : "silent" },
    cell("Choose", check),
    cell("Node", el("strong", {}, String(device.node))),
    cell("Name", device.name ?? "unknown"),
    cell("Runs", device.runs, ...[device.heartbeat, device.security?.sealed ? "sealed" : null]
      .filter((words) => words).map((words) => el("span", { class: "faint" }, ` · ${words}`))),
    cell("Version", device.software ?? "unknown"),
    cell("CRC", el("code", {}, one?.crc ? hex(one.crc) : "–")),
    cell("Program", one?.words ?? "unknown"),
    cell("The file", verdict ? el("span", { class: `verdict ${verdict.fits}` }, verdict.words) : "–"),
    el("td", { role: "cell", class: "more" },
      el("button", {
        type: "button", "data-key": `more-${device.node}`, "aria-label": `More about node ${device.node}`,
        "aria-haspopup": "dialog", title: name, onclick: () => open(device.node),
      }, "More …")),
  );
}

/** What can be pressed now, and why not. */
function buttons() {
  keep("chosen", [...chosen]);
  const list = devices();
  const busy = state.task !== null;
  const ready = state.adapter.state === "open" && !busy;
  for (const id of ["scan", "fastscan", "assign"]) $(id).disabled = !ready;
  for (const id of ["connect", "disconnect", "board", "program", "file", "map"]) $(id).disabled = busy;
  for (const id of ["file", "map"]) $(id).parentElement.classList.toggle("off", busy);
  $("all").checked = list.length > 0 && chosen.size === list.length;
  $("all").indeterminate = chosen.size > 0 && chosen.size < list.length;
  const count = chosen.size;
  text($("update"), label(count));
  for (const id of ["trial", "start"]) $(id).disabled = busy || Boolean(state.firmware?.is_bootloader);
  const why = busy ? "" : state.adapter.state !== "open" ? "Connect to an adapter first."
    : !state.firmware ? "Choose a firmware file first." : count === 0 ? "Choose a device in the table." : "";
  $("update").disabled = busy || why !== "";
  text($("update-hint"), why);
}

/** What a device says about sealed images. */
function sealed(security) {
  if (!security) return [["Sealed", "not reported"]];
  if (!security.sealed) return [["Sealed", "no, it has no keys"]];
  return [
    ["Sealed", "yes: it takes sealed images alone"],
    ["Root keys", security.roots.join(", ") || "not reported"],
    ["Lowest counters", security.counters.map((one, index) => `program ${index + 1}: ${one}`).join(", ") || "not reported"],
    ["Lowest epoch", security.epoch ?? "not reported"],
  ];
}

/** What the button Update says for so many devices. */
function label(count) {
  const what = state.firmware?.is_bootloader ? "Renew the bootloader of" : "Update";
  if (count === 0) return "Update";
  return count === 1 ? `${what} node ${[...chosen][0]}` : `${what} ${count} devices`;
}

let opened = null;

function open(node) {
  opened = node;
  const device = state.devices?.[node];
  if (!device) return;
  const [vendor, product, revision, serial] = device.identity.map(hex);
  text($("device-head"), `Node ${node}`);
  facts($("device-facts"), [
    ["Runs", device.runs],
    ["Name", device.name ?? "unknown"],
    ["Hardware", device.hardware ?? "unknown"],
    ["Software", device.software ?? "unknown"],
    ...sealed(device.security),
    ...[["State", device.state], ["Last reset", device.last_reset], ["What to do", device.advice], ["Supply", device.supply], ["Option bytes", device.option_bytes],
      ["Bootloader", device.renewable]].filter(([, words]) => words),
    ...device.warnings.map((words) => ["Warning", words]),
    ["Vendor-ID", vendor], ["Product code", product], ["Revision", revision], ["Serial number", serial],
    ["Dialect", device.dialect ?? "unknown"],
    ...device.programs.map((one) => [`Program ${one.number}`, `${one.words}${one.crc ? `, CRC ${hex(one.crc)}` : ""}`]),
  ]);
  const off = state.task !== null || state.adapter.state !== "open";
  for (const button of $("device").querySelectorAll("[data-step]")) button.disabled = off;
  $("use-address").disabled = device.identity.some((part) => part === null);
  $("device").showModal();
}

export function start() {
  $("scan").addEventListener("click", () => ask("scan"));
  $("cancel").addEventListener("click", () => ask("cancel"));
  $("all").addEventListener("change", (event) => {
    chosen.clear();
    if (event.target.checked) devices().forEach((device) => chosen.add(device.node));
    shown = "";
    show(state);
  });
  $("update-form").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!state.firmware?.is_bootloader) return update(false);
    const { name, version } = state.firmware;
    const [who, own] = chosen.size === 1 ? [`Node ${[...chosen][0]} gets`, "its own"] : [`${chosen.size} devices get`, "their own"];
    text($("renew-words"), `${who} the bootloader ${version} of ${name} in place of ${own}. The programs stay. ` +
      "A new bootloader runs on trial first; until it has answered and is installed, a reset brings the old one back.");
    $("renew").showModal();
  });
  $("renew").addEventListener("close", () => {
    if ($("renew").returnValue === "yes") update(true);
    $("renew").returnValue = "";
  });
  for (const button of $("device").querySelectorAll("[data-step]")) {
    button.addEventListener("click", () => step(button.dataset.step));
  }
  $("confirm").addEventListener("close", () => {
    if ($("confirm").returnValue === "yes") ask("step", { node: opened, program: state.settings.program, step: "erase" });
    $("confirm").returnValue = "";
  });
  $("use-address").addEventListener("click", () => {
    state.devices?.[opened]?.identity.forEach((part, index) => ($(`lss-${index}`).value = hex(part)));
    $("device").close();
    tabs.open("lss");
    $("lss-node").focus();
  });
}

/** Updates the chosen devices. The password is sent, and kept nowhere. */
async function update(renew) {
  const [nodes, password] = [[...chosen].sort((a, b) => a - b), $("password").value];
  if (await ask("update", { nodes, trial: $("trial").checked, start: $("start").checked, renew, password })) $("password").value = "";
}

function step(name) {
  $("device").close();
  if (name === "erase") {
    text($("confirm-words"), `Program ${state.settings.program} of node ${opened} will be erased. The device stays in ` +
      "its bootloader until it gets another program.");
    $("confirm").showModal();
    return;
  }
  ask("step", { node: opened, program: state.settings.program, step: name });
}

/** A bar for each device of the update. */
export function updates(list) {
  const box = $("updates");
  const now = list.map((one) => one.node).join();
  if (box.dataset.nodes !== now) {
    box.dataset.nodes = now;
    box.replaceChildren(...list.map((one) => el("div", { class: "update", "data-node": one.node },
      el("strong", {}, `Node ${one.node}`),
      el("progress", { max: "1", value: "0", "aria-label": `Update of node ${one.node}` }),
      el("span", { class: "percent" }),
      el("p", { class: "words" }),
      el("details", {}, el("summary", {}, "Steps"), el("ol", {})),
    )));
  }
  list.forEach((one, index) => {
    const line = box.children[index];
    line.dataset.phase = one.phase;
    const part = one.phase === "done" ? 1 : one.total > 0 ? one.done / one.total : 0;
    const bar = line.querySelector("progress");
    bar.value = part;
    text(line.querySelector(".percent"), `${Math.floor(part * 100)} %`);
    text(line.querySelector(".words"), one.words + (one.advice ? " " + one.advice.charAt(0).toUpperCase() + one.advice.slice(1) + "." : ""));
    const steps = line.querySelector("ol");
    if (steps.children.length !== one.lines.length) steps.replaceChildren(...one.lines.map((words) => el("li", {}, words)));
  });
}
