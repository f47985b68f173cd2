//! The bus for other programs: the socketcand protocol over TCP, as python-can and can-utils'
//! friends speak it.
//!
//! All clients share one host port, the "adapter" of the bench: it is on the bus whether clients
//! are connected or not, so a device always gets its acknowledge. A client sees the frames of the
//! other clients too, but not its own. Time stamps are virtual time. Remote frames reach clients as
//! `< rtr … >`.
//!
//! What clients taught us: python-can expects each answer of the opening alone in one read, so no
//! frame goes out for [`HOLD`] after the answer to `rawmode`; and without TCP_NODELAY every
//! exchange waits for delayed acknowledges.
//!
//! No client can hold up the world: a client that does not read is disconnected, and a client that
//! sends more than the bus takes is read more slowly.

pub mod protocol;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, HashMap};
use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{sync_channel, Receiver, SyncSender, TrySendError};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{self, Thread};
use std::time::Duration;

use crate::frame::Frame;
use crate::world::{Computer, PortId, World};
use protocol::{frame_element, Effect, Reaction, Session, Splitter, HELLO};

/// How long frames are held back after the answer to `rawmode`.
pub const HOLD: Duration = Duration::from_millis(10);
/// Clients at a time.
pub const MAX_CLIENTS: usize = 64;
/// Texts that wait for a client to read them; one more, and it is disconnected.
const QUEUE: usize = 8192;
/// Frames of one client that wait for the bus; after them its connection is not read on.
const CREDIT: usize = 256;
/// Events that wait for the world.
const EVENTS: usize = 1024;
/// A client that reads nothing for this long while data waits for it is disconnected.
const PATIENCE: Duration = Duration::from_secs(10);
/// A write takes up to so many bytes of waiting texts at once.
const WRITE: usize = 16 * 1024;

type ClientId = u64;

/// An event that the connections' threads report to the world's thread.
enum Event {
    Connected {
        id: ClientId,
        peer: SocketAddr,
        out: SyncSender<Out>,
        stream: TcpStream,
        credit: Arc<Credit>,
    },
    Frame {
        id: ClientId,
        frame: Frame,
    },
    /// Frames go to the client from now on, or no longer.
    Frames {
        id: ClientId,
        on: bool,
        answer: String,
        done: SyncSender<()>,
    },
    Gone {
        id: ClientId,
    },
}

/// The channel from the connections' threads to the world's thread.
#[derive(Clone)]
struct Events {
    sender: SyncSender<Event>,
    /// The thread that made the server; it may sleep.
    owner: Thread,
}

impl Events {
    /// Hands in an event. Returns whether the world's thread still receives events.
    fn send(&self, event: Event) -> bool {
        let sent = self.sender.send(event).is_ok();
        self.owner.unpark();
        sent
    }
}

/// A task for a client's writing thread.
enum Out {
    Text(String),
    Hold,
}

/// How many frames a client may still hand in.
#[derive(Default)]
struct Credit {
    used: Mutex<usize>,
    changed: Condvar,
    closed: AtomicBool,
}

impl Credit {
    /// Waits until a frame may be handed in; `false` if the connection is over.
    fn take(&self) -> bool {
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        while *used >= CREDIT && !self.closed.load(Ordering::Relaxed) {
            used = self.changed.wait(used).unwrap_or_else(PoisonError::into_inner);
        }
        *used += 1;
        !self.closed.load(Ordering::Relaxed)
    }

    fn release(&self) {
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        *used = used.saturating_sub(1);
        self.changed.notify_one();
    }

    fn close(&self) {
        // Under the lock, so that nobody falls asleep between the look at the flag and the wait.
        let _used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        self.closed.store(true, Ordering::Relaxed);
        self.changed.notify_all();
    }
}

struct Client {
    out: SyncSender<Out>,
    stream: TcpStream,
    credit: Arc<Credit>,
    frames: bool,
}

impl Client {
    fn hang_up(&self) {
        self.credit.close();
        // The client may have closed the connection itself.
        let _ = self.stream.shutdown(Shutdown::Both);
    }
}

/// The server. Its threads only carry texts; the owner of the world calls
/// [`exchange`](Self::exchange).
pub struct Server {
    address: SocketAddr,
    events: Receiver<Event>,
    clients: BTreeMap<ClientId, Client>,
    /// The client that handed in the frame, by ticket.
    owners: HashMap<u64, ClientId>,
    notices: Vec<String>,
    stop: Arc<AtomicBool>,
}

impl Server {
    /// Listens. `bus` is the name that clients have to open, as a rule `can0`. The calling thread is
    /// unparked when a client wants something.
    ///
    /// # Errors
    /// The operating system's error, for instance that the address is in use.
    pub fn bind(address: impl ToSocketAddrs, bus: &str) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let (sender, events) = sync_channel(EVENTS);
        let sender = Events { sender, owner: thread::current() };
        let stop = Arc::new(AtomicBool::new(false));
        let (bus, stopped) = (bus.to_owned(), stop.clone());
        thread::Builder::new()
            .name("socketcand".into())
            .spawn(move || accept(&listener, &bus, &sender, &stopped))?;
        Ok(Self {
            address,
            events,
            clients: BTreeMap::new(),
            owners: HashMap::new(),
            notices: Vec::new(),
            stop,
        })
    }

    /// The address at which it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Clients connected.
    #[must_use]
    pub fn clients(&self) -> usize {
        self.clients.len()
    }

    /// The events of clients since the last call, as sentences for people to read.
    pub fn notices(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notices)
    }

    /// Hands the clients' frames to the port, and the port's frames to the clients. Gives the
    /// number of frames that clients got.
    pub fn exchange<M: Computer>(&mut self, world: &mut World<M>, port: PortId) -> usize {
        while let Ok(event) = self.events.try_recv() {
            self.handle_event(event, world, port);
        }
        self.send_queued(world, port)
    }

    fn handle_event<M: Computer>(&mut self, event: Event, world: &mut World<M>, port: PortId) {
        match event {
            Event::Connected { id, peer, out, stream, credit } => {
                self.notices.push(format!("client {id} connected from {peer}"));
                self.clients.insert(id, Client { out, stream, credit, frames: false });
            }
            Event::Frame { id, frame } => {
                let ticket = world.send(port, frame);
                self.owners.insert(ticket, id);
            }
            Event::Frames { id, on, answer, done } => {
                // A client that has read the answer misses no frame, and none comes before the answer.
                let answers = [Some(Out::Text(answer)), on.then_some(Out::Hold)];
                if let Some(client) = self.clients.get_mut(&id) {
                    client.frames = on;
                    if answers.into_iter().flatten().any(|answer| client.out.try_send(answer).is_err()) {
                        client.hang_up();
                    }
                }
                // The connection may be over.
                let _ = done.send(());
            }
            Event::Gone { id } => {
                // What is in its queue still reaches it.
                if self.clients.remove(&id).is_some() {
                    self.notices.push(format!("client {id} disconnected"));
                }
            }
        }
    }

    fn send_queued<M: Computer>(&mut self, world: &mut World<M>, port: PortId) -> usize {
        let port = world.port_mut(port);
        let mut frames = Vec::new();
        while let Some((at, frame)) = port.receive() {
            frames.push((at, None, frame));
        }
        while let Some((at, ticket, frame)) = port.sent() {
            let owner = self.owners.remove(&ticket);
            if let Some(client) = owner.and_then(|id| self.clients.get(&id)) {
                client.credit.release();
            }
            frames.push((at, owner, frame));
        }
        frames.sort_by_key(|(at, ..)| *at);
        let mut given = 0;
        for (at, owner, frame) in frames {
            let text = frame_element(at, &frame);
            let mut full = Vec::new();
            for (id, client) in &self.clients {
                if !client.frames || owner == Some(*id) {
                    continue;
                }
                match client.out.try_send(Out::Text(text.clone())) {
                    Ok(()) => given += 1,
                    Err(TrySendError::Full(_)) => full.push(*id),
                    // Its reading thread is about to say so.
                    Err(TrySendError::Disconnected(_)) => {}
                }
            }
            for id in full {
                if let Some(client) = self.clients.remove(&id) {
                    client.hang_up();
                    self.notices.push(format!("client {id} does not read its frames: disconnected"));
                }
            }
        }
        given
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.clients.values().for_each(Client::hang_up);
        // Wakes the listening thread, which then sees the flag.
        let _ = TcpStream::connect_timeout(&self.address, Duration::from_millis(100));
    }
}

fn accept(listener: &TcpListener, bus: &str, events: &Events, stop: &AtomicBool) {
    let connected = Arc::new(AtomicUsize::new(0));
    let mut next_id: ClientId = 1;
    while !stop.load(Ordering::Relaxed) {
        let Ok((stream, peer)) = listener.accept() else {
            // Perhaps the process is out of file descriptors: it goes on when a client leaves.
            thread::sleep(Duration::from_millis(50));
            continue;
        };
        if stop.load(Ordering::Relaxed) {
            return;
        }
        if connected.load(Ordering::Relaxed) >= MAX_CLIENTS {
            // If the client cannot receive this, it sees the end of the connection.
            let _ = (&stream).write_all(b"< error too many clients >");
            continue;
        }
        if serve(stream, peer, next_id, bus, events, &connected).is_ok() {
            next_id += 1;
        }
    }
}

/// Starts the two threads of a connection.
fn serve(
    stream: TcpStream,
    peer: SocketAddr,
    id: ClientId,
    bus: &str,
    events: &Events,
    connected: &Arc<AtomicUsize>,
) -> io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let (out, texts) = sync_channel(QUEUE);
    let credit = Arc::new(Credit::default());
    let connection =
        Event::Connected { id, peer, out: out.clone(), stream: stream.try_clone()?, credit: credit.clone() };
    let writing = stream.try_clone()?;
    let (session, events, connected) = (Session::new(bus), events.clone(), connected.clone());
    thread::Builder::new().name(format!("client {id} out")).spawn(move || write(writing, &texts))?;
    thread::Builder::new().name(format!("client {id} in")).spawn(move || {
        connected.fetch_add(1, Ordering::Relaxed);
        if events.send(connection) {
            read(&stream, id, session, &out, &credit, &events);
        }
        credit.close();
        connected.fetch_sub(1, Ordering::Relaxed);
        // If the world is gone, nobody needs to know.
        events.send(Event::Gone { id });
    })?;
    Ok(())
}

/// Takes a client's elements until the connection or the server ends, or the client asks for what
/// ends it.
fn read(
    mut stream: &TcpStream,
    id: ClientId,
    mut session: Session,
    out: &SyncSender<Out>,
    credit: &Credit,
    events: &Events,
) {
    let mut splitter = Splitter::default();
    let mut buffer = [0; 4096];
    if out.try_send(Out::Text(HELLO.into())).is_err() {
        return;
    }
    loop {
        let len = match stream.read(&mut buffer) {
            Ok(0) => return,
            Ok(len) => len,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(_) => return,
        };
        for element in buffer[..len].iter().filter_map(|byte| splitter.push(*byte)) {
            let Reaction { answer, effect } = session.handle(element.as_deref().map_err(|bad| *bad));
            if matches!(effect, Effect::StartFrames | Effect::StopFrames) {
                let (done, is_done) = sync_channel(1);
                let (on, answer) = (effect == Effect::StartFrames, answer.unwrap_or_default());
                // The next answer comes after this one.
                if !events.send(Event::Frames { id, on, answer, done }) || is_done.recv().is_err() {
                    return;
                }
                continue;
            }
            // A full queue: it sends and does not read.
            if answer.is_some_and(|answer| out.try_send(Out::Text(answer)).is_err()) {
                return;
            }
            match effect {
                Effect::Send(frame) => {
                    if !credit.take() || !events.send(Event::Frame { id, frame }) {
                        return;
                    }
                }
                // The writing thread ends the connection after the last text.
                Effect::Close => return,
                Effect::None | Effect::StartFrames | Effect::StopFrames => {}
            }
        }
    }
}

/// Brings texts to a client until there will be no more, then ends the connection.
fn write(mut stream: TcpStream, texts: &Receiver<Out>) {
    let mut next = texts.recv().ok();
    while let Some(out) = next.take() {
        match out {
            Out::Text(mut text) => {
                while text.len() < WRITE {
                    match texts.try_recv() {
                        Ok(Out::Text(more)) => text += &more,
                        Ok(other) => {
                            next = Some(other);
                            break;
                        }
                        Err(_) => break,
                    }
                }
                if stream.write_all(text.as_bytes()).is_err() {
                    break;
                }
            }
            Out::Hold => thread::sleep(HOLD),
        }
        next = next.or_else(|| texts.recv().ok());
    }
    // The client may have closed the connection itself.
    let _ = stream.shutdown(Shutdown::Both);
}
