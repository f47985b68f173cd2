//! The server: connections to 127.0.0.1, each with its limits.

use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{sync_channel, Receiver};
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{service_fn, Service as _};
use hyper::Request;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::Semaphore;
use tokio_io_timeout::TimeoutStream;

use super::events::Readers;
use super::guard::Guard;
use super::guests::{Guest, Guests};
use super::http::{engineers, router, Page, Site};
use super::service::Service;
use super::shared::{Failed, Order, Shared};
use super::upload::Room;
use super::worker;
use coboot_can::Kind;

/// The most connections. A browser opens six for each page.
const CONNECTIONS: usize = 64;
/// The send buffer of a connection, which limits the data for a slow reader.
const SEND_BUFFER: u32 = 128 * 1024;
/// How often the server checks whether it must end.
const POLL: Duration = Duration::from_millis(100);
/// How long a cancelled task may take to end.
const IN_ORDER: Duration = Duration::from_secs(10);

coflash_core::options! {
    /// The options of the server.
    #[derive(Clone, Debug)]
    pub struct Options {
        /// The adapter to open at once, as a URL.
        pub bus: Option<String> = None,
        /// The port on 127.0.0.1; 0 for a free one.
        pub port: u16 = 0,
        /// The base COB-IDs of SDO requests and answers, without the node-ID, if they differ from the
        /// predefined ones.
        pub sdo_ids: Option<(u16, u16)> = None,
        /// The kinds of adapters that the page offers.
        pub kinds: Vec<Kind> = Kind::ALL.to_vec(),
        /// The version of the tool for reports, with its commit.
        pub version: String = env!("CARGO_PKG_VERSION").to_owned(),
        /// A page for people who update machines, in place of the one for engineers.
        pub service: Option<Service> = None,
        /// What is done with what a device has shown whose update has failed.
        pub failed: Failed = Failed::default(),
        /// How long a reader may accept no data before it is dropped.
        pub write_timeout: Duration = Duration::from_secs(10),
        /// How long the header of a request may take to arrive.
        pub head_timeout: Duration = Duration::from_secs(10),
        /// How long an upload may send nothing.
        pub body_timeout: Duration = Duration::from_secs(10),
    }
}

/// A server with an open port.
pub struct Server {
    runtime: tokio::runtime::Runtime,
    listener: TcpListener,
    guard: Guard,
    options: Options,
    shared: Arc<Shared>,
    readers: Readers,
    orders: Option<Receiver<Order>>,
}

impl std::fmt::Debug for Server {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Server").field("options", &self.options).finish_non_exhaustive()
    }
}

impl Server {
    /// Opens the port. The server answers no request before [`run`](Self::run).
    ///
    /// # Errors
    /// The port is in use, or the system provides no random numbers.
    pub fn new(options: Options) -> io::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let listener = runtime.block_on(async {
            let socket = TcpSocket::new_v4()?;
            // Accepted connections inherit this size.
            socket.set_send_buffer_size(SEND_BUFFER)?;
            // On Windows this option would let another program use the same port.
            #[cfg(unix)]
            socket.set_reuseaddr(true)?;
            socket.bind(SocketAddr::from((Ipv4Addr::LOCALHOST, options.port)))?;
            socket.listen(64)
        })?;
        let port = listener.local_addr()?.port();
        let guard = Guard { token: Guard::token().map_err(io::Error::other)?, port };
        let (sender, orders) = sync_channel(4);
        let shared = Arc::new(Shared::new(sender, options.failed.clone(), options.version.clone()));
        Ok(Self {
            runtime,
            listener,
            guard,
            options,
            shared,
            readers: Readers::default(),
            orders: Some(orders),
        })
    }

    /// The URL of the page. Anyone with the URL can do everything that the page offers.
    #[must_use]
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.guard.port, self.guard.token)
    }

    /// The number of pages that get events, for tests.
    pub fn readers(&self) -> impl Fn() -> usize + Send + 'static {
        let readers = self.readers.clone();
        move || readers.count()
    }

    /// Serves until `end` is set. A running task is cancelled first: its transfer is aborted, and
    /// the result describes the state of the devices, and what was not saved of a service station.
    ///
    /// # Errors
    /// The thread for the bus does not start.
    pub fn run(mut self, end: &AtomicBool) -> io::Result<Option<String>> {
        let shared = self.shared.clone();
        let orders = self.orders.take();
        let worker = {
            let (shared, sdo_ids) = (shared.clone(), self.options.sdo_ids);
            let work = move || orders.iter().for_each(|orders| worker::run(&shared, orders, sdo_ids));
            thread::Builder::new().name("bus".to_string()).spawn(work)?
        };
        let last_bus = self.options.service.as_ref().and_then(Service::last_bus);
        if let Some(bus) = self.options.bus.take().or(last_bus) {
            // This is the first order, so there is room for it.
            let _ = shared.order(Order::Open(bus));
        }
        let (Page { files, view, routes }, at_end) = match self.options.service.take() {
            None => (engineers(), None),
            Some(service) => {
                let (page, at_end) = service.open();
                (page, Some(at_end))
            }
        };
        let site = Site {
            own_boards: Arc::default(),
            shared: shared.clone(),
            readers: self.readers,
            kinds: self.options.kinds.clone(),
            room: Room::new(self.options.body_timeout),
            reading: Arc::new(Semaphore::new(1)),
            view,
        };
        let app = router(site, self.guard, files, routes);
        let (listener, options) = (self.listener, &self.options);
        let left = self.runtime.block_on(async {
            tokio::select! {
                () = accept(listener, app, options) => {}
                () = set(end) => {}
            }
            end_in_order(&shared).await
        });
        // The adapter is closed normally; a thread that hangs in a task is abandoned.
        if shared.order(Order::End).is_ok() && shared.read(|state| state.task.is_none()) {
            let _ = worker.join();
        }
        let unsaved = at_end.and_then(|at_end| at_end.save());
        let words: Vec<String> = left.into_iter().chain(unsaved).collect();
        Ok((!words.is_empty()).then(|| words.join("\n")))
    }
}

/// Cancels the running task, and returns the state of an update's devices.
async fn end_in_order(shared: &Shared) -> Option<String> {
    let busy = || shared.read(|state| state.task.is_some());
    if !busy() {
        return None;
    }
    shared.cancel();
    let ended = async {
        while busy() {
            tokio::time::sleep(POLL).await;
        }
    };
    // A task that does not react is abandoned.
    let _ = tokio::time::timeout(IN_ORDER, ended).await;
    let words = shared.read(|state| {
        let devices = state.updates.iter().map(|update| format!("node {}: {}", update.node, update.words));
        devices.collect::<Vec<_>>().join("\n")
    });
    Some(words).filter(|words| !words.is_empty()).map(|words| format!("an update was running: {words}"))
}

/// Returns when the flag is set.
async fn set(flag: &AtomicBool) {
    while !flag.load(Ordering::Relaxed) {
        tokio::time::sleep(POLL).await;
    }
}

/// Accepts connections without end. If there are too many, the oldest without the token gives way.
async fn accept(listener: TcpListener, app: axum::Router, options: &Options) {
    let Options { write_timeout, head_timeout, .. } = *options;
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    let mut guests = Guests::default();
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            // The error may be temporary, for example if no descriptor is free.
            tokio::time::sleep(POLL).await;
            continue;
        };
        if places.available_permits() == 0 {
            guests.dismiss_oldest();
        }
        // The semaphore is never closed.
        let Ok(place) = places.clone().acquire_owned().await else { return };
        let (app, guest) = (app.clone(), Guest::default());
        let served = guest.clone();
        let task = tokio::spawn(async move {
            serve(stream, app, served, (write_timeout, head_timeout)).await;
            drop(place);
        });
        guests.add(guest, task.abort_handle());
    }
}

/// Serves one connection, with the limits of time of a write and of a request's header. An error of the
/// connection is the browser's concern.
async fn serve(stream: TcpStream, app: axum::Router, guest: Guest, (write, head): (Duration, Duration)) {
    let _ = stream.set_nodelay(true);
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(write));
    let app = TowerToHyperService::new(app);
    let service = service_fn(move |mut request: Request<Incoming>| {
        request.extensions_mut().insert(guest.clone());
        app.call(request)
    });
    let _ = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(head)
        .max_buf_size(64 * 1024)
        .serve_connection(TokioIo::new(Box::pin(stream)), service)
        .await;
}
