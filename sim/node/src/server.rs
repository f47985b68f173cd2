//! A separate bus for socketcand clients: coflash, python-can and others. Every client receives the
//! frames of the devices and of the other clients.
//!
//! This bus uses the host's time, and a frame takes no time: there is no bit rate, no arbitration
//! and no error.

use std::collections::BTreeMap;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::sync::mpsc::{sync_channel, Receiver, RecvTimeoutError, SyncSender};
use std::thread;
use std::time::{Duration, Instant};

use boot_core::canopen::Frame;
use coboot_can::socketcand::{frame_message, parse_send, Messages};
use coboot_can::{Adapter, AdapterError};

/// The most clients at the same time.
const MAX_CLIENTS: usize = 64;
/// The most messages of clients that wait for the bus; beyond this number, connections are not
/// read.
const EVENTS: usize = 1024;
/// A client that accepts no data for this time is disconnected.
const PATIENCE: Duration = Duration::from_millis(500);
/// How long frames are delayed after the answer to `rawmode`: python-can needs this answer alone in
/// one read.
const HOLD: Duration = Duration::from_millis(10);

/// A message of a connection's thread, with the number of its client.
enum Event {
    Connected(u64, TcpStream),
    Message(u64, String),
    Gone(u64),
}

/// A connection.
struct Client {
    stream: TcpStream,
    mode: Mode,
}

enum Mode {
    /// No bus is open.
    NoBus,
    /// The client may send frames.
    Open,
    /// The client sends and receives frames.
    Raw,
    /// The client receives frames from `until` on; these messages wait for it.
    Delayed { until: Instant, messages: String },
}

/// The server. Its threads read, and live as long as the process.
pub struct Server {
    address: SocketAddr,
    bus: String,
    started: Instant,
    events: Receiver<Event>,
    clients: BTreeMap<u64, Client>,
}

impl Server {
    /// Opens the port. `bus` is the name that clients must open, usually `can0`.
    ///
    /// # Errors
    /// The error of the operating system, for example that the address is in use.
    pub fn bind(address: impl ToSocketAddrs, bus: &str) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let (sender, events) = sync_channel(EVENTS);
        thread::Builder::new().name("socketcand".into()).spawn(move || accept(&listener, &sender))?;
        Ok(Self { address, bus: bus.to_owned(), started: Instant::now(), events, clients: BTreeMap::new() })
    }

    /// The address of the server.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Processes an event of a client; returns the frame that the client sends.
    fn take(&mut self, event: Event) -> Option<Frame> {
        match event {
            Event::Connected(number, stream) => {
                if self.clients.len() >= MAX_CLIENTS {
                    // If this message does not reach the client, it sees the end of the connection.
                    let _ = (&stream).write_all(b"< error too many clients >");
                    let _ = stream.shutdown(Shutdown::Both);
                    return None;
                }
                self.clients.insert(number, Client { stream, mode: Mode::NoBus });
                self.send_text(number, "< hi >");
                None
            }
            Event::Gone(number) => {
                self.clients.remove(&number);
                None
            }
            Event::Message(number, message) => {
                let frame = self.message(number, &message)?;
                self.broadcast(&frame, Some(number));
                Some(frame)
            }
        }
    }

    /// Processes one message of a client.
    fn message(&mut self, number: u64, message: &str) -> Option<Frame> {
        let client = self.clients.get_mut(&number)?;
        let mut words = message.split_ascii_whitespace();
        let answer = match (words.next().unwrap_or(""), &client.mode) {
            ("open", Mode::NoBus) if words.next() == Some(&self.bus) => {
                client.mode = Mode::Open;
                "< ok >".to_owned()
            }
            ("open", Mode::NoBus) => format!("< error the only bus is {} >", self.bus),
            ("echo", _) => "< echo >".to_owned(),
            (_, Mode::NoBus) => format!("< error open a bus first: open {} >", self.bus),
            ("rawmode", Mode::Open) => {
                client.mode = Mode::Delayed { until: Instant::now() + HOLD, messages: String::new() };
                "< ok >".to_owned()
            }
            ("rawmode", _) => "< ok >".to_owned(),
            ("bcmmode", _) => {
                client.mode = Mode::Open;
                "< ok >".to_owned()
            }
            ("send", _) => match parse_send(message) {
                Some(frame) => return Some(frame),
                None => "< error send needs an identifier, a data length and the data: send 601 2 40 00 >"
                    .to_owned(),
            },
            _ => {
                "< error unknown command: the commands are open, rawmode, bcmmode, send and echo >".to_owned()
            }
        };
        self.send_text(number, &answer);
        None
    }

    /// Sends a message to a client; a client that does not accept it is disconnected.
    fn send_text(&mut self, number: u64, message: &str) {
        let Some(client) = self.clients.get_mut(&number) else { return };
        if client.stream.write_all(message.as_bytes()).is_err() {
            // The client's thread then sees the end of the connection.
            let _ = client.stream.shutdown(Shutdown::Both);
            self.clients.remove(&number);
        }
    }

    /// Sends a frame to all clients except its sender.
    fn broadcast(&mut self, frame: &Frame, from: Option<u64>) {
        let message = frame_message(frame, self.started.elapsed());
        let mut listeners = Vec::new();
        for (number, client) in &mut self.clients {
            match &mut client.mode {
                _ if from == Some(*number) => {}
                Mode::NoBus | Mode::Open => {}
                Mode::Raw => listeners.push(*number),
                Mode::Delayed { messages, .. } => messages.push_str(&message),
            }
        }
        for number in listeners {
            self.send_text(number, &message);
        }
    }

    /// Sends the delayed messages that are due. Returns the time of the next one.
    fn release(&mut self) -> Option<Instant> {
        let now = Instant::now();
        let mut due = Vec::new();
        let mut next: Option<Instant> = None;
        for (number, client) in &mut self.clients {
            let Mode::Delayed { until, messages } = &mut client.mode else { continue };
            if *until <= now {
                due.push((*number, std::mem::take(messages)));
                client.mode = Mode::Raw;
            } else {
                next = Some(next.map_or(*until, |next| next.min(*until)));
            }
        }
        for (number, messages) in due {
            self.send_text(number, &messages);
        }
        next
    }
}

impl Adapter for Server {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.release();
        self.broadcast(frame, None);
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let deadline = Instant::now() + timeout;
        loop {
            let next = self.release().map_or(deadline, |next| next.min(deadline));
            match self.events.recv_timeout(next.saturating_duration_since(Instant::now())) {
                Ok(event) => {
                    if let Some(frame) = self.take(event) {
                        return Ok(Some(frame));
                    }
                }
                Err(RecvTimeoutError::Timeout) if Instant::now() < deadline => {}
                Err(RecvTimeoutError::Timeout) => return Ok(None),
                Err(RecvTimeoutError::Disconnected) => {
                    let source = io::Error::from(ErrorKind::NotConnected).into();
                    return Err(AdapterError::Lost {
                        adapter: format!("the server at {}", self.address),
                        source,
                    });
                }
            }
        }
    }

    fn now(&self) -> Duration {
        self.started.elapsed()
    }
}

fn accept(listener: &TcpListener, events: &SyncSender<Event>) {
    for number in 0.. {
        let started = listener.accept().and_then(|(stream, _)| serve(stream, number, events.clone()));
        if started.is_err() {
            // File descriptors or threads may have run out; this ends when a client leaves.
            thread::sleep(Duration::from_millis(50));
        }
    }
}

/// Starts the thread of a connection.
fn serve(stream: TcpStream, number: u64, events: SyncSender<Event>) -> io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let writing = stream.try_clone()?;
    thread::Builder::new().name(format!("client {number}")).spawn(move || {
        if events.send(Event::Connected(number, writing)).is_ok() {
            read(&stream, number, &events);
            // If the bus is gone, no receiver is left.
            let _ = events.send(Event::Gone(number));
        }
        let _ = stream.shutdown(Shutdown::Both);
    })?;
    Ok(())
}

/// Reads a client's messages until the connection ends, or the client breaks the protocol.
fn read(mut stream: &TcpStream, number: u64, events: &SyncSender<Event>) {
    let mut messages = Messages::default();
    let mut bytes = [0; 4096];
    loop {
        match stream.read(&mut bytes) {
            Ok(0) => return,
            Ok(length) => messages.add(&bytes[..length]),
            Err(error) if error.kind() == ErrorKind::Interrupted => continue,
            Err(_) => return,
        }
        loop {
            match messages.next() {
                Ok(Some(message)) => {
                    if events.send(Event::Message(number, message)).is_err() {
                        return;
                    }
                }
                Ok(None) => break,
                Err(_) => return,
            }
        }
    }
}
