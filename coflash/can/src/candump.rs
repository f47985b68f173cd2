//! Logs in the format of `candump -L` of the Linux can-utils: `(1436509052.249713) can0
//! 044#2A366C2BBA`.

use std::time::Duration;

use canopen::Frame;
use embedded_can::{ExtendedId, Frame as _, Id, StandardId};

use super::digits::{decimal, hex_bytes, hex_number};

/// A line of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Line {
    /// When, on the log's clock.
    pub time: Duration,
    /// The name of the interface.
    pub interface: String,
    /// The frame.
    pub frame: Frame,
}

impl std::fmt::Display for Line {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (seconds, micros) = (self.time.as_secs(), self.time.subsec_micros());
        write!(f, "({seconds:010}.{micros:06}) {} {}", self.interface, self.frame)
    }
}

impl Line {
    /// Parses a line. `Ok(None)` for a line without a classic frame: an empty line, a comment, a
    /// CAN FD frame or an error frame.
    ///
    /// # Errors
    /// What is wrong with the line.
    pub fn parse(line: &str) -> Result<Option<Self>, &'static str> {
        let mut words = line.split_ascii_whitespace();
        let Some(time) = words.next() else { return Ok(None) };
        if time.starts_with('#') {
            return Ok(None);
        }
        let time = time.strip_prefix('(').and_then(|time| time.strip_suffix(')'));
        let time =
            time.and_then(parse_time).ok_or("it does not begin with a time, like (1436509052.249713)")?;
        let interface = words.next().ok_or("it names no interface")?;
        let frame = words.next().ok_or("it has no frame")?;
        // candump can append the direction, R or T.
        let Some(frame) = parse_frame(frame)? else { return Ok(None) };
        Ok(Some(Self { time, interface: interface.to_string(), frame }))
    }
}

fn parse_time(text: &str) -> Option<Duration> {
    let (seconds, fraction) = text.split_once('.')?;
    let nanos: u32 = decimal(fraction).filter(|_| fraction.len() <= 9)?;
    let nanos = nanos * 10u32.pow(9 - fraction.len() as u32);
    // A time after the year 9999 is invalid.
    let seconds = decimal(seconds).filter(|seconds: &u64| *seconds < 1 << 38)?;
    Some(Duration::new(seconds, nanos))
}

/// `601#4000100000000000`, `601#40.00.10`, `12345678#`, `601#R`, `601#R8`; after eight bytes, or `R8`, there may
/// be a data length code above 8: `601#R8_C` (can-utils, `lib.h`).
fn parse_frame(text: &str) -> Result<Option<Frame>, &'static str> {
    const NO_FRAME: &str = "it has no frame, like 601#4000100000000000";
    let (id, data) = text.split_once('#').ok_or(NO_FRAME)?;
    if data.starts_with('#') {
        return Ok(None);
    }
    let number = hex_number(id).ok_or(NO_FRAME)?;
    let id: Id = match id.len() {
        3 => StandardId::new(number as u16).ok_or("its identifier has more than 11 bits")?.into(),
        8 if number & 0x2000_0000 != 0 => return Ok(None),
        8 => ExtendedId::new(number & 0x1FFF_FFFF).ok_or(NO_FRAME)?.into(),
        _ => return Err("its identifier has neither 3 nor 8 digits"),
    };
    let (data, code) = data.split_once('_').map_or((data, None), |(data, code)| (data, Some(code)));
    let frame = match data.strip_prefix(['R', 'r']) {
        Some("") => Frame::new_remote(id, 0),
        Some(dlc) => Frame::new_remote(id, dlc.parse().map_err(|_| NO_FRAME)?),
        None => {
            let bytes = hex_bytes(&data.replace('.', ""));
            Frame::new(id, &bytes.ok_or("its data are not pairs of hexadecimal digits")?)
        }
    };
    let frame = frame.ok_or("a frame has at most 8 bytes")?;
    match code.map(hex_number) {
        Some(code) if frame.dlc() < 8 || !matches!(code, Some(9..=15)) => {
            Err("its data length code is not one of 9 to F for eight bytes")
        }
        _ => Ok(Some(frame)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The examples of the can-utils' man pages.
    #[test]
    fn lines_are_those_of_candump() {
        let text = "(1436509052.249713) vcan0 044#2A366C2BBA";
        let line = Line::parse(text).unwrap().unwrap();
        assert_eq!(
            (line.time, line.interface.as_str()),
            (Duration::new(1_436_509_052, 249_713_000), "vcan0")
        );
        assert_eq!(line.frame.data(), [0x2A, 0x36, 0x6C, 0x2B, 0xBA]);
        assert_eq!(line.to_string(), text);
        for same in ["(0000000000.000000) can0 12345678#", "(0000000001.500000) can0 601#R8"] {
            assert_eq!(Line::parse(same).unwrap().unwrap().to_string(), same);
        }
        assert!(Line::parse("(1.5) can0 601#R T").unwrap().unwrap().frame.is_remote_frame());
        // Examples of can-utils' lib.h.
        for (form, frame) in [
            ("123#R8_E", "123#R8"),
            ("701#R8_C", "701#R8"),
            ("333#1122334455667788_9", "333#1122334455667788"),
            ("5A1#11.2233.44556677.88_f", "5A1#1122334455667788"),
            ("123#r2", "123#R2"),
        ] {
            let line = Line::parse(&format!("(1.5) can0 {form}")).unwrap().unwrap();
            assert_eq!(line.frame.to_string(), frame);
        }
        for none in
            ["", "   ", "# a comment", "(1.0) can0 123##1112233", "(1.0) can0 20000004#0000000000000000"]
        {
            assert_eq!(Line::parse(none), Ok(None), "{none}");
        }
        const BAD: &str = "x|1.0 can0 601#|(1) can0 601#|(a.b) can0 601#|(1.0)|(1.0) can0|(1.0) can0 601|\
            (1.0) can0 60#|(1.0) can0 FFF#|(1.0) can0 601#1|(1.0) can0 601#xx|(1.0) can0 601#+1|\
            (1.0) can0 +12#|(1.0) can0 601#112233445566778899|(1.0) can0 601#R9|(1.0) can0 601#R8_8|\
            (1.0) can0 601#1122_C|(1.0) can0 601#1122334455667788_10|(1.0) can0 601#\u{e9}|\
            (99999999999999999999.0) can0 601#|(1.9999999999) can0 601#";
        for bad in BAD.split('|') {
            assert!(Line::parse(bad).is_err(), "{bad}");
        }
    }

    proptest! {
        #[test]
        fn any_line_is_read_or_refused(line in "[(0-9.)]{0,14} ?[a-z0-9]{0,4} ?[0-9A-F]{0,9}#?[0-9A-FR#_]{0,18}") {
            if let Ok(Some(read)) = Line::parse(&line) {
                prop_assert_eq!(Line::parse(&read.to_string()).unwrap().unwrap().frame, read.frame);
            }
        }
    }
}
