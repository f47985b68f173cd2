//! The control socket: power, reset and pins for other programs, in lines of text over TCP.
//!
//! ```text
//! power off|on | vdd 2400 [in 100] | reset | pin PC13 low|high|open | status
//! ```
//!
//! Each line gets one line back, which begins with `ok` or `error`. A prefix `board 2` selects a
//! board other than the first one. The owner of the boards answers ([`Server::take`]); the threads
//! only carry lines.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{channel, sync_channel, Receiver, Sender, SyncSender};
use std::sync::Arc;
use std::thread::{self, Thread};
use std::time::Duration;

/// The longest line, its end included.
const LONGEST: u64 = 256;
/// Clients at a time.
const MAX_CLIENTS: usize = 16;
/// Requests that wait for the boards' owner.
const REQUESTS: usize = 64;
/// The server disconnects a client that does not read for this long.
const PATIENCE: Duration = Duration::from_secs(10);

/// An action on a board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Switches the power.
    Power(bool),
    /// Switches the power on if it is off, and off if it is on.
    TogglePower,
    /// Lets the supply go to another voltage.
    Supply {
        /// In mV, up to [`MOST_MV`].
        mv: u32,
        /// In ms.
        within_ms: u32,
    },
    /// Pulls NRST low for a moment.
    Reset,
    /// Drives a pin from outside; `None` releases it.
    Pin {
        /// `'A'` to `'K'`.
        port: char,
        /// 0 to 15.
        pin: u8,
        /// Its level.
        level: Option<bool>,
    },
    /// Changes nothing and reports the state.
    Status,
}

/// A command that was parsed from a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Command {
    /// The board; the first one is 0.
    pub board: usize,
    /// The action.
    pub action: Action,
}

/// The highest supply, in mV (datasheet, general operating conditions).
pub const MOST_MV: u32 = 3_600;

const KNOWN: &str = "known: power off|on, vdd 2400 (mV) in 100 (ms), reset, pin PC13 low|high|open, status; `board 2` may be in front";

impl std::str::FromStr for Command {
    type Err = String;

    fn from_str(line: &str) -> Result<Self, String> {
        let mut words: Vec<&str> = line.split_ascii_whitespace().collect();
        let mut board = 0;
        if words.first() == Some(&"board") {
            let number = words.get(1).and_then(|word| word.parse::<usize>().ok()).filter(|&n| n > 0);
            board = number.ok_or("`board` needs a number from 1 on")? - 1;
            words.drain(..2);
        }
        let action = match words[..] {
            ["power", "on"] => Action::Power(true),
            ["power", "off"] => Action::Power(false),
            ["p"] => Action::TogglePower,
            ["vdd", mv] => supply(mv, "0")?,
            ["vdd", mv, "in", ms] => supply(mv, ms)?,
            ["reset" | "r"] => Action::Reset,
            ["status" | "s"] => Action::Status,
            ["pin", name, level] => {
                let (port, pin) = pin(name).ok_or("a pin is called PA0 to PK15")?;
                let level = match level {
                    "low" => Some(false),
                    "high" => Some(true),
                    "open" => None,
                    _ => return Err("a pin is low, high or open".into()),
                };
                Action::Pin { port, pin, level }
            }
            _ => return Err(KNOWN.into()),
        };
        Ok(Self { board, action })
    }
}

/// The supply goes to `mv` mV within `ms` ms.
fn supply(mv: &str, ms: &str) -> Result<Action, String> {
    let mv = mv.parse().ok().filter(|mv| *mv <= MOST_MV);
    let mv = mv.ok_or(format!("`vdd` is a number of mV from 0 to {MOST_MV}"))?;
    let within_ms = ms.parse().map_err(|_| "`in` needs a number of ms".to_owned())?;
    Ok(Action::Supply { mv, within_ms })
}

/// `PC13` or `pc13`.
fn pin(name: &str) -> Option<(char, u8)> {
    let upper = name.to_ascii_uppercase();
    let mut rest = upper.strip_prefix('P')?.chars();
    let port = rest.next().filter(|port| ('A'..='K').contains(port))?;
    let digits = rest.as_str();
    let plain = digits.bytes().all(|digit| digit.is_ascii_digit()) && digits.len() <= 2;
    let pin = digits.parse().ok().filter(|&pin: &u8| plain && pin < 16)?;
    Some((port, pin))
}

/// A command and the channel for its answer.
pub struct Request {
    /// The command.
    pub command: Command,
    answer: Sender<Result<String, String>>,
}

impl Request {
    /// Answers with a description of what was done, or with the reason why not.
    pub fn answer(self, outcome: Result<String, String>) {
        // The client may have disconnected.
        let _ = self.answer.send(outcome);
    }
}

/// The server of the control socket.
pub struct Server {
    requests: Receiver<Request>,
    asking: Asking,
}

/// The way from a client's thread to the boards' owner.
#[derive(Clone)]
struct Asking {
    requests: SyncSender<Request>,
    owner: Thread,
}

impl Asking {
    /// The answer to a line; `None` if the owner of the boards is gone.
    fn ask(&self, line: &str) -> Option<Result<String, String>> {
        let command = match line.parse() {
            Ok(command) => command,
            Err(error) => return Some(Err(error)),
        };
        let (answer, outcome) = channel();
        self.requests.send(Request { command, answer }).ok()?;
        self.owner.unpark();
        outcome.recv().ok()
    }
}

impl Default for Server {
    fn default() -> Self {
        Self::new()
    }
}

impl Server {
    /// A server that no client can reach yet. A request unparks the calling thread.
    #[must_use]
    pub fn new() -> Self {
        let (sender, requests) = sync_channel(REQUESTS);
        Self { requests, asking: Asking { requests: sender, owner: thread::current() } }
    }

    /// The oldest request that waits.
    pub fn take(&mut self) -> Option<Request> {
        self.requests.try_recv().ok()
    }

    /// Listens for clients and returns the address.
    ///
    /// # Errors
    /// The operating system's error, for instance that the address is in use.
    pub fn listen(&self, address: impl ToSocketAddrs) -> io::Result<SocketAddr> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let asking = self.asking.clone();
        thread::Builder::new().name("control".into()).spawn(move || accept(&listener, &asking))?;
        Ok(address)
    }

    /// Reads lines from the terminal and prints the answers to it.
    ///
    /// # Errors
    /// The operating system cannot start a thread for it.
    pub fn read_terminal(&self) -> io::Result<()> {
        let asking = self.asking.clone();
        thread::Builder::new().name("keys".into()).spawn(move || {
            talk(&mut io::stdin().lock(), &mut io::stdout(), &asking);
        })?;
        Ok(())
    }
}

fn accept(listener: &TcpListener, asking: &Asking) {
    let connected = Arc::new(AtomicUsize::new(0));
    loop {
        let Ok((stream, _)) = listener.accept() else {
            // Perhaps the process is out of file descriptors: it goes on when a client leaves.
            thread::sleep(Duration::from_millis(50));
            continue;
        };
        if connected.load(Ordering::Relaxed) >= MAX_CLIENTS {
            // If the client cannot receive this, it sees the end of the connection.
            let _ = (&stream).write_all(b"error: too many clients\n");
            continue;
        }
        let (asking, counted) = (asking.clone(), connected.clone());
        connected.fetch_add(1, Ordering::Relaxed);
        let served = thread::Builder::new().name("control client".into()).spawn(move || {
            let _ = stream.set_write_timeout(Some(PATIENCE));
            let _ = stream.set_nodelay(true);
            serve(&stream, &asking);
            counted.fetch_sub(1, Ordering::Relaxed);
        });
        if served.is_err() {
            connected.fetch_sub(1, Ordering::Relaxed);
        }
    }
}

fn serve(stream: &TcpStream, asking: &Asking) {
    let mut writing = stream;
    talk(&mut BufReader::new(stream), &mut writing, asking);
}

/// Answers lines until one side closes the connection.
fn talk(lines: &mut impl BufRead, answers: &mut impl Write, asking: &Asking) {
    loop {
        let mut line = Vec::new();
        match lines.by_ref().take(LONGEST).read_until(b'\n', &mut line) {
            Ok(1..) => {}
            _ => return,
        }
        let outcome = if line.len() as u64 == LONGEST && !line.ends_with(b"\n") {
            if !skip_line(lines) {
                return;
            }
            Some(Err(format!("a line has {} characters at most", LONGEST - 1)))
        } else if line.trim_ascii().is_empty() {
            continue;
        } else {
            match std::str::from_utf8(&line) {
                Ok(line) => asking.ask(line),
                Err(_) => Some(Err("this is no text".into())),
            }
        };
        let text = match outcome {
            Some(Ok(text)) => format!("ok {text}\n"),
            Some(Err(text)) => format!("error: {text}\n"),
            None => return,
        };
        if answers.write_all(text.as_bytes()).and_then(|()| answers.flush()).is_err() {
            return;
        }
    }
}

/// Reads to the end of a line without keeping it. Returns whether the end came.
fn skip_line(lines: &mut impl BufRead) -> bool {
    loop {
        let Ok(buffer) = lines.fill_buf() else { return false };
        if buffer.is_empty() {
            return false;
        }
        let (used, found) = match buffer.iter().position(|&byte| byte == b'\n') {
            Some(end) => (end + 1, true),
            None => (buffer.len(), false),
        };
        lines.consume(used);
        if found {
            return true;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_understood_or_refused() {
        let action = |line: &str| line.parse::<Command>().map(|command| command.action);
        assert_eq!(action("power off\r\n"), Ok(Action::Power(false)));
        assert_eq!(action("  power   on"), Ok(Action::Power(true)));
        assert_eq!((action("reset"), action("r")), (Ok(Action::Reset), Ok(Action::Reset)));
        assert_eq!(action("pin PC13 low"), Ok(Action::Pin { port: 'C', pin: 13, level: Some(false) }));
        assert_eq!(action("pin pa0 open"), Ok(Action::Pin { port: 'A', pin: 0, level: None }));
        assert_eq!(action("vdd 2400"), Ok(Action::Supply { mv: 2_400, within_ms: 0 }));
        assert_eq!(action("vdd 0 in 3600000"), Ok(Action::Supply { mv: 0, within_ms: 3_600_000 }));
        assert_eq!("board 2 reset".parse(), Ok(Command { board: 1, action: Action::Reset }));
        for line in [
            "",
            "power",
            "power of",
            "pin PC16 low",
            "pin PL1 low",
            "pin C1 low",
            "pin P low",
            "pin PC+1 low",
            "pin PC1 up",
            "reset now",
            "vdd",
            "vdd 3601",
            "vdd -1",
            "vdd 2.4",
            "vdd 2400 in",
            "vdd 2400 in 99999999999",
            "vdd 2400 within 5",
            "board",
            "board 0 reset",
            "board x reset",
            "board 1",
            "Pé1 low",
            "pin PC001 low",
        ] {
            assert!(line.parse::<Command>().is_err(), "{line:?}");
        }
    }

    #[test]
    fn every_line_gets_a_line_however_bad() {
        let mut server = Server::new();
        let asking = server.asking.clone();
        let client = thread::spawn(move || {
            let long = "x".repeat(100_000);
            let input = format!("status\n\n{long}\nrubbish\n\u{0}\u{1}\nreset\npower off");
            let input = [input.as_bytes(), b"\n\xFF\xFE\n"].concat();
            let mut answers = Vec::new();
            talk(&mut &input[..], &mut answers, &asking);
            String::from_utf8(answers).unwrap()
        });
        let mut actions = Vec::new();
        while !client.is_finished() {
            match server.take() {
                Some(request) => {
                    actions.push(request.command.action);
                    request.answer(Ok("done".into()));
                }
                None => thread::park_timeout(Duration::from_millis(50)),
            }
        }
        assert_eq!(actions, [Action::Status, Action::Reset, Action::Power(false)]);
        let answers = client.join().unwrap();
        let heads: Vec<&str> = answers.lines().map(|line| line.get(..3).unwrap_or(line)).collect();
        assert_eq!(heads, ["ok ", "err", "err", "err", "ok ", "ok ", "err"], "{answers}");
    }
}
