//! The server: connections to 127.0.0.1, each with its limits.

use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{sync_channel, Receiver};
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::Semaphore;
use tokio_io_timeout::TimeoutStream;

use super::events::Readers;
use super::guard::Guard;
use super::http::{router, Site};
use super::shared::{Order, Shared};
use super::worker;
use crate::bus::Kind;

/// Connections at a time. A browser has six for each page.
const CONNECTIONS: usize = 64;
/// Bytes that the system keeps for a reader who is slow.
const SEND_BUFFER: u32 = 128 * 1024;
/// How long the head of a request may take to arrive.
const HEAD: Duration = Duration::from_secs(10);
/// How often it looks whether it is to end.
const LOOK: Duration = Duration::from_millis(100);
/// How long a task that is cancelled may take to end in order.
const IN_ORDER: Duration = Duration::from_secs(10);

/// How to serve.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Options {
    /// The adapter to open at once, as a URL.
    pub bus: Option<String>,
    /// The port on 127.0.0.1; 0 for a free one.
    pub port: u16,
    /// COB-IDs of SDO requests and answers, without the node-ID, where they are not the usual ones.
    pub sdo_ids: Option<(u16, u16)>,
    /// The kinds of adapters that the page offers.
    pub kinds: Vec<Kind>,
    /// How long a reader may take nothing of what it is sent until it is dropped.
    pub write_timeout: Duration,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            bus: None,
            port: 0,
            sdo_ids: None,
            kinds: Kind::ALL.to_vec(),
            write_timeout: Duration::from_secs(10),
        }
    }
}

/// A server that listens already.
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
    /// Takes the port. Nothing is served before [`run`](Self::run).
    ///
    /// # Errors
    /// The port is taken, or the system has no randomness.
    pub fn new(options: Options) -> io::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let listener = runtime.block_on(async {
            let socket = TcpSocket::new_v4()?;
            // What is accepted inherits it.
            socket.set_send_buffer_size(SEND_BUFFER)?;
            // On Windows this would let another program take the port as well.
            #[cfg(unix)]
            socket.set_reuseaddr(true)?;
            socket.bind(SocketAddr::from((Ipv4Addr::LOCALHOST, options.port)))?;
            socket.listen(64)
        })?;
        let port = listener.local_addr()?.port();
        let guard = Guard { token: Guard::token().map_err(io::Error::other)?, port };
        let (tell, orders) = sync_channel(4);
        let shared = Arc::new(Shared::new(tell));
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

    /// Where the page is. Who knows it may do all that the page can.
    #[must_use]
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.guard.port, self.guard.token)
    }

    /// How many pages get events, for tests.
    pub fn readers(&self) -> impl Fn() -> usize + Send + 'static {
        let readers = self.readers.clone();
        move || readers.count()
    }

    /// Serves until `end` is set. A task that runs then is cancelled first: its transfer is aborted,
    /// and what state that leaves the device in is told.
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
        if let Some(bus) = self.options.bus.take() {
            // It is the first: there is room for it.
            let _ = shared.order(Order::Open(bus));
        }
        let site = Site {
            shared: shared.clone(),
            readers: self.readers,
            kinds: self.options.kinds.clone(),
            reading: Arc::new(Semaphore::new(1)),
        };
        let app = router(site, self.guard);
        let (listener, write_timeout) = (self.listener, self.options.write_timeout);
        let left = self.runtime.block_on(async {
            tokio::select! {
                () = accept(listener, app, write_timeout) => {}
                () = set(end) => {}
            }
            end_in_order(&shared).await
        });
        // The adapter is closed in order; one who hangs in a task that does not end is left behind.
        if shared.order(Order::End).is_ok() && shared.look(|state| state.task.is_none()) {
            let _ = worker.join();
        }
        Ok(left)
    }
}

/// Cancels the task that runs, and tells what became of an update's devices.
async fn end_in_order(shared: &Shared) -> Option<String> {
    let busy = || shared.look(|state| state.task.is_some());
    if !busy() {
        return None;
    }
    shared.cancel();
    let ended = async {
        while busy() {
            tokio::time::sleep(LOOK).await;
        }
    };
    // One that does not listen any more is left behind.
    let _ = tokio::time::timeout(IN_ORDER, ended).await;
    let words = shared.look(|state| {
        let devices = state.updates.iter().map(|update| format!("node {}: {}", update.node, update.words));
        devices.collect::<Vec<_>>().join("\n")
    });
    Some(words).filter(|words| !words.is_empty())
}

/// Until the flag is set.
async fn set(flag: &AtomicBool) {
    while !flag.load(Ordering::Relaxed) {
        tokio::time::sleep(LOOK).await;
    }
}

/// Takes connections, for ever.
async fn accept(listener: TcpListener, app: axum::Router, write_timeout: Duration) {
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    loop {
        // It is never closed.
        let Ok(place) = places.clone().acquire_owned().await else { return };
        let Ok((stream, _)) = listener.accept().await else {
            // Out of descriptors, say: that passes.
            tokio::time::sleep(LOOK).await;
            continue;
        };
        let app = app.clone();
        tokio::spawn(async move {
            serve(stream, app, write_timeout).await;
            drop(place);
        });
    }
}

/// One connection. How it ends is the browser's affair.
async fn serve(stream: TcpStream, app: axum::Router, write_timeout: Duration) {
    let _ = stream.set_nodelay(true);
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(write_timeout));
    let _ = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD)
        .max_buf_size(64 * 1024)
        .serve_connection(TokioIo::new(Box::pin(stream)), TowerToHyperService::new(app))
        .await;
}
