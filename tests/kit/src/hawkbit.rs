//! A hawkBit server on this computer, as far as devices see it, written from the public description
//! of the Direct Device Integration API; and its faults.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread;
use std::time::Duration;

use serde_json::{json, Value};
use sha2::{Digest, Sha256};

/// How long a test waits for what must come.
const PATIENCE: Duration = Duration::from_secs(60);

/// A request as it came.
#[derive(Clone, Debug)]
pub struct Request {
    pub method: String,
    pub path: String,
    pub token: Option<String>,
    pub range: Option<String>,
    pub body: Value,
}

/// A file of a deployment: what is said of it, and what is sent.
#[derive(Clone)]
pub struct File {
    pub name: String,
    pub size: u64,
    pub sha256: Option<String>,
    pub content: Vec<u8>,
    /// Whether the server gives parts of it.
    pub ranges: bool,
    /// The link, if it is not on this server.
    pub link: Option<String>,
}

impl std::fmt::Debug for File {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} of {} bytes", self.name, self.content.len())
    }
}

impl File {
    pub fn new(name: &str, content: &[u8]) -> Self {
        Self {
            name: name.to_string(),
            size: content.len() as u64,
            sha256: Some(sha256(content)),
            content: content.to_vec(),
            ranges: true,
            link: None,
        }
    }
}

pub fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// An action for a device.
#[derive(Clone, Debug)]
pub struct Action {
    pub id: u64,
    pub file: File,
    pub update: &'static str,
    pub window: Option<&'static str>,
    pub active: bool,
    pub cancelling: bool,
    /// `success` or `failure` when it is closed; `canceled`.
    pub result: Option<String>,
    /// All feedback on it: execution and details.
    pub feedback: Vec<(String, Vec<String>)>,
    /// The progress that was reported.
    pub progress: Vec<u64>,
    /// The reasons why a cancellation was rejected.
    pub rejected: Vec<String>,
}

impl Action {
    pub fn new(id: u64, file: &File) -> Self {
        Self {
            id,
            file: file.clone(),
            update: "forced",
            window: None,
            active: true,
            cancelling: false,
            result: None,
            feedback: Vec::new(),
            progress: Vec::new(),
            rejected: Vec::new(),
        }
    }

    /// The details of all feedback with this execution.
    pub fn details(&self, execution: &str) -> String {
        let of = self.feedback.iter().filter(|(of, _)| of == execution);
        of.flat_map(|(_, details)| details).cloned().collect::<Vec<_>>().join("\n")
    }
}

/// A device on the server.
#[derive(Clone, Debug, Default)]
pub struct Target {
    pub action: Option<Action>,
    pub wants_attributes: bool,
    pub attributes: BTreeMap<String, Value>,
}

/// What the server does wrong with a request.
#[derive(Clone, Debug)]
pub enum Fault {
    /// It answers with this status, and Retry-After.
    Status(u16, Option<u64>),
    /// It waits before it answers.
    Slow(Duration),
    /// It closes the connection after this many bytes of the body.
    Cut(usize),
    /// It sends this in place of the body.
    Body(Vec<u8>),
    /// It sends bytes without end.
    Endless,
    /// It redirects.
    Redirect(String),
    /// It closes the connection at once.
    Close,
}

#[derive(Debug, Default)]
pub struct State {
    pub targets: BTreeMap<String, Target>,
    pub seen: Vec<Request>,
    /// For requests whose path contains the text: how often, and what.
    pub faults: Vec<(String, usize, Fault)>,
    pub url: String,
    over: bool,
}

/// The server. Every device `ID` has the token `t-ID`, and the gateway's is `g`.
pub struct Server {
    state: Arc<(Mutex<State>, Condvar)>,
    pub url: String,
}

impl Server {
    pub fn start(targets: &[&str]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let targets = targets
            .iter()
            .map(|id| (id.to_string(), Target { wants_attributes: true, ..Target::default() }))
            .collect();
        let state = State { targets, url: url.clone(), ..State::default() };
        let state = Arc::new((Mutex::new(state), Condvar::new()));
        let shared = state.clone();
        thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let shared = shared.clone();
                if shared.0.lock().unwrap().over {
                    return;
                }
                thread::spawn(move || {
                    // The other side may go away at any time.
                    let _ = serve(&stream, &shared);
                });
            }
        });
        Self { state, url }
    }

    pub fn state(&self) -> MutexGuard<'_, State> {
        self.state.0.lock().unwrap()
    }

    pub fn assign(&self, target: &str, action: Action) {
        self.state().targets.get_mut(target).unwrap().action = Some(action);
    }

    /// Makes the next requests with this text in their path fail.
    pub fn fault(&self, path: &str, times: usize, fault: Fault) {
        self.state().faults.push((path.to_string(), times, fault));
    }

    pub fn action(&self, target: &str) -> Action {
        self.state().targets[target].action.clone().unwrap()
    }

    /// Waits until the state is such.
    #[track_caller]
    pub fn wait(&self, what: &str, until: impl Fn(&State) -> bool) {
        let (mutex, changed) = &*self.state;
        let guard = mutex.lock().unwrap();
        let (guard, timeout) = changed.wait_timeout_while(guard, PATIENCE, |state| !until(state)).unwrap();
        assert!(!timeout.timed_out(), "{what} never comes: {:?}", guard.targets);
    }

    pub fn seen(&self, path: &str) -> Vec<Request> {
        self.state().seen.iter().filter(|seen| seen.path.contains(path)).cloned().collect()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.state().over = true;
        let _ = TcpStream::connect(self.url.trim_start_matches("http://"));
    }
}

/// One request, one answer, and the end of the connection.
fn serve(stream: &TcpStream, shared: &(Mutex<State>, Condvar)) -> std::io::Result<()> {
    let mut reader = BufReader::new(stream.try_clone()?);
    let mut line = String::new();
    reader.read_line(&mut line)?;
    let mut words = line.split_whitespace();
    let (Some(method), Some(path)) = (words.next(), words.next()) else { return Ok(()) };
    let mut headers = BTreeMap::new();
    loop {
        let mut line = String::new();
        reader.read_line(&mut line)?;
        let Some((name, value)) = line.trim_end().split_once(": ") else { break };
        headers.insert(name.to_lowercase(), value.to_string());
    }
    let length = headers.get("content-length").and_then(|length| length.parse().ok()).unwrap_or(0);
    let mut body = vec![0; length];
    reader.read_exact(&mut body)?;
    let seen = Request {
        method: method.to_string(),
        path: path.to_string(),
        token: headers.get("authorization").cloned(),
        range: headers.get("range").cloned(),
        body: serde_json::from_slice(&body).unwrap_or_default(),
    };
    let (mutex, changed) = shared;
    let (answer, fault) = {
        let mut state = mutex.lock().unwrap();
        let fault = state.faults.iter_mut().find(|(of, times, _)| *times > 0 && path.contains(of.as_str()));
        let fault = fault.map(|(_, times, fault)| {
            *times -= 1;
            fault.clone()
        });
        state.seen.push(seen.clone());
        // What fails does not count.
        let counts = matches!(fault, None | Some(Fault::Slow(_) | Fault::Cut(_)));
        (if counts { answer(&mut state, &seen) } else { Answer::status(500) }, fault)
    };
    changed.notify_all();
    send(stream, answer, fault)
}

struct Answer {
    status: u16,
    headers: Vec<(String, String)>,
    body: Vec<u8>,
}

impl Answer {
    fn status(status: u16) -> Self {
        Self { status, headers: Vec::new(), body: Vec::new() }
    }

    fn json(value: &Value) -> Self {
        let headers = vec![("Content-Type".to_string(), "application/hal+json".to_string())];
        Self { status: 200, headers, body: value.to_string().into_bytes() }
    }
}

fn send(mut stream: &TcpStream, mut answer: Answer, fault: Option<Fault>) -> std::io::Result<()> {
    let mut cut = None;
    match fault {
        None => {}
        Some(Fault::Status(status, retry)) => {
            answer = Answer::status(status);
            answer.headers.extend(retry.map(|retry| ("Retry-After".to_string(), retry.to_string())));
        }
        Some(Fault::Slow(pause)) => thread::sleep(pause),
        Some(Fault::Cut(length)) => cut = Some(length),
        Some(Fault::Body(body)) => answer = Answer { status: 200, headers: Vec::new(), body },
        Some(Fault::Endless) => {
            stream.write_all(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n")?;
            loop {
                stream.write_all(&[b' '; 4096])?;
            }
        }
        Some(Fault::Redirect(to)) => {
            answer = Answer::status(302);
            answer.headers.push(("Location".to_string(), to));
        }
        Some(Fault::Close) => return Ok(()),
    }
    let mut head = format!("HTTP/1.1 {} x\r\nConnection: close\r\n", answer.status);
    for (name, value) in &answer.headers {
        head += &format!("{name}: {value}\r\n");
    }
    head += &format!("Content-Length: {}\r\n\r\n", answer.body.len());
    stream.write_all(head.as_bytes())?;
    stream.write_all(&answer.body[..cut.unwrap_or(answer.body.len()).min(answer.body.len())])
}

fn answer(state: &mut State, seen: &Request) -> Answer {
    let path = seen.path.split('?').next().unwrap();
    let url = state.url.clone();
    if let Some(name) = path.strip_prefix("/files/") {
        // A store of files as a content delivery network has one: no device, no token.
        let files = state.targets.values().filter_map(|target| target.action.as_ref());
        return match files.map(|action| &action.file).find(|file| file.name == name) {
            Some(file) => part(file, seen),
            None => Answer::status(404),
        };
    }
    let parts: Vec<&str> = path.trim_start_matches('/').split('/').collect();
    let ["DEFAULT", "controller", "v1", id, resource @ ..] = parts.as_slice() else {
        return Answer::status(404);
    };
    let right = [format!("TargetToken t-{id}"), "GatewayToken g".to_string()];
    if !seen.token.as_ref().is_some_and(|token| right.contains(token)) {
        return Answer::status(401);
    }
    let root = format!("{url}/DEFAULT/controller/v1/{id}");
    let Some(target) = state.targets.get_mut(*id) else { return Answer::status(404) };
    let action = target.action.as_mut();
    match (seen.method.as_str(), resource) {
        ("GET", []) => {
            let mut links = json!({});
            if let Some(action) = action.filter(|action| action.active) {
                let (kind, query) = if action.cancelling {
                    ("cancelAction", "")
                } else {
                    ("deploymentBase", "?c=-2127183556")
                };
                links[kind] = json!({ "href": format!("{root}/{kind}/{}{query}", action.id) });
            }
            if target.wants_attributes {
                links["configData"] = json!({ "href": format!("{root}/configData") });
            }
            Answer::json(&json!({ "config": { "polling": { "sleep": "00:00:01" } }, "_links": links }))
        }
        ("PUT", ["configData"]) => {
            target.wants_attributes = false;
            if let Some(data) = seen.body["data"].as_object() {
                target.attributes.extend(data.iter().map(|(key, value)| (key.clone(), value.clone())));
            }
            Answer::status(200)
        }
        ("GET", ["deploymentBase", number]) => match action.filter(|a| a.id.to_string() == *number) {
            Some(action) if action.active && !action.cancelling => deployment(action, &root),
            _ => Answer::status(404),
        },
        ("GET", ["softwaremodules", "1", "artifacts", name]) => match action {
            Some(action) if action.file.name == *name => part(&action.file, seen),
            _ => Answer::status(404),
        },
        ("GET", ["cancelAction", number]) => match action {
            Some(action) if action.cancelling => {
                Answer::json(&json!({ "id": number, "cancelAction": { "stopId": number } }))
            }
            _ => Answer::status(404),
        },
        ("POST", [channel @ ("deploymentBase" | "cancelAction"), number, "feedback"]) => {
            let Some(action) = action.filter(|action| action.id.to_string() == *number) else {
                return Answer::status(404);
            };
            let (answer, wants_attributes) = feedback(action, channel, &seen.body["status"]);
            target.wants_attributes = wants_attributes.unwrap_or(target.wants_attributes);
            answer
        }
        _ => Answer::status(405),
    }
}

/// What a device is to install.
fn deployment(action: &Action, root: &str) -> Answer {
    let file = &action.file;
    let mut hashes = json!({ "md5": "0", "sha1": "0" });
    if let Some(sha256) = &file.sha256 {
        hashes["sha256"] = sha256.as_str().into();
    }
    let own = format!("{root}/softwaremodules/1/artifacts/{}", file.name);
    let href = file.link.clone().unwrap_or(own);
    let mut deployment = json!({
        "download": "forced", "update": action.update,
        "chunks": [{ "part": "bApp", "version": "1.0", "name": "program", "artifacts": [{
            "filename": file.name, "hashes": hashes, "size": file.size,
            "_links": { "download-http": { "href": href } },
        }]}],
    });
    if let Some(window) = action.window {
        deployment["maintenanceWindow"] = window.into();
    }
    Answer::json(&json!({ "id": action.id.to_string(), "deployment": deployment }))
}

/// Feedback of a device; with whether the server asks for its attributes now, if that changes.
fn feedback(action: &mut Action, channel: &str, status: &Value) -> (Answer, Option<bool>) {
    let (Some(execution), Some(finished)) =
        (status["execution"].as_str(), status["result"]["finished"].as_str())
    else {
        return (Answer::status(400), None);
    };
    if !action.active {
        return (Answer::status(410), None);
    }
    let details = status["details"].as_array().into_iter().flatten();
    let details: Vec<String> = details.filter_map(Value::as_str).map(String::from).collect();
    match (channel, execution) {
        ("cancelAction", "rejected") => {
            action.cancelling = false;
            action.rejected.extend(details);
        }
        ("cancelAction", "closed") => {
            action.active = false;
            action.result = Some("canceled".to_string());
        }
        (_, "closed") => {
            action.active = false;
            action.result = Some(finished.to_string());
            action.feedback.push((execution.to_string(), details));
            return (Answer::status(200), Some(finished == "success"));
        }
        _ => {
            action.progress.extend(status["result"]["progress"]["cnt"].as_u64());
            action.feedback.push((execution.to_string(), details));
        }
    }
    (Answer::status(200), None)
}

/// A file, or the part of it that is asked for.
fn part(file: &File, seen: &Request) -> Answer {
    let mut headers = Vec::new();
    if file.ranges {
        headers.push(("Accept-Ranges".to_string(), "bytes".to_string()));
        let from = seen.range.as_deref().and_then(|range| range.strip_prefix("bytes=")?.strip_suffix('-'));
        if let Some(from) = from.and_then(|from| from.parse::<usize>().ok()) {
            let length = file.content.len();
            if from >= length {
                return Answer::status(416);
            }
            headers.push(("Content-Range".to_string(), format!("bytes {from}-{}/{length}", length - 1)));
            return Answer { status: 206, headers, body: file.content[from..].to_vec() };
        }
    }
    Answer { status: 200, headers, body: file.content.clone() }
}
