//! The texts of the protocol, without any socket: what linux-can/socketcand's `doc/protocol.md`
//! describes, modes NO_BUS, BCM (sending only) and RAW.

use crate::frame::{ExtendedId, Frame, Id, StandardId};
use crate::time::Time;

/// The longest element that is looked at; the longest meaningful one has some 60 characters.
pub const MAX_ELEMENT: usize = 512;
/// The longest name of a bus.
const MAX_BUS_NAME: usize = 16;

/// Cuts the bytes of a connection into elements, `< … >`. Anything between elements is skipped.
#[derive(Clone, Debug, Default)]
pub struct Splitter {
    element: Vec<u8>,
    inside: bool,
    too_long: bool,
}

/// An invalid element.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BadElement {
    /// More than [`MAX_ELEMENT`] bytes.
    TooLong,
    /// Something that is not printable ASCII.
    NotText,
}

impl Splitter {
    /// Takes one byte; gives the text between the brackets when this byte completes it.
    pub fn push(&mut self, byte: u8) -> Option<Result<String, BadElement>> {
        match byte {
            b'<' => {
                self.element.clear();
                (self.inside, self.too_long) = (true, false);
                None
            }
            b'>' if self.inside => {
                self.inside = false;
                if self.too_long {
                    return Some(Err(BadElement::TooLong));
                }
                let printable = self.element.iter().all(|byte| (b' '..=b'~').contains(byte));
                let text = String::from_utf8(std::mem::take(&mut self.element)).ok();
                Some(text.filter(|_| printable).ok_or(BadElement::NotText))
            }
            _ if !self.inside => None,
            _ if self.element.len() == MAX_ELEMENT => {
                self.too_long = true;
                None
            }
            // Line ends and tabs separate words as blanks do.
            b'\r' | b'\n' | b'\t' => {
                self.element.push(b' ');
                None
            }
            _ => {
                self.element.push(byte);
                None
            }
        }
    }
}

/// The mode of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// No bus is open.
    NoBus,
    /// A bus is open; frames can be sent.
    Bcm,
    /// Frames can be sent and come in.
    Raw,
}

/// The action that an element requires of the server besides the answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Nothing.
    None,
    /// Put this frame onto the bus.
    Send(Frame),
    /// Frames go to the client from now on.
    StartFrames,
    /// ... and no longer.
    StopFrames,
    /// End the connection once the answer is out.
    Close,
}

/// The result of an element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reaction {
    /// Text for the client.
    pub answer: Option<String>,
    /// The rest.
    pub effect: Effect,
}

impl Reaction {
    fn answer(text: &str) -> Self {
        Self { answer: Some(text.into()), effect: Effect::None }
    }

    fn error(text: &str) -> Self {
        Self { answer: Some(format!("< error {text} >")), effect: Effect::None }
    }

    fn ok(effect: Effect) -> Self {
        Self { answer: Some("< ok >".into()), effect }
    }
}

/// The first text of the server.
pub const HELLO: &str = "< hi >";

/// One connection, as the protocol sees it.
#[derive(Clone, Debug)]
pub struct Session {
    mode: Mode,
    bus: String,
}

impl Session {
    /// A connection to a server that has one bus of this name.
    #[must_use]
    pub fn new(bus: &str) -> Self {
        Self { mode: Mode::NoBus, bus: bus.into() }
    }

    /// The mode of the connection.
    #[must_use]
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Handles one element.
    pub fn handle(&mut self, element: Result<&str, BadElement>) -> Reaction {
        let text = match element {
            Ok(text) => text,
            Err(BadElement::TooLong) => {
                return Reaction::error(&format!("element is longer than {MAX_ELEMENT} characters"))
            }
            Err(BadElement::NotText) => return Reaction::error("element is not printable ASCII"),
        };
        let mut words = text.split_ascii_whitespace();
        let command = words.next().unwrap_or("");
        let rest: Vec<&str> = words.collect();
        match (command, self.mode, &rest[..]) {
            ("open", Mode::NoBus, [bus]) if *bus == self.bus => {
                self.mode = Mode::Bcm;
                Reaction::ok(Effect::None)
            }
            ("open", Mode::NoBus, [bus]) if bus.len() <= MAX_BUS_NAME => Reaction {
                answer: Some(format!("< error there is no bus {bus}, only {} >", self.bus)),
                effect: Effect::Close,
            },
            ("open", Mode::NoBus, _) => Reaction {
                answer: Some(format!("< error open needs the name of a bus: open {} >", self.bus)),
                effect: Effect::Close,
            },
            ("open", ..) => Reaction::error("the bus is open already"),
            ("echo", _, []) => Reaction::answer("< echo >"),
            (_, Mode::NoBus, _) => Reaction::error(&format!("open a bus first: open {}", self.bus)),
            ("rawmode", _, []) => {
                self.mode = Mode::Raw;
                Reaction::ok(Effect::StartFrames)
            }
            ("bcmmode", _, []) => {
                self.mode = Mode::Bcm;
                Reaction::ok(Effect::StopFrames)
            }
            ("send", _, rest) => send(parse_data_frame(rest)),
            ("sendrtr", _, rest) => send(parse_remote_frame(rest)),
            (
                "add" | "update" | "delete" | "filter" | "muxfilter" | "subscribe" | "unsubscribe"
                | "controlmode" | "isotpmode" | "statistics",
                ..,
            ) => Reaction::error(&format!("{command} is not supported here, use rawmode and send")),
            _ => Reaction::error("unknown command"),
        }
    }
}

fn send(frame: Result<Frame, String>) -> Reaction {
    match frame {
        Ok(frame) => Reaction { answer: None, effect: Effect::Send(frame) },
        Err(text) => Reaction::error(&text),
    }
}

/// Identifiers of eight digits have 29 bits, shorter ones 11.
fn parse_id(word: &str) -> Result<Id, String> {
    let hex = !word.is_empty() && word.len() <= 8 && word.bytes().all(|byte| byte.is_ascii_hexdigit());
    let number = u32::from_str_radix(word, 16).ok().filter(|_| hex);
    let number = number.ok_or("the identifier is not a hexadecimal number of at most eight digits")?;
    if word.len() == 8 {
        let id = ExtendedId::new(number).map(Id::Extended);
        return id.ok_or_else(|| "the identifier has more than 29 bits".into());
    }
    let id = u16::try_from(number).ok().and_then(StandardId::new).map(Id::Standard);
    id.ok_or_else(|| "the identifier has more than 11 bits, write eight digits for 29 bits".into())
}

fn parse_dlc(word: &str) -> Result<u8, String> {
    // In decimal as in the daemon, or one hexadecimal digit as from python-can.
    let dlc = match word.as_bytes() {
        [_] => u8::from_str_radix(word, 16).ok(),
        [b'1', digit @ b'0'..=b'5'] => Some(10 + digit - b'0'),
        _ => None,
    };
    dlc.ok_or_else(|| "the data length is not a number from 0 to 15".into())
}

fn parse_byte(word: &str) -> Result<u8, String> {
    let hex = matches!(word.len(), 1 | 2) && word.bytes().all(|byte| byte.is_ascii_hexdigit());
    u8::from_str_radix(word, 16)
        .ok()
        .filter(|_| hex)
        .ok_or_else(|| "a data byte is not one or two hexadecimal digits".into())
}

fn parse_data_frame(words: &[&str]) -> Result<Frame, String> {
    let [id, dlc, data @ ..] = words else {
        return Err("send needs an identifier, a data length and the data: send 601 2 40 00".into());
    };
    let (id, dlc) = (parse_id(id)?, parse_dlc(dlc)?);
    let other = || format!("the data length says {} bytes, there are {}", dlc.min(8), data.len());
    let bytes = data.iter().map(|word| parse_byte(word)).collect::<Result<Vec<u8>, _>>()?;
    Frame::data_frame(id, &bytes).and_then(|frame| frame.with_dlc(dlc)).ok_or_else(other)
}

fn parse_remote_frame(words: &[&str]) -> Result<Frame, String> {
    let [id, dlc] = words else {
        return Err("sendrtr needs an identifier and a data length: sendrtr 701 0".into());
    };
    Frame::remote_frame(parse_id(id)?, parse_dlc(dlc)?).ok_or_else(|| "a data length above 15".into())
}

/// A frame as a client in raw mode gets it. Data bytes are adjacent, as the daemon writes them
/// (its description puts blanks between them), and a frame without data has two blanks before its
/// closing bracket: clients split there.
#[must_use]
pub fn frame_element(at: Time, frame: &Frame) -> String {
    let id = match frame.id() {
        Id::Standard(id) => format!("{:03X}", id.as_raw()),
        Id::Extended(id) => format!("{:08X}", id.as_raw()),
    };
    if frame.is_remote() {
        return format!("< rtr {id} {at} {} >", frame.dlc().min(8));
    }
    let data: String = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
    format!("< frame {id} {at} {data} >")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Feeds a whole conversation; returns the answers and the frames to send.
    fn talk(session: &mut Session, text: &[u8]) -> (Vec<String>, Vec<String>) {
        let mut splitter = Splitter::default();
        let (mut answers, mut sent) = (Vec::new(), Vec::new());
        for element in text.iter().filter_map(|byte| splitter.push(*byte)) {
            let reaction = session.handle(element.as_deref().map_err(|bad| *bad));
            answers.extend(reaction.answer);
            match reaction.effect {
                Effect::Send(frame) => sent.push(frame.to_string()),
                Effect::None => {}
                effect => sent.push(format!("{effect:?}")),
            }
        }
        (answers, sent)
    }

    fn raw() -> Session {
        let mut session = Session::new("can0");
        talk(&mut session, b"< open can0 >< rawmode >");
        session
    }

    #[test]
    fn the_conversation_of_the_description() {
        let mut session = Session::new("can0");
        assert_eq!(talk(&mut session, b"< open can0 >"), (vec!["< ok >".into()], vec![]));
        assert_eq!(session.mode(), Mode::Bcm);
        // The two examples of "Send a single frame".
        let (answers, sent) = talk(&mut session, b"< send 123 0 >< send 1AAAAAAA 2 1 F1 >");
        assert_eq!(answers, Vec::<String>::new());
        assert_eq!(sent, ["123#", "1AAAAAAA#01F1"]);
        let (_, sent) = talk(&mut session, b"< sendrtr 123 0 >< sendrtr 1AAAAAAA 2 >");
        assert_eq!(sent, ["123#R", "1AAAAAAA#R2"]);
        assert_eq!(
            talk(&mut session, b"< rawmode >"),
            (vec!["< ok >".into()], vec!["StartFrames".to_string()])
        );
        assert_eq!(session.mode(), Mode::Raw);
        assert_eq!(talk(&mut session, b"< echo >"), (vec!["< echo >".into()], vec![]));
        assert_eq!(
            talk(&mut session, b"< bcmmode >"),
            (vec!["< ok >".into()], vec!["StopFrames".to_string()])
        );
    }

    #[test]
    fn what_python_can_sends() {
        // Bytes without leading zero, data length in hexadecimal, and a DLC of 0 leaves two blanks.
        let (answers, sent) =
            talk(&mut raw(), b"< send 601 8 40 0 10 0 0 0 0 0 >< send 080 0  >< send 00000080 1 a >");
        assert_eq!(answers, Vec::<String>::new());
        assert_eq!(sent, ["601#4000100000000000", "080#", "00000080#0A"]);
        let (_, sent) = talk(&mut raw(), b"< send 601 15 1 2 3 4 5 6 7 8 >< send 601 F 1 2 3 4 5 6 7 8 >");
        assert_eq!(sent, ["601#0102030405060708_F"; 2], "a DLC of 9 to 15 is eight bytes");
    }

    #[test]
    fn elements_arrive_in_pieces_and_with_rubbish_between() {
        let mut session = Session::new("can0");
        let text = b"\r\n< open\tcan0 >\0\xFFxyz<echo>\n <  send 1 1  FF >> > <\nrawmode\n>";
        let (answers, sent) = talk(&mut session, text);
        assert_eq!(answers, ["< ok >", "< echo >", "< ok >"]);
        assert_eq!(sent, ["001#FF", "StartFrames"]);
    }

    #[test]
    fn frames_for_the_client() {
        let at = Time(23_424_242_999_999);
        let frame = Frame::standard(0x123, &[0x11, 0x22, 0x33, 0x44]).unwrap();
        assert_eq!(frame_element(at, &frame), "< frame 123 23.424242 11223344 >");
        assert_eq!(
            frame_element(Time(5_000_000), &Frame::standard(0x80, &[]).unwrap()),
            "< frame 080 0.000005  >"
        );
        assert_eq!(
            frame_element(at, &Frame::extended(0x80, &[0xAB]).unwrap()),
            "< frame 00000080 23.424242 AB >"
        );
        let remote = Frame::remote_frame(frame.id(), 4).unwrap();
        assert_eq!(frame_element(at, &remote), "< rtr 123 23.424242 4 >");
    }

    #[test]
    fn bad_elements_get_an_error_and_nothing_is_sent() {
        for (text, words) in [
            (&b"< >"[..], "unknown command"),
            (b"< nonsense >", "unknown command"),
            (b"< echo echo >", "unknown command"),
            (b"< open can0 >", "already"),
            (b"< send >", "send needs"),
            (b"< send 601 >", "send needs"),
            (b"< send 601 1 >", "says 1 bytes, there are 0"),
            (b"< send 601 1 40 00 >", "there are 2"),
            (b"< send 601 9 1 2 3 4 5 6 7 8 9 >", "says 8 bytes, there are 9"),
            (b"< send 601 16 1 2 3 4 5 6 7 8 >", "0 to 15"),
            (b"< send 601 -1 >", "0 to 15"),
            (b"< send 601 1 100 >", "data byte"),
            (b"< send 601 1 +1 >", "data byte"),
            (b"< send 800 0 >", "11 bits"),
            (b"< send 20000000 0 >", "29 bits"),
            (b"< send 123456789 0 >", "hexadecimal"),
            (b"< send +1 0 >", "hexadecimal"),
            (b"< send xyz 0 >", "hexadecimal"),
            (b"< sendrtr 1 16 >", "0 to 15"),
            (b"< sendrtr 1 >", "sendrtr needs"),
            (b"< subscribe 0 0 123 >", "not supported"),
            (b"< s\xE9nd 601 0 >", "ASCII"),
        ] {
            let (answers, sent) = talk(&mut raw(), text);
            assert_eq!((answers.len(), sent.len()), (1, 0), "{}", String::from_utf8_lossy(text));
            assert!(answers[0].starts_with("< error ") && answers[0].ends_with(" >"), "{answers:?}");
            assert!(answers[0].contains(words), "{answers:?}");
        }
    }

    #[test]
    fn an_endless_element_is_refused_and_forgotten() {
        let mut text = b"< send ".to_vec();
        text.extend(vec![b'1'; 5_000_000]);
        text.extend(b" >< echo >");
        let mut session = raw();
        let (answers, _) = talk(&mut session, &text);
        assert_eq!(answers.len(), 2);
        assert!(answers[0].contains("longer than"));
        assert_eq!(answers[1], "< echo >");
    }

    #[test]
    fn nothing_works_before_a_bus_is_open() {
        for text in [&b"< send 601 0 >"[..], b"< rawmode >", b"< bcmmode >"] {
            let (answers, sent) = talk(&mut Session::new("can0"), text);
            assert_eq!((answers[0].contains("open can0"), sent.len()), (true, 0));
        }
        for text in [&b"< open can1 >"[..], b"< open >", b"< open can0 can1 >", b"< open 12345678901234567 >"]
        {
            let (answers, sent) = talk(&mut Session::new("can0"), text);
            assert!(answers[0].starts_with("< error "));
            assert_eq!(sent, ["Close"]);
        }
    }
}
