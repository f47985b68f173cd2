//! What the tool says of a device against what the device has: each outcome of an update, by each way. The reader is
//! the file of the node's flash, which nothing of the tool reads. The way by Python is in `coflash/python/tests`.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::panic::catch_unwind;
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Mutex;
use std::thread;
use std::time::Duration;

use coflash_agent::Config;
use kit::crc::crc32;
use kit::hawkbit::{Action, File, Server};
use serde_json::{json, Value};

use crate::agent::{options, serve};
use crate::bus::{program, Coflash, Folder, Nodes};

/// Where the program is in the file of a flash, its size, and the size of its first part.
const AT: usize = 0x2_0000;
const SIZE: usize = 96 * 1024;
const OWN: usize = 8 * 1024;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    One,
    Together,
    Package,
    Agent,
    AgentPackage,
    Page,
}

const WAYS: [Way; 6] = [Way::One, Way::Together, Way::Package, Way::Agent, Way::AgentPackage, Way::Page];

/// What happens during the update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    /// Nothing.
    Well,
    /// The devices lose their power in the middle, for good.
    Dies,
    /// The device is not there.
    Absent,
    /// The download of the file that the device has before was cut off.
    CutBefore,
}

/// The outcomes: what the devices have before, what they get, what happens, and what is to be said by `flash` and by
/// a way with a plan.
///
/// A file is its byte, its version (0 for a raw file, `n` for none in block 0) and a letter: `p`lain, or with its
/// CRC-32 at the end as `z`lib gives it, `d` as the suffix of DFU has it; `i` has it at the end of its first part alone, and the rest is the same in each;
/// `x` is for another product.
const OUTCOMES: [(&str, &str, Fate, &str, &str); 17] = [
    ("", "1-0p", Fate::Well, "updated", "updated"),
    ("1-0p", "2-0p", Fate::Well, "updated", "updated"),
    ("1-1p", "2-2p", Fate::Well, "updated", "updated"),
    ("1-1p", "1-1p", Fate::Well, "updated", "had"),
    ("1-1p", "1-2p", Fate::Well, "updated", "updated"),
    ("1-2p", "2-1p", Fate::Well, "updated", "untouched"),
    ("1-0z", "2-0z", Fate::Well, "updated", "updated"),
    ("1-0d", "2-0d", Fate::Well, "updated", "updated"),
    ("1-1z", "2-2z", Fate::Well, "updated", "updated"),
    ("1-1z", "2-1z", Fate::Well, "updated", "updated"),
    ("1-ni", "2-ni", Fate::Well, "updated", "updated"),
    ("1-0p", "2-1x", Fate::Well, "untouched", "untouched"),
    ("", "1-0p", Fate::Dies, "erased", "erased"),
    ("1-0p", "2-0p", Fate::Dies, "erased", "erased"),
    ("1-0p", "2-0p", Fate::Absent, "untouched", "untouched"),
    ("1-ni", "2-ni", Fate::CutBefore, "updated", "updated"),
    ("1-0p", "2-0p", Fate::CutBefore, "updated", "updated"),
];

/// The image of a file.
fn image(name: &str) -> Vec<u8> {
    let mut bytes = program(name.as_bytes()[0], SIZE);
    let (end, complement) = match name.as_bytes()[3] {
        b'z' => (SIZE, 0),
        b'd' => (SIZE, u32::MAX),
        b'i' => (OWN, 0),
        _ => return bytes,
    };
    bytes[end..].fill(0x77);
    let own = crc32(&bytes[..end - 4]) ^ complement;
    bytes[end - 4..end].copy_from_slice(&own.to_le_bytes());
    bytes
}

/// The file for the tool: raw, or as blocks with its version.
fn file(folder: &Folder, coflash: &Coflash, name: &str) -> String {
    folder.write(&format!("{name}.bin"), &image(name));
    let version = &name[2..3];
    if version == "0" {
        return format!("{name}.bin");
    }
    let product = if name.ends_with('x') { "99" } else { "3" };
    let (raw, blocks) = (format!("{name}.bin"), format!("{name}.blk"));
    let label = ["--vid", "0x3F", "--pid", product, "--ver", version];
    let label = if version == "n" { &label[..4] } else { &label[..] };
    let convert = ["convert", &raw, &blocks, "-I", "binary", "--board", "stm32f407g-disc1"];
    coflash.done(&[&convert[..], label].concat());
    blocks
}

/// What is said of the devices, in one word.
fn word(said: &str) -> &'static str {
    let words = [
        ("it contains no complete program", "erased"),
        ("it was not changed", "untouched"),
        ("its program is unchanged", "untouched"),
        ("it contains the new program", "updated"),
        ("with the first good data", "unknown"),
        ("may have changed it", "unknown"),
        ("is older: it was not written", "untouched"),
        ("is another device than the package says", "untouched"),
        ("is not the machine of this package", "untouched"),
        ("is not on the bus", "untouched"),
        ("it had this program", "had"),
        ("had it before", "had"),
        (",had,", "had"),
        ("done in", "updated"),
        (": updated: node", "updated"),
        (",updated,", "updated"),
    ];
    words.iter().find(|(words, _)| said.contains(words)).unwrap_or_else(|| panic!("{said}")).1
}

/// Whether that is so.
fn is_so(word: &str, before: &[u8], now: &[u8], new: &[u8]) -> bool {
    match word {
        "updated" | "had" => now == new,
        "untouched" => now == before,
        "erased" => now != new && (now != before || before.iter().all(|byte| *byte == 0xFF)),
        _ => true,
    }
}

/// The state of an outcome's run.
struct Bench {
    folder: Folder,
    coflash: Coflash,
    url: String,
    /// Until their power is cut.
    devices: Option<Nodes>,
    /// The bus, with a node that nobody names.
    _bus: Nodes,
}

impl Bench {
    /// Devices that have this file.
    fn new(test: &str, count: usize, before: &str, fate: Fate) -> Self {
        let folder = Folder::new(test);
        let bus = Nodes::start(&folder, &["--node", "77", "--serial", "77", "--flash", "instant"]);
        let coflash = Coflash::new(&folder, &bus);
        let speed = if matches!(fate, Fate::Well | Fate::Absent) { "instant" } else { "typical" };
        let count = count.to_string();
        let node = if fate == Fate::Absent { "15" } else { "5" };
        let identity = ["--vendor-id", "0x3F", "--product-code", "3", "--stand-in"];
        let which = ["--node", node, "--count", &count, "--flash", speed];
        let devices = Nodes::join(&folder, bus.url(), &[&which[..], &identity].concat());
        devices.await_line("bootloader");
        let bench = Self { folder, coflash, url: bus.url().to_owned(), devices: Some(devices), _bus: bus };
        if !before.is_empty() && fate != Fate::Absent {
            let file = file(&bench.folder, &bench.coflash, before);
            let nodes = if count == "1" { "5" } else { "5,6" };
            let flash = [&["flash", &file, "-N", nodes, "--watch", "0"][..], raw(&file)].concat();
            if fate == Fate::CutBefore {
                let running = bench.coflash.spawn(&flash);
                bench.folder.await_bytes("1.flash", (AT + OWN) as u64);
                let id = running.id().to_string();
                assert!(Command::new("kill").args(["-INT", &id]).status().unwrap().success());
                running.wait();
            } else {
                bench.coflash.done(&flash);
            }
        }
        bench
    }

    /// The programs of the devices.
    fn programs(&self, count: usize) -> Vec<Vec<u8>> {
        (1..=count)
            .map(|serial| self.folder.read(&format!("{serial}.flash"))[AT..AT + SIZE].to_vec())
            .collect()
    }

    /// Cuts the power when a part of the new program is there, if that is the fate of the devices.
    fn cut(&mut self, fate: Fate, new: &[u8]) {
        while fate == Fate::Dies && self.folder.read("1.flash")[AT + 8..AT + OWN] != new[8..OWN] {
            thread::sleep(Duration::from_millis(2));
        }
        if fate == Fate::Dies {
            drop(self.devices.take());
        }
    }

    /// Updates by the command line; all that it says.
    fn flash(&mut self, words: &[&str], fate: Fate, new: &[u8]) -> String {
        let running = self.coflash.spawn(&[&["flash"], words].concat());
        self.cut(fate, new);
        let done = running.wait();
        done.out + &done.err
    }

    /// Updates by the agent; what the server is told at the end.
    fn agent(&mut self, target: &str, file: &str, fate: Fate, new: &[u8]) -> String {
        let server = Server::start(&["press"]);
        self.folder.write("token", b"g\n");
        let text = format!(
            "gateway-token-file = 'token'\npoll-least = 1\nbus = '{}'\nboard = 'stm32f407g-disc1'\n{target}\n\
             controller-id = 'press'\n",
            self.url
        );
        let config = Config::parse(&text, &self.folder.path(""), Some(&server.url), None).unwrap();
        server.assign("press", Action::new(1, &File::new(file, &self.folder.read(file))));
        thread::scope(|scope| {
            let agent = scope.spawn(|| serve(&config, &options()));
            self.cut(fate, new);
            agent.join().unwrap();
        });
        server.action("press").details("closed")
    }

    /// Updates by the service page; the table of its reports, or what the page says if there is nothing to update.
    fn page(&mut self, fate: Fate, new: &[u8]) -> String {
        let running =
            self.coflash.spawn(&["--report-dir", "reports", "ui", "--service", "p.cpk", "--no-open"]);
        let url = running.await_text("http://").split("http://").nth(1).unwrap().to_owned();
        let page = Page(url.split_whitespace().next().unwrap().to_owned());
        page.until(|state| state["open"] == true && state["busy"] == false);
        page.post("search", &json!({}));
        let state = page.until(|state| !state["plan"].is_null() && state["busy"] == false);
        let rows = state["rows"].as_array().unwrap();
        let due: Vec<&Value> =
            rows.iter().filter(|row| row["state"] == "state-due").map(|row| &row["node"]).collect();
        if due.is_empty() && rows.iter().any(|row| row["state"] == "state-older") {
            return "is older: it was not written".to_owned();
        }
        if state["station"] == "none" {
            return "is not on the bus".to_owned();
        }
        let entered = json!({ "plan": state["plan"], "nodes": due, "operator": "", "order": "", "device_number": "", "language": "en" });
        page.post("update", &entered);
        self.cut(fate, new);
        page.until(|state| {
            state["busy"] == false && ["good", "bad"].iter().any(|end| state["station"] == *end)
        });
        let reports =
            std::fs::read_dir(self.folder.path("reports")).unwrap().map(|entry| entry.unwrap().path());
        let tables = reports.filter(|path| path.extension().is_some_and(|end| end == "csv"));
        tables.map(|path| std::fs::read_to_string(path).unwrap()).collect()
    }

    /// Updates by this way; what is said.
    fn update(&mut self, way: Way, file: &str, fate: Fate, new: &[u8]) -> String {
        let recipe = format!("board = 'stm32f407g-disc1'\n[[program]]\nimage = '{file}'\nnodes = [5, 6]\n");
        self.folder.write("p.toml", recipe.as_bytes());
        if !matches!(way, Way::One | Way::Together | Way::Agent) {
            self.coflash.done(&["seal", "keys", "new", "--role", "root", "-o", "root.pem"]);
            self.coflash.done(&["package", "p.toml", "--key", "root.pem"]);
        }
        match way {
            Way::One => self.flash(&[&[file, "-N", "5"][..], raw(file)].concat(), fate, new),
            Way::Together => self.flash(&[&[file, "-N", "5,6"][..], raw(file)].concat(), fate, new),
            Way::Package => self.flash(&["p.cpk", "--yes"], fate, new),
            Way::Agent => self.agent("[[device]]\nnode = 5", file, fate, new),
            Way::AgentPackage => self.agent("[[machine]]\ntrust = ['root.pub']", "p.cpk", fate, new),
            Way::Page => self.page(fate, new),
        }
    }
}

/// The options for a file.
fn raw(file: &str) -> &'static [&'static str] {
    if file.ends_with(".bin") {
        &["-I", "binary", "--board", "stm32f407g-disc1"]
    } else {
        &[]
    }
}

/// The page of a station, by its URL without the scheme.
struct Page(String);

impl Page {
    fn send(&self, method: &str, what: &str, body: &str) -> TcpStream {
        let (host, path) = self.0.split_once('/').unwrap();
        let mut stream = TcpStream::connect(host).unwrap();
        let head = format!("{method} /{path}{what} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n");
        let more = format!("Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}", body.len());
        stream.write_all((head + &more).as_bytes()).unwrap();
        stream
    }

    fn post(&self, what: &str, value: &Value) {
        let mut answer = String::new();
        self.send("POST", what, &value.to_string()).read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    }

    /// Follows the events until `wanted` accepts the state.
    fn until(&self, wanted: impl Fn(&Value) -> bool) -> Value {
        let stream = BufReader::new(self.send("GET", "events", ""));
        let events = stream.lines().map_while(Result::ok);
        let mut states = events.filter_map(|line| {
            let event: Value = serde_json::from_str(line.strip_prefix("data: ")?).ok()?;
            Some(event["state"].clone()).filter(|state| !state.is_null())
        });
        states.find(wanted).expect("the events go on")
    }
}

/// The result of one outcome by one way: what is said, and whether it is so.
fn check(number: usize, way: Way) -> Result<(), String> {
    let (before, gets, fate, by_flash, by_plan) = OUTCOMES[number];
    let count = if matches!(way, Way::One | Way::Agent) { 1 } else { 2 };
    let mut bench = Bench::new(&format!("outcome-{number}-{way:?}"), count, before, fate);
    let (new, had) = (image(gets), bench.programs(count));
    let file = file(&bench.folder, &bench.coflash, gets);
    let said = bench.update(way, &file, fate, &new);
    let expected = if matches!(way, Way::One | Way::Together | Way::Agent) { by_flash } else { by_plan };
    let now = bench.programs(count);
    let word = word(&said);
    let so = now.iter().zip(&had).all(|(now, had)| is_so(word, had, now, &new));
    if word == expected && so {
        return Ok(());
    }
    Err(format!(
        "{before:?} -> {gets:?}, {fate:?}, {way:?}: {word}, which is {so}, in place of {expected}: {said}"
    ))
}

#[test]
fn what_is_said_of_a_device_is_so_for_each_outcome_by_each_way() {
    let all: Vec<(usize, Way)> =
        (0..OUTCOMES.len()).flat_map(|number| WAYS.map(|way| (number, way))).collect();
    let next = AtomicUsize::new(0);
    let wrong = Mutex::new(Vec::new());
    thread::scope(|scope| {
        // They mostly wait.
        for _ in 0..24 {
            scope.spawn(|| {
                while let Some((number, way)) = all.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let checked = catch_unwind(|| check(*number, *way));
                    let why = checked
                        .unwrap_or_else(|_| Err(format!("{:?}, {way:?}: see above", OUTCOMES[*number])));
                    wrong.lock().unwrap().extend(why.err());
                }
            });
        }
    });
    let wrong = wrong.into_inner().unwrap();
    assert!(wrong.is_empty(), "{} of {}:\n{}", wrong.len(), all.len(), wrong.join("\n\n"));
}
