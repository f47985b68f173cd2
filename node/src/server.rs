//! A bus of its own, for socketcand clients: coflash, python-can and their friends. Every client
//! hears the devices and the other clients.
//!
//! Time on this bus is the host's, and a frame takes none: there is no bit rate, no arbitration and
//! no error.

use std::collections::BTreeMap;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::sync::mpsc::{sync_channel, Receiver, RecvTimeoutError, SyncSender};
use std::thread;
use std::time::{Duration, Instant};

use boot_core::canopen::Frame;
use coflash::bus::socketcand::{frame_message, parse_send, Messages};
use coflash::bus::{Adapter, AdapterError};

/// Clients at a time.
const MAX_CLIENTS: usize = 64;
/// Messages of clients that wait for the bus; behind them connections are not read on.
const EVENTS: usize = 1024;
/// A client that takes nothing for so long is disconnected.
const PATIENCE: Duration = Duration::from_millis(500);
/// How long frames are held back behind the answer to `rawmode`: python-can wants that answer alone
/// in one read.
const HOLD: Duration = Duration::from_millis(10);

/// What the threads of the connections tell, of the client of this number.
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
    /// Frames can be sent.
    Open,
    /// Frames can be sent and come in.
    Raw,
    /// They come in from then on; these wait for it.
    Held { until: Instant, messages: String },
}

/// The server. Its threads read, and last as long as the process.
pub struct Server {
    address: SocketAddr,
    bus: String,
    started: Instant,
    events: Receiver<Event>,
    clients: BTreeMap<u64, Client>,
}

impl Server {
    /// Listens. `bus` is the name that clients have to open, as a rule `can0`.
    ///
    /// # Errors
    /// What the operating system says, for instance that the address is in use.
    pub fn bind(address: impl ToSocketAddrs, bus: &str) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let (sender, events) = sync_channel(EVENTS);
        thread::Builder::new().name("socketcand".into()).spawn(move || accept(&listener, &sender))?;
        Ok(Self { address, bus: bus.to_owned(), started: Instant::now(), events, clients: BTreeMap::new() })
    }

    /// Where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Takes what a client says; gives the frame that it sends.
    fn take(&mut self, event: Event) -> Option<Frame> {
        match event {
            Event::Connected(number, stream) => {
                if self.clients.len() >= MAX_CLIENTS {
                    // If not even that reaches it, it sees the end of the connection.
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

    /// One message of a client.
    fn message(&mut self, number: u64, message: &str) -> Option<Frame> {
        let client = self.clients.get_mut(&number)?;
        let mut words = message.split_ascii_whitespace();
        let answer = match (words.next().unwrap_or(""), &client.mode) {
            ("open", Mode::NoBus) if words.next() == Some(&self.bus) => {
                client.mode = Mode::Open;
                "< ok >".to_owned()
            }
            ("open", Mode::NoBus) => format!("< error there is one bus here, {} >", self.bus),
            ("echo", _) => "< echo >".to_owned(),
            (_, Mode::NoBus) => format!("< error open a bus first: open {} >", self.bus),
            ("rawmode", Mode::Open) => {
                client.mode = Mode::Held { until: Instant::now() + HOLD, messages: String::new() };
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
            _ => "< error unknown command, here are open, rawmode, bcmmode, send and echo >".to_owned(),
        };
        self.send_text(number, &answer);
        None
    }

    /// Says something to a client; who does not listen is disconnected.
    fn send_text(&mut self, number: u64, message: &str) {
        let Some(client) = self.clients.get_mut(&number) else { return };
        if client.stream.write_all(message.as_bytes()).is_err() {
            // Its thread sees the end of the connection.
            let _ = client.stream.shutdown(Shutdown::Both);
            self.clients.remove(&number);
        }
    }

    /// Brings a frame to all clients but the one that sent it.
    fn broadcast(&mut self, frame: &Frame, from: Option<u64>) {
        let message = frame_message(frame, self.started.elapsed());
        let mut listeners = Vec::new();
        for (number, client) in &mut self.clients {
            match &mut client.mode {
                _ if from == Some(*number) => {}
                Mode::NoBus | Mode::Open => {}
                Mode::Raw => listeners.push(*number),
                Mode::Held { messages, .. } => messages.push_str(&message),
            }
        }
        for number in listeners {
            self.send_text(number, &message);
        }
    }

    /// Brings to clients what was held back for long enough. When the next one is due.
    fn release(&mut self) -> Option<Instant> {
        let now = Instant::now();
        let mut due = Vec::new();
        let mut next: Option<Instant> = None;
        for (number, client) in &mut self.clients {
            let Mode::Held { until, messages } = &mut client.mode else { continue };
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
                    let source = io::Error::from(ErrorKind::NotConnected);
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
            // Out of file descriptors or threads, perhaps: some client will leave.
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
            // If the bus is gone, nobody needs to know.
            let _ = events.send(Event::Gone(number));
        }
        let _ = stream.shutdown(Shutdown::Both);
    })?;
    Ok(())
}

/// Takes a client's messages until the connection ends, or the client speaks another language.
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
