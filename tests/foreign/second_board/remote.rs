//! A client of gdb's remote serial protocol (GDB manual, appendix E), as far as it is needed.
//!
//! It acknowledges nothing: QEMU takes the next packet for an acknowledgement, and would take one
//! that comes late as an order to stop.

use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// The PC's number in QEMU's `arm-m-profile.xml`.
pub const PC: usize = 15;
/// xPSR's number there, and where [`Remote::registers`] has it.
pub const XPSR: usize = 25;
pub const XPSR_AT: usize = 16;

/// Bytes of memory in a packet: QEMU takes 4096 characters.
const CHUNK: usize = 1024;

pub struct Remote {
    stream: TcpStream,
    come: Vec<u8>,
}

fn odd(what: &str, said: &str) -> io::Error {
    io::Error::new(ErrorKind::InvalidData, format!("QEMU answered {said:?} to {what}"))
}

impl Remote {
    /// Connects to the stub at this port, which may take a while to open it.
    pub fn connect(port: u16) -> io::Result<Self> {
        let limit = Instant::now() + Duration::from_secs(20);
        let stream = loop {
            match TcpStream::connect(("127.0.0.1", port)) {
                Ok(stream) => break stream,
                Err(error) if Instant::now() > limit => return Err(error),
                Err(_) => std::thread::sleep(Duration::from_millis(20)),
            }
        };
        stream.set_nodelay(true)?;
        let mut remote = Self { stream, come: Vec::new() };
        // Who reads the description may write single registers.
        remote.ask("qXfer:features:read:target.xml:0,ffb")?;
        Ok(remote)
    }

    fn send(&mut self, packets: &[String]) -> io::Result<()> {
        let mut text = String::new();
        for packet in packets {
            let sum = packet.bytes().fold(0_u8, u8::wrapping_add);
            text += &format!("${packet}#{sum:02x}");
        }
        self.stream.write_all(text.as_bytes())
    }

    /// The next packet; `None` if none comes in time.
    pub fn receive(&mut self, timeout: Duration) -> io::Result<Option<String>> {
        let deadline = Instant::now() + timeout;
        loop {
            // Acknowledgements are skipped.
            let start = self.come.iter().position(|&byte| byte == b'$');
            let end = self.come.iter().position(|&byte| byte == b'#');
            if let (Some(start), Some(end)) = (start, end) {
                if self.come.len() >= end + 3 {
                    let packet = String::from_utf8_lossy(&self.come[start + 1..end]).into_owned();
                    self.come.drain(..end + 3);
                    return Ok(Some(packet));
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            self.stream.set_read_timeout(Some(left.max(Duration::from_micros(20))))?;
            let mut buffer = [0; 4096];
            match self.stream.read(&mut buffer) {
                Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
                Ok(len) => self.come.extend_from_slice(&buffer[..len]),
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                    if Instant::now() >= deadline {
                        return Ok(None);
                    }
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn ask(&mut self, packet: &str) -> io::Result<String> {
        self.send(&[packet.into()])?;
        self.answer(packet)
    }

    fn answer(&mut self, packet: &str) -> io::Result<String> {
        self.receive(Duration::from_secs(20))?.ok_or_else(|| odd(packet, "nothing"))
    }

    fn order(&mut self, packet: String) -> io::Result<()> {
        self.orders(vec![packet], "")
    }

    /// Sends these packets, each of which is answered with OK, and another one, all at once.
    fn orders(&mut self, mut packets: Vec<String>, last: &str) -> io::Result<()> {
        let orders = packets.len();
        if !last.is_empty() {
            packets.push(last.into());
        }
        self.send(&packets)?;
        for packet in &packets[..orders] {
            match self.answer(packet)?.as_str() {
                "OK" => {}
                said => return Err(odd(packet, said)),
            }
        }
        Ok(())
    }

    /// Sets registers and lets the machine run; the packet that comes next says why it stopped.
    pub fn run(&mut self, registers: &[(usize, u32)]) -> io::Result<()> {
        let packets = registers.iter().map(|&(n, value)| format!("P{n:x}={:08x}", value.swap_bytes()));
        self.orders(packets.collect(), "c")
    }

    /// Stores these bytes, sets registers and lets the machine run.
    pub fn run_with(&mut self, at: u32, bytes: &[u8], registers: &[(usize, u32)]) -> io::Result<()> {
        let mut packets = vec![store(at, bytes)];
        packets.extend(registers.iter().map(|&(n, value)| format!("P{n:x}={:08x}", value.swap_bytes())));
        self.orders(packets, "c")
    }

    /// Carries out the store in front of the machine, which is watched.
    pub fn step_over(&mut self, watched: u32) -> io::Result<()> {
        self.orders(vec![format!("z2,{watched:x},4")], "s")?;
        let said = self.answer("s")?;
        if !said.starts_with("T05") {
            return Err(odd("s", &said));
        }
        self.watch_stores(watched, 4)
    }

    /// Stops the machine; the packet that comes next says so.
    pub fn interrupt(&mut self) -> io::Result<()> {
        self.stream.write_all(&[3])
    }

    /// Stops in front of a store to these bytes.
    pub fn watch_stores(&mut self, address: u32, len: u32) -> io::Result<()> {
        self.order(format!("Z2,{address:x},{len:x}"))
    }

    /// Stops in front of a load of this word.
    pub fn watch_loads(&mut self, address: u32) -> io::Result<()> {
        self.order(format!("Z3,{address:x},4"))
    }

    fn bytes(what: &str, text: &str) -> io::Result<Vec<u8>> {
        let digits = (0..text.len() / 2).map(|n| text.get(2 * n..2 * n + 2));
        let byte = |digits: Option<&str>| digits.and_then(|digits| u8::from_str_radix(digits, 16).ok());
        digits.map(byte).collect::<Option<_>>().ok_or_else(|| odd(what, text))
    }

    fn words(what: &str, text: &str) -> io::Result<Vec<u32>> {
        let bytes = Self::bytes(what, text)?;
        Ok(bytes.chunks_exact(4).map(|it| u32::from_le_bytes([it[0], it[1], it[2], it[3]])).collect())
    }

    /// r0 to r12, SP, LR, PC, xPSR.
    pub fn registers(&mut self) -> io::Result<[u32; 17]> {
        let said = self.ask("g")?;
        let words = Self::words("g", &said)?;
        words.get(..17).and_then(|it| it.try_into().ok()).ok_or_else(|| odd("g", &said))
    }

    /// Memory.
    pub fn read(&mut self, address: u32, len: usize) -> io::Result<Vec<u8>> {
        let mut all = Vec::new();
        while all.len() < len {
            let part = CHUNK.min(len - all.len());
            let packet = format!("m{:x},{part:x}", address as usize + all.len());
            let said = self.ask(&packet)?;
            let bytes = Self::bytes(&packet, &said)?;
            if bytes.len() != part {
                return Err(odd(&packet, &said));
            }
            all.extend(bytes);
        }
        Ok(all)
    }

    /// Memory, read-only memory too; no registers.
    pub fn write(&mut self, address: u32, bytes: &[u8]) -> io::Result<()> {
        for (n, part) in bytes.chunks(CHUNK).enumerate() {
            self.order(store(address + (n * CHUNK) as u32, part))?;
        }
        Ok(())
    }
}

fn store(address: u32, bytes: &[u8]) -> String {
    let text: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    format!("M{address:x},{:x}:{text}", bytes.len())
}
