//! What the tool says of a device against what the device has: each outcome of an update, by each way. The reader is
//! the boot stage's: program and record in the file of the flash, which nothing of the tool reads. The way by Python is
//! in `coflash/python/tests`, from the same table.
//!
//! A row of `outcomes.json`:
//!
//! | member | what it has |
//! |---|---|
//! | `what` | the circumstance |
//! | `device` | the options of the nodes; `--stand-in` if it is missing |
//! | `second` | more options of the second one |
//! | `id` | the node-ID of a device whose bootloader has another one |
//! | `nodes` | whom the tool updates; 5 and 6 if it is missing |
//! | `before`, `before-with` | the file that the devices have, and the options with which they got it |
//! | `gets`, `with` | the file that they get, and the options of `flash` |
//! | `fate` | what happens meanwhile (below) |
//! | `said`, `planned` | what is to be said of each device, and by a way with a plan if it is something else |
//! | `ways` | the ways, if not all of them can have it |
//!
//! A fate comes in the middle, when a part of the new program is in the first device: the devices lose their power
//! (`dies`), the first of them does (`one-dies`), they do and there is another attempt (`returns`), they do before they
//! have acknowledged any data (`dies-early`); the adapter is `unplugged`; the tool gets a signal (`INT`, `TERM`, `HUP`, or
//! `KILL` and another attempt). Or it is there before: no device (`absent`), only the first one (`one-absent`), two with
//! one node-ID (`twins`), or the download of the file before was cut off (`cut-before`).
//!
//! A file is its byte, its version (0 for a raw file, `n` for none in block 0) and a letter: `p`lain, or with its
//! CRC-32 at the end as `z`lib gives it, `d` as the suffix of DFU has it; `i` has it at the end of its first part alone,
//! and the rest is the same in each; `x` is for another product, `L` is too large, `c` is sealed, `h` is Intel HEX, `s` is program 2, `l`
//! has the label of a lift.

use std::os::unix::fs::PermissionsExt as _;
use std::panic::{catch_unwind, resume_unwind};
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock, Mutex};
use std::time::Duration;
use std::{fs, thread};

use boot_core::store::{Journal, Parameters as _, ProgramRecord};
use coboot_node::file_flash::{FileFlash, Speed};
use coflash_agent::Config;
use coflash_core::file::board;
use coflash_core::file::sealed::{Sealer, SigningKey};
use kit::crc::crc32;
use kit::hawkbit::{Action, File, Server};
use kit::http::Page;
use serde_json::{json, Value};
use shared_abi::label::{self, Label};
use shared_abi::layout::Layout;

use crate::agent::{options, serve};
use crate::bus::{program, Coflash, Folder, Nodes};

/// The size of a program, and of its first part.
const SIZE: usize = 96 * 1024;
const OWN: usize = 8 * 1024;

/// The identity of the devices.
const IDENTITY: [&str; 4] = ["--vendor-id", "0x3F", "--product-code", "3"];

/// The file of a program of the host that no system takes as one.
const RUN: &[u8] = b"it ends at once";

/// The ways, as the table names them. The others have a plan.
const WAYS: &str = "one together agent package agent-package page";
const UNPLANNED: [&str; 3] = ["one", "together", "agent"];

static ROWS: LazyLock<Vec<Value>> =
    LazyLock::new(|| serde_json::from_str(include_str!("outcomes.json")).unwrap());

/// A row of the table.
#[derive(Clone, Copy)]
struct Row(&'static Value);

impl Row {
    fn text(self, member: &str) -> &'static str {
        self.0[member].as_str().unwrap_or_default()
    }

    fn words(self, member: &str, otherwise: &'static str) -> Vec<&'static str> {
        self.0[member].as_str().unwrap_or(otherwise).split_whitespace().collect()
    }

    fn nodes(self) -> Vec<&'static str> {
        self.words("nodes", "5 6")
    }

    fn board(self) -> &'static str {
        let name = self.words("device", "").into_iter().skip_while(|word| *word != "--board").nth(1);
        name.unwrap_or("stm32f407g-disc1")
    }

    fn layout(self) -> &'static Layout {
        board::named(self.board()).unwrap()
    }

    fn program(self) -> u8 {
        if self.text("gets").ends_with('s') {
            2
        } else {
            1
        }
    }

    /// Where the program is in the file of a flash.
    fn at(self) -> usize {
        let layout = self.layout();
        (layout.program(self.program()).unwrap().base - layout.chip.flash.base) as usize
    }

    /// The image of a file.
    fn image(self, name: &str) -> Vec<u8> {
        let (byte, letter) = (name.as_bytes()[0], name.as_bytes()[3]);
        let mut bytes = program(byte, if letter == b'L' { 7 * SIZE } else { SIZE });
        let (end, complement) = match letter {
            b'z' => (SIZE, 0),
            b'd' => (SIZE, u32::MAX),
            b'i' => (OWN, 0),
            b's' => {
                // The reset vector.
                bytes[6] = 0x08;
                return bytes;
            }
            b'l' => {
                bytes[label::OFFSET as usize..][..label::SIZE]
                    .copy_from_slice(&Label::new(0x3F, 3, 0).emit());
                return bytes;
            }
            _ => return bytes,
        };
        bytes[end..].fill(0x77);
        let own = crc32(&bytes[..end - 4]) ^ complement;
        bytes[end - 4..end].copy_from_slice(&own.to_le_bytes());
        bytes
    }

    /// The file for the tool: raw, sealed, or as blocks with its version.
    fn file(self, folder: &Folder, coflash: &Coflash, name: &str) -> String {
        let image = self.image(name);
        if name.ends_with('c') {
            let sealer = Sealer { vendor_id: 0x3F, product_code: 3, ..Sealer::default() };
            let sealed = sealer.seal(&image, &SigningKey::from_seed([2; 32]).unwrap()).unwrap();
            folder.write(&format!("{name}.cbs"), &sealed);
            return format!("{name}.cbs");
        }
        if name.ends_with('h') {
            folder.write(&format!("{name}.hex"), kit::ihex::intel_hex(0x0802_0000, &image).as_bytes());
            return format!("{name}.hex");
        }
        let (raw, blocks) = (format!("{name}.bin"), format!("{name}.blk"));
        folder.write(&raw, &image);
        let version = &name[2..3];
        if version == "0" {
            return raw;
        }
        let product = if name.ends_with('x') { "99" } else { "3" };
        let label = ["--vid", "0x3F", "--pid", product, "--ver", version];
        let label = if version == "n" { &label[..4] } else { &label[..] };
        let program = self.program().to_string();
        // One that is too large is made for a larger device.
        let board = if name.ends_with('L') { "stm32f407g-disc1" } else { self.board() };
        let to = [&raw, &blocks, "-I", "binary", "--board", board, "-P", &program];
        coflash.done(&[&["convert"], &to[..], label].concat());
        blocks
    }
}

/// What is said of a device, in one word: each verdict in the text has to be the same.
fn word(said: &str) -> &'static str {
    let words = [
        ("contains no complete program", "erased"),
        ("Has no program now", "erased"),
        ("has no program now", "erased"),
        ("contains the new program, not released", "unreleased"),
        ("the new program, which is not confirmed", "unreleased"),
        ("The device has the new program", "unreleased"),
        ("not released for autostart;", "unreleased"),
        ("it may have the old one", "unknown"),
        ("may have changed it", "unknown"),
        ("Its program is unknown", "unknown"),
        ("It is not known whether the device", "unknown"),
        ("was not changed", "untouched"),
        ("its program is unchanged", "untouched"),
        ("has its old program", "untouched"),
        ("is older: it was not written", "untouched"),
        ("Has a newer program", "untouched"),
        ("is another device than the package says", "untouched"),
        ("is not on the bus", "absent"),
        ("answers, but so does a second device", "untouched"),
        ("Missing", "absent"),
        ("Not updated", "untouched"),
        ("Left alone", "untouched"),
        ("contains the new program", "updated"),
        ("it had this program", "had"),
        ("had it before", "had"),
        ("Has its program", "had"),
        (",had,", "had"),
        (": updated: node", "updated"),
        ("Updated", "updated"),
        (",updated,", "updated"),
    ];
    // The longest at each place: "contains the new program, not released" is not "contains the new program".
    let at =
        |at| words.iter().filter(move |(words, _)| said[at..].starts_with(words)).max_by_key(|it| it.0.len());
    let (mut verdicts, mut end) = (Vec::new(), 0);
    for (place, _) in said.char_indices() {
        if let Some((words, verdict)) = at(place).filter(|_| place >= end) {
            end = place + words.len();
            verdicts.push(*verdict);
        }
    }
    if verdicts.is_empty() && said.contains("done in") {
        verdicts.push("updated");
    }
    verdicts.dedup();
    assert_eq!(verdicts.len(), 1, "one verdict and no other: {verdicts:?} in {said}");
    verdicts[0]
}

/// What a text says of a node: its own lines, and those that go on with them; all, if it names no nodes.
fn of_node(said: &str, node: &str) -> String {
    let own = format!("node {node}: ");
    let is_named = |line: &str| line.starts_with("node ") && line.contains(": ");
    // Of the agent: the nodes with one outcome.
    let lists = |line: &str| {
        let nodes = line.rsplit_once(": node ")?.1.split(", ").collect::<Vec<_>>();
        nodes.iter().all(|node| node.parse::<u8>().is_ok()).then(|| nodes.contains(&node))
    };
    if !said.lines().any(|line| is_named(line) || lists(line).is_some()) {
        return said.to_owned();
    }
    let mut is_own = false;
    let mut is_of = |line: &&str| {
        is_own = line.starts_with(&own) || lists(line) == Some(true) || is_own && line.starts_with("  ");
        is_own
    };
    said.lines().filter(|line| is_of(line)).collect::<Vec<_>>().join("\n")
}

/// What a device has: the bytes of the program, and the record of it if it is complete.
struct Has {
    bytes: Vec<u8>,
    record: Option<ProgramRecord>,
}

impl Has {
    /// Whether this is so of a device that had `before` and gets `new`.
    fn is(&self, word: &str, before: &Self, new: &[u8]) -> bool {
        let is_new = self.record.is_some() && self.bytes == new[..SIZE];
        let same = |record: ProgramRecord| (record.size, record.crc, record.signed, record.version);
        match word {
            "updated" => is_new && self.record.is_some_and(|record| record.signed),
            "had" => is_new && before.bytes == self.bytes,
            "unreleased" => is_new && self.record.is_some_and(|record| !record.signed),
            "untouched" | "absent" => {
                self.bytes == before.bytes && self.record.map(same) == before.record.map(same)
            }
            "erased" => self.record.is_none() && (before.record.is_none() || self.bytes != before.bytes),
            _ => true,
        }
    }
}

/// The state of an outcome's run.
struct Bench {
    row: Row,
    way: &'static str,
    fate: &'static str,
    folder: Folder,
    coflash: Coflash,
    url: String,
    server: Server,
    /// Until their power is cut.
    devices: Vec<Nodes>,
    /// The bus, with a node that nobody names, until it is unplugged.
    bus: Option<Nodes>,
}

impl Bench {
    /// Devices that have what they have before.
    fn new(test: &str, row: Row, way: &'static str) -> Self {
        let folder = Folder::new(test);
        folder.write("run.sh", RUN);
        fs::set_permissions(folder.path("run.sh"), fs::Permissions::from_mode(0o755)).unwrap();
        let bus = Nodes::start(&folder, &["--node", "77", "--serial", "77", "--flash", "instant"]);
        let (coflash, url) = (Coflash::new(&folder, &bus), bus.url().to_owned());
        let (fate, server) = (row.text("fate"), Server::start(&["press"]));
        let (devices, bus) = (Vec::new(), Some(bus));
        let mut bench = Self { row, way, fate, folder, coflash, url, server, devices, bus };
        bench.switch_on();
        let (before, mut nodes) = (row.text("before"), bench.targets());
        nodes.truncate(match fate {
            "absent" => 0,
            "one-absent" => 1,
            _ => nodes.len(),
        });
        if !before.is_empty() && !nodes.is_empty() {
            let flash = ["--watch", "0", "-N", &nodes.join(",")];
            let flash = [&bench.given(before)[..], &flash.map(str::to_owned)].concat();
            let flash: Vec<&str> =
                flash.iter().map(String::as_str).chain(row.words("before-with", "")).collect();
            if fate == "cut-before" {
                let running = bench.coflash.spawn(&flash);
                bench.folder.await_bytes("1.flash", row.at() + OWN);
                kill("INT", running.id());
                running.wait();
            } else {
                bench.coflash.done(&flash);
            }
        }
        bench
    }

    /// Whether something happens in the middle.
    fn strikes(&self) -> bool {
        !["", "absent", "one-absent", "twins", "cut-before"].contains(&self.fate)
    }

    /// The nodes that this way updates.
    fn targets(&self) -> Vec<&'static str> {
        let mut nodes = self.row.nodes();
        nodes.truncate(if matches!(self.way, "one" | "agent") { 1 } else { nodes.len() });
        nodes
    }

    /// The serial numbers of the devices, with their nodes.
    fn serials(&self) -> Vec<(usize, &'static str)> {
        let targets = self.targets();
        let all = if self.fate == "twins" { targets.repeat(2) } else { targets };
        (1..).zip(all).collect()
    }

    fn switch_on(&mut self) {
        let is_slow = self.strikes() || self.fate == "cut-before";
        let flash = ["--flash", if is_slow { "typical" } else { "instant" }];
        for (serial, node) in self.serials() {
            let id = match self.fate {
                "absent" => "15",
                "one-absent" if serial > 1 => "15",
                _ => self.row.words("id", node)[0],
            };
            let (number, more) = (serial.to_string(), self.row.words("second", ""));
            let which = ["--node", id, "--serial", &number];
            let more = if serial == 2 { &more[..] } else { &[] };
            // The last one counts.
            let identity = if more.contains(&"--product-code") { &IDENTITY[..2] } else { &IDENTITY };
            let device = self.row.words("device", "--stand-in");
            let device =
                Nodes::join(&self.folder, &self.url, &[&which[..], &flash, identity, &device, more].concat());
            device.await_line("serial ");
            self.devices.push(device);
        }
    }

    /// What the devices have, by serial number.
    fn have(&self) -> Vec<Has> {
        let of = |(serial, _)| {
            let name = format!("{serial}.flash");
            let bytes = self.folder.part(&name, self.row.at(), SIZE);
            let layout = self.row.layout();
            let flash = FileFlash::open(&self.folder.path(&name), layout, Speed::Instant).unwrap();
            let journal = Journal::open(&flash, layout.parameters);
            Has { bytes, record: journal.program(&flash, self.row.program()) }
        };
        self.serials().into_iter().map(of).collect()
    }

    /// `flash` with this file.
    fn given(&self, name: &str) -> Vec<String> {
        let file = self.row.file(&self.folder, &self.coflash, name);
        let raw = ["-I", "binary", "--board", self.row.board()];
        let raw = if file.ends_with(".bin") { &raw[..] } else { &[] };
        let program = self.row.program().to_string();
        [&["flash", &file, "-P", &program], raw].concat().into_iter().map(str::to_owned).collect()
    }

    /// Has its fate come true, and the tool end if that is it.
    fn strike(&mut self, end: impl FnOnce(&str)) {
        if !self.strikes() {
            return;
        }
        let (at, new) = (self.row.at(), self.row.image(self.row.text("gets")));
        while self.fate != "dies-early" && self.folder.part("1.flash", at + 8, OWN - 8) != new[8..OWN] {
            thread::sleep(Duration::from_millis(5));
        }
        match self.fate {
            "dies" | "dies-early" | "returns" => self.devices.clear(),
            "one-dies" => drop(self.devices.remove(0)),
            "unplugged" => self.bus = None,
            "INT" | "TERM" | "HUP" | "KILL" => end(self.fate),
            _ => {}
        }
    }

    /// Updates by the command line; all that it says.
    fn flash(&mut self, words: &[&str]) -> String {
        let running = self.coflash.spawn(&[words, &self.row.words("with", "")].concat());
        if self.fate == "dies-early" {
            running.await_text("postponed the erase");
        }
        self.strike(|signal| kill(signal, running.id()));
        let done = running.wait();
        done.out + &done.err
    }

    /// Updates by the agent; what the server is told at the end.
    fn agent(&mut self, target: &str, file: &str) -> String {
        self.folder.write("token", b"g\n");
        let (url, board) = (&self.url, self.row.board());
        let text = format!(
            "gateway-token-file = 'token'\npoll-least = 1\nbus = '{url}'\nboard = '{board}'\n{target}\n\
             controller-id = 'press'\n"
        );
        let config = Config::parse(&text, &self.folder.path(""), Some(&self.server.url), None).unwrap();
        // One that was killed goes on with its action.
        let number = if self.fate == "returns" { 1 } else { 2 };
        let is_open =
            self.server.state().targets["press"].action.as_ref().is_some_and(|it| it.result.is_none());
        let goes_on = self.row.text("fate") == "KILL" && self.fate.is_empty();
        assert!(is_open || !goes_on, "the end of an agent is no result of its action");
        if !is_open {
            self.server.assign("press", Action::new(number, &File::new(file, &self.folder.read(file))));
        }
        let cancelled = Arc::new(AtomicBool::new(false));
        let options = options().cancelled(cancelled.clone());
        thread::scope(|scope| {
            let agent = scope.spawn(|| serve(&config, &options));
            self.strike(|_| cancelled.store(true, Ordering::Relaxed));
            agent.join().unwrap_or_else(|why| resume_unwind(why));
        });
        let action = self.server.action("press");
        let resumes = |(execution, _): &(String, _)| execution == "resumed";
        assert!(!goes_on || action.feedback.iter().any(resumes), "{:?}", action.feedback);
        action.details("closed")
    }

    /// Updates by the service page; what it shows of each device, and the tables of its reports.
    fn page(&mut self) -> Vec<String> {
        let words = ["--report-dir", "reports", "ui", "--service", "p.cpk", "--no-open"];
        let running = self.coflash.spawn(&words);
        let url = running.await_text("http://").split_once("http://").unwrap().1.to_owned();
        let page = Page::at(&format!("http://{}", url.split_whitespace().next().unwrap()));
        page.until("the adapter", |state| state["open"] == true && state["busy"] == false);
        page.post("search", &json!({}));
        let mut state = page.until("the plan", |state| !state["plan"].is_null() && state["busy"] == false);
        let rows = state["rows"].as_array().unwrap();
        let due: Vec<&Value> =
            rows.iter().filter(|row| row["state"] == "state-due").map(|row| &row["node"]).collect();
        if !due.is_empty() {
            let entered = json!({
                "plan": state["plan"], "nodes": due, "operator": "", "order": "", "device_number": "",
                "language": "en", "password": self.row.words("with", "").get(1).unwrap_or(&""),
            });
            assert_eq!(page.post("update", &entered).status, 200);
            self.strike(|signal| match signal {
                "INT" => drop(page.post("cancel", &json!({}))),
                signal => kill(signal, running.id()),
            });
        }
        let mut said = Vec::new();
        if !matches!(self.fate, "TERM" | "HUP" | "KILL") {
            if !due.is_empty() {
                // As a page does that was loaded again in the middle.
                let is_over = |state: &Value| ["good", "bad"].iter().any(|end| state["station"] == *end);
                state = page.until("the end", |state| state["busy"] == false && is_over(state));
            }
            let words = page.get("words.json").json();
            let shows = |row: &Value, key: &str| {
                let key = row[key].as_str()?;
                Some(format!("node {}: {}", row["node"], words[key]["en"].as_str()?))
            };
            let rows = state["rows"].as_array().unwrap();
            for key in ["says", "left"] {
                said.push(rows.iter().filter_map(|row| shows(row, key)).collect::<Vec<_>>().join("\n"));
            }
        } else {
            running.wait();
        }
        let Ok(reports) = fs::read_dir(self.folder.path("reports")) else { return said };
        let mut tables: Vec<_> = reports.map(|entry| entry.unwrap().path()).collect();
        tables.retain(|path| path.extension().is_some_and(|end| end == "csv"));
        tables.sort();
        for node in self.targets() {
            let of = |path: &std::path::PathBuf| path.to_string_lossy().contains(&format!("_node-{node}_"));
            let table = tables.iter().rfind(|path| of(path)).map(|path| fs::read_to_string(path).unwrap());
            said.extend(table.and_then(|table| Some(format!("node {node}: {}", table.split_once('\n')?.1))));
        }
        said
    }

    /// Updates once; what is said, in one or several places.
    fn update(&mut self) -> Vec<String> {
        let (row, nodes, given) = (self.row, self.targets().join(","), self.given(self.row.text("gets")));
        let (file, board, program) = (given[1].clone(), row.board(), row.program());
        let recipe = format!(
            "board = '{board}'\n[[program]]\nimage = '{file}'\nnodes = [{nodes}]\nprogram = {program}\n"
        );
        self.folder.write("p.toml", recipe.as_bytes());
        if !UNPLANNED.contains(&self.way) && !self.folder.path("p.cpk").exists() {
            self.coflash.done(&["seal", "keys", "new", "--role", "root", "-o", "root.pem"]);
            self.coflash.done(&["package", "p.toml", "--key", "root.pem"]);
        }
        let words: Vec<&str> = given.iter().map(String::as_str).chain(["-N", &nodes]).collect();
        match self.way {
            "package" => vec![self.flash(&["flash", "p.cpk", "--yes"])],
            "agent" => vec![self.agent(&format!("[[device]]\nnode = {nodes}\nprogram = {program}"), &file)],
            "agent-package" => vec![self.agent("[[machine]]\ntrust = ['root.pub']", "p.cpk")],
            "page" => self.page(),
            _ => vec![self.flash(&words)],
        }
    }
}

fn kill(signal: &str, id: u32) {
    assert!(Command::new("kill").args([&format!("-{signal}"), &id.to_string()]).status().unwrap().success());
}

/// The result of one outcome by one way: what is said of each device, and whether it is so.
fn check(number: usize, way: &'static str) -> Result<(), String> {
    let row = Row(&ROWS[number]);
    let mut bench = Bench::new(&format!("outcome-{number}-{way}"), row, way);
    let (new, had) = (row.image(row.text("gets")), bench.have());
    let mut said = bench.update();
    if matches!(bench.fate, "returns" | "KILL") {
        if bench.fate == "returns" {
            bench.switch_on();
        }
        bench.fate = "";
        said = bench.update();
    }
    let planned = if UNPLANNED.contains(&way) { "" } else { row.text("planned") };
    let expected = row.words(if planned.is_empty() { "said" } else { "planned" }, "");
    let mut wrong = String::new();
    for ((at, (_, node)), (now, had)) in
        bench.serials().into_iter().enumerate().zip(bench.have().iter().zip(&had))
    {
        let own: Vec<String> =
            said.iter().map(|said| of_node(said, node)).filter(|own| !own.is_empty()).collect();
        if own.is_empty() {
            wrong += &format!("nothing is said of node {node}; ");
        }
        for own in &own {
            let (word, expected) = (word(own), expected[at.min(expected.len() - 1)]);
            let is_so = now.is(word, had, &new);
            if !is_so || !expected.split('|').any(|expected| expected == word) {
                let has = (now.record, now.bytes == new[..SIZE], now.bytes == had.bytes);
                wrong += &format!(
                    "node {node}: {word}, which is {is_so} ({has:?}), in place of {expected}, by {own:?}; "
                );
            }
        }
    }
    if wrong.is_empty() {
        return Ok(());
    }
    Err(format!("{}, {way}: {wrong}\n{}", row.text("what"), said.join("\n--\n")))
}

#[test]
fn what_is_said_of_a_device_is_so_for_each_outcome_by_each_way() {
    // One alone: `OUTCOME=page`, or a part of its name.
    let only = std::env::var("OUTCOME").unwrap_or_default();
    let ways = |(number, row): (usize, &'static Value)| {
        let is_wanted = |way: &&str| format!("{}, {way}", Row(row).text("what")).contains(&only);
        Row(row)
            .words("ways", WAYS)
            .into_iter()
            .filter(is_wanted)
            .map(move |way| (number, way))
            .collect::<Vec<_>>()
    };
    let all: Vec<(usize, &str)> = ROWS.iter().enumerate().flat_map(ways).collect();
    let next = AtomicUsize::new(0);
    let wrong = Mutex::new(Vec::new());
    thread::scope(|scope| {
        // They mostly wait.
        for _ in 0..16 {
            scope.spawn(|| {
                while let Some((number, way)) = all.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let what = ROWS[*number]["what"].as_str().unwrap();
                    let checked = catch_unwind(|| check(*number, way));
                    let why = checked.unwrap_or_else(|why| {
                        Err(format!(
                            "{what}, {way}: {}",
                            why.downcast_ref::<String>().map_or("panic", |why| why)
                        ))
                    });
                    wrong.lock().unwrap().extend(why.err());
                }
            });
        }
    });
    let wrong = wrong.into_inner().unwrap();
    assert!(wrong.is_empty(), "{} of {}:\n{}", wrong.len(), all.len(), wrong.join("\n\n"));
}
