"""The page of `coflash ui` in a real Chromium, as a person uses it.

usage: ui_page.py SCENARIO --coflash PROGRAM --node PROGRAM --folder DIR [--bus URL --image FILE] [--pictures DIR]

Each scenario starts its own nodes (coboot-node) and its own `coflash ui`, and looks at nothing but what the page
shows. What a person does is done by the browser's own input: keys, clicks and drags of files and folders.
"""

import argparse
import contextlib
import csv
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
import urllib.error
import urllib.request
import zlib
from pathlib import Path

from playwright.sync_api import expect, sync_playwright

# The time after which a step counts as hanging, in milliseconds. It is not used to measure
# anything.
PATIENCE = 120_000
expect.set_options(timeout=PATIENCE)

VENDOR, PRODUCT = 0x1A2B, 0x42
SCENARIOS = {}


def scenario(function):
    SCENARIOS[function.__name__] = function
    return function


class Bench:
    """Programs, files and the browser of one scenario."""

    def __init__(self, arguments, browser, stack):
        self.arguments, self.browser, self.stack = arguments, browser, stack
        self.folder = Path(arguments.folder)
        self.complaints = []

    def free_port(self):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            return probe.getsockname()[1]

    def spawn(self, *command, until, **variables):
        """Starts a program, and waits for a line with `until`; returns the program and the line."""
        # Its error messages go to this script's standard error.
        variables = {**os.environ, **{name: str(value) for name, value in variables.items()}}
        program = subprocess.Popen([str(word) for word in command], stdout=subprocess.PIPE, text=True, env=variables)
        self.stack.callback(end, program)
        for line in program.stdout:
            if until in line:
                return program, line.strip()
        raise AssertionError(f"{command}: it never says {until!r}")

    def nodes(self, port, *options):
        node, _ = self.spawn(self.arguments.node, "--listen", f"127.0.0.1:{port}", "--folder", self.folder,
                             *options, until=f"127.0.0.1:{port}")
        return node

    def ui(self, bus=None, *options):
        """Starts the server; returns the program and the URL."""
        bus = ["--bus", bus] if bus else []
        program, line = self.spawn(self.arguments.coflash, *bus, "ui", "--no-open", *options, until="http://127.0.0.1:")
        return program, re.search(r"http://127\.0\.0\.1:\d+/[0-9a-f]{32}/", line)[0]

    def page(self, url, width=1280, height=900, **options):
        context = self.browser.new_context(viewport={"width": width, "height": height}, **options)
        context.set_default_timeout(PATIENCE)
        page = context.new_page()
        # A script that fails, or that the page's own policy blocks, is reported there. Requests
        # that the server refuses are reported there, too, but are no errors of the page; nor is a
        # connection that is lost on purpose.
        page.on("console", lambda message: self.complaint(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: self.complaint(str(error)))
        page.goto(url)
        expect(page.locator("#version")).not_to_be_empty()
        return page

    def complaint(self, words):
        if not words.startswith("Failed to load resource") and "net::ERR" not in words:
            self.complaints.append(words)

    def image(self, name, size=8 * 1024, seed=1, vendor=VENDOR, product=PRODUCT):
        """A block file with a program of `size` bytes, made by the host tool from a raw image."""
        words = [0x2001_0000, 0x0802_0201] + [0] * 2
        body = bytes((seed * 7 + at * 31 + (at >> 8)) & 0xFF for at in range(size - 16))
        raw, blocks = self.folder / f"{name}.bin", self.folder / f"{name}.blk"
        raw.write_bytes(struct.pack("<4I", *words) + body)
        subprocess.run([self.arguments.coflash, "--quiet", "convert", "-I", "binary", "--board", "stm32f407g-disc1",
                        "--vid", hex(vendor), "--pid", hex(product), raw, blocks], check=True)
        return blocks

    def package(self, *programs):
        """A package for a machine: the programs with what its recipe says of each."""
        recipe, package = self.folder / "machine.toml", self.folder / "machine.cpk"
        lines = ["name = 'Press 4'", "release = '2026-11'"]
        for image, more in programs:
            lines += ["[[program]]", f"image = '{image.name}'", more]
        recipe.write_text("\n".join(lines))
        subprocess.run([self.arguments.coflash, "--quiet", "package", recipe, "-o", package], check=True)
        return package

    def picture(self, page, name, last=None):
        """Saves a screenshot: from the top to the end of the last element shown, or of the whole page."""
        if self.arguments.pictures:
            Path(self.arguments.pictures).mkdir(parents=True, exist_ok=True)
            page.evaluate("scrollTo(0, 0)")
            size = page.viewport_size
            clip = None
            if last:
                box = page.locator(last).bounding_box()
                clip = {"x": 0, "y": 0, "width": size["width"], "height": box["y"] + box["height"] + 12}
            page.screenshot(path=f"{self.arguments.pictures}/ui-{name}.png", full_page=True, clip=clip)


def end(program):
    if program.poll() is None:
        program.kill()
    program.wait()


IDENTITY = ["--vendor-id", hex(VENDOR), "--product-code", hex(PRODUCT)]
TWO = ["--node", "5", "--count", "2", "--serial", "0x100", "--stand-in", *IDENTITY]


def drop(page, *paths):
    """Drags files or folders from the desktop onto the page, with the browser's own input."""
    # Only a visible element gets input.
    page.locator("#drop").scroll_into_view_if_needed()
    box = page.locator("#drop").bounding_box()
    at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    devtools = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(Path(path).resolve()) for path in paths], "dragOperationsMask": 1}
    for kind in ["dragEnter", "dragOver", "drop"]:
        devtools.send("Input.dispatchDragEvent", {"type": kind, **at, "data": data})
    devtools.detach()


def connected(page):
    expect(page.locator("#adapter-state")).to_have_class("pill open")


def scan(page, count):
    page.get_by_role("button", name="Search the bus").click()
    # The table may have had the same number of rows before: the result shows that the search is
    # over.
    expect(page.locator("#notice")).to_contain_text(re.compile(rf"{count} devices? found"))
    expect(page.locator("#rows tr")).to_have_count(count)
    idle(page)


def idle(page):
    expect(page.locator("#task")).to_have_text("Nothing is being done.")


def update_line(page, node):
    return page.locator(f'.update[data-node="{node}"]')


def sending(page, node=5):
    """Waits until the program is being sent: a part of it is transferred, but not all."""
    page.wait_for_function(
        "node => { const bar = document.querySelector(`.update[data-node=\"${node}\"] progress`);"
        " return bar && bar.value > 0.02 && bar.value < 0.95 }", arg=node)


def page_with_two_nodes(bench):
    """A page that has found two nodes; with its address, the port of the bus, the nodes and the tool."""
    port = bench.free_port()
    node = bench.nodes(port, *TWO)
    program, url = bench.ui(f"socketcand://127.0.0.1:{port}/can0")
    page = bench.page(url)
    connected(page)
    scan(page, 2)
    return page, url, port, node, program


@scenario
def two_nodes(bench):
    """Two nodes get a program from a dropped file; the report has their serial numbers."""
    port = bench.free_port()
    bench.nodes(port, *TWO)
    program, url = bench.ui()
    page = bench.page(url)
    expect(page.locator("#update-hint")).to_have_text("Connect to an adapter first.")
    page.get_by_label("Address of the bus").fill(f"socketcand://127.0.0.1:{port}/can0")
    page.keyboard.press("Enter")
    connected(page)
    # The address bar and the history contain only the page's own address.
    assert page.url == url, page.url
    scan(page, 2)
    expect(page.locator("#rows")).to_contain_text("bootloader")
    drop(page, bench.image("app", size=300 * 1024))
    expect(page.locator("#file-facts")).to_contain_text("app.blk")
    expect(page.locator("#file-facts")).to_contain_text("vendor-ID 00001A2Bh, product code 00000042h")
    expect(page.locator("#inspection")).to_contain_text("block file")
    expect(page.locator(".verdict.yes")).to_have_count(2)
    page.get_by_label("Choose all devices").check()
    page.get_by_role("button", name="Update 2 devices").click()
    sending(page)
    bench.picture(page, "update", "#devices")
    for node in [5, 6]:
        expect(update_line(page, node)).to_have_attribute("data-phase", "done")
    idle(page)
    expect(page.locator("#notice")).to_contain_text("2 of 2 devices updated with app.blk")
    expect(page.locator("#rows")).to_contain_text("in the device already")
    expect(page.locator("#rows tr").first).to_contain_text("application")
    report = page.locator("#report-rows")
    for serial in ["00000100h", "00000101h"]:
        expect(report).to_contain_text(serial)
    # The CRC of the report is the file's, which the host tool prints as well.
    info = subprocess.run([bench.arguments.coflash, "--json", "inspect", bench.folder / "app.blk"], check=True,
                          capture_output=True, text=True).stdout
    crc = f'{int(re.search(r"crc.:([0-9]+),.size.:[0-9]+,.start", info)[1]):08X}h'
    expect(report.locator("tr").nth(1)).to_contain_text(crc)
    page.emulate_media(media="print")
    expect(page.locator("#report-head")).to_be_visible()
    expect(page.locator("#devices")).to_be_hidden()
    bench.picture(page, "print")
    page.emulate_media(media="screen")
    # The page shows the frames on the bus in words, and the filter selects some of them.
    page.get_by_label("Show frames with").fill("node 6 heartbeat")
    expect(page.locator("#frame-rows tr").first).to_contain_text("node 6: heartbeat")
    expect(page.locator("#frame-rows")).not_to_contain_text("node 5")
    with page.expect_download() as download:
        page.get_by_role("link", name="Save the log").click()
    log = Path(download.value.path()).read_text()
    first = log.splitlines()[0]
    assert re.fullmatch(r"\(\d+\.\d{6}\) can0 [0-9A-F]{3}#[0-9A-F]*", first), first
    assert "605#" in log and "586#" in log, "the transfer is in the log"
    replay = bench.folder / "page.log"
    replay.write_text(log)
    shown = subprocess.run([bench.arguments.coflash, "monitor", "--replay", replay, "--count", "5"], check=True,
                           capture_output=True, text=True).stdout
    assert len(shown.splitlines()) == 5, shown
    # Ctrl-C ends the server without an error.
    program.send_signal(signal.SIGINT)
    assert program.wait(timeout=60) == 0
    expect(page.locator("#lost")).to_be_visible()


@scenario
def unplugged(bench):
    """The server of the adapter ends in the middle of an update, and comes back."""
    page, _, port, node, _ = page_with_two_nodes(bench)
    drop(page, bench.image("app", size=300 * 1024))
    page.get_by_label("Choose node 5").check()
    page.get_by_role("button", name="Update node 5").click()
    sending(page)
    end(node)
    expect(update_line(page, 5)).to_have_attribute("data-phase", "failed")
    expect(update_line(page, 5)).to_contain_text("no complete program")
    expect(page.locator("#adapter-state")).to_have_class("pill lost")
    expect(page.locator("#adapter-words")).to_contain_text("The adapter is lost")
    expect(page.locator("#report-rows")).to_contain_text("failed")
    bench.picture(page, "unplugged", "#devices")
    # Without the adapter the page allows no requests to it.
    expect(page.get_by_role("button", name="Search the bus")).to_be_disabled()
    bench.nodes(port, *TWO)
    connected(page)
    expect(page.locator("#adapter-words")).to_be_hidden()
    page.get_by_role("button", name="Update node 5").click()
    expect(update_line(page, 5)).to_have_attribute("data-phase", "done")
    idle(page)


@scenario
def refused(bench):
    """An image for another product is refused by its label, other files by their contents."""
    page, url, _, _, _ = page_with_two_nodes(bench)
    drop(page, bench.image("other", product=0x43))
    expect(page.locator(".verdict.no").first).to_contain_text("made for product code 00000043h, this device has 00000042h")
    page.get_by_label("Choose node 5").check()
    page.get_by_role("button", name="Update node 5").click()
    expect(page.locator("#notice")).to_have_attribute("role", "alert")
    expect(page.locator("#notice")).to_contain_text("not for node 5")
    expect(page.locator("#notice")).to_contain_text("no device was changed")
    bench.picture(page, "refused", "#devices")
    expect(page.locator(".update")).to_have_count(0)
    folder = bench.folder / "folder"
    folder.mkdir(exist_ok=True)
    (folder / "app.hex").write_text(":00000001FF\n")
    files = {
        "empty.hex": (b"", "empty"),
        "page.html": (b"<!doctype html><title>404 not found</title>", "not a firmware file"),
        "zeros.elf": (bytes(3000), "not a firmware file"),
    }
    for name, (content, _) in files.items():
        (bench.folder / name).write_bytes(content)
    huge = bench.folder / "huge.bin"
    with open(huge, "wb") as file:
        # The sparse file takes no room on the disk.
        file.truncate(200 * 1024 * 1024)
    wrong = [(bench.folder / name, words) for name, (_, words) in files.items()]
    wrong += [(folder, "hat is a folder"), (huge, "more than any program")]
    for path, words in wrong:
        drop(page, path)
        expect(page.locator("#notice")).to_contain_text(words)
    drop(page, bench.folder / "other.blk", bench.folder / "empty.hex")
    expect(page.locator("#notice")).to_contain_text("ne file at a time")
    # A browser opens a dropped file, unless the page handles it.
    assert page.url == url
    # After all these files the right one is accepted.
    drop(page, bench.image("app"))
    expect(page.locator(".verdict.yes")).to_have_count(2)


@scenario
def reload_keeps_the_choice(bench):
    """The chosen devices, the file and the options are those of before a reload, in this tab alone."""
    page, url, _, _, _ = page_with_two_nodes(bench)
    drop(page, bench.image("app"))
    expect(page.locator("#file-facts")).to_contain_text("app.blk")
    page.get_by_label("Choose node 6").check()
    trial = page.get_by_label("Trial run first").is_checked()
    page.get_by_label("Trial run first").set_checked(not trial)
    page.get_by_label("Start the program at the end").uncheck()
    page.get_by_label("Show frames with").fill("node 6")
    page.get_by_label("Board").select_option("stm32f407g-disc1")
    page.reload()
    expect(page.get_by_role("button", name="Update node 6")).to_be_enabled()
    expect(page.get_by_label("Choose node 6")).to_be_checked()
    expect(page.get_by_label("Choose node 5")).not_to_be_checked()
    expect(page.locator("#file-facts")).to_contain_text("app.blk")
    expect(page.locator("#version")).to_contain_text("version")
    expect(page.get_by_label("Trial run first")).to_be_checked(checked=not trial)
    expect(page.get_by_label("Start the program at the end")).not_to_be_checked()
    expect(page.get_by_label("Show frames with")).to_have_value("node 6")
    expect(page.get_by_label("Board")).to_have_value("stm32f407g-disc1")
    # Another tab begins with nothing chosen.
    second = bench.page(url)
    expect(second.locator("#rows tr")).to_have_count(2)
    expect(second.get_by_label("Choose node 6")).not_to_be_checked()
    expect(second.get_by_label("Trial run first")).to_be_checked(checked=trial)
    # What is no longer chosen stays so.
    page.get_by_label("Choose node 6").uncheck()
    page.reload()
    expect(page.locator("#rows tr")).to_have_count(2)
    expect(page.get_by_label("Choose node 6")).not_to_be_checked()
    second.close()
    page.close()


@scenario
def reload_in_mid_update(bench):
    """A reload of the page, a second tab and a closed tab do not disturb a running update."""
    page, url, _, _, program = page_with_two_nodes(bench)
    drop(page, bench.image("app", size=500 * 1024))
    page.get_by_label("Choose node 5").check()
    page.get_by_role("button", name="Update node 5").click()
    sending(page)
    page.reload()
    expect(update_line(page, 5)).to_have_attribute("data-phase", "running")
    expect(page.locator("#task")).to_contain_text("The update of 1 device with app.blk")
    expect(page.locator("#file-facts")).to_contain_text("app.blk")
    second = bench.page(url)
    expect(update_line(second, 5)).to_have_attribute("data-phase", "running")
    expect(second.get_by_role("button", name="Update", exact=True)).to_be_disabled()
    # The page disables the button; the server refuses the request as well.
    answer = second.evaluate(
        "async () => { const response = await fetch('update', { method: 'POST', headers: { 'content-type':"
        " 'application/json' }, body: JSON.stringify({ nodes: [6], trial: false, start: true }) });"
        " return [response.status, await response.text()] }")
    assert answer[0] == 409 and "the update of 1 device with app.blk" in answer[1], answer
    page.close()
    expect(update_line(second, 5)).to_have_attribute("data-phase", "done")
    idle(second)
    expect(second.locator("#report-rows")).to_contain_text("00000100h")
    # A server that does not answer any more counts as lost, and is found again when it is back.
    expect(second.locator("#lost")).to_be_hidden()
    program.send_signal(signal.SIGSTOP)
    expect(second.locator("#lost")).to_contain_text("connection to coflash is lost")
    program.send_signal(signal.SIGCONT)
    expect(second.locator("#lost")).to_be_hidden()
    expect(second.locator("#report-rows")).to_contain_text("00000100h")


@scenario
def single_steps(bench):
    """Call back, release, erase after a question, only by keys; LSS sets node-ID and bit rate."""
    port = bench.free_port()
    bench.nodes(port, "--unconfigured", "--serial", "0x200", "--stand-in", *IDENTITY)
    _, url = bench.ui(f"socketcand://127.0.0.1:{port}/can0")
    page = bench.page(url)
    connected(page)
    page.get_by_role("button", name="Find a device without node-ID").click()
    expect(page.get_by_label("Serial number")).to_have_value("00000200h")
    expect(page.get_by_label("Vendor-ID")).to_have_value("00001A2Bh")
    page.get_by_label("New node-ID").fill("9")
    page.get_by_label("New bit rate").select_option("250")
    bench.picture(page, "lss")
    page.get_by_role("button", name="Give it to the device").click()
    expect(page.locator("#notice")).to_contain_text("the device is node 9 now", ignore_case=True)
    expect(page.locator("#notice")).to_contain_text("250 kbit/s")
    idle(page)
    scan(page, 1)
    drop(page, bench.image("app"))
    page.get_by_label("Choose node 9").check()
    page.get_by_role("button", name="Update node 9").click()
    expect(update_line(page, 9)).to_have_attribute("data-phase", "done")
    idle(page)
    row = page.locator('#rows tr[data-node="9"]')
    expect(row).to_contain_text("application")
    more = page.get_by_role("button", name="More about node 9")

    def press(name):
        """Moves to a button of the device's dialog with the tab key, and presses it."""
        more.focus()
        page.keyboard.press("Enter")
        expect(page.locator("#device")).to_be_visible()
        for _ in range(12):
            if page.evaluate("document.activeElement.textContent") == name:
                page.keyboard.press("Enter")
                return
            page.keyboard.press("Tab")
        raise AssertionError(f"{name!r} is not reached")

    press("Call back to the bootloader (80h)")
    expect(page.locator("#notice")).to_contain_text("the bootloader is running")
    expect(row).to_contain_text("bootloader")
    idle(page)
    press("Release for autostart (83h)")
    expect(page.locator("#notice")).to_contain_text("released for autostart")
    assert "signed" not in page.locator("body").inner_text().lower()
    idle(page)
    press("Erase the program …")
    # The question has the harmless answer selected.
    expect(page.locator("#confirm")).to_be_visible()
    assert page.evaluate("document.activeElement.textContent") == "Keep it"
    page.keyboard.press("Escape")
    expect(page.locator("#confirm")).to_be_hidden()
    expect(row.locator("code")).not_to_have_text("–")
    press("Erase the program …")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    expect(page.locator("#notice")).to_contain_text("is erased")
    expect(row.locator("code")).to_have_text("–")
    idle(page)
    # This device does not allow its program to be read.
    press("Read the program back")
    expect(page.locator("#notice")).to_have_attribute("role", "alert")
    idle(page)


def readable(page, width, where):
    """Nothing is cut off, all text has its contrast, and all fields have names."""
    wide = page.evaluate("document.documentElement.scrollWidth")
    assert wide <= width, f"{where}: the page is {wide} wide"
    out = page.evaluate(
        "width => [...document.querySelectorAll(':is(main, dialog) *:not(.hidden, .hidden *, .hidden-input, thead, thead *)')]"
        ".filter(e => e.checkVisibility() && !e.closest('pre, #frames, #plot') && e.getBoundingClientRect().right"
        " > width + 1).map(e => e.outerHTML.slice(0, 80))", width)
    assert out == [], f"{where}: {out}"
    thin = page.evaluate(CONTRAST)
    assert thin == [], f"{where}: {thin}"
    nameless = page.evaluate(
        "[...document.querySelectorAll('input, select, button, progress')].filter(e => e.checkVisibility()"
        " && !(e.labels?.length || e.ariaLabel || e.textContent.trim())).map(e => e.outerHTML.slice(0, 80))")
    assert nameless == [], f"{where}: {nameless}"


# Gives the page a sealed device and a bootloader's file, which these nodes do not have: what it shows of them is as long
# as it can be.
SEALED = """async () => {
  const devices = await import(new URL("devices.js", location));
  const state = await new Promise((done) => {
    const events = new EventSource("events");
    events.onmessage = ({ data }) => {
      const told = JSON.parse(data).state;
      if (!told) return;
      events.close();
      done(told);
    };
  });
  Object.assign(state.devices[5], {
    security: { sealed: true, roots: ["1A2B3C4Dh", "5E6F7081h"], counters: [12, 4294967295], epoch: 3 },
    state: "stays in the bootloader: the program has crashed; 3 resets in a row that nobody requested",
    supply: "sufficient", option_bytes: "RDP level 1, BOR level 3, nWRP FFEh",
    renewable: "version 1.4.0, services 3, renewed as program 254",
    warnings: ["the device's read protection is off: everybody with a debugger can read its keys"],
  });
  state.firmware = { ...state.firmware, name: "bootloader.blk", version: "1.5.0", is_bootloader: true };
  devices.show(state);
}"""


@scenario
def looks(bench):
    """No part is cut off at 1280, 800 and 390 pixels, light and dark; fields have names; no key trap."""
    first, url, _, _, _ = page_with_two_nodes(bench)
    drop(first, bench.image("app"))
    first.get_by_label("Choose all devices").check()
    first.get_by_role("button", name="Update 2 devices").click()
    expect(update_line(first, 6)).to_have_attribute("data-phase", "done")
    idle(first)
    for width, height in [(1280, 900), (800, 900), (390, 844)]:
        for scheme in ["light", "dark"]:
            page = bench.page(url, width, height, color_scheme=scheme)
            expect(page.locator("#rows tr")).to_have_count(2)
            # On a narrow screen the parts are behind tabs, and none of them is long.
            tabs = page.locator("#tabs button").all() if width == 390 else [None]
            for tab in tabs:
                name = f"{width}-{scheme}"
                if tab:
                    tab.click()
                    name += f"-{tab.get_attribute('data-tab')}"
                    tall = page.evaluate("document.documentElement.scrollHeight")
                    assert tall <= 2500, f"{name}: {tall}"
                if tab is None or name.endswith("bus"):
                    expect(page.locator("#frame-rows tr").first).to_be_visible()
                bench.picture(page, name)
                if name == "390-dark-update":
                    bench.picture(page, "small", "#table")
                readable(page, width, name)
            if width == 390:
                # What leads to another part opens it.
                page.get_by_role("button", name="Update", exact=True).click()
                page.get_by_role("button", name="More about node 5").click()
                page.get_by_role("button", name="Use its address for LSS").click()
                expect(page.get_by_label("New node-ID")).to_be_focused()
                page.get_by_role("button", name="Update", exact=True).click()
            page.evaluate(SEALED)
            expect(page.locator('#rows tr[data-node="5"]')).to_contain_text("sealed")
            for button, dialog in [("More about node 5", "device"), ("Renew the bootloader of node 5", "renew")]:
                if dialog == "renew":
                    page.get_by_label("Choose node 5").check()
                page.get_by_role("button", name=button).click()
                # A long dialog begins with its head, not with the first of its buttons.
                expect(page.locator(f"#{dialog} h2")).to_be_in_viewport()
                bench.picture(page, f"{width}-{scheme}-{dialog}", f"#{dialog}")
                readable(page, width, f"{width} {scheme} {dialog}")
                page.keyboard.press("Escape")
            page.context.close()
    # The tab key moves through all elements, in the order of the page, and then out of it.
    page = bench.page(url)
    expect(page.locator("#rows tr")).to_have_count(2)
    seen = []
    for _ in range(80):
        page.keyboard.press("Tab")
        here = page.evaluate("document.activeElement === document.body ? null : [document.activeElement.id,"
                             " document.activeElement.getBoundingClientRect().top + scrollY]")
        if here is None:
            break
        seen.append(here[0])
    else:
        raise AssertionError(f"the keys do not get out: {seen}")
    order = ["adapter-list", "adapter-url", "connect", "file", "board", "program", "map", "scan", "all", "trial", "password",
             "fastscan", "lss-0", "lss-node", "assign", "run", "print", "bit-rate", "filter", "trace", "frames"]
    places = [seen.index(name) for name in order]
    assert places == sorted(places), list(zip(order, places))
    # The elements that report the state to a screen reader.
    for name in ["task", "notice", "adapter-state"]:
        assert page.locator(f"#{name}").get_attribute("role") in ("status", "alert"), name


# WCAG 2.1, 1.4.3: text has a contrast of 4.5 against its background.
CONTRAST = """() => {
  const parts = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((c) => c / 255)
    .map((c) => c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = (e) => { for (; e; e = e.parentElement) {
    const colour = parts(getComputedStyle(e).backgroundColor);
    if (colour.length < 4 || colour[3] === 1) return colour; } return [255, 255, 255]; };
  const bad = [];
  for (const e of document.querySelectorAll("body *")) {
    const own = [...e.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    if (!own || !e.checkVisibility() || e.disabled || e.closest(".off")) continue;
    const [a, b] = [light(parts(getComputedStyle(e).color)), light(behind(e))];
    const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (contrast < 4.5) bad.push([e.textContent.trim().slice(0, 30), contrast]);
  }
  return bad;
}"""


def stationed(page, name):
    """Waits until the station has this state."""
    expect(page.locator("#banner")).to_have_attribute("data-station", name)


def writing(page):
    """Waits until a device is being written: a part of its program is transferred."""
    page.wait_for_function("() => document.querySelector('progress')?.value > 2")


def reach(page, name):
    """Moves to the button or field with this name or id by the tab key."""
    for _ in range(40):
        here = page.evaluate("[document.activeElement.id, document.activeElement.textContent.trim()]")
        if name in here:
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"{name!r} is not reached")


def press(page, name):
    """Moves to a button by the tab key, and presses it: one click of a person."""
    reach(page, name)
    page.keyboard.press("Enter")


# Counts the clicks of a page: a pressed key that presses a button is one, too.
CLICKS = "() => { window.clicks = 0; document.addEventListener('click', () => (window.clicks += 1), true); }"

# Counts the tones that a page plays.
TONES = """() => {
  window.tones = 0;
  const create = AudioContext.prototype.createOscillator;
  AudioContext.prototype.createOscillator = function () { window.tones += 1; return create.call(this); };
}"""


def away(folder):
    """Puts a file in the place of a folder: as good as a full disk, also for root."""
    folder.rename(folder.with_suffix(".away"))
    folder.write_text("")


def back(folder):
    """Puts the folder back."""
    folder.unlink()
    folder.with_suffix(".away").rename(folder)


def reports(bench):
    """The rows of all saved tables of reports, by their files' names."""
    rows = {}
    for path in sorted((bench.folder / "reports").glob("*.csv")):
        with open(path, newline="", encoding="utf-8") as file:
            rows[path.stem] = list(csv.DictReader(file))
        assert path.with_suffix(".html").is_file(), path
    return rows


@scenario
def service(bench):
    """A machine is updated by keys alone, in three presses; a barcode goes into its field; the reports are saved."""
    port = bench.free_port()
    bench.nodes(port, *TWO)
    package = bench.package((bench.image("drive", size=120 * 1024), f"vendor = {VENDOR}\nproduct = {PRODUCT}\ncount = 2"))
    options = ["--service", package, "--report-dir", bench.folder / "reports"]
    _, url = bench.ui(None, *options)
    page = bench.page(url, locale="de-AT")
    page.evaluate(TONES)
    stationed(page, "closed")
    assert page.locator("html").get_attribute("lang") == "de"
    expect(page.locator("#package")).to_have_text("Paket: Press 4 2026-11 (machine.cpk) · Nicht signiert")
    page_words = page.locator("body").inner_text()
    for word in ["LSS", "Erase", "Löschen", "stm32", "Board"]:
        assert word not in page_words, word
    page.evaluate(CLICKS)
    reach(page, "Verbinden")
    page.keyboard.type("4711\n\n")
    assert page.evaluate("window.clicks") == 0, "there is no field for a barcode yet, and it presses no button"
    reach(page, "adapter-list")
    page.keyboard.press("End")
    reach(page, "address")
    page.keyboard.type(f"socketcand://127.0.0.1:{port}/can0")
    # The first press.
    page.keyboard.press("Enter")
    stationed(page, "ready")
    expect(page.locator("#search")).to_be_focused()
    expect(page.locator("#state")).to_have_text("Bereit")
    reach(page, "operator")
    page.keyboard.type("Jörg")
    # A reader of barcodes sends characters and Enter, whatever has the focus: it presses no button.
    page.keyboard.press("Tab")
    page.keyboard.type("A-77\n")
    assert page.evaluate("document.activeElement.id") == "device-number"
    reach(page, "Geräte suchen")
    page.keyboard.type("4711\n")
    for name, value in [("operator", "Jörg"), ("order", "A-77"), ("device-number", "4711")]:
        expect(page.locator(f"#{name}")).to_have_value(value)
    stationed(page, "ready")
    # The second press.
    press(page, "Geräte suchen")
    stationed(page, "planned")
    # The focus goes with the work.
    expect(page.locator("#update")).to_be_focused()
    expect(page.locator(".device")).to_have_count(2)
    expect(page.locator('.device[data-node="5"]')).to_contain_text("00000100h")
    expect(page.locator('.device[data-node="5"]')).to_contain_text("drive: kein Programm → CRC ")
    # A number that is read again replaces the last one.
    reach(page, "2 Geräte aktualisieren")
    page.evaluate(CLICKS)
    # A reader may send Enter twice (CR LF), or hold it.
    page.keyboard.type("4712\n\n")
    expect(page.locator("#device-number")).to_have_value("4712")
    page.keyboard.down("Enter")
    page.keyboard.down("Enter")
    page.keyboard.up("Enter")
    page.keyboard.type("4713\n\n")
    expect(page.locator("#device-number")).to_have_value("4713")
    # The button is pressed by a person.
    assert page.evaluate("window.clicks") == 0, page.evaluate("window.clicks")
    assert not reports(bench), reports(bench)
    # The third press.
    press(page, "2 Geräte aktualisieren")
    stationed(page, "working")
    expect(page.locator("#stop")).to_be_focused()
    expect(page.locator('.device[data-state="state-working"]').first).to_contain_text("%")
    expect(page.locator("#device-number")).to_have_value("")
    stationed(page, "good")
    expect(page.locator("#search")).to_be_focused()
    expect(page.locator("#number")).to_have_text("Gerätenummer: 4713")
    expect(page.locator("#saved-count")).to_have_text("3 Berichte sind gespeichert:")
    assert page.evaluate("window.tones") == 2, page.evaluate("window.tones")
    saved = reports(bench)
    assert [rows[0]["serial_number"] for rows in saved.values()] == ["00000100h", "00000101h"], saved
    for rows in saved.values():
        (row,) = rows
        assert (row["result"], row["program"], row["from"]) == ("updated", "drive", ""), row
        assert (row["operator"], row["order"], row["device_number"]) == ("Jörg", "A-77", "4713"), row
        assert (row["package"], row["release"], row["file"]) == ("Press 4", "2026-11", "machine.cpk"), row
    # The report is that of a user with this language, and needs no script.
    html = next((bench.folder / "reports").glob("*_node-5*.html"))
    report = page.context.new_page()
    report.goto(html.as_uri())
    expect(report.locator("h1")).to_have_text("Bericht über ein Update")
    expect(report.locator("body")).to_contain_text("4713")
    bench.picture(report, "service-report")
    report.close()
    # The sheet of the machine has what sha256sum says of the package, and the token is in no address that is printed.
    page.context.add_init_script("window.print = () => { window.printed = location.href; }")
    with page.context.expect_page() as opened:
        page.get_by_role("link", name="Blatt der Maschine drucken").click()
    sheet = opened.value
    sheet.wait_for_function("window.printed")
    assert url.split("/")[3] not in sheet.evaluate("window.printed"), sheet.url
    sums = subprocess.run(["sha256sum", package], check=True, capture_output=True, text=True).stdout.split()
    for part in [sums[0], f"CRC-32 {zlib.crc32(package.read_bytes()):08X}h", "2 von 2 gut", "Nicht signiert", "00000101h", "Probelauf", "Unterschrift", "coflash 0.1.0 ("]:
        expect(sheet.locator("body")).to_contain_text(part)
    if bench.arguments.pictures:
        sheet.pdf(path=f"{bench.arguments.pictures}/ui-service-sheet.pdf", prefer_css_page_size=True)
    sheet.close()
    # What is done is not done again.
    page.bring_to_front()
    press(page, "Erneut suchen")
    stationed(page, "complete")
    expect(page.locator('.device[data-state="state-has"]')).to_have_count(2)
    expect(page.locator(".device input")).to_have_count(0)
    # The language is a matter of a key; what was entered stays.
    press(page, "English")
    expect(page.locator("#state")).to_have_text("Nothing to do: every device has its program")
    expect(page.locator("#operator")).to_have_value("Jörg")
    page.reload()
    expect(page.locator("#state")).to_have_text("Nothing to do: every device has its program")
    page.context.close()
    # The next start has the adapter of this one, and an English browser has its language.
    _, url = bench.ui(None, *options)
    page = bench.page(url, locale="en-GB")
    stationed(page, "ready")
    expect(page.locator("#state")).to_have_text("Ready")
    expect(page.locator("#adapter-name")).to_have_text(f"socketcand://127.0.0.1:{port}/can0")


@scenario
def service_full(bench):
    """Without room for the reports no device is changed; a closed browser loses nothing."""
    port = bench.free_port()
    bench.nodes(port, *TWO)
    package = bench.package((bench.image("drive", size=300 * 1024), f"vendor = {VENDOR}\nproduct = {PRODUCT}"))
    folder = bench.folder / "reports"
    bus = f"socketcand://127.0.0.1:{port}/can0"
    program, url = bench.ui(bus, "--service", package, "--report-dir", folder)
    page = bench.page(url, locale="en-GB")
    stationed(page, "ready")
    page.get_by_role("button", name="Search the devices").click()
    stationed(page, "planned")
    away(folder)
    page.get_by_label("Device number").fill("4711")
    # The answer to the request comes after the states that it has led to.
    held = []
    page.route("**/update", lambda route: held.append((route, route.fetch())))
    page.get_by_role("button", name="Update 2 devices").click()
    expect(page.locator("#message")).to_contain_text("Reports cannot be saved in")
    expect(page.locator("#message")).to_contain_text("until then no device is changed")
    while not held:
        page.wait_for_timeout(20)
    ((route, answer),) = held
    route.fulfill(response=answer)
    page.unroute("**/update")
    # A request after it: its answer is read later.
    page.evaluate("fetch('station').then((answer) => answer.text())")
    stationed(page, "planned")
    expect(page.locator("#device-number")).to_have_value("4711")
    back(folder)
    page.get_by_label("Update node 6").uncheck()
    # A device that was left out is so after a reload.
    page.reload()
    expect(page.get_by_label("Update node 6")).not_to_be_checked()
    page.get_by_role("button", name="Update 1 device").click()
    # The disk is full in mid-update, and the browser is closed.
    writing(page)
    away(folder)
    page.context.close()
    page = bench.page(url, locale="en-GB")
    stationed(page, "good-unsaved")
    expect(page.locator("#unsaved")).to_contain_text("Reports that are not saved: 2.")
    expect(page.locator('.device[data-node="6"]')).to_have_attribute("data-state", "state-left-out")
    bench.picture(page, "service-unsaved")
    with page.expect_download() as download:
        page.get_by_role("link", name="Take report 1 with the browser").click()
    assert "00000100h" in Path(download.value.path()).read_text(), download.value.suggested_filename
    # It stays through another search, and is saved when there is room again.
    page.get_by_role("button", name="Search again").click()
    stationed(page, "planned")
    expect(page.locator("#unsaved")).to_be_visible()
    back(folder)
    page.get_by_role("button", name="Save again").click()
    expect(page.locator("#unsaved")).to_be_hidden()
    expect(page.locator("#message")).to_be_hidden()
    (rows,) = reports(bench).values()
    assert (rows[0]["device_number"], rows[0]["serial_number"]) == ("4711", "00000100h"), rows
    # Stopping asks first, and the outcome is kept, too.
    page.get_by_role("button", name="Update 1 device").click()
    writing(page)
    page.get_by_role("button", name="Stop").click()
    assert page.evaluate("document.activeElement.textContent") == "Go on"
    page.keyboard.type("4711\n")
    expect(page.locator("#confirm")).to_be_visible()
    page.get_by_role("button", name="Stop the update").click()
    stationed(page, "bad")
    expect(page.locator('.device[data-node="6"]')).to_contain_text("It was stopped.")
    assert sorted(row[0]["result"] for row in reports(bench).values()) == ["failed", "had", "updated"], reports(bench)
    # What is said is what is so: the device was being written.
    expect(page.locator("#state")).to_have_text("A device has no program now")
    expect(page.locator('.device[data-node="6"] .state')).to_have_text("Has no program now")
    program.send_signal(signal.SIGINT)
    assert program.wait(timeout=60) == 0
    expect(page.locator("#lost")).to_be_visible()


@scenario
def service_tabs(bench):
    """The browser gets no token as an argument; seven pages leave a connection for Stop; a missing answer is said."""
    port = bench.free_port()
    bench.nodes(port, *TWO)
    package = bench.package((bench.image("drive", size=300 * 1024), f"vendor = {VENDOR}\nproduct = {PRODUCT}"))
    browser, opened = bench.folder / "bin" / "xdg-open", bench.folder / "opened"
    browser.parent.mkdir()
    browser.write_text(f'#!/bin/sh\necho "$@" >{opened}.new && mv {opened}.new {opened}\n')
    browser.chmod(0o755)
    words = [bench.arguments.coflash, "--bus", f"socketcand://127.0.0.1:{port}/can0", "ui", "--service", package]
    program, line = bench.spawn(*words, "--report-dir", bench.folder / "reports", until="http://127.0.0.1:",
                                PATH=f"{browser.parent}:{os.environ['PATH']}", HOME=bench.folder)
    url = line.split()[0]
    while not opened.exists():
        time.sleep(0.05)
    door = Path(opened.read_text().strip())
    # /proc/PID/cmdline shows the arguments to every user (proc(5)).
    assert url.split("/")[3] not in str(door), door
    assert door.parent == bench.folder and door.stat().st_mode & 0o777 == 0o600, door
    first = bench.page(door.as_uri(), locale="en-GB")
    assert first.url == url, first.url
    stationed(first, "ready")
    first.get_by_role("button", name="Search the devices").click()
    tabs = [first]
    for _ in range(6):
        tabs.append(first.context.new_page())
        tabs[-1].goto(url)
        stationed(tabs[-1], "planned")
    last = tabs[-1]
    last.get_by_role("button", name="Update 2 devices").click()
    for tab in tabs:
        writing(tab)
    last.get_by_role("button", name="Stop").click()
    last.get_by_role("button", name="Stop the update").click()
    for tab in tabs:
        stationed(tab, "bad")
    # The pages that stay do not need the one that came first.
    first.close()
    last.get_by_role("button", name="Search again").click()
    stationed(last, "planned")
    program.send_signal(signal.SIGSTOP)
    last.get_by_role("button", name="Search again").click()
    expect(last.locator("#message")).to_contain_text("coflash has not answered.")
    program.send_signal(signal.SIGCONT)
    program.send_signal(signal.SIGINT)
    assert program.wait(timeout=60) == 0
    assert not door.exists(), door


@scenario
def service_adapters(bench):
    """The adapter of the last time is chosen, with its bit rate; one whose bit rate the system sets has none here."""
    package = bench.package((bench.image("drive"), f"vendor = {VENDOR}\nproduct = {PRODUCT}"))
    _, url = bench.ui(None, "--service", package, "--report-dir", bench.folder / "reports")
    page = bench.page(url, locale="en-GB")
    # Adapters that this machine does not have.
    found = [{"url": "socketcan:can9", "kind": "port-socketcan", "name": "can9", "product": None, "state": "port-off"},
             {"url": "slcan:/dev/none@500k", "kind": "port-serial", "name": "/dev/none", "product": "CANable", "state": None}]

    def told(route):
        answer = route.fetch()
        route.fulfill(response=answer, json={**answer.json(), "adapters": found, "last": "slcan:/dev/none@250k"})

    page.route("**/station", told)
    page.reload()
    expect(page.get_by_label("Adapter")).to_have_value("slcan:/dev/none")
    expect(page.get_by_label("Bit rate")).to_have_value("250k")
    expect(page.locator("#address")).to_be_hidden()
    # Each has its name, in the language of the user.
    expect(page.locator("#adapter-list option")).to_have_text(
        ["CAN interface can9 · switched off", "Serial port /dev/none · CANable", "Another address …"])
    page.get_by_role("button", name="Deutsch").click()
    expect(page.locator("#adapter-list option")).to_have_text(
        ["CAN-Schnittstelle can9 · ausgeschaltet", "Serieller Anschluss /dev/none · CANable", "Andere Adresse …"])
    page.get_by_role("button", name="English").click()

    def asked():
        with page.expect_request("**/open") as request:
            page.get_by_role("button", name="Connect").click()
        return request.value.post_data_json["url"]

    assert asked() == "slcan:/dev/none@250k"
    expect(page.locator("#message")).to_contain_text("The adapter cannot be opened.")
    expect(page.locator("#message")).to_contain_text("/dev/none")
    page.get_by_label("Bit rate").select_option("1M")
    assert asked() == "slcan:/dev/none@1M"
    page.get_by_label("Adapter").select_option("socketcan:can9")
    expect(page.get_by_label("Bit rate")).to_be_hidden()
    assert asked() == "socketcan:can9"
    page.get_by_label("Adapter").select_option("Another address …")
    page.get_by_role("textbox", name="Address").fill("slcan:/dev/other@125k")
    assert asked() == "slcan:/dev/other@125k"
    # The server has no such adapter.
    expect(page.locator("#message")).to_contain_text("/dev/other")
    stationed(page, "closed")


@scenario
def service_looks(bench):
    """A good, a bad and a foreign device at three widths, light and dark, in both languages: nothing is cut off."""
    port = bench.free_port()
    bench.nodes(port, *TWO)
    package = bench.package(
        (bench.image("drive", size=200 * 1024), f"nodes = [5]\nvendor = {VENDOR}\nproduct = {PRODUCT}"),
        (bench.image("valve", vendor=0x63, product=2), "nodes = [9]\nvendor = 0x63\nproduct = 2"),
        # A script could take these characters of a name for a pattern.
        (bench.image("tap", vendor=0x63, product=3), "name = '$& {found} $$'\nvendor = 0x63\nproduct = 3\ncount = 2"))
    _, url = bench.ui(f"socketcand://127.0.0.1:{port}/can0", "--service", package, "--report-dir", bench.folder / "reports")
    kinds = [(width, scheme, locale) for width in (1280, 800, 390) for scheme in ("light", "dark") for locale in ("en-GB", "de-DE")]

    def look(url, step):
        for width, scheme, locale in kinds:
            page = bench.page(url, width, 844 if width == 390 else 900, color_scheme=scheme, locale=locale)
            expect(page.locator("#banner")).to_have_attribute("data-station", re.compile("ready|bad|none|planned"))
            assert page.locator("html").get_attribute("lang") == locale[:2]
            bench.picture(page, f"service-{step}-{width}-{scheme}-{locale[:2]}")
            readable(page, width, f"{step} {width} {scheme} {locale}")
            if step == "bad":
                expect(page.locator("#rows")).to_contain_text("$& {found} $$: 2 ")
                part = "Hersteller-ID" if locale == "de-DE" else "Vendor-ID"
                expect(page.locator("#others li")).to_have_text(re.compile(rf"6: .+ · {part}.+: [0-9A-F]{{8}}h / [0-9A-F]{{8}}h / "))
            page.context.close()

    first = bench.page(url, locale="en-GB")
    for step in ["ready", "bad", "working", "ended"]:
        if step == "bad":
            first.get_by_role("button", name="Search the devices").click()
            stationed(first, "planned-bad")
        elif step == "working":
            first.get_by_role("button", name="Update 1 device").click()
            writing(first)
            bench.picture(first, "service", "#devices")
            continue
        elif step == "ended":
            stationed(first, "bad")
            expect(first.locator("#message")).to_be_hidden()
        look(url, step)
    # A job file whose device is not there; a package for a lift, which is always locked.
    job = bench.folder / "job.toml"
    job.write_text("[[program]]\nimage = 'drive.blk'\nnodes = [9]\n")
    lift = bench.package((bench.image("door"), "nodes = [6]\ndialect = 'lift'"))
    for step, file, end in [("job", job, "none"), ("password", lift, "planned")]:
        _, url = bench.ui(f"socketcand://127.0.0.1:{port}/can0", "--service", file, "--report-dir", bench.folder / "reports")
        page = bench.page(url, locale="en-GB")
        if file == job:
            expect(page.locator("#package")).to_have_text("Job file: job.toml")
        else:
            expect(page.locator("#package")).to_contain_text("Not signed")
        page.get_by_role("button", name="Search the devices").click()
        stationed(page, end)
        expect(page.locator("#password")).to_be_visible(visible=file == lift)
        look(url, step)


@scenario
def service_machine(bench):
    """Emulated boards, of which one is sealed and two have programs in C, get the programs of a package."""
    _, url = bench.ui(bench.arguments.bus, "--service", bench.arguments.image, "--report-dir", bench.folder / "reports")
    page = bench.page(url, locale="en-GB")
    page.get_by_role("button", name="Search the devices").click()
    stationed(page, "planned")
    expect(page.locator("#others li")).to_have_count(1)
    page.get_by_role("button", name="Update 8 devices").click()
    stationed(page, "good")
    assert len(list((bench.folder / "reports").glob("*.csv"))) == 8


@scenario
def emulated(bench):
    """The emulated board gets an application's ELF through the page."""
    _, url = bench.ui(bench.arguments.bus)
    page = bench.page(url)
    connected(page)
    scan(page, 1)
    drop(page, bench.arguments.image)
    expect(page.locator("#file-facts")).to_contain_text("CRC")
    page.get_by_label("Choose all devices").check()
    page.locator("#update").click()
    line = page.locator(".update")
    # The next line says which one, with the page's message.
    expect(line).to_have_attribute("data-phase", re.compile("done|failed"))
    expect(line).to_have_attribute("data-phase", "done")
    idle(page)
    expect(page.locator("#rows")).to_contain_text("application")
    # The application's own data.
    expect(page.locator("#rows")).to_contain_text("1.0.0")
    expect(page.locator("#report-rows")).to_contain_text("the program runs")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", choices=sorted(SCENARIOS))
    parser.add_argument("--coflash", required=True)
    parser.add_argument("--node")
    parser.add_argument("--folder", required=True)
    parser.add_argument("--bus")
    parser.add_argument("--image")
    parser.add_argument("--pictures")
    arguments = parser.parse_args()
    chromium = os.environ.get("COBOOT_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if not chromium:
        sys.exit("there is no chromium: `cargo xtask setup` installs it")
    # As root Chromium has no sandbox.
    options = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright, contextlib.ExitStack() as stack:
        browser = playwright.chromium.launch(executable_path=chromium, args=options)
        stack.callback(browser.close)
        bench = Bench(arguments, browser, stack)
        SCENARIOS[arguments.scenario](bench)
        assert not bench.complaints, bench.complaints
    print(f"{arguments.scenario}: done")


if __name__ == "__main__":
    main()
