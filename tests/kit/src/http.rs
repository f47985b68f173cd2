//! A page of `coflash ui` without a browser. Requests are written byte by byte, because no library would send
//! some of them.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use serde_json::Value;

/// How long something may take before it counts as hanging. It measures nothing.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// The page of a server on this computer.
#[derive(Clone, Debug)]
pub struct Page {
    /// `127.0.0.1:PORT`.
    pub host: String,
    /// `/TOKEN/`.
    pub path: String,
}

/// What the server answered.
#[derive(Debug)]
pub struct Answer {
    pub status: u16,
    pub head: String,
    pub body: String,
}

impl Answer {
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|error| panic!("{error}: {}", self.body))
    }
}

impl Page {
    /// The page with this URL.
    pub fn at(url: &str) -> Self {
        let (host, token) = url.strip_prefix("http://").unwrap().split_once('/').unwrap();
        Self { host: host.to_string(), path: format!("/{token}") }
    }

    pub fn stream(&self) -> TcpStream {
        let stream = TcpStream::connect(&self.host).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream
    }

    /// Sends these bytes, and reads all of the answer.
    pub fn raw(&self, request: &[u8]) -> Answer {
        let mut stream = self.stream();
        // It may answer and close the connection before it has received all.
        let _ = stream.write_all(request);
        let mut answer = Vec::new();
        let mut part = [0; 4096];
        loop {
            match stream.read(&mut part) {
                Ok(0) => break,
                Ok(len) => answer.extend_from_slice(&part[..len]),
                Err(error) if error.kind() == ErrorKind::ConnectionReset => break,
                Err(error) => panic!("{error}"),
            }
        }
        let text = String::from_utf8(answer).unwrap();
        let (head, body) = text.split_once("\r\n\r\n").unwrap_or((&text, ""));
        let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
        Answer { status, head: head.to_lowercase(), body: body.to_string() }
    }

    /// A request with these header lines and those that HTTP requires.
    pub fn request(&self, method: &str, path: &str, lines: &[&str], body: &[u8]) -> Answer {
        let mut request = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
        for line in lines {
            request += &format!("{line}\r\n");
        }
        if !body.is_empty() {
            request += &format!("Content-Length: {}\r\n", body.len());
        }
        self.raw(&[request.as_bytes(), b"\r\n", body].concat())
    }

    pub fn host_line(&self) -> String {
        format!("Host: {}", self.host)
    }

    pub fn get(&self, what: &str) -> Answer {
        self.request("GET", &format!("{}{what}", self.path), &[&self.host_line()], b"")
    }

    pub fn post(&self, what: &str, value: &Value) -> Answer {
        let lines = [&*self.host_line(), "Content-Type: application/json"];
        self.request("POST", &format!("{}{what}", self.path), &lines, value.to_string().as_bytes())
    }

    /// A reader of the events, which has read the status of the answer.
    pub fn events(&self, query: &str) -> TcpStream {
        let mut stream = self.stream();
        let request = format!("GET {}events{query} HTTP/1.1\r\n{}\r\n\r\n", self.path, self.host_line());
        stream.write_all(request.as_bytes()).unwrap();
        let mut head = [0; 12];
        stream.read_exact(&mut head).unwrap();
        assert_eq!(&head, b"HTTP/1.1 200");
        stream
    }

    /// Follows the events until `wanted` accepts the state; returns the state.
    #[track_caller]
    pub fn until(&self, what: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        let mut stream = self.events("");
        let mut text = Vec::new();
        let mut last = Value::Null;
        let began = Instant::now();
        while began.elapsed() < PATIENCE {
            let mut part = [0; 16 * 1024];
            let len = stream.read(&mut part).unwrap();
            assert!(len > 0, "{what}: the events ended; the last state was {last}");
            text.extend_from_slice(&part[..len]);
            while let Some(end) = text.windows(2).position(|two| two == b"\n\n") {
                let event: Vec<u8> = text.drain(..end + 2).collect();
                let event = String::from_utf8_lossy(&event);
                let Some(data) = event.lines().find_map(|line| line.strip_prefix("data: ")) else { continue };
                let value: Value = serde_json::from_str(data).unwrap();
                if !value["state"].is_null() {
                    last = value["state"].clone();
                    if wanted(&last) {
                        return last;
                    }
                }
            }
        }
        panic!("{what}: it never comes; the last state was {last}");
    }
}
