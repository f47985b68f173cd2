//! The requests that a page sends to `coflash ui`: any route, any body, with the token of the URL and
//! without it, and firmware files of any content. No adapter is open.
//!
//! Must hold: each request gets an answer, which is no fault of the server; what a wrong token or
//! another origin asks for is refused; and what a JSON route answers is JSON.
//!
//! The server finds no program with which it would list the adapters of this computer.
#![cfg_attr(fuzzing, no_main)]

use std::cell::RefCell;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::sync::atomic::AtomicBool;
use std::sync::OnceLock;
use std::thread;

use coboot_fuzz::Input;
use coflash_ui::{Options, Server};

/// The routes with a body in JSON, with bodies that are nearly good. No adapter of this computer is
/// opened: there is none by this name.
const POSTS: [(&str, &str); 9] = [
    ("open", "{\"url\": \"none\"}"),
    ("close", ""),
    ("settings", "{\"board\": \"stm32f407g-disc1\", \"program\": 1}"),
    ("scan", ""),
    ("update", "{\"nodes\": [1, 2], \"trial\": true, \"start\": true}"),
    ("step", "{\"node\": 1, \"program\": 1, \"step\": \"call_back\"}"),
    ("fastscan", ""),
    ("assign", "{\"address\": [1, 2, 3, 4], \"node\": 5, \"bit_rate\": 125, \"store\": true}"),
    ("cancel", ""),
];
const GETS: [&str; 6] = ["", "adapters", "trace", "readback", "app.js", "nothing"];

/// The host and the token of the server, which runs as long as this program.
fn server() -> &'static (String, String) {
    static SERVER: OnceLock<(String, String)> = OnceLock::new();
    SERVER.get_or_init(|| {
        std::env::set_var("PATH", "/nowhere");
        let server = Server::new(Options::default()).expect("a free port");
        let url = server.url();
        let mut parts = url.trim_start_matches("http://").split('/').map(str::to_owned);
        let (host, token) = (parts.next().expect("a host"), parts.next().expect("a token"));
        thread::spawn(move || server.run(&AtomicBool::new(false)));
        (host, token)
    })
}

/// Status and body of the answer to a request.
fn ask(connection: &mut BufReader<TcpStream>, request: &[u8]) -> Option<(u16, Vec<u8>)> {
    connection.get_mut().write_all(request).ok()?;
    let mut line = String::new();
    let mut status = None;
    let mut len = 0;
    loop {
        line.clear();
        if connection.read_line(&mut line).ok()? == 0 {
            return None;
        }
        let words = line.trim_end();
        if words.is_empty() {
            break;
        }
        match (status, words.split_once(": ")) {
            (None, _) => status = words.split(' ').nth(1).and_then(|status| status.parse().ok()),
            (_, Some(("content-length", value))) => len = value.parse().ok()?,
            _ => {}
        }
    }
    let mut body = vec![0; len];
    connection.read_exact(&mut body).ok()?;
    Some((status?, body))
}

coboot_fuzz::target!(|bytes: &[u8]| {
    thread_local! {
        static CONNECTION: RefCell<Option<BufReader<TcpStream>>> = const { RefCell::new(None) };
    }
    let (host, token) = server();
    let mut input = Input::new(bytes);
    let Some([what, how]) = input.array() else { return };
    let (is_told, is_own, is_json) = (how & 0x07 != 0, how & 0x38 != 0, how & 0xC0 != 0);
    let shown = if is_told { token } else { "0123456789abcdef0123456789abcdef" };
    let origin = if is_own { format!("http://{host}") } else { "http://example.org".to_owned() };
    let kind = if is_json { "application/json" } else { "text/plain" };
    let (method, path, content) = match usize::from(what) {
        n @ 0..=89 => {
            let (path, good) = POSTS[n % POSTS.len()];
            // The good body, with some of its bytes replaced; or any.
            let mut content = if n < 63 { good.as_bytes().to_vec() } else { input.take(usize::MAX).to_vec() };
            while let Some([at, byte]) = input.array() {
                if let Some(place) = content.get_mut(usize::from(at)) {
                    *place = byte;
                }
            }
            // Such a name would be looked up, or opened.
            if path == "open" && content.contains(&b':') && !content.starts_with(b"{\"url\": \"none\"}") {
                return;
            }
            ("POST", path.to_owned(), content)
        }
        n @ 90..=119 => ("GET", GETS[n % GETS.len()].to_owned(), Vec::new()),
        n => {
            let suffix = ["bin", "hex", "cbf", "elf", "seal"][n % 5];
            ("POST", format!("firmware?name=a.{suffix}"), input.take(usize::MAX).to_vec())
        }
    };
    let mut request = format!(
        "{method} /{shown}/{path} HTTP/1.1\r\nhost: {host}\r\norigin: {origin}\r\ncontent-type: {kind}\r\n\
         content-length: {}\r\n\r\n",
        content.len()
    )
    .into_bytes();
    request.extend(content);
    CONNECTION.with_borrow_mut(|kept| {
        let mut answer = None;
        // A kept connection may have been closed after a refusal.
        for _ in 0..2 {
            let connection = kept.get_or_insert_with(|| {
                let connection = TcpStream::connect(host).expect("the server listens");
                connection.set_nodelay(true).expect("a socket");
                BufReader::new(connection)
            });
            answer = ask(connection, &request);
            if answer.is_some() {
                break;
            }
            *kept = None;
        }
        let (status, body) = answer.expect("no answer");
        assert!((200..500).contains(&status), "{status}: {}", String::from_utf8_lossy(&body));
        assert!((is_told && is_own) || status == 403, "{status} without the token, or for another page");
        if status == 200 && method == "POST" {
            let text = String::from_utf8(body).expect("UTF-8");
            assert!(text.starts_with('{') && text.ends_with('}'), "no JSON: {text}");
        }
    });
});
