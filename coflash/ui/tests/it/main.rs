//! The server of `coflash ui` without a browser: access control, and hostile requests.

mod service;

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::ops::Deref;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use coflash_core::file::sealed::{Kek, Sealer, SigningKey};
use coflash_core::update::FailedUpdate;
use coflash_ui::{Failed, Options, Server};
use serde_json::{json, Value};

use kit::fake::vault::Vault;
use kit::fake::{Bus, Fake, Outcome};
use kit::http::{Answer, Page, PATIENCE};

/// A server of one test.
struct Ui {
    page: Page,
    readers: Box<dyn Fn() -> usize + Send>,
    end: Arc<AtomicBool>,
    thread: Option<JoinHandle<Option<String>>>,
}

impl Deref for Ui {
    type Target = Page;

    fn deref(&self) -> &Page {
        &self.page
    }
}

impl Ui {
    fn new(bus: Option<String>) -> Self {
        Self::with(|options| options.bus = bus)
    }

    /// With this bus, whose adapter is open.
    fn on(bus: String) -> Self {
        let ui = Self::new(Some(bus));
        ui.until("the adapter", |state| state["adapter"]["state"] == "open");
        ui
    }

    fn with(change: impl FnOnce(&mut Options)) -> Self {
        let mut options = Options::default();
        change(&mut options);
        options.write_timeout = Duration::from_millis(200);
        // A test touches no adapter of this machine.
        options.kinds = Vec::new();
        let server = Server::new(options).unwrap();
        let page = Page::at(&server.url());
        let readers = Box::new(server.readers());
        let end = Arc::new(AtomicBool::new(false));
        let flag = end.clone();
        let thread = Some(thread::spawn(move || server.run(&flag).unwrap()));
        Self { page, readers, end, thread }
    }

    fn file(&self, name: &str, bytes: &[u8]) -> Answer {
        let what = if name.to_ascii_lowercase().ends_with(".toml") { "board" } else { "firmware" };
        self.request("POST", &format!("{}{what}?name={name}", self.path), &[&self.host_line()], bytes)
    }

    fn finish(mut self) -> Option<String> {
        self.end.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap()
    }
}

impl Drop for Ui {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
    }
}

/// Waits until something has come about.
fn wait(what: &str, mut has_come: impl FnMut() -> bool) {
    let began = std::time::Instant::now();
    while !has_come() {
        assert!(began.elapsed() < PATIENCE, "never: {what}");
        thread::sleep(Duration::from_millis(20));
    }
}

/// A program of 516 bytes in Intel HEX: initial stack pointer 2001_FFC0h, reset vector 0801_0201h.
const HEX: &[u8] = b":020000040801F1\n:08000000C0FF0120010201080C\n:04020000EFBEADDEC2\n:00000001FF\n";

#[test]
fn without_the_token_nothing_is_told() {
    let ui = Ui::new(None);
    let good = ui.get("");
    assert_eq!(good.status, 200, "{}", good.head);
    assert!(good.body.contains("<title>coflash</title>"));
    let host = ui.host_line();
    let token = ui.path.trim_matches('/');
    let (wrong, short) = (format!("/{}/", "0".repeat(32)), format!("/{}/", &token[..31]));
    let (upper, query) = (format!("/{}/", token.to_uppercase()), format!("/?token={token}"));
    for path in ["/", "/app.js", "/events", "/favicon.ico", &wrong, &short, &upper, &query, "//", "/%2e%2e/"]
    {
        if path == ui.path {
            continue;
        }
        let answer = ui.request("GET", path, &[&host], b"");
        assert_eq!(answer.status, 403, "{path}: {}", answer.body);
        assert!(!answer.body.contains(token), "{path}");
    }
    for line in [format!("Cookie: coflash={token}"), format!("Authorization: Bearer {token}")] {
        assert_eq!(ui.request("GET", "/events", &[&host, &line], b"").status, 403, "{line}");
    }
    assert_eq!(ui.request("POST", "/scan", &[&host], b"{}").status, 403);
    // Two servers do not share a token, and it is long.
    let other = Ui::new(None);
    assert_ne!(other.path, ui.path);
    assert_eq!(token.len(), 32);
    assert!(token.bytes().all(|byte| byte.is_ascii_hexdigit()), "{token}");
}

#[test]
fn other_names_and_other_origins_are_turned_away() {
    let ui = Ui::new(None);
    let (host, path) = (ui.host_line(), format!("{}adapters", ui.path));
    let port = ui.host.split_once(':').unwrap().1;
    let own = [format!("Origin: http://{}", ui.host), format!("Origin: http://localhost:{port}")];
    for line in own.iter().map(String::as_str).chain(["Sec-Fetch-Site: same-origin", "Sec-Fetch-Site: none"])
    {
        assert_eq!(ui.request("GET", &path, &[&host, line], b"").status, 200, "{line}");
    }
    let (longer, tls) =
        (format!("Origin: http://{}.evil.example", ui.host), format!("Origin: https://{}", ui.host));
    let next = format!("Origin: http://127.0.0.1:{}", port.parse::<u16>().unwrap() ^ 1);
    for line in [
        "Origin: http://evil.example",
        "Origin: null",
        &longer,
        &tls,
        &next,
        "Origin: http://127.0.0.1",
        "Origin: \u{fc}",
        "Sec-Fetch-Site: cross-site",
        "Sec-Fetch-Site: same-site",
    ] {
        assert_eq!(ui.request("GET", &path, &[&host, line], b"").status, 403, "{line}");
    }
    // Fetch Metadata of a browser that a file has led to the page: to the page, in a tab of its own, and to nothing else.
    let led = ["Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate", "Sec-Fetch-Dest: document"];
    let framed = [led[0], led[1], "Sec-Fetch-Dest: iframe"];
    for (path, lines, status) in
        [(&ui.path, &led[..], 200), (&path, &led, 403), (&ui.path, &framed, 403), (&ui.path, &led[..1], 403)]
    {
        let lines = [&[host.as_str()], lines].concat();
        assert_eq!(ui.request("GET", path, &lines, b"").status, status, "{path} {lines:?}");
    }
    // The name of another server with this address (DNS rebinding).
    for line in
        ["Host: evil.example", &format!("Host: evil.example:{port}"), "Host: 127.0.0.1", "Host: ", "X: y"]
    {
        let answer = ui.request("GET", &path, &[line], b"");
        assert!(matches!(answer.status, 400 | 403), "{line}: {}", answer.status);
    }
    // Two of a header that may be there once: a proxy and this server could each take another one.
    let (evil, none) = ("Host: evil.example".to_string(), "Host: ".to_string());
    for other in [&host, &evil, &none] {
        for lines in [[host.as_str(), other.as_str()], [other, &host]] {
            let answer = ui.request("GET", &path, &lines, b"");
            assert_eq!(answer.status, 400, "{lines:?}: {}", answer.body);
        }
    }
    for (good, evil) in [
        (own[0].as_str(), "Origin: http://evil.example"),
        ("Sec-Fetch-Site: none", "Sec-Fetch-Site: cross-site"),
    ] {
        for lines in [[&host, good, evil], [&host, evil, good]] {
            assert_eq!(ui.request("GET", &path, &lines, b"").status, 403, "{lines:?}");
        }
    }
    let absolute = format!("http://evil.example{path}");
    // The name in the request line counts as well as the header.
    assert_eq!(ui.request("GET", &absolute, &[&host], b"").status, 403);
    assert_eq!(ui.request("GET", &format!("http://{}{path}", ui.host), &[&host], b"").status, 200);
    assert_eq!(ui.request("GET", &absolute, &["Host: evil.example"], b"").status, 403);
}

#[test]
fn the_page_keeps_to_itself() {
    let ui = Ui::new(None);
    for what in ["", "app.js", "style.css", "colours.css", "uPlot.js", "adapters", "trace", "nowhere"] {
        let answer = ui.get(what);
        for line in [
            "content-security-policy: default-src 'none'; script-src 'self';",
            "x-content-type-options: nosniff",
            "referrer-policy: no-referrer",
            "cache-control: no-store",
            "cross-origin-resource-policy: same-origin",
        ] {
            assert!(answer.head.contains(line), "{what}: no {line} in {}", answer.head);
        }
        assert!(!answer.head.contains("access-control-allow"), "{what}");
        assert!(!answer.head.contains("unsafe-inline") && !answer.head.contains("set-cookie"), "{what}");
    }
    let page = ui.get("").body;
    // The page has no inline script or style, and loads nothing from other servers.
    assert!(page.split("<script").skip(1).all(|script| script.trim_start().starts_with("src=\"")), "{page}");
    assert!(!page.contains("style=") && !page.contains("<style") && !page.contains("javascript:"), "{page}");
    let handler = |word: &&str| word.starts_with("on") && word.contains('=');
    assert_eq!(page.split_ascii_whitespace().find(handler), None);
    assert!(!page.contains("https://"), "{page}");
    assert!(!page.contains("src=\"/") && !page.contains("src=\"http"), "{page}");
    for method in ["PUT", "DELETE", "OPTIONS", "PATCH"] {
        assert_eq!(ui.request(method, &ui.path, &[&ui.host_line()], b"").status, 405, "{method}");
    }
}

/// A board that is not built in: its memory map is taken, and chosen.
#[test]
fn a_memory_map_is_taken_and_chosen_and_a_bad_one_is_refused_with_its_line() {
    use shared_abi::layout::nucleo_f446re::LAYOUT;
    let ui = Ui::new(None);
    let map = shared_abi::layout::toml::Toml(&LAYOUT).to_string().replace("nucleo-f446re", "my-board");
    assert_eq!(ui.file("my-board.toml", map.as_bytes()).status, 200);
    ui.until("the board is chosen", |state| state["settings"]["board"] == "my-board");
    let list = ui.get("adapters").json();
    assert!(list["boards"].as_array().unwrap().contains(&json!("my-board")), "{list}");
    // Its region is that of the map: a raw binary has its address, and it has one program.
    assert_eq!(ui.file("app.bin", &[1, 2, 3, 4]).status, 200);
    ui.until("the binary", |state| state["firmware"]["program_size"] == 4);
    let other = ui.post("settings", &json!({ "board": "my-board", "program": 2 }));
    assert!(other.body.contains("my-board has no program 2"), "{}", other.body);
    // Another board and back.
    for board in ["stm32f407g-disc1", "my-board"] {
        assert_eq!(ui.post("settings", &json!({ "board": board, "program": 1 })).status, 200, "{board}");
    }
    for (bytes, says) in [
        (&b"board = ["[..], "a.TOML: line 1: "),
        (b"\xFF\xFE\x00", "a.TOML: line 1: "),
        (b"", "a.TOML: line 1: missing field"),
        (&[b'#'; 70_000], "64 KiB at most"),
        (b"\"\\u001b\" = 1", "unknown field"),
    ] {
        let refused = ui.file("a.TOML", bytes);
        assert!(refused.status == 400 && refused.body.contains(says), "{}: {}", refused.status, refused.body);
        assert!(refused.json()["advice"].as_str().unwrap().contains("my-board.toml"));
    }
    ui.until("the board stays", |state| state["settings"]["board"] == "my-board");
    // Each map stays in memory.
    while ui.file("x.toml", map.as_bytes()).status == 200 {}
    assert!(ui.file("x.toml", map.as_bytes()).body.contains("too many memory maps"));
}

#[test]
fn what_is_no_request_of_the_page_is_refused_with_words() {
    let ui = Ui::new(None);
    let kind = "Content-Type: application/json";
    let send = |what: &str, lines: &[&str], body: &[u8]| {
        let host = ui.host_line();
        let lines = [&[host.as_str()], lines].concat();
        ui.request("POST", &format!("{}{what}", ui.path), &lines, body)
    };
    // What a form of another page could send.
    for other in ["Content-Type: text/plain", "Content-Type: application/x-www-form-urlencoded", "X: y"] {
        assert_eq!(send("open", &[other], br#"{"url":"slcan:x"}"#).status, 415, "{other}");
    }
    for (what, body) in [
        ("open", "{}"),
        ("open", "x"),
        // A file without its name.
        ("firmware", "x"),
        ("board", "x"),
        ("open", r#"{"url":5}"#),
        ("update", r#"{"nodes":[0],"trial":false,"start":true}"#),
        ("update", r#"{"nodes":[300],"trial":false,"start":true}"#),
        ("update", r#"{"nodes":[1],"trial":false,"start":true}"#),
        ("step", r#"{"node":128,"program":1,"step":"erase"}"#),
        ("step", r#"{"node":1,"program":0,"step":"erase"}"#),
        ("step", r#"{"node":1,"program":1,"step":"explode"}"#),
        ("settings", r#"{"board":"no such board","program":1}"#),
        ("settings", r#"{"board":null,"program":255}"#),
        ("assign", r#"{"address":[1,2,3],"node":1,"bit_rate":null,"store":true}"#),
        ("assign", r#"{"address":[1,2,3,4],"node":null,"bit_rate":null,"store":true}"#),
        ("assign", r#"{"address":[1,2,3,4],"node":null,"bit_rate":4294967295,"store":true}"#),
    ] {
        let answer = send(what, &[kind], body.as_bytes());
        assert_eq!(answer.status, 400, "{what} {body}: {}", answer.body);
        let words = answer.json();
        assert!(words["words"].is_string() && words["advice"].is_string(), "{what} {body}: {words}");
    }
    // A request of 64 KiB does not come from the page.
    let long = json!({ "url": "x".repeat(70_000) }).to_string();
    assert_eq!(send("open", &[kind], long.as_bytes()).status, 413);
    // Nothing can be done without an adapter.
    for what in ["scan", "fastscan"] {
        assert_eq!(send(what, &[kind], b"{}").status, 409, "{what}");
    }
    assert_eq!(ui.get("readback").status, 404);
    // A header without end, and bytes that are no HTTP.
    let endless = [b"GET / HTTP/1.1\r\nX: ".as_slice(), &vec![b'x'; 200_000]].concat();
    assert!(matches!(ui.raw(&endless).status, 0 | 400 | 431), "a head has its limit");
    ui.raw(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03");
    assert_eq!(ui.get("").status, 200);
}

#[test]
fn files_of_every_kind_are_taken_or_refused_with_their_name() {
    let ui = Ui::new(None);
    for (bytes, words) in [
        (b"<!doctype html><p>Not found".as_slice(), "page.hex: is not a firmware file"),
        (&[0; 5000], "page.hex: is not a firmware file"),
        (b"\x7fELF", "page.hex"),
        (b":zz", "page.hex, line 1"),
    ] {
        refuses(&ui, "page.hex", bytes, words);
    }
    assert_eq!(refuses(&ui, "e.hex", b"", "e.hex")["words"], "e.hex: is empty");
    assert_eq!(ui.file("app.hex", HEX).status, 200);
    let state = ui.until("the file", |state| !state["firmware"].is_null());
    let file = &state["firmware"];
    assert_eq!((&file["name"], &file["program_size"]), (&json!("app.hex"), &json!(516)));
    // A refused file also removes the previous one, which the user no longer means.
    ui.file("bad.hex", b"no");
    ui.until("no file", |state| state["firmware"].is_null());
    // Larger than any program: refused by what it announces, before it is sent.
    assert_eq!(ui.raw((upload(&ui, 99_999_999_999) + "x").as_bytes()).status, 413);
    assert_eq!(ui.get("").status, 200);
}

/// What the page says of a file that it does not take; it begins with these words.
#[track_caller]
fn refuses(ui: &Ui, name: &str, bytes: &[u8], words: &str) -> Value {
    let answer = ui.file(name, bytes);
    assert_eq!(answer.status, 422, "{}", answer.body);
    assert!(answer.json()["words"].as_str().unwrap().starts_with(words), "{}", answer.body);
    answer.json()
}

/// The first lines of an upload that announces this many bytes.
fn upload(ui: &Ui, announced: usize) -> String {
    let (path, host) = (&ui.path, ui.host_line());
    format!(
        "POST {path}firmware?name=a.hex HTTP/1.1\r\n{host}\r\nConnection: close\r\nContent-Length: {announced}\r\n\r\n"
    )
}

/// A connection that has sent this.
fn sends(ui: &Ui, text: &str) -> TcpStream {
    let mut stream = ui.stream();
    stream.write_all(text.as_bytes()).unwrap();
    stream
}

/// Forty uploads of 32 MiB that never end take the room of two: the others are refused before they
/// are read, with words, and the page goes on.
#[test]
fn uploads_are_limited_together_and_before_they_are_read() {
    let ui = Ui::new(None);
    let head = upload(&ui, 32 << 20);
    let mut open: Vec<TcpStream> = (0..40).map(|_| sends(&ui, &head)).collect();
    let mut refused = 0;
    for stream in &mut open {
        stream.set_read_timeout(Some(Duration::from_millis(500))).unwrap();
        let mut answer = [0; 2048];
        // Those that wait for their bytes say nothing yet.
        let Ok(len) = stream.read(&mut answer) else { continue };
        let answer = String::from_utf8_lossy(&answer[..len]).into_owned();
        assert!(answer.starts_with("HTTP/1.1 503") && answer.contains("advice"), "{answer}");
        refused += 1;
    }
    assert_eq!(refused, 38);
    assert_eq!(ui.get("adapters").status, 200);
    // A client that sends all before it reads learns why, too.
    let whole = ui.file("large.hex", &vec![b'x'; 32 << 20]);
    assert_eq!(whole.status, 503);
    assert!(whole.json()["words"].as_str().unwrap().contains("no room"), "{}", whole.body);
    // A small file has no room either, and has it when the large ones are gone.
    assert_eq!(ui.file("app.hex", HEX).status, 503);
    drop(open);
    wait("the room is given back", || ui.file("app.hex", HEX).status == 200);
}

/// An upload without a length counts as the largest one, and ends at that size.
#[test]
fn an_upload_without_a_length_has_the_same_limit() {
    let ui = Ui::new(None);
    let head = upload(&ui, 0).replace("Content-Length: 0", "Transfer-Encoding: chunked");
    let chunk = |bytes: &[u8]| [format!("{:x}\r\n", bytes.len()).as_bytes(), bytes, b"\r\n"].concat();
    let small = [head.as_bytes(), &chunk(HEX), b"0\r\n\r\n"].concat();
    assert_eq!(ui.raw(&small).status, 200);
    let mut stream = sends(&ui, &head);
    let chunk = chunk(&[b'x'; 1 << 20]);
    for _ in 0..33 {
        stream.write_all(&chunk).unwrap();
    }
    let mut answer = [0; 12];
    stream.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 413");
}

/// An upload that stops sending gives its room back.
#[test]
fn an_upload_that_stops_is_ended_with_words() {
    let ui = Ui::with(|options| options.body_timeout = Duration::from_millis(200));
    let answer = ui.raw(upload(&ui, 32 << 20).as_bytes());
    assert_eq!(answer.status, 408, "{}", answer.body);
    assert!(answer.json()["advice"].is_string(), "{}", answer.body);
}

/// More connections than there are places, that send nothing, or half a request: the page comes at
/// once, because a place is taken from them and not waited for.
#[test]
fn connections_that_send_nothing_do_not_keep_the_page_away() {
    // No time-out of an idle connection can help within this test.
    let ui = Ui::with(|options| options.head_timeout = Duration::from_secs(3600));
    let _page = ui.events("");
    for sent in ["", "G", "GET / HTTP/1.1\r\nHost: ", "GET / HTTP/1.1\r\nHost: x\r\n\r\n"] {
        let idle: Vec<TcpStream> = (0..200).map(|_| sends(&ui, sent)).collect();
        for what in ["", "app.js", "adapters"] {
            assert_eq!(ui.get(what).status, 200, "{sent:?} {what}");
        }
        drop(idle);
    }
    // The page that was there first keeps its events.
    assert_eq!((ui.readers)(), 1);
}

/// A sealed image for the fake device, of 1000 bytes.
fn sealed(sealer: Sealer<'_>) -> Vec<u8> {
    let key = SigningKey::from_seed([2; 32]).unwrap();
    let sealer = Sealer { vendor_id: 0x3F, product_code: 1234, counter: 7, version: 0x0064_0A01, ..sealer };
    sealer.seal(&[0x5A; 1000], &key).unwrap()
}

#[test]
fn a_sealed_image_shows_what_it_says_or_is_refused_with_what_to_do() {
    let ui = Ui::new(None);
    let kek = [Kek::new([7; 32]).unwrap()];
    let file = sealed(Sealer { compress: true, encrypt_for: &kek, ..Sealer::default() });
    assert_eq!(ui.file("app.cbs", &file).status, 200);
    let state = ui.until("the file", |state| !state["firmware"].is_null());
    let shown = &state["firmware"];
    let signer = SigningKey::from_seed([2; 32]).unwrap().public().id();
    let seal = json!({
        "program": 1, "counter": 7, "signed_by": [signer], "opened_by": [kek[0].id()],
        "flags": ["encrypted", "compressed"],
    });
    assert_eq!(shown["seal"], seal);
    assert_eq!([&shown["vendor_id"], &shown["product_code"]], [&json!(0x3F), &json!(1234)]);
    assert_eq!([&shown["program_size"], &shown["version"]], [&json!(1000), &json!("V1.10r100")]);
    let words = shown["inspection"].as_str().unwrap();
    assert!(words.starts_with("sealed image, well-formed") && words.contains("counter      7"), "{words}");

    // The image is for another program than the chosen one: it is refused and removed, as any file.
    let other = ui.post("settings", &json!({ "board": null, "program": 2 }));
    assert_eq!(other.status, 422, "{}", other.body);
    let other = other.json();
    assert_eq!(other["words"], "app.cbs: it is for program 1, and program 2 is to be written");
    assert!(other["advice"].as_str().unwrap().contains("seal the program for it"), "{other}");
    ui.until("no file", |state| state["firmware"].is_null());
    assert_eq!(ui.post("settings", &json!({ "board": null, "program": 1 })).status, 200);
    for (bytes, words) in [
        (&file[..file.len() - 1], "app.cbs: it is cut off"),
        (&[&file[..4], &[0; 4], &file[8..]].concat(), "app.cbs: the head is damaged"),
        (&[&file[..], b"x"].concat(), "app.cbs: it has"),
    ] {
        refuses(&ui, "app.cbs", bytes, words);
    }
}

/// A sealed image is sent to the device unchanged; a refusal is reported with advice.
#[test]
fn a_sealed_image_is_sent_as_it_is_and_the_device_judges_it() {
    let file = sealed(Sealer::default());
    let counter = "counter and epoch in Contents of the file";
    for (status, phase, words, advice) in [
        (0, "done", "done in", None),
        (0x8A, "failed", "the program's signature is wrong", Some("root's public key")),
        (0x8C, "failed", "its counter or the epoch of its key is too low", Some(counter)),
        (0x8E, "failed", "the device has no key for this program", Some("key ids in Contents of the file")),
    ] {
        let kept: Arc<Mutex<Vec<u8>>> = Arc::default();
        let mut fake = Fake::new(kit::fake::BOOTLOADER);
        fake.erase_time = Duration::from_millis(30);
        let vault = Vault { kept: kept.clone(), start: 0x0801_0000, room: 0x10000, status };
        fake.maker = Some(Box::new(vault));
        let (bus, _server) = kit::fake::serve(fake);
        let reported: Arc<Mutex<Vec<FailedUpdate>>> = Arc::default();
        let report = reported.clone();
        let ui = Ui::with(|options| {
            options.bus = Some(bus);
            options.failed = Failed::new(move |update| report.lock().unwrap().push(update.clone()));
        });
        ui.until("the adapter", |state| state["adapter"]["state"] == "open");
        assert_eq!(ui.file("app.cbs", &file).status, 200);
        ui.post("update", &json!({ "nodes": [kit::fake::NODE], "trial": true, "start": true }));
        let state = ui.until("the end", |state| !state["notice"].is_null() && state["task"].is_null());
        let update = &state["updates"][0];
        assert_eq!(update["phase"], phase, "{update}");
        assert!(update["words"].as_str().unwrap().contains(words), "{update}");
        match advice {
            Some(advice) => assert!(update["advice"].as_str().unwrap().contains(advice), "{update}"),
            None => assert!(update["advice"].is_null(), "{update}"),
        }
        assert!(*kept.lock().unwrap() == file, "{status:02X}h");
        // What only a log could say: the frame and the words with the answer of 1F57h (CiA 302-3).
        let reported = reported.lock().unwrap();
        assert_eq!(reported.len(), usize::from(status != 0), "{reported:?}");
        for failed in reported.iter() {
            assert_eq!(failed.node.get(), kit::fake::NODE);
            assert!(failed.tried.iter().any(|line| line.contains("erase the old program")), "{failed:?}");
            let answer = format!("#43571F01{status:02X}000000  ");
            assert!(failed.frames.iter().any(|line| line.contains(&answer)), "{answer}: {failed:?}");
            let reads = format!("1F57h reads {status:02X}h");
            assert!(failed.answers.iter().any(|line| line.starts_with(&reads)), "{failed:?}");
        }
    }
}

/// A new bootloader is written only after a confirmation; the page shows its steps and its outcome.
#[test]
fn a_bootloader_is_renewed_when_that_is_confirmed() {
    use kit::fake::renewal::{device, image, NEW};
    let (fake, log) = device(kit::fake::BOOTLOADER, |_| {});
    let (bus, _server) = kit::fake::serve(fake);
    let ui = Ui::on(bus);
    assert_eq!(ui.file("new.bin", &image(NEW)).status, 200);
    let order = |renew| json!({ "nodes": [kit::fake::NODE], "trial": true, "start": true, "renew": renew });
    let refused = ui.post("update", &order(false));
    assert!(refused.status == 409 && refused.body.contains("nobody has confirmed"), "{}", refused.body);
    assert!(log.lock().unwrap().is_empty());
    let answer = ui.post("update", &order(true));
    assert_eq!(answer.status, 200, "{}", answer.body);
    let state = ui.until("the end", |state| !state["notice"].is_null() && state["task"].is_null());
    let (update, report) = (&state["updates"][0], &state["reports"][0]);
    assert_eq!(update["phase"], "done", "{update}");
    assert!(update["words"].as_str().unwrap().ends_with("bootloader 1.2 -> 1.3, installed"), "{update}");
    let steps = update["lines"].as_array().unwrap();
    let tries = |step: &Value| step.as_str().unwrap().contains("starting it for its trial");
    assert!(steps.iter().any(tries), "{update}");
    assert!(report["words"].as_str().unwrap().ends_with("bootloader 1.2 -> 1.3, installed"), "{report}");
    assert_eq!(state["notice"]["words"], "1 of 1 devices have the bootloader of new.bin");
    let device = &state["devices"][kit::fake::NODE.to_string()];
    assert!(device["renewable"].as_str().unwrap().starts_with("version 1.3"), "{device}");
    let wrong =
        json!({ "nodes": [5], "trial": true, "start": true, "renew": true, "password": "x".repeat(65) });
    let refused = ui.post("update", &wrong);
    assert!(refused.status == 400 && !refused.body.contains("xxx"), "{}", refused.body);
}

/// A device whose erase takes longer than the test.
fn slow() -> Fake {
    let mut fake = Fake::new(kit::fake::BOOTLOADER);
    fake.erase_time = Duration::from_secs(3600);
    fake
}

/// Two tabs start an update at the same time: the second one is refused, with the name of the
/// running task.
#[test]
fn a_second_update_is_refused_while_one_runs() {
    let (bus, _server) = kit::fake::serve(slow());
    let ui = Ui::on(bus);
    assert_eq!(ui.file("app.hex", HEX).status, 200);
    let update = json!({ "nodes": [kit::fake::NODE], "trial": false, "start": true });
    assert_eq!(ui.post("update", &update).status, 200);
    let state = ui.until("the update", |state| state["updates"][0]["phase"] == "running");
    assert_eq!(state["task"]["kind"], "update");
    for (what, value) in [
        ("update", update),
        ("scan", json!({})),
        ("step", json!({ "node": kit::fake::NODE, "program": 1, "step": "erase" })),
        ("open", json!({ "url": "slcan:/dev/null" })),
        ("close", json!({})),
        ("settings", json!({ "board": null, "program": 2 })),
    ] {
        let answer = ui.post(what, &value);
        assert_eq!(answer.status, 409, "{what}: {}", answer.body);
        assert!(answer.body.contains("the update of 1 device with app.hex"), "{what}: {}", answer.body);
    }
    assert_eq!(ui.file("other.hex", HEX).status, 409);
    // Any tab can cancel it; the message has the state of the device.
    assert_eq!(ui.post("cancel", &json!({})).status, 200);
    let state = ui.until("the end", |state| state["task"].is_null());
    assert_eq!(state["updates"][0]["phase"], "failed");
    let words = state["updates"][0]["words"].as_str().unwrap();
    assert!(words.contains("cancelled") && words.contains("The device: "), "{words}");
    assert_eq!(state["reports"][0]["ok"], false);
}

/// A device loses its program in an update that fails, and is not on the bus in the next one.
#[test]
fn what_is_known_of_a_device_outlives_its_update() {
    let mut device = Fake::new(kit::fake::BOOTLOADER);
    device.on_block = Box::new(|_| Outcome::Status(0x06));
    let (bus, _server) = kit::fake::serve(device);
    let (empty, _server) = kit::fake::serve(Bus(Vec::new()));
    let ui = Ui::new(None);
    ui.file("app.hex", HEX);
    for (number, url) in [bus, empty].iter().enumerate() {
        ui.post("open", &json!({ "url": url }));
        let is_open = |state: &Value| state["adapter"]["url"] == **url && state["adapter"]["state"] == "open";
        ui.until("the adapter", is_open);
        ui.post("update", &json!({ "nodes": [kit::fake::NODE], "trial": false, "start": true }));
        let ended =
            |state: &Value| state["task"].is_null() && state["reports"].as_array().unwrap().len() > number;
        let state = ui.until("the end", ended);
        let words = state["reports"][number]["words"].as_str().unwrap();
        let before = "this attempt has not changed it; known from before: it contains no complete program";
        assert!(words.contains("it contains no complete program"), "{words}");
        assert_eq!(words.contains(before), number == 1, "{words}");
    }
}

/// Ctrl-C during an update ends it in an orderly way, and reports the state of the device.
#[test]
fn the_end_of_the_server_ends_an_update_in_order() {
    let (bus, server) = kit::fake::serve(slow());
    let ui = Ui::on(bus);
    ui.file("app.hex", HEX);
    ui.post("update", &json!({ "nodes": [kit::fake::NODE], "trial": false, "start": true }));
    ui.until("the update", |state| state["updates"][0]["phase"] == "running");
    let words = ui.finish().expect("an update was running");
    assert!(words.contains("node 5: cancelled") && words.contains("The device: "), "{words}");
    // The bus is closed.
    server.join().unwrap();
}

/// A bus on which frames follow one another without a pause, until the client disconnects.
fn flood() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let bus = format!("socketcand://{}/can0", listener.local_addr().unwrap());
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(b"< hi >").unwrap();
        let mut text = String::new();
        while !text.contains("rawmode") {
            let mut bytes = [0; 256];
            let len = stream.read(&mut bytes).unwrap();
            text += std::str::from_utf8(&bytes[..len]).unwrap();
            stream.write_all(b"< ok >").unwrap();
        }
        let frames = "< frame 181 1.000000 0102030405060708 >".repeat(100);
        while stream.write_all(frames.as_bytes()).is_ok() {}
    });
    bus
}

/// A page that stops reading its events is dropped, and does not block the others meanwhile.
#[test]
fn a_reader_that_stops_reading_is_dropped() {
    let ui = Ui::on(flood());
    let _lazy = ui.events("?frames=1");
    // From here on it reads nothing. Other pages are served until it is dropped.
    assert!((ui.readers)() > 0, "it was a reader at first");
    wait("it is dropped", || {
        assert_eq!(ui.get("adapters").status, 200);
        (ui.readers)() == 0
    });
    // Its place is free again, and a page that reads gets events.
    ui.until("an event", |state| state["adapter"]["state"] == "open");
}

/// The number of pages is limited; one too many gets an error, and the others are not affected.
#[test]
fn more_readers_than_there_are_places_are_refused() {
    let ui = Ui::new(None);
    let kept: Vec<TcpStream> = (0..32).map(|_| ui.events("")).collect();
    assert_eq!(ui.get("events").status, 503);
    assert_eq!(ui.get("adapters").status, 200);
    drop(kept);
    wait("places are given back", || (ui.readers)() == 0);
    ui.until("an event", |state| state["adapter"]["state"] == "closed");
}

/// The adapter's server ends and starts again; the page gets an event for each.
#[test]
fn a_lost_adapter_is_shown_and_opened_again() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let greet = |listener: &TcpListener| {
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(b"< hi >< ok >< ok >").unwrap();
        stream
    };
    let ui = Ui::new(Some(format!("socketcand://{address}/can0")));
    let first = greet(&listener);
    ui.until("the adapter", |state| state["adapter"]["state"] == "open");
    drop(first);
    let state = ui.until("the loss", |state| state["adapter"]["state"] == "lost");
    assert!(state["adapter"]["words"].as_str().unwrap().contains("is gone"), "{state}");
    assert_eq!(ui.post("scan", &json!({})).status, 409);
    let _second = greet(&listener);
    ui.until("the adapter again", |state| state["adapter"]["state"] == "open");
    // An adapter that was never open is not tried again.
    ui.post("open", &json!({ "url": "slcan:/no/such/port@500k" }));
    let state = ui.until("the refusal", |state| state["adapter"]["state"] == "closed");
    assert!(state["notice"]["words"].as_str().unwrap().contains("/no/such/port"), "{state}");
    assert!(!state["notice"]["advice"].as_str().unwrap().is_empty());
    assert_eq!(ui.finish(), None);
}

/// Any server accepts a connection: the page shows a gateway as open when it has answered.
#[test]
fn a_gateway_is_open_when_it_has_said_something() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("cia309://{}/1", listener.local_addr().unwrap());
    let ui = Ui::new(Some(url.clone()));
    let (mute, _) = listener.accept().unwrap();
    let state = ui.until("the refusal", |state| {
        assert_ne!(state["adapter"]["state"], "open", "{state}");
        state["adapter"]["state"] == "closed" && !state["notice"].is_null()
    });
    assert!(state["notice"]["words"].as_str().unwrap().contains("it has not answered for 5.0 s"), "{state}");
    drop(mute);
    ui.post("open", &json!({ "url": url }));
    let (mut gateway, _) = listener.accept().unwrap();
    gateway.write_all(b"1 7 ERROR 205\r\n[1] OK\r\n").unwrap();
    let state = ui.until("the gateway", |state| state["adapter"]["state"] == "open");
    assert_eq!(state["adapter"]["gateway"], true, "{state}");
}
