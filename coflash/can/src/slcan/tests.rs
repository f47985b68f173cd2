//! The protocol's messages, and the adapters and other devices that are found at a serial port.

use std::collections::VecDeque;
use std::sync::LazyLock;

use proptest::prelude::*;

use super::*;
use crate::tests::frame;

/// Examples of the CAN232 manual.
#[test]
fn messages_are_those_of_the_protocol() {
    assert_eq!(text_of(&frame(0x100, &[0x11, 0x22, 0x33])), "t1003112233\r");
    assert_eq!(text_of(&frame(0x7FF, &[])), "t7FF0\r");
    assert_eq!(parse_frame(b"t10021133"), Some(frame(0x100, &[0x11, 0x33])));
    assert_eq!(parse_frame(b"t100211330A1B"), Some(frame(0x100, &[0x11, 0x33])), "with time");
    assert_eq!(parse_frame(b"t100211330001A2B3"), Some(frame(0x100, &[0x11, 0x33])), "in microseconds");
    let extended = Frame::new(ExtendedId::new(0x100).unwrap(), &[0x11, 0x33]).unwrap();
    assert_eq!(parse_frame(b"T0000010021133"), Some(extended));
    assert_eq!(text_of(&extended), "T0000010021133\r");
    assert_eq!(parse_frame(b"T00000100211330A1B"), Some(extended));
    let remote = Frame::new_remote(StandardId::new(0x100).unwrap(), 2).unwrap();
    assert_eq!(parse_frame(b"r10020A1B"), Some(remote));
    assert_eq!((parse_frame(b"r1002"), text_of(&remote)), (Some(remote), "r1002\r".to_string()));
    // Codes above 8, which the manual does not have and the bus does (ISO 11898-1:2015, table 5).
    let eight = frame(0x100, &[1, 2, 3, 4, 5, 6, 7, 8]);
    for dlc in ["8", "9", "A", "f"] {
        assert_eq!(parse_frame(format!("t100{dlc}0102030405060708").as_bytes()), Some(eight), "{dlc}");
        assert_eq!(parse_frame(format!("t100{dlc}01020304050607080A1B").as_bytes()), Some(eight), "{dlc}");
        assert_eq!(parse_frame(format!("r100{dlc}").as_bytes()), Frame::new_remote(eight.id(), 8), "{dlc}");
    }
    // The first one has no characters.
    for bad in " z Z V1013 t t10 t100 t1009 t10011 t100111223 t1001110A1 t100111time r10020A1 t8000 txyz0 T200000000 \
                t100\u{e9}1 t1001+1 t+121AA"
        .split(' ')
    {
        assert_eq!(parse_frame(bad.as_bytes()), None, "{bad:?}");
    }
}

/// The answer of a device to a line; the number counts the lines.
type Answers = fn(line: &str, number: usize) -> String;

/// When virtual time begins.
static EPOCH: LazyLock<Instant> = LazyLock::new(Instant::now);

/// A device at the other end of a line, in virtual time.
#[derive(Default)]
struct Device {
    now: Duration,
    timeout: Duration,
    answers: Option<Answers>,
    /// How long an answer takes.
    latency: Duration,
    /// It answers one command after the other: when the last answer came.
    busy: Option<Duration>,
    /// It is deaf and mute until then.
    starts: Duration,
    /// What it sends by itself, and how often.
    says: &'static [u8],
    period: Option<Duration>,
    next: Duration,
    /// Bytes on their way to the host, in the order of time.
    coming: VecDeque<(Duration, u8)>,
    /// A line that is not complete.
    line: String,
    /// The lines it received.
    lines: Vec<String>,
    gone: bool,
    /// How long a byte takes on the way to it, and when the last one is there.
    byte: Duration,
    arrived: Duration,
    /// Its queue, if frames are to reach a bus.
    queue: Option<Queue>,
}

/// The queue of an adapter of the manual, and the bus behind it.
struct Queue {
    open: bool,
    size: usize,
    /// How long a frame takes on the bus, and when those in the queue are through.
    frame: Duration,
    ends: VecDeque<Duration>,
    bus: Vec<String>,
    /// Frames of other nodes take the bus: how often, and for how long.
    others: (Duration, Duration),
}

impl Queue {
    fn new(size: usize, frame: Duration) -> Self {
        let others = (ms(1), ms(0));
        Self { open: false, size, frame, ends: VecDeque::new(), bus: Vec::new(), others }
    }

    /// When a frame is through that follows those in the queue.
    fn end(&self, at: Duration) -> Duration {
        let begin = self.ends.back().map_or(at, |end| at.max(*end));
        let (period, taken) = self.others;
        let since = Duration::from_nanos((begin.as_nanos() % period.as_nanos()) as u64);
        begin + taken.saturating_sub(since) + self.frame
    }

    fn answer(&mut self, line: &str, at: Duration) -> String {
        let was_open = self.open;
        self.ends.retain(|end| *end > at);
        match line.chars().next() {
            Some('t') if self.open && self.ends.len() < self.size => {
                self.ends.push_back(self.end(at));
                self.bus.push(line.to_string());
                return "z\r".to_string();
            }
            Some('O') => self.open = true,
            Some('C') => self.open = false,
            Some('S') => {}
            Some('V') => return "V1013\r".to_string(),
            _ => return "\x07".to_string(),
        }
        if was_open == line.starts_with('C') { "\r" } else { "\x07" }.to_string()
    }
}

const fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

impl Device {
    fn new(answers: Answers) -> Self {
        Self { answers: Some(answers), latency: ms(1), ..Self::default() }
    }

    fn queue(size: usize, frame: Duration) -> Self {
        Self { queue: Some(Queue::new(size, frame)), ..Self::new(nothing) }
    }

    fn slow(answers: Answers, latency: u64) -> Self {
        Self { latency: ms(latency), ..Self::new(answers) }
    }

    /// It needs so many milliseconds for each command.
    fn busy(answers: Answers, latency: u64) -> Self {
        Self { busy: Some(Duration::ZERO), ..Self::slow(answers, latency) }
    }

    /// It restarts when its port opens, and then says this.
    fn restarts(answers: Answers, starts: u64, says: &'static [u8]) -> Self {
        Self { starts: ms(starts), next: ms(starts), says, ..Self::new(answers) }
    }

    /// It sends this by itself, each time after so many milliseconds.
    fn talks(answers: Answers, says: &'static [u8], first: u64, period: u64) -> Self {
        Self { says, next: ms(first), period: Some(ms(period)), ..Self::new(answers) }
    }

    /// It sends this, in so many milliseconds.
    fn sends(&mut self, text: &str, after: u64) {
        self.coming.extend(text.bytes().map(|byte| (self.now + ms(after), byte)));
    }

    /// Puts what it says by itself until `end` behind what is on its way.
    fn talk(&mut self, end: Duration) {
        while !self.says.is_empty() && self.next <= end {
            self.coming.extend(self.says.iter().map(|byte| (self.next, *byte)));
            match self.period {
                Some(period) => self.next += period,
                None => self.says = b"",
            }
        }
    }
}

impl Read for Device {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        if self.gone {
            return Ok(0);
        }
        let end = self.now + self.timeout.max(Duration::from_micros(1));
        self.talk(end);
        // One byte at a time: the reader must not rely on more.
        match self.coming.front() {
            Some((at, byte)) if *at <= end => {
                self.now = self.now.max(*at);
                bytes[0] = *byte;
                self.coming.pop_front();
                Ok(1)
            }
            _ => {
                self.now = end;
                Err(ErrorKind::TimedOut.into())
            }
        }
    }
}

impl Write for Device {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.talk(self.now);
        for byte in bytes {
            self.arrived = self.arrived.max(self.now) + self.byte;
            if self.now < self.starts {
                continue;
            }
            if *byte != b'\r' {
                self.line.push((*byte).into());
                continue;
            }
            let line = std::mem::take(&mut self.line);
            let answer = match &mut self.queue {
                Some(queue) => queue.answer(&line, self.arrived),
                None => self.answers.map_or(String::new(), |answers| answers(&line, self.lines.len())),
            };
            let at = self.busy.map_or(self.arrived, |busy| busy.max(self.arrived)) + self.latency;
            self.busy = self.busy.map(|_| at);
            self.coming.extend(answer.bytes().map(|byte| (at, byte)));
            self.lines.push(line);
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Line for &mut Device {
    fn set_timeout(&mut self, timeout: Duration) -> io::Result<()> {
        self.timeout = timeout;
        Ok(())
    }

    fn now(&self) -> Instant {
        *EPOCH + self.now
    }
}

fn open(device: &mut Device, rate: Option<u32>) -> Result<Slcan<&mut Device>, AdapterError> {
    Slcan::open(device, "SLCAN adapter test".to_string(), rate)
}

/// CAN232 manual: CR is yes, BEL is no; `C` is refused while the bus is closed.
fn lawicel(line: &str, number: usize) -> String {
    match line.chars().next() {
        Some('C') if number < 2 => "\x07",
        Some('V') => "V1013\r",
        Some('N') => "NA123\r",
        Some('F') => "F00\r",
        Some('t') => "z\r",
        Some('C' | 'S' | 'O') => "\r",
        _ => "\x07",
    }
    .to_string()
}

/// The firmware that CANables are sold with: no acknowledgements, and a version in its own words.
fn quiet(line: &str, _: usize) -> String {
    if line == "V" { "1a2b3c4 git.example/slcan-firmware\r" } else { "" }.to_string()
}

/// USBtin: BEL for what it does not know.
fn usbtin(line: &str, _: usize) -> String {
    match line.chars().next() {
        Some('V') => "V0101\r",
        Some('S' | 'O' | 'C') => "\r",
        _ => "\x07",
    }
    .to_string()
}

/// A Lawicel that gives another answer to lines that begin like this.
fn but(begin: &str, answer: &str, line: &str, number: usize) -> String {
    match line.starts_with(begin) {
        true => answer.to_string(),
        false => lawicel(line, number),
    }
}

fn echoes(line: &str, number: usize) -> String {
    format!("{line}\r{}", lawicel(line, number))
}

/// It answers the opening of the bus alone.
fn opens(line: &str, _: usize) -> String {
    if line == "O" { "\r" } else { "" }.to_string()
}

fn nothing(_: &str, _: usize) -> String {
    String::new()
}

#[test]
fn adapters_of_the_field_are_opened() {
    for (name, mut device, rate) in [
        ("Lawicel CAN232", Device::new(lawicel), true),
        ("CANable as it is sold", Device::new(quiet), true),
        ("CANable, first firmware", Device::new(|line, _| quiet(line, 0) + "\r"), true),
        (
            "a version of 130 characters",
            Device::new(|line, _| quiet(line, 0).replace("git", &"Some:Thing ".repeat(9))),
            true,
        ),
        ("USBtin", Device::new(usbtin), true),
        ("BEL for V", Device::new(|line, n| but("V", "\x07", line, n)), true),
        ("an echo", Device::new(echoes), true),
        ("an echo of characters", Device::new(|line, n| format!("{line}{}", lawicel(line, n))), true),
        ("CR LF", Device::new(|line, n| lawicel(line, n).replace('\r', "\r\n")), true),
        ("answers after 400 ms", Device::slow(lawicel, 400), true),
        ("works 400 ms on each command", Device::busy(lawicel, 400), true),
        ("quiet, after 400 ms", Device::slow(quiet, 400), true),
        ("restarts for 1.6 s", Device::restarts(lawicel, 1600, b""), true),
        ("restarts for 1.6 s with a greeting", Device::restarts(usbtin, 1600, b"\r\nCAN init ok!\r\n"), true),
        ("quiet, restarts for 2.5 s", Device::restarts(quiet, 2500, b""), true),
        ("restarts while S is sent", Device::restarts(lawicel, 700, b""), true),
        ("frames before the opening", Device::talks(lawicel, b"t70517F\r", 0, 3), true),
        ("quiet, frames before the opening", Device::talks(quiet, b"t70517F\r", 0, 3), true),
        ("frames alone", Device::new(|line, _| if line == "O" { "t70517F\r" } else { "" }.into()), true),
        ("O alone", Device::new(opens), false),
    ] {
        let opened = open(&mut device, rate.then_some(125_000)).map(drop).map_err(|e| e.to_string());
        assert_eq!(opened, Ok(()), "{name}: {:?}", device.lines);
        assert!(device.now < ms(10_000), "{name}: {:?}", device.now);
        // The last attempt is whole: closed, the bit rate, opened; and closed at the end.
        let begun = device.lines.iter().rposition(|line| line == "V").unwrap_or_default();
        let tail: Vec<&str> =
            device.lines[begun..].iter().map(String::as_str).filter(|l| *l != "V").collect();
        let rate: &[&str] = if rate { &["S4"] } else { &[] };
        assert_eq!(tail, [rate, &["O", "C"]].concat(), "{name}: {:?}", device.lines);
        // Some firmwares repeat their last command for a line without characters.
        assert!(device.lines.iter().all(|line| !line.is_empty()), "{name}: {:?}", device.lines);
    }
}

/// A modem with and without its echo.
fn modem(line: &str, _: usize) -> String {
    format!("{line}\r\r\nERROR\r\n")
}

fn modem_without_echo(_: &str, _: usize) -> String {
    "\r\nERROR\r\n".to_string()
}

/// The prompt of a shell sets the title of its window, which ends with BEL.
fn shell(line: &str, _: usize) -> String {
    format!("{line}\r\nbash: {line}: command not found\r\n\x1B]0;root@board: /root\x07root@board:~# ")
}

/// A name, then a password that is not shown, and so on.
fn login(line: &str, number: usize) -> String {
    if number.is_multiple_of(2) {
        format!("{line}\r\nPassword: ")
    } else {
        "\r\n\r\nLogin incorrect\r\nboard login: ".to_string()
    }
}

#[test]
fn what_is_no_adapter_is_refused_and_quoted() {
    const GPS: &[u8] = b"$GPGGA,120000,4807.038,N\r\n$GPGSA,A,3\r\n";
    let gps = "it sent '$GPGGA,120000,4807.038,N'";
    for rate in [None, Some(125_000)] {
        for (name, mut device, said) in [
            ("silence", Device::new(nothing), "as an adapter does"),
            ("modem", Device::new(modem), "it sent 'ERROR'"),
            ("modem without echo", Device::new(modem_without_echo), "it sent 'ERROR'"),
            ("GPS receiver, 1 Hz", Device::talks(nothing, GPS, 350, 1000), gps),
            ("GPS receiver, 10 Hz", Device::talks(nothing, GPS, 350, 100), gps),
            ("shell", Device::new(shell), "it sent 'bash: C: command not found'"),
            (
                "monitor",
                Device::new(|line, _| format!("{line}: unknown command\r\n> ")),
                "it sent 'C: unknown command'",
            ),
            ("login", Device::new(login), "it sent 'Password:'"),
            ("both wires joined", Device::new(|line, _| format!("{line}\r")), "it sent back what it got"),
            ("a value for each line", Device::new(|_, n| format!("+{n}.25\r\n")), "it sent '+0.25'"),
            (
                "voltmeter",
                Device::new(|line, n| if line == "V" { format!("12.{n}\r\n") } else { String::new() }),
                "it sent '12.",
            ),
            ("text without CR", Device::talks(nothing, b"hello\n", 10, 10), "it sent 'hellohello"),
            ("bytes without a pause", Device::talks(nothing, &[b'x'; 100], 0, 1), "it sent 'xxxx"),
            ("no pause", Device::talks(nothing, b"xxxxxxxxxxxxxxxxxxxxxxx\r", 0, 1), "it sent 'xxxx"),
        ] {
            let error = open(&mut device, rate).map(drop).unwrap_err();
            let words = error.to_string();
            for part in ["it answered neither V (version) nor O (open the bus)", said] {
                assert!(words.contains(part), "{name}: {words}");
            }
            assert!(error.advice().contains("not an SLCAN adapter"), "{name}: {}", error.advice());
            assert!(device.now < ms(8_000), "{name}: {:?}", device.now);
        }
    }
}

/// One device, and from this line on another one.
fn turns(first: Answers, at: usize, then: Answers, line: &str, number: usize) -> String {
    let answers = if number < at { first } else { then };
    answers(line, number)
}

#[test]
fn an_adapter_that_refuses_or_changes_its_mind_is_named() {
    for (name, answers, rate, words) in [
        ("rate", (|line, n| but("S", "\x07", line, n)) as Answers, 125_000, "it refuses the bit rate"),
        ("bus", |line, n| but("O", "\x07", line, n), 125_000, "it refuses to open the bus"),
        ("no such rate", lawicel, 123_456, "it does not support 123456 bit/s"),
        ("S alone", |line, n| but("O", "", line, n), 125_000, "it acknowledges S4, but not O"),
        ("O alone", opens, 125_000, "it acknowledges O, but not S4"),
    ] {
        let mut device = Device::new(answers);
        let error = open(&mut device, Some(rate)).map(drop).unwrap_err().to_string();
        assert!(error.contains(words), "{name}: {error}");
        assert!(device.now < ms(8_000), "{name}: {:?}", device.now);
    }
    let mut device = Device::new(|line, n| turns(modem, 6, lawicel, line, n));
    assert!(open(&mut device, Some(125_000)).is_ok(), "{:?}", device.lines);
    // Its version was that of an adapter.
    let mut device = Device::new(|line, n| turns(lawicel, 3, modem, line, n));
    let error = open(&mut device, Some(125_000)).map(drop).unwrap_err().to_string();
    assert!(error.contains("it sent 'ERROR'"), "{error}");
    // A UART may have another speed.
    let mut device = Device::new(nothing);
    let mut bus = Slcan::opened(&mut device, "SLCAN adapter test".to_string());
    bus.baud = Some(115_200);
    let error = bus.open_bus(None).map(drop).unwrap_err();
    assert!(error.to_string().contains("O (open the bus) at 115200 bit/s as"), "{error}");
    assert!(error.advice().contains("append, for example, ?baud=57600 to the URL"), "{}", error.advice());
    let mut gone = Device { gone: true, ..Device::new(lawicel) };
    let error = open(&mut gone, None).map(drop).unwrap_err();
    assert!(matches!(error, AdapterError::Lost { .. }), "{error}");
}

#[test]
fn a_session_sets_the_bit_rate_opens_and_closes() {
    // A frame follows the acknowledgement directly.
    let answers = |line: &str, number| match line {
        "O" => "\rt70517F\r".to_string(),
        "t6050" => "z\rt5850\r".to_string(),
        _ => lawicel(line, number),
    };
    let mut device = Device::new(answers);
    let mut bus = open(&mut device, Some(500_000)).unwrap();
    let soon = ms(20);
    assert_eq!(bus.receive(soon).unwrap(), Some(frame(0x705, &[0x7F])));
    bus.send(&frame(0x605, &[])).unwrap();
    assert_eq!(bus.receive(soon).unwrap(), Some(frame(0x585, &[])));
    assert_eq!(bus.receive(soon).unwrap(), None);
    drop(bus);
    // The first C ends a line that an earlier session left incomplete.
    assert_eq!(device.lines, ["C", "C", "V", "S6", "O", "t6050", "C"]);
}

#[test]
fn the_status_flags_tell_the_controllers_state() {
    for (answer, controller) in [
        ("F00\r", Some(Controller::Active)),
        ("t70517F\rF04\r", Some(Controller::Warning)),
        ("FA4\r", Some(Controller::Passive)),
        ("\x07", None),
        ("F1\r", None),
        ("", None),
    ] {
        let mut device = Device::new(lawicel);
        let mut bus = open(&mut device, None).unwrap();
        bus.line.sends(answer, 0);
        bus.line.answers = None;
        assert_eq!(bus.health().and_then(|health| health.controller), controller, "{answer:?}");
        // A frame that arrives meanwhile is not lost.
        assert_eq!(bus.receive(Duration::ZERO).unwrap().is_some(), answer.starts_with('t'));
    }
}

/// The port is opened while the adapter sends a frame.
#[test]
fn the_rest_of_a_frame_costs_no_second_attempt() {
    let mut device = Device::restarts(quiet, 0, b"7F00\rt70517F\r");
    assert!(open(&mut device, Some(125_000)).is_ok());
    assert_eq!(device.lines, ["C", "C", "V", "V", "S4", "O", "C"]);
}

/// The frames of this tool are not those of another one.
#[test]
fn an_echo_is_no_frame_of_the_bus() {
    let mut device = Device::new(echoes);
    let mut bus = open(&mut device, None).unwrap();
    bus.send(&frame(0x605, &[0x40])).unwrap();
    bus.send(&frame(0x605, &[0x60])).unwrap();
    bus.line.sends("t5851FF\r", 2);
    assert_eq!(bus.receive(ms(20)).unwrap(), Some(frame(0x585, &[0xFF])));
    // Another tool sends the same.
    bus.line.sends("t605140\r", 0);
    assert_eq!(bus.receive(ms(20)).unwrap(), Some(frame(0x605, &[0x40])));
    assert_eq!(bus.receive(ms(20)).unwrap(), None);
}

/// Sends sub-blocks of an SDO block download; returns what has reached the bus, the time, and what was refused.
fn sub_blocks(queue: Queue, rate: u32, latency: u64, baud: u32) -> (Vec<String>, Duration, u32) {
    let mut device = Device { queue: Some(queue), ..Device::new(nothing) };
    (device.latency, device.byte) = (Duration::from_micros(latency), Duration::from_secs(10) / baud);
    let mut bus = open(&mut device, Some(rate)).unwrap();
    let begun = bus.line.now;
    for segment in 0..8 * 127_u32 {
        let [.., high, low] = segment.to_be_bytes();
        bus.send(&frame(0x605, &[high, low, 2, 3, 4, 5, 6, 7])).unwrap();
        if segment % 127 == 126 {
            // The device answers when it has all of them.
            bus.settle().unwrap();
            let end = bus.line.queue.as_ref().unwrap().ends.back().copied().unwrap_or_default();
            bus.line.now = bus.line.now.max(end) + ms(1);
        }
    }
    let (time, refused) = (bus.line.now - begun, bus.losses().refused);
    drop(bus);
    (device.queue.unwrap().bus, time, refused)
}

/// What fits into the queue while an answer is on the way (USB takes 1 ms, some converters 16 ms) keeps the bus
/// busy, also where other nodes take it for some ms of each period.
#[test]
fn a_refused_frame_is_sent_again_in_its_order() {
    let sent: Vec<String> = (0..8 * 127).map(|segment| format!("t6058{segment:04X}020304050607")).collect();
    for (rate, latency, baud, shortest) in [
        (125_000, 100, 12_000_000, 3),
        (1_000_000, 100, 12_000_000, 3),
        (125_000, 1_000, 12_000_000, 3),
        (500_000, 1_000, 12_000_000, 16),
        (125_000, 16_000, 3_000_000, 64),
        (125_000, 1_000, 1_000_000, 3),
        (125_000, 1_000, 115_200, 3),
        (125_000, 1_000, 57_600, 3),
    ] {
        for others in [(100, 0), (20, 4), (100, 10), (100, 30), (300, 30)] {
            let queue = |size| Queue {
                others: (ms(others.0), ms(others.1)),
                ..Queue::new(size, Duration::from_secs(125) / rate)
            };
            let (all, free, none) = sub_blocks(queue(10_000), rate, latency, baud);
            assert_eq!((&all, none), (&sent, 0));
            for size in [3, 16, 64].into_iter().filter(|size| *size >= shortest) {
                let (mut bus, time, refused) = sub_blocks(queue(size), rate, latency, baud);
                // A frame that was on its way when the one before was refused.
                let late = bus.iter().zip(&sent).filter(|(there, sent)| there != sent).count();
                let ratio = time.as_secs_f64() / free.as_secs_f64();
                let at = format!("{size} frames, {rate} bit/s, {latency} us, {baud} baud, others {others:?}");
                let at = format!("{at}: {refused} refused, {late} late, {ratio:.2} of the time");
                let is_alone = others.1 == 0;
                // What a slow line cannot send while others have the bus is lost.
                assert!(ratio <= if is_alone || baud >= 1_000_000 { 1.3 } else { 1.5 }, "{at}");
                assert!(refused <= sent.len() as u32 / if is_alone { 20 } else { 4 }, "{at}");
                assert!(late <= 30 || !is_alone, "{at}");
                bus.sort();
                assert_eq!(bus, sent, "{at}");
            }
        }
    }
}

/// A restart closes the bus: all frames are refused, and some adapters greet.
#[test]
fn an_adapter_that_has_restarted_is_opened_again() {
    for text in ["", "\r\nCAN init ok!\r\n"] {
        let mut device = Device::queue(3, ms(1));
        let mut bus = open(&mut device, Some(125_000)).unwrap();
        bus.send(&frame(0x605, &[0x40])).unwrap();
        assert_eq!((bus.receive(ms(20)).unwrap(), bus.losses()), (None, Losses::default()));
        let lines = bus.line.lines.len();
        bus.line.queue.as_mut().unwrap().open = false;
        bus.line.sends(text, 0);
        assert_eq!(bus.receive(ms(100)).unwrap(), None);
        bus.send(&frame(0x605, &[0x60])).unwrap();
        assert_eq!(bus.receive(ms(500)).unwrap(), None);
        assert_eq!(bus.losses().restarts, 1, "{text:?}");
        assert_eq!(bus.losses().refused > 0, text.is_empty(), "{text:?}");
        let advice = bus.health().unwrap().advice().unwrap();
        assert!(advice.contains("restarted once, and its bus was opened again"), "{advice}");
        drop(bus);
        let again = &device.lines[lines..];
        assert!(again.iter().any(|line| line == "S4"), "{again:?}");
        assert_eq!(device.queue.unwrap().bus, ["t605140", "t605160"], "{text:?}");
    }
    // One that acknowledges nothing may say anything: it has restarted if no frame follows.
    let mut device = Device::new(quiet);
    let mut bus = open(&mut device, Some(125_000)).unwrap();
    for (text, restarts) in
        [("tx done\rt70517F\r", 0), ("USB CAN v1\r", 0), ("\rt70517F\r", 0), ("USB CAN v1\r", 1)]
    {
        bus.line.sends(text, 0);
        while bus.receive(ms(200 + 1_000 * restarts)).unwrap().is_some() {}
        assert_eq!(u64::from(bus.losses().restarts), restarts, "{text}");
    }
    // Its frames need no answers. It drops what does not fit into its queue: they come as the bus takes them.
    let now = bus.line.now;
    for _ in 0..500 {
        bus.send(&frame(0x605, &[0x60])).unwrap();
    }
    let took = (bus.line.now - now).as_micros() / 888;
    assert_eq!((took, bus.losses().lost), (500 - 6, 0), "frames of 111 bits at 125 kbit/s");
}

/// Nobody acknowledges on the bus, so its queue stays full.
#[test]
fn an_adapter_that_goes_on_to_refuse_is_stuck() {
    let mut device = Device::queue(3, Duration::from_secs(9999));
    let mut bus = open(&mut device, Some(125_000)).unwrap();
    for _ in 0..4 {
        bus.send(&frame(0x605, &[0x40])).unwrap();
    }
    let error = bus.receive(ms(5_000)).unwrap_err();
    assert!(matches!(error, AdapterError::Stuck { .. }), "{error}");
    assert!(error.advice().contains("no other node acknowledges"), "{}", error.advice());
    assert!((bus.losses().refused > 10) && bus.losses().restarts == 0, "{:?}", bus.losses());
    assert!(bus.line.now < ms(5_000), "{:?}", bus.line.now);
}

/// The answers wait in the line until the computer wakes; a queue that was full has room then.
#[test]
fn an_hour_of_sleep_is_no_silence_of_the_adapter() {
    let mut device = Device::queue(3, ms(1));
    let mut bus = open(&mut device, Some(125_000)).unwrap();
    for _ in 0..50 {
        for _ in 0..5 {
            bus.send(&frame(0x605, &[0x40])).unwrap();
        }
        bus.line.now += Duration::from_secs(3600);
    }
    bus.settle().unwrap();
    assert_eq!((bus.losses().lost, bus.losses().restarts), (0, 0));
    drop(bus);
    assert_eq!(device.queue.unwrap().bus.len(), 250);
    // One that does not answer any more is another matter.
    let mut device = Device::queue(3, ms(1));
    let mut bus = open(&mut device, Some(125_000)).unwrap();
    bus.send(&frame(0x605, &[0x40])).unwrap();
    bus.settle().unwrap();
    bus.line.queue = None;
    bus.send(&frame(0x605, &[0x40])).unwrap();
    assert_eq!((bus.receive(ms(2_000)).unwrap(), bus.losses().lost), (None, 1));
}

/// An adapter that becomes something else in the middle of a session: a gateway, a boot loader, a modem.
#[test]
fn an_adapter_that_becomes_something_else_is_told() {
    for answers in
        [(|_, _| "[1] OK\r\n".to_string()) as Answers, modem_without_echo, |_, _| "< ok >\r".into()]
    {
        let mut device = Device::new(lawicel);
        let mut bus = open(&mut device, None).unwrap();
        bus.send(&frame(0x605, &[0x40])).unwrap();
        assert_eq!(bus.receive(ms(20)).unwrap(), None);
        let strange = bus.health().map_or(0, |health| health.strange);
        assert_eq!(strange, 0, "acknowledgements are of the protocol");
        bus.line.answers = Some(answers);
        for _ in 0..3 {
            bus.send(&frame(0x605, &[0x40])).unwrap();
            assert_eq!(bus.receive(ms(20)).unwrap(), None);
        }
        let health = bus.health().unwrap();
        assert!(health.strange >= 3, "{health:?}");
        let advice = health.advice().unwrap();
        assert!(advice.contains("not of its protocol") && advice.contains("URL of the bus"), "{advice}");
    }
}

#[test]
fn a_line_that_is_too_long_is_skipped_and_the_session_goes_on() {
    let mut device = Device::new(lawicel);
    let mut bus = open(&mut device, None).unwrap();
    let long = |len| "t70517F".repeat(len);
    // As long as a CAN FD frame; longer than any buffer; a frame may follow in the same line's end.
    for line in [long(10), long(5000), format!("d0058{}", "00".repeat(64)), "x\x07".repeat(100)] {
        bus.line.sends(&format!("{line}\rt70517F\r"), 0);
        assert_eq!(bus.receive(ms(100)).unwrap(), Some(frame(0x705, &[0x7F])), "{}", line.len());
        assert_eq!(bus.receive(ms(100)).unwrap(), None, "{}", line.len());
    }
}

#[test]
fn waiting_ends_beside_a_flood() {
    let mut device = Device::new(lawicel);
    let mut bus = open(&mut device, None).unwrap();
    for flood in [&b"xxxxxxxxxxxxxxxxxxxxx"[..], b"xx\r", b"\r\x07"] {
        let before = bus.line.now;
        (bus.line.says, bus.line.next, bus.line.period) = (flood, before, Some(Duration::from_micros(1)));
        assert_eq!(bus.receive(ms(5)).unwrap(), None, "{flood:?}");
        assert!(bus.line.now < before + ms(50), "{flood:?}: {:?}", bus.line.now - before);
        bus.line.says = b"";
    }
}

proptest! {
    #[test]
    fn any_text_is_a_frame_or_not(text in "[tTrRzZ][0-9A-Fa-f]{0,30}") {
        if let Some(frame) = parse_frame(text.as_bytes()) {
            let again = text_of(&frame);
            prop_assert_eq!(parse_frame(again.trim_end().as_bytes()), Some(frame));
        }
    }
}
