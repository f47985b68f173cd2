// The page of `coflash ui`. The server holds the state; the page shows it and sends requests.

import { ask, listen, sendFile } from "./api.js";
import * as bus from "./bus.js";
import * as devices from "./devices.js";
import { $, el, facts, hex, notice, number, text } from "./dom.js";
import { keepField, kept } from "./kept.js";
import * as reports from "./reports.js";
import * as tabs from "./tabs.js";

let fileMax = 32 * 1024 * 1024;
/** The last notice of the server that was shown; null until the page has got its first state. */
let told = null;
let state = null;

const CONNECTION = { closed: "not connected", opening: "connecting …", open: "connected", lost: "adapter lost, trying again …" };

function show(next) {
  const before = state;
  state = next;
  const { adapter, task } = state;
  text($("adapter-state"), CONNECTION[adapter.state] + (adapter.url && adapter.state !== "closed" ? `: ${adapter.url}` : ""));
  $("adapter-state").className = `pill ${adapter.state}`;
  $("adapter-words").hidden = adapter.words === null;
  text($("adapter-words"), adapter.words ? `The adapter is lost: ${adapter.words}. coflash tries to open it again every second.` : "");
  $("disconnect").hidden = adapter.state === "closed";
  if (adapter.url && adapter.url !== before?.adapter.url && document.activeElement !== $("adapter-url")) $("adapter-url").value = adapter.url;
  if (adapter.bit_rate && adapter.bit_rate !== before?.adapter.bit_rate) $("bit-rate").value = adapter.bit_rate;
  const words = task ? (task.cancelling ? "Cancelling: " : "") + task.words : "Nothing is being done.";
  text($("task"), words.charAt(0).toUpperCase() + words.slice(1));
  $("cancel").hidden = task === null;
  $("cancel").disabled = task?.cancelling ?? false;
  $("task-progress").hidden = task === null;
  if (task?.percent != null) $("task-progress").value = task.percent / 100;
  else $("task-progress").removeAttribute("value");
  document.body.classList.toggle("busy", task !== null);
  if (state.notice && state.notices !== told && (told !== null || !state.notice.ok)) {
    notice(state.notice.ok, state.notice.words, state.notice.advice);
  }
  told = state.notices;
  file(state.firmware);
  offer(state.settings.board);
  if (document.activeElement !== $("board")) $("board").value = state.settings.board ?? "";
  if (document.activeElement !== $("program")) $("program").value = state.settings.program;
  devices.show(state);
  devices.updates(state.updates);
  if (state.lss && JSON.stringify(state.lss) !== JSON.stringify(before?.lss ?? null)) {
    const { vendor_id, product_code, revision, serial_number } = state.lss;
    [vendor_id, product_code, revision, serial_number].forEach((part, index) => ($(`lss-${index}`).value = hex(part)));
  }
  const read = state.readback;
  $("readback").hidden = read === null;
  if (read && JSON.stringify(read) !== JSON.stringify(before?.readback ?? null)) {
    $("readback").replaceChildren(`Program ${read.program} of node ${read.node}, ${read.size} bytes: `,
      el("a", { href: "readback", download: true, class: "button" }, "Save it"));
  }
  reports.show(state.reports);
}

/** Adds a board to the list; that of the user's file is not there from the beginning. */
function offer(board) {
  const known = [...$("board").options].some((option) => option.value === (board ?? ""));
  if (!known) $("board").append(el("option", { value: board }, board));
}

function file(firmware) {
  $("file-shown").hidden = firmware === null;
  if (!firmware) return;
  facts($("file-facts"), [
    ["File", firmware.name],
    ["Program", `${firmware.program_size} bytes`],
    ["CRC", hex(firmware.crc)],
    ["Version", firmware.version ?? "unknown"],
    ["Made for", firmware.vendor_id === null ? "unknown" : `vendor-ID ${hex(firmware.vendor_id)}, product code ${hex(firmware.product_code)}`],
    ...(firmware.seal ? seal(firmware.seal) : []),
    ...(firmware.left_out > 0 ? [["Left out", `${firmware.left_out} bytes outside the program's region`]] : []),
  ]);
  text($("inspection"), firmware.inspection);
}

/** The statements of a sealed image; only the device can check them. */
function seal({ program, counter, signed_by, opened_by, flags }) {
  const keys = (ids) => ids.map(hex).join(", ");
  return [
    ["Program number", program],
    ["Security counter", counter],
    ["Signed by", `key ${keys(signed_by)} (the device checks it)`],
    ["Encrypted for", opened_by.length > 0 ? `key ${keys(opened_by)}` : "no key: it is not encrypted"],
    ["Contents", flags.length > 0 ? flags.join(", ") : "as in flash"],
  ];
}

/** Takes the one file that was dropped or chosen. */
async function take(files) {
  if (files.length !== 1) {
    notice(false, "one file at a time is taken", "choose the firmware file alone");
    return;
  }
  const [given] = files;
  if (given.size > fileMax) {
    notice(false, `the file ${given.name} has ${given.size} bytes: more than any program`, "choose the firmware file itself");
    return;
  }
  if (state?.task) {
    notice(false, "not now: something is being done", "wait until it has finished, or cancel it");
    return;
  }
  if (given.name.toLowerCase().endsWith(".toml")) {
    if (await sendFile("board", given)) notice(true, `the memory map ${given.name} was read, and its board is chosen`);
  } else if (await sendFile("firmware", given)) notice(true, `the file ${given.name} was read and checked`);
}

function dropping() {
  let depth = 0;
  const over = (on) => document.body.classList.toggle("over", on);
  document.addEventListener("dragenter", (event) => { event.preventDefault(); depth += 1; over(true); });
  document.addEventListener("dragleave", () => { depth -= 1; if (depth <= 0) over(false); });
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    depth = 0;
    over(false);
    const entries = [...(event.dataTransfer?.items ?? [])].map((item) => item.webkitGetAsEntry?.());
    if (entries.some((entry) => entry?.isDirectory)) {
      notice(false, "that is a folder", "drop the firmware file itself");
      return;
    }
    take([...(event.dataTransfer?.files ?? [])]);
  });
  for (const id of ["file", "map"]) {
    $(id).addEventListener("change", async (event) => {
      const files = [...event.target.files];
      // The user may choose the same file again after a new build.
      event.target.value = "";
      if (files.length > 0) await take(files);
    });
  }
}

async function adapters() {
  const found = await (await fetch("adapters")).json();
  fileMax = found.file_max;
  if (kept("trial") === undefined) $("trial").checked = found.trial;
  text($("version"), `version ${found.version}`);
  $("adapter-list").append(...found.adapters.map((one) => el("option", { value: one.url }, one.words)));
  found.boards.forEach(offer);
  if (state) $("board").value = state.settings.board ?? "";
}

function forms() {
  $("adapter-list").addEventListener("change", (event) => {
    if (event.target.value) $("adapter-url").value = event.target.value;
    $("adapter-url").focus();
  });
  $("adapter-form").addEventListener("submit", (event) => {
    event.preventDefault();
    ask("open", { url: $("adapter-url").value });
  });
  $("disconnect").addEventListener("click", () => ask("close"));
  const settings = () => ask("settings", { board: $("board").value || null, program: Number($("program").value) });
  $("board").addEventListener("change", settings);
  $("program").addEventListener("change", () => { if ($("program").reportValidity()) settings(); });
  $("fastscan").addEventListener("click", () => ask("fastscan"));
  $("lss-form").addEventListener("submit", (event) => {
    event.preventDefault();
    const address = [0, 1, 2, 3].map((index) => number($(`lss-${index}`).value));
    const wrong = address.indexOf(null);
    if (wrong >= 0) {
      notice(false, "a number of the LSS address cannot be read", "write it like 0000001Ah, 0x1A or 26");
      $(`lss-${wrong}`).focus();
      return;
    }
    const node = $("lss-node").value ? Number($("lss-node").value) : null;
    const rate = $("lss-rate").value ? Number($("lss-rate").value) : null;
    ask("assign", { address, node, bit_rate: rate, store: $("lss-store").checked });
  });
}

["trial", "start", "bit-rate", "filter"].forEach(keepField);
tabs.start();
bus.start();
devices.start();
reports.start();
forms();
dropping();
adapters().catch(() => notice(false, "the list of adapters cannot be had", "reload the page"));
listen((event) => {
  if (event.state) show(event.state);
  bus.take(event);
}, bus.renew);
