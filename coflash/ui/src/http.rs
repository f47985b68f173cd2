//! The requests of the page and their answers.

use std::fmt::Display;
use std::sync::{Arc, Mutex};

use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, FromRequest, Query, Request, State};
use axum::http::{header, StatusCode};
use axum::middleware;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::Router;
use canopen::NodeId;
use serde::de::DeserializeOwned;
use serde::Deserialize;
use serde_json::{json, Value};
use shared_abi::layout::{self, Layout};
use tokio::sync::Semaphore;

use super::adapters;
use super::events::{self, Readers, View};
use super::firmware::{self, FILE_MAX};
use super::frames::candump;
use super::guard::{guard, Guard};
use super::job::{Job, Step};
use super::shared::{lock, Order, Refusal, Shared};
use super::state::{Fits, Notice, Settings};
use super::upload::{Room, Upload};

pub(super) use super::upload::Refused;

use coboot_can::Kind;
use coflash_core::device::lss::{BitRate, LssAddress};
use coflash_core::file::board;
use coflash_core::update::{FlashOptions, Password};

/// The most bytes of a request without a file.
const BODY_MAX: usize = 64 * 1024;
/// The most memory maps that are taken: each stays in memory.
const BOARDS_MAX: usize = 100;

/// The state that the handlers share.
#[derive(Clone)]
pub(super) struct Site {
    pub(super) shared: Arc<Shared>,
    pub(super) readers: Readers,
    /// The kinds of adapters on offer.
    pub(super) kinds: Vec<Kind>,
    /// The room for files that are being sent.
    pub(super) room: Room,
    /// Only one file is judged at a time: it may be large.
    pub(super) reading: Arc<Semaphore>,
    /// The boards of the user's files; the last one can be chosen.
    pub(super) own_boards: Arc<Mutex<Vec<&'static Layout>>>,
    /// What the page gets of the state.
    pub(super) view: View,
}

/// A page: its files, what it gets of the state, and its own requests.
pub(super) struct Page {
    /// Name, type and content.
    pub(super) files: &'static [(&'static str, &'static str, &'static str)],
    pub(super) view: View,
    pub(super) routes: Router<Site>,
}

impl IntoResponse for Refused {
    fn into_response(self) -> Response {
        json_response(self.0, &json!(self.1))
    }
}

pub(super) type Answer = Result<Response, Refused>;

pub(super) fn json_response(status: StatusCode, value: &Value) -> Response {
    (status, [(header::CONTENT_TYPE, "application/json")], value.to_string()).into_response()
}

pub(super) fn done() -> Answer {
    Ok(json_response(StatusCode::OK, &json!({})))
}

pub(super) fn bad(words: impl Into<String>, advice: &str) -> Refused {
    Refused::new(StatusCode::BAD_REQUEST, words, advice)
}

impl From<Refusal> for Refused {
    fn from(refusal: Refusal) -> Self {
        match refusal {
            Refusal::Busy(words) => Self::new(
                StatusCode::CONFLICT,
                format!("another task is running: {words}"),
                "wait until it has finished, or cancel it",
            ),
            Refusal::NotReady(words) => {
                Self::new(StatusCode::CONFLICT, words, "choose an adapter and connect to it first")
            }
        }
    }
}

/// The files of the engineer's page. They are part of the program, so nothing must be installed or downloaded.
const FILES: [(&str, &str, &str); 16] = [
    ("", HTML, concat!(include_str!("page/head.html"), include_str!("page/index.html"))),
    ("icon.svg", "image/svg+xml", include_str!("page/icon.svg")),
    ("colours.css", CSS, include_str!("page/colours.css")),
    ("style.css", CSS, include_str!("page/style.css")),
    ("app.js", SCRIPT, include_str!("page/app.js")),
    ("api.js", SCRIPT, include_str!("page/api.js")),
    ("bus.js", SCRIPT, include_str!("page/bus.js")),
    ("devices.js", SCRIPT, include_str!("page/devices.js")),
    ("dom.js", SCRIPT, include_str!("page/dom.js")),
    ("events.js", SCRIPT, include_str!("page/events.js")),
    ("kept.js", SCRIPT, include_str!("page/kept.js")),
    ("reports.js", SCRIPT, include_str!("page/reports.js")),
    ("stream.js", SCRIPT, include_str!("page/stream.js")),
    ("tabs.js", SCRIPT, include_str!("page/tabs.js")),
    ("uPlot.css", CSS, include_str!("page/uPlot.min.css")),
    ("uPlot.js", SCRIPT, include_str!("page/uPlot.iife.min.js")),
];
pub(super) const HTML: &str = "text/html; charset=utf-8";
pub(super) const CSS: &str = "text/css; charset=utf-8";
pub(super) const SCRIPT: &str = "text/javascript; charset=utf-8";

/// The page for engineers.
pub(super) fn engineers() -> Page {
    let routes = Router::new()
        .route("/adapters", get(list))
        .route("/trace", get(trace))
        .route("/firmware", post(take_file))
        .route("/board", post(take_board))
        .route("/readback", get(readback))
        .route("/open", post(open))
        .route("/close", post(close))
        .route("/settings", post(settings))
        .route("/scan", post(|State(site): State<Site>| begin(site, Job::Scan)))
        .route("/update", post(update))
        .route("/step", post(step))
        .route("/fastscan", post(|State(site): State<Site>| begin(site, Job::Fastscan)))
        .route("/assign", post(assign));
    Page { files: &FILES, view: Arc::new(|state| json!(state)), routes }
}

/// All requests to a page, behind the guard.
pub(super) fn router(
    site: Site,
    who: Guard,
    files: &[(&str, &'static str, &'static str)],
    routes: Router<Site>,
) -> Router {
    let mut router = Router::new();
    for (name, kind, content) in files.iter().copied() {
        let file = get(move || async move { ([(header::CONTENT_TYPE, kind)], content) });
        router = router.route(&format!("/{}/{name}", who.token), file);
    }
    let routes = routes.route("/events", get(take_events)).route("/cancel", post(cancel));
    router
        .nest(&format!("/{}", who.token), routes)
        .layer(DefaultBodyLimit::max(BODY_MAX))
        .layer(middleware::from_fn_with_state(who, guard))
        .with_state(site)
}

/// A JSON body. A form of a foreign page cannot send one.
pub(super) struct Body<T>(pub(super) T);

impl<T: DeserializeOwned> FromRequest<Site> for Body<T> {
    type Rejection = Refused;

    async fn from_request(request: Request, site: &Site) -> Result<Self, Refused> {
        let kind = request.headers().get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok());
        if kind.unwrap_or_default().split(';').next() != Some("application/json") {
            let status = StatusCode::UNSUPPORTED_MEDIA_TYPE;
            return Err(Refused::new(status, "the request is not JSON", "send it as application/json"));
        }
        let bytes = Bytes::from_request(request, site).await;
        let bytes =
            bytes.map_err(|error| Refused::new(error.status(), error.body_text(), "reload the page"))?;
        serde_json::from_slice(&bytes).map(Self).map_err(unreadable)
    }
}

fn unreadable(error: impl Display) -> Refused {
    bad(format!("the request cannot be read: {error}"), "reload the page")
}

#[derive(Deserialize)]
struct Wanted {
    #[serde(default)]
    frames: u8,
}

async fn take_events(State(site): State<Site>, Query(wanted): Query<Wanted>) -> Answer {
    match events::stream(site.shared, site.view, &site.readers, wanted.frames != 0) {
        Some(stream) => Ok(stream.into_response()),
        None => {
            let status = StatusCode::SERVICE_UNAVAILABLE;
            Err(Refused::new(status, "too many pages are open", "close some of them"))
        }
    }
}

async fn list(State(site): State<Site>) -> Response {
    let boards: Vec<&str> = boards(&site).iter().map(|layout| layout.board).collect();
    let tool = site.shared.tool.clone();
    let found = tokio::task::spawn_blocking(move || adapters::list(&site.kinds)).await.unwrap_or_default();
    let value = json!({
        "adapters": found,
        "boards": boards,
        "trial": FlashOptions::default().trial_run,
        "version": tool,
        "file_max": FILE_MAX,
    });
    json_response(StatusCode::OK, &value)
}

/// A file for the user to save.
pub(super) fn download(name: &str, kind: &'static str, content: impl IntoResponse) -> Response {
    let disposition = format!("attachment; filename=\"{name}\"");
    ([(header::CONTENT_TYPE, kind.to_string()), (header::CONTENT_DISPOSITION, disposition)], content)
        .into_response()
}

async fn trace(State(site): State<Site>) -> Response {
    let text = tokio::task::spawn_blocking(move || {
        // Formatted without the lock, so that the bus continues.
        let (log, forgotten) = lock(&site.shared.frames).log();
        candump(&log, forgotten)
    });
    download("coflash.log", "text/plain; charset=utf-8", text.await.unwrap_or_default())
}

async fn readback(State(site): State<Site>) -> Answer {
    let bytes = lock(&site.shared.readback).clone();
    let shown = site.shared.read(|state| state.readback.clone());
    let (Some(bytes), Some(shown)) = (bytes, shown) else {
        return Err(Refused::new(StatusCode::NOT_FOUND, "no program was read", "read one first"));
    };
    let name = format!("node{}-program{}.bin", shown.node, shown.program);
    Ok(download(&name, "application/octet-stream", bytes.to_vec()))
}

#[derive(Deserialize)]
pub(super) struct Open {
    pub(super) url: String,
}

/// Refuses to change the adapter during a task.
pub(super) fn idle(site: &Site) -> Result<(), Refused> {
    match site.shared.read(|state| state.task.as_ref().map(|task| task.words.clone())) {
        Some(words) => Err(Refusal::Busy(words).into()),
        None => Ok(()),
    }
}

async fn open(State(site): State<Site>, Body(Open { url }): Body<Open>) -> Answer {
    idle(&site)?;
    site.shared.order(Order::Open(url.trim().to_string()))?;
    done()
}

async fn close(State(site): State<Site>) -> Answer {
    idle(&site)?;
    site.shared.order(Order::Close)?;
    done()
}

#[derive(Deserialize)]
struct Named {
    name: String,
}

/// A file in a request. It is taken only while nothing is being done.
struct Sent {
    name: String,
    upload: Upload,
}

impl FromRequest<Site> for Sent {
    type Rejection = Refused;

    async fn from_request(request: Request, site: &Site) -> Result<Self, Refused> {
        let Query(Named { name }) = Query::try_from_uri(request.uri()).map_err(unreadable)?;
        idle(site)?;
        let (parts, body) = request.into_parts();
        let upload = site.room.read(&parts.headers, body).await?;
        Ok(Self { name, upload })
    }
}

async fn take_file(State(site): State<Site>, Sent { name, upload }: Sent) -> Answer {
    let Upload { bytes, room } = upload;
    let settings = site.shared.read(|state| state.settings.clone());
    let answer = load(&site, Arc::new(bytes), name, settings).await;
    drop(room);
    answer
}

#[derive(Deserialize)]
struct Choice {
    board: Option<String>,
    program: u8,
}

/// After a change of the settings, the file is converted again.
async fn settings(State(site): State<Site>, Body(Choice { board, program }): Body<Choice>) -> Answer {
    idle(&site)?;
    let board = match board.as_deref().filter(|board| !board.is_empty()) {
        None => None,
        Some(name) => match boards(&site).into_iter().find(|layout| layout.board == name) {
            Some(layout) => Some(layout),
            None => return Err(bad(format!("there is no board '{name}'"), "reload the page")),
        },
    };
    if !(1..=254).contains(&program) {
        return Err(bad("programs are 1 to 254", "choose another program"));
    }
    choose(&site, Settings { board, program }).await
}

/// The boards to choose from: that of the user's file, then those that are built in.
fn boards(site: &Site) -> Vec<&'static Layout> {
    lock(&site.own_boards).last().copied().into_iter().chain(layout::BOARDS.iter().copied()).collect()
}

/// Takes the file with the memory map of a board, and chooses that board.
async fn take_board(State(site): State<Site>, Sent { name, upload }: Sent) -> Answer {
    let name = firmware::printable(&name);
    let is_full = lock(&site.own_boards).len() >= BOARDS_MAX;
    if is_full {
        return Err(bad("this coflash has taken too many memory maps", "start it again"));
    }
    let layout = board::parse(&String::from_utf8_lossy(&upload.bytes)).map_err(|error| {
        bad(
            format!("{name}: {error}"),
            "choose the memory map that the build of the board has written (my-board.toml)",
        )
    })?;
    lock(&site.own_boards).push(layout);
    let program = site.shared.read(|state| state.settings.program);
    choose(&site, Settings { board: Some(layout), program }).await
}

/// Applies settings; the firmware file is converted again.
async fn choose(site: &Site, settings: Settings) -> Answer {
    site.shared.change(|state| {
        state.settings = settings.clone();
        state.judge();
    });
    let loaded = lock(&site.shared.firmware).clone();
    match loaded {
        Some(loaded) => load(site, loaded.bytes.clone(), loaded.shown.name.clone(), settings).await,
        None => done(),
    }
}

/// Reads a file on a separate thread, so that the pages stay responsive.
async fn load(site: &Site, bytes: Arc<Vec<u8>>, name: String, settings: Settings) -> Answer {
    let Ok(_turn) = site.reading.try_acquire() else {
        return Err(Refusal::Busy("another file is being read".to_string()).into());
    };
    let read = tokio::task::spawn_blocking(move || firmware::load(bytes, &name, &settings)).await;
    let fault = |_| {
        Notice::failed(
            "the file cannot be read because of an internal error of coflash",
            "report it, with the file",
        )
    };
    let (loaded, answer) = match read.map_err(fault).and_then(|read| read) {
        Ok(loaded) => (Some(Arc::new(loaded)), done()),
        // The previous file is no longer the one that the user means.
        Err(notice) => (None, Err(Refused(StatusCode::UNPROCESSABLE_ENTITY, notice))),
    };
    let shown = loaded.as_ref().map(|loaded| loaded.shown.clone());
    *lock(&site.shared.firmware) = loaded;
    site.shared.change(|state| {
        state.firmware = shown;
        state.judge();
    });
    answer
}

/// Begins a task.
async fn begin(site: Site, job: Job) -> Answer {
    site.shared.begin(job)?;
    done()
}

#[derive(Deserialize)]
struct Update {
    nodes: Vec<u8>,
    trial: bool,
    start: bool,
    /// Whether the user has confirmed that bootloaders are renewed.
    #[serde(default)]
    renew: bool,
    /// The password of locked devices; empty for none.
    #[serde(default)]
    password: String,
}

pub(super) fn node_id(number: u8) -> Result<NodeId, Refused> {
    NodeId::new(number).ok_or_else(|| bad(format!("{number} is not a node-ID"), "node-IDs are 1 to 127"))
}

/// The password in a request; none for an empty field. A refusal does not repeat it.
pub(super) fn password_of(text: &str) -> Result<Option<Password>, Refused> {
    let too_long = || bad("the password has more than 64 bytes", "enter the password of the device");
    match text {
        "" => Ok(None),
        text => Password::new(text).map(Some).ok_or_else(too_long),
    }
}

async fn update(State(site): State<Site>, Body(wanted): Body<Update>) -> Answer {
    let Update { nodes, trial, start, renew, password } = wanted;
    let Some(file) = lock(&site.shared.firmware).clone() else {
        return Err(bad("there is no firmware file", "drop one on the page, or choose one"));
    };
    if file.shown.is_bootloader && !renew {
        return Err(Refused::new(
            StatusCode::CONFLICT,
            "the file is a bootloader, and nobody has confirmed that it replaces that of the devices",
            "press the button Update, and confirm the renewal; no device was changed",
        ));
    }
    let unlock = password_of(&password)?;
    let mut wanted: Vec<NodeId> = Vec::new();
    for node in nodes {
        let node = node_id(node)?;
        if !wanted.contains(&node) {
            wanted.push(node);
        }
    }
    if wanted.is_empty() {
        return Err(bad("no device is chosen", "choose one in the table"));
    }
    let (program, misfit) = site.shared.read(|state| {
        let devices = state.devices.iter().flat_map(|devices| devices.values());
        let misfit =
            devices.filter(|device| wanted.iter().any(|node| node.get() == device.node)).find_map(|device| {
                let verdict = device.verdict.as_ref().filter(|verdict| verdict.fits == Fits::No)?;
                Some(format!("the file is not for node {}: {}", device.node, verdict.words))
            });
        (state.settings.program, misfit)
    });
    if let Some(words) = misfit {
        let advice = "choose the file that is made for this device; no device was changed";
        return Err(Refused::new(StatusCode::UNPROCESSABLE_ENTITY, words, advice));
    }
    begin(site, Job::Update { nodes: wanted, file, program, trial, start, unlock }).await
}

#[derive(Deserialize)]
struct Single {
    node: u8,
    program: u8,
    step: Step,
}

async fn step(State(site): State<Site>, Body(Single { node, program, step }): Body<Single>) -> Answer {
    if !(1..=254).contains(&program) {
        return Err(bad("programs are 1 to 254", "choose another program"));
    }
    begin(site, Job::Step { node: node_id(node)?, program, step }).await
}

#[derive(Deserialize)]
struct Assign {
    /// Vendor-ID, product code, revision, serial number.
    address: [u32; 4],
    node: Option<u8>,
    /// In kbit/s.
    bit_rate: Option<u32>,
    store: bool,
}

async fn assign(
    State(site): State<Site>,
    Body(Assign { address, node, bit_rate, store }): Body<Assign>,
) -> Answer {
    let [vendor_id, product_code, revision, serial_number] = address;
    let identity = address.map(Some);
    let address = LssAddress { vendor_id, product_code, revision, serial_number };
    let node = node.map(node_id).transpose()?;
    let rate = |kbits: u32| {
        let known = (0..=8).filter_map(BitRate::from_index);
        let found = known.into_iter().find(|rate| rate.bits_per_second() == kbits.checked_mul(1000));
        found.ok_or_else(|| bad(format!("LSS has no bit rate of {kbits} kbit/s"), "choose another"))
    };
    let bit_rate = bit_rate.map(rate).transpose()?;
    if node.is_none() && bit_rate.is_none() {
        return Err(bad("neither a node-ID nor a bit rate is given", "give one of them"));
    }
    if let Some(node) = node {
        let taken = site.shared.read(|state| {
            let device = state.devices.as_ref().and_then(|devices| devices.get(&node.get()))?;
            (device.answers && device.identity != identity).then_some(())
        });
        if taken.is_some() {
            return Err(bad(format!("another device already has node-ID {node}"), "choose a free one"));
        }
    }
    begin(site, Job::Assign { address, node, bit_rate, store }).await
}

async fn cancel(State(site): State<Site>) -> Answer {
    site.shared.cancel();
    done()
}
